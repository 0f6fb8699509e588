"""The machine that all runs on: cores, threads, files, and how a command ends."""

import errno
import functools
import io
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import mitsuba as mi
import pytest
import torch
from helpers.quick_fits import BRIEF

from mi_ring.doctor import DoctorConfig
from mi_ring.errors import InputError
from mi_ring.fitting import session
from mi_ring.nets import chunks
from mi_ring.system import command, files, gpus, machine, progress


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_quota_of_a_container_by_version_1(tmp_path):
    assert machine.cpu_quota(tmp_path) == float("inf")
    write(tmp_path / "cpu/cpu.cfs_quota_us", "150000\n")
    write(tmp_path / "cpu/cpu.cfs_period_us", "100000\n")
    assert machine.cpu_quota(tmp_path) == 1.5
    write(tmp_path / "cpu/cpu.cfs_quota_us", "-1\n")
    assert machine.cpu_quota(tmp_path) == float("inf")


def test_quota_of_a_container_by_version_2(tmp_path):
    write(tmp_path / "cpu.max", "300000 100000\n")
    assert machine.cpu_quota(tmp_path) == 3
    write(tmp_path / "cpu.max", "max 100000\n")
    assert machine.cpu_quota(tmp_path) == float("inf")
    write(tmp_path / "cpu.max", "nonsense\n")
    assert machine.cpu_quota(tmp_path) == float("inf")


def test_cores_are_at_least_one_and_heed_the_quota(monkeypatch):
    monkeypatch.setattr(machine, "cpu_quota", lambda root: 0.3)
    assert machine.cores() == 1
    monkeypatch.setattr(machine, "cpu_quota", lambda root: float("inf"))
    if hasattr(os, "sched_getaffinity"):
        assert machine.cores() == len(os.sched_getaffinity(0))
        monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS and Windows
    assert machine.cores() == os.cpu_count()


@pytest.mark.parametrize("error", [TypeError, OSError, AttributeError])
def test_where_there_is_no_glibc_memory_is_left_alone(error, monkeypatch):
    def cdll(name):
        raise error("no such library")

    monkeypatch.setattr(machine.ctypes, "CDLL", cdll)
    machine.keep_memory()
    machine.release_memory()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_that_is_kept_can_be_released():
    """Between what stays, where it would otherwise be held as long as the process lives."""
    code = """
import ctypes
import re
from pathlib import Path

import numpy as np
from mi_ring.system import machine

if not hasattr(ctypes.CDLL(None), "malloc_trim"):
    raise SystemExit(3)
held = lambda: int(re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
machine.keep_memory()
before = held()
large, small = [], []
for _ in range(200):
    large.append(np.ones(2**17))
    small.append(np.ones(100))
large.clear()
kept = held()
machine.release_memory()
assert kept > before + 150, (before, kept)
assert held() < before + 50, (before, kept, held())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode == 3:
        pytest.skip("needs glibc")
    assert not done.returncode, done.stderr


def test_workers_are_kept_and_their_one_thread_does_not_spread():
    """Torch takes what a thread sets for the number of all threads started later."""
    torch.set_num_threads(2)
    chunks._pool = None
    names = set()
    for _ in range(3):
        names |= set(chunks.in_parallel(lambda k: threading.current_thread().name, range(8)))
    assert len(names) <= 2 and all(name.startswith("mi_ring") for name in names)
    assert chunks.in_parallel(lambda k: torch.get_num_threads(), [0, 1]) == [1, 1]
    seen = []
    thread = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert seen == [2] and torch.get_num_threads() == 2


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a place where nobody may write, root neither")
def test_where_nothing_can_be_written_nobody_else_is_blamed():
    with pytest.raises(InputError, match="cannot be written"), files.locked(Path("/proc/capture")):
        pass


def test_a_second_fit_into_a_folder_is_refused_while_the_first_writes(tmp_path):
    code = """
