"""Fuzzes the readers of foreign files by hand, for as long as one likes, and prints how many cases each had.

    python tests/fuzz/run.py [READER ...] [--cases 10000] [--seconds 60] [--coverage] [--keep FOLDER]

A case is a whole file with one to four things wrong (`damage.py`), read as a command would read it (`readers.py`).
What is no documented error is a finding: another exception, an error that nobody has foreseen, one of memory, a crash,
a case that takes longer than 20 s. Its file is kept in FOLDER, called like the reader and the number of the case; the
same READER, seed and number make it again. By `--coverage` Atheris (libFuzzer) chooses what to damage further, by which
lines of ours and of some readers in Python that we call a case reaches; else cases are independent of each other.
Each reader works in a process of its own, which is replaced when it dies (Linux).
"""

import argparse
import collections
import contextlib
import datetime
import faulthandler
import json
import mmap
import multiprocessing
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

import mi_ring  # noqa: F401  (chooses LLVM before Dr.Jit is imported)

# isort: split
import drjit as dr

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

SLOWEST = 20  #: seconds that a case may take
PATIENCE = 0.2  #: seconds that a native reader may take, which needs some ms for whole files
ROOM = 2 * 2**30  #: bytes that a case may ask for
LIFE = 50_000  #: cases of a process, which Mitsuba's objects outlive
ALIKE = 3  #: findings of one kind of which the files are kept
GUIDING = (
    "mi_ring.importers", "mi_ring.capture", "mi_ring.objects.ring_file", "mi_ring.images",
    "mi_ring.photogrammetry.folder",
    "mi_ring.foreign", "tifffile", "zipfile", "json", "csv",
)  # fmt: skip


class Bench:
    """A reader, and what is found while it reads, in a process of its own."""

    def __init__(self, name: str, keep: Path, count: mmap.mmap) -> None:
        from readers import READERS

        self.name, self.keep, self.count = name, keep, count
        memory = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(prefix="mi_ring-fuzz-", dir=memory if memory.is_dir() else None))
        self.reader = READERS[name](self.folder)
        self.whole = [file.read_bytes() for file in self.reader.files]
        self.kinds: collections.Counter = collections.Counter()
        self.number, self.refused = (int.from_bytes(count[place : place + 8], "little") for place in (0, 8))
        with contextlib.suppress(ValueError, OSError):
            held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_DATA, (held + ROOM, resource.RLIM_INFINITY))

    def case(self, k: int, content: bytes) -> None:
        """Read with this in the place of file k."""
        from readers import beyond

        from mi_ring.errors import InputError

        file = self.reader.files[k]
        file.write_bytes(content)
        faulthandler.dump_traceback_later(SLOWEST, exit=True)
        try:
            self.reader.read()
        except InputError as error:
            self.refused += 1
            if why := beyond(error):
                self.found(k, content, error.__cause__ or error, why)
        except Exception as error:
            self.found(k, content, error, str(error))
        finally:
            faulthandler.cancel_dump_traceback_later()
            file.write_bytes(self.whole[k])
        self.number += 1
        self.count[:16] = self.number.to_bytes(8, "little") + self.refused.to_bytes(8, "little")

    def found(self, k: int, content: bytes, error: BaseException, why: str) -> None:
        """Note what is no documented error; of each place that it comes from some."""
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f for f in frames if "mi_ring" in f.filename and Path(f.filename).parent != HERE]
        kind = f"{type(error).__name__} at {Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else repr(error)
        self.kinds[kind] += 1
        if self.kinds[kind] <= ALIKE:
            path = self.keep / f"{self.name}-{self.number}-{self.reader.files[k].name}"
            path.write_bytes(content)
            note(self.keep / f"{self.name}.jsonl", kind, why, path)


def note(log: Path, kind: str, why: str, path: Path) -> None:
    """Add a finding to the log."""
    with log.open("a") as file:
        file.write(json.dumps({"kind": kind, "why": " ".join(why.split())[:300], "file": str(path)}) + "\n")


def work(bench: Bench, options: argparse.Namespace, seconds: float) -> None:
    """Read case after case."""
    from damage import damaged

    until, last = time.monotonic() + seconds, min(options.cases, bench.number + LIFE)
    if options.coverage:
        guided(bench, last, until, options.seed)
    while bench.number < last and time.monotonic() < until:
        random = Random(f"{options.seed}/{bench.name}/{bench.number}")
        k = random.randrange(len(bench.whole))
        bench.case(k, damaged(bench.whole[k], bench.reader.files[k].name, random))


def guided(bench: Bench, last: int, until: float, seed: int) -> None:
    """Have libFuzzer choose. What it changes is the number of a file and its content. It does not return."""
    import atheris
    from damage import damaged

    corpus = bench.folder / "corpus"
    corpus.mkdir()
    for k, content in enumerate(bench.whole):
        (corpus / str(k)).write_bytes(bytes([k]) + content)

    def one(data: bytes) -> None:
        if data:
            bench.case(data[0] % len(bench.whole), data[1:])
        if bench.number >= last or time.monotonic() > until:
            shutil.rmtree(bench.folder, ignore_errors=True)
            os._exit(0)  # by its own end libraries in C++ would be taken down while they work

    def mutated(data: bytes, largest: int, seed: int) -> bytes:
        k = data[0] % len(bench.whole) if data else 0
        return (bytes([k]) + damaged(data[1:], bench.reader.files[k].name, Random(seed)))[:largest]

    flags = ["-max_len=1048576", f"-seed={seed + bench.number + 1}", f"-timeout={2 * SLOWEST}", "-rss_limit_mb=8192",
             f"-artifact_prefix={bench.keep}/"]  # fmt: skip
    atheris.Setup([sys.argv[0], *flags, str(corpus)], one, custom_mutator=mutated)
    atheris.Fuzz()