import sys, pathlib
from mi_ring.system.files import locked
with locked(pathlib.Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.readline()
"""
    folder = tmp_path / "out" / "pot"
    holder = subprocess.Popen([sys.executable, "-c", code, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"locked\n"
    with pytest.raises(InputError, match="pot: --out: another process is writing there"), files.locked(folder):
        pass
    with files.locked(folder.with_name("other")):
        pass
    holder.kill()
    holder.wait()
    with files.locked(folder):  # a lock goes with its process, however that ends
        pass
    assert not list(folder.parent.iterdir())


def test_names_of_files_that_grow_are_unlike(tmp_path):
    names = {files.partial_path(tmp_path / "ring.pt") for _ in range(100)}
    assert len(names) == 100 and {name.parent for name in names} == {tmp_path}


def ends(main, *arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.fit", main, list(arguments))
    return stop.value.code, capsys.readouterr().err


def test_only_mistakes_of_the_user_are_one_line(capsys, tmp_path):
    def mistaken(arguments):
        raise InputError("pot.xml: no such file")

    def gone(arguments):
        (tmp_path / "gone").read_text()

    assert ends(mistaken, capsys=capsys) == (2, "mi_ring.fit: pot.xml: no such file\n")
    assert ends(gone, capsys=capsys) == (2, f"mi_ring.fit: {tmp_path / 'gone'}: No such file or directory\n")
    with pytest.raises(InputError):
        command.run("mi_ring.fit", mistaken, ["--traceback"])
    for error in (OSError("of ours, without number or file"), ValueError("of ours"), KeyError("of ours")):

        def broken(arguments, error=error):
            raise error

        with pytest.raises(type(error)):
            command.run("mi_ring.fit", broken, [])


def test_traceback_is_no_argument_of_the_command(capsys):
    assert ends(lambda arguments: 0 if arguments == ["a"] else 3, "a", "--traceback", capsys=capsys)[0] == 0


def test_a_reader_that_goes_away_is_no_mistake():
    """`mi-ring fit --help | head -1`."""
    code = (
        "import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-m', 'mi_ring.fit', '--help']).returncode)"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.read(1)
    process.stdout.close()
    assert b"Traceback" not in process.stderr.read()
    process.wait()


class Stream(io.StringIO):
    """Standard output as a file that now and then cannot be written."""

    encoding, trouble = "utf-8", None

    def write(self, text):
        if self.trouble:
            raise OSError(self.trouble, "as if")
        return super().write(text)


def test_what_nobody_reads_is_dropped(tmp_path, monkeypatch):
    """After a full disk the rest is written; after a closed pipe nothing is, not even at the interpreter's end."""
    stream = Stream()
    with (tmp_path / "pipe").open("w") as pipe:
        monkeypatch.setattr(stream, "fileno", pipe.fileno)
        monkeypatch.setattr(sys, "stdout", stream)
        with progress.tolerating_closed_output():
            assert sys.stdout.encoding == "utf-8" and not sys.stdout.isatty()
            print("one")
            stream.trouble = errno.ENOSPC
            print("two")
            stream.trouble = None
            print("three")
            stream.trouble = errno.EPIPE
            print("four")
            assert os.path.samestat(os.fstat(pipe.fileno()), os.stat(os.devnull))
        assert sys.stdout is stream and stream.getvalue() == "one\nthree\n"


@pytest.mark.parametrize(("words", "seen"), [
    (["python", "-u", "-m", "mi_ring.fit", "a.xml"], "7"), (["python", "/bin/mi-ring", "fit", "a.xml"], "7"),
    (["python", "-u", "train.py"], "4,7"),
])  # fmt: skip
def test_fits_that_torchrun_starts_see_one_gpu_each_and_other_programs_all_of_theirs(words, seen, monkeypatch):
    there = {"LOCAL_WORLD_SIZE": "2", "LOCAL_RANK": "1", "CUDA_VISIBLE_DEVICES": "4,7"}
    monkeypatch.setattr(os, "environ", there)
    monkeypatch.setattr(sys, "orig_argv", words)
    gpus.choose_gpu()
    assert there["CUDA_VISIBLE_DEVICES"] == seen and (gpus.OWN in there) == (seen == "7")


def test_with_one_thread_nothing_else_runs_meanwhile(monkeypatch):
    """Reading an EXR changes their number for a moment, which another thread that renders does not survive."""
    where = []

    def seen(*things):
        where.append(threading.get_ident())
        return things

    for count, several in ((1, False), (2, True)):
        monkeypatch.setattr(machine.dr, "thread_count", lambda count=count: count)
        where.clear()
        assert list(machine.pipelined(seen, seen, "ab")) == [("a", ("a",)), ("b", ("b",))]
        assert (len({*where}) > 1) is several


def test_a_signal_is_heard_without_a_word(capsys):
    """It may come while something is being printed, which cannot be begun anew within itself."""
    with session.ending_signals() as heard:
        signal.raise_signal(signal.SIGTERM)
        assert heard() == signal.SIGTERM
    assert "".join(capsys.readouterr()) == ""


@pytest.fixture
def heard_signals():
    """None is ignored, as Ctrl-C is in what a script's shell runs in the background."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_of_which_a_library_makes_an_error_of_its_own_is_one(number, capsys, heard_signals):
    """Mitsuba does where it comes while one of our plugins is made."""
    handler = signal.getsignal(number)
    with pytest.raises(command.Interrupted) as stop, command.resumable():
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt as error:
            raise InputError("scene.xml: failed to instantiate a plugin") from error
    assert command.exit_status(stop.value) == 128 + number and signal.getsignal(number) is handler
    assert capsys.readouterr().err == "interrupted; to continue, give the same command again\n"
    with pytest.raises(InputError, match="no signal"), command.resumable():
        raise InputError("no signal")
    assert not command.interrupted()


def test_a_ctrl_c_of_which_a_library_makes_an_error_ends_a_command_without_a_word(capsys, monkeypatch, heard_signals):
    def main(_):
        command.parse(DoctorConfig, [], "mi_ring.doctor", needs_llvm=False)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            raise RuntimeError("a plugin cannot be made") from error

    monkeypatch.setattr(command, "_received", [])
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # as a command begins
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.doctor", main, [])
    assert stop.value.code == 128 + signal.SIGINT and capsys.readouterr().err == ""


#: Sends Ctrl-C when Mitsuba is about to be imported.
EARLY = """
import os, signal, sys

class Impatient:
    def find_spec(self, name, path=None, target=None):
        if name == "mitsuba":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Impatient())
"""


@pytest.mark.skipif(os.name != "posix", reason="Windows has other signals")
def test_ctrl_c_at_the_start_ends_a_command_without_a_word(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(EARLY)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[1]}"}
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # who starts the tests may ignore it
    for call in (["mi_ring.fit"], ["mi_ring", "fit"]):
        words = [sys.executable, "-m", *call, "scene.xml"]
        done = subprocess.run(words, capture_output=True, env=environment, preexec_fn=listening)
        assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")


@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGPIPE")
def test_a_command_whose_reader_has_gone_says_nothing():
    reading, writing = os.pipe()
    os.close(reading)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "mi_ring.doctor"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, env=environment)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, b"")


def test_help_whose_reader_has_gone_says_nothing(monkeypatch, capsys):
    def helped(_):
        print("help")
        sys.exit(0)

    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        with pytest.raises(SystemExit) as stop:
            command.run("mi_ring.fit", helped, [])
    assert stop.value.code == 141 and capsys.readouterr().err == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has it")
def test_output_to_a_full_disk_is_one_line(monkeypatch, capsys):
    with open("/dev/full", "w") as full:  # whose end would fail again
        monkeypatch.setattr(sys, "stdout", full)
        with pytest.raises(SystemExit) as stop:
            command.run("mi_ring.check", lambda _: print("table"), [])
    assert stop.value.code == 2
    assert capsys.readouterr().err == f"mi_ring.check: standard output, or a file: {os.strerror(errno.ENOSPC)}\n"


def test_a_command_without_streams_works(monkeypatch):
    """As after `<&- >&- 2>&-`, where Python has none."""

    def talks(_):
        print("table")
        print("found", file=sys.stderr)
        assert sys.stdin.read() == ""

    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.check", talks, [])
    assert stop.value.code == 0


def test_an_exr_is_written_and_read_on_a_single_thread(tmp_path):
    """In a process of its own: Mitsuba would wait forever."""
    script = f"""
import mi_ring, numpy as np
from pathlib import Path
from mi_ring.images import read_image, write_image
from mi_ring.system.machine import set_threads
set_threads(1)
pixels, path = np.arange(105, dtype=np.float32).reshape(5, 7, 3), Path({str(tmp_path / "a.exr")!r})
write_image(pixels, path)
assert (read_image(path) == pixels).all()
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


def test_fits_on_one_thread_read_an_exr_one_after_the_other(broken_capture, tmp_path):
    path, replace = broken_capture
    image = path.parent / "images/000"
    mi.Bitmap(f"{image}.png").convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False).write(f"{image}.exr")
    replace("images/000.png", "images/000.exr")
    code = """
import sys
from mi_ring import fit
for out in "ab":
    assert fit.main([*sys.argv[1:], "--out", out, "--iterations", "1", "--threads", "1"]) == 0
"""
    subprocess.run([sys.executable, "-c", code, path, *BRIEF], check=True, timeout=300, cwd=tmp_path)


def test_on_one_core_an_exr_is_written_and_read(tmp_path):
    code = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import mi_ring, numpy
from mi_ring.images import write_image
from pathlib import Path
write_image(numpy.ones((5, 7, 3), numpy.float32), Path("one.exr"))
import mitsuba as mi
assert tuple(mi.Bitmap("one.exr").size()) == (7, 5)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, cwd=tmp_path)


def test_writes_are_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.pt"
    files.write_state({"iteration": 1}, path)
    monkeypatch.setattr(os, "replace", lambda a, b: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        files.write_state({"iteration": 2}, path)
    assert torch.load(path)["iteration"] == 1