def fuzz(name: str, options: argparse.Namespace, keep: Path) -> tuple[int, int, list[dict], float]:
    """Cases of a reader, how many of them were refused, findings, and seconds."""
    log, words, start, number = keep / f"{name}.jsonl", keep / f"{name}.txt", time.monotonic(), 0
    log.write_text("")
    count = mmap.mmap(-1, 16)
    while number < options.cases and (left := options.seconds - (time.monotonic() - start)) > 0:
        if not (child := os.fork()):
            child_of(name, options, keep, count, words, left)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        before, number = number, int.from_bytes(count[:8], "little")
        if status:
            text = words.read_text(errors="replace")
            kind = "takes too long" if "Timeout (" in text else f"ends its process with status {status}"
            note(log, kind, text[-300:], words.rename(keep / f"{name}-{number}.txt"))
            number += 1
            count[:8] = number.to_bytes(8, "little")
        if number == before:
            break
    findings = [json.loads(line) for line in log.read_text().splitlines()]
    return number, int.from_bytes(count[8:], "little"), findings, time.monotonic() - start


class Trials:
    """As much of `subprocess` as `foreign` asks for: one process tries case after case, until one of them ends it.

    A new process for each, as readers have it, takes 100 times as long.
    """

    TimeoutExpired = subprocess.TimeoutExpired

    def __init__(self) -> None:
        self.child, self.pipe = 0, None

    def run(self, command: list[str], timeout: float, **_: object) -> subprocess.CompletedProcess:
        """Run the Python of `python -c PYTHON ARGUMENTS…`."""
        if not self.child:
            self.pipe, own = multiprocessing.Pipe()
            if not (child := os.fork()):
                self.pipe.close()
                self.serve(own)
            self.child = child
            own.close()
        self.pipe.send(command[2:])
        with contextlib.suppress(EOFError):
            if self.pipe.poll(timeout):
                return subprocess.CompletedProcess(command, self.pipe.recv(), "", "cannot be read")
            os.kill(self.child, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(os.waitpid(self.child, 0)[1])
        self.child = 0
        if code == -signal.SIGKILL:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, code, "", "cannot be read")

    @staticmethod
    def serve(pipe: Connection) -> None:
        """The life of the process. Its memory is bounded as the first case asks for."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        while True:
            try:
                sys.argv = pipe.recv()
            except EOFError:
                os._exit(0)
            try:
                exec(sys.argv[0], {})
                pipe.send(0)
            except BaseException:
                pipe.send(1)


def child_of(name: str, options: argparse.Namespace, keep: Path, count: mmap.mmap, words: Path, left: float) -> None:
    """The life of a process that reads."""
    from mi_ring import foreign

    status, bench = 1, None
    with words.open("w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        faulthandler.enable()
        dr.set_thread_count(2)
        foreign.subprocess, foreign.READ_SECONDS = Trials(), PATIENCE
        try:
            bench = Bench(name, keep, count)
            work(bench, options, left)
            status = 0
        except SystemExit as stop:  # libFuzzer is done
            status = stop.code or 0
        except BaseException:
            traceback.print_exc()
        if bench:
            shutil.rmtree(bench.folder, ignore_errors=True)
        sys.stdout.flush()
        os._exit(status)


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", metavar="READER")
    parser.add_argument("--cases", type=int, default=10_000, help="of each reader, at most")
    parser.add_argument("--seconds", type=float, default=60, help="for each reader, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--coverage", action="store_true")
    parser.add_argument("--keep", default="build/fuzz", help="folder of what is found")
    options = parser.parse_args()
    if options.coverage:
        import atheris

        with atheris.instrument_imports(include=list(GUIDING)):
            import readers
    else:
        import readers
    if unknown := {*options.readers} - {*readers.READERS}:
        parser.error(f"{unknown.pop()}: no reader; must be one of {', '.join(readers.READERS)}")
    dr.set_thread_count(0)  # threads do not outlive a fork
    keep = Path(options.keep)
    keep.mkdir(parents=True, exist_ok=True)
    print(f"{platform.machine()}, Python {platform.python_version()}; {datetime.date.today()}; seed {options.seed}\n")
    print("| reader | cases | refused | s | findings |\n|---|---|---|---|---|", flush=True)
    total, kinds = 0, 0
    for name in options.readers or readers.READERS:
        cases, refused, findings, seconds = fuzz(name, options, keep)
        total, kinds = total + cases, kinds + len(findings)
        print(f"| {name} | {cases:,} | {refused:,} | {seconds:.0f} | {len(findings)} |", flush=True)
        for finding in findings:
            print(f"    {finding['kind']}: {finding['why'][:160]} ({finding['file']})", flush=True)
    print(f"\n{total:,} cases, {kinds} findings")
    return 1 if kinds else 0


if __name__ == "__main__":
    sys.exit(main())
