"""Does a fit that is killed again and again give the same result?

    python benchmarks/stress.py [SCENE.xml] [--kills 100] [--seed 0] [-- OPTIONS OF FIT]

A deterministic fit runs once undisturbed. Then it is started again, killed (SIGKILL) at N random moments and resumed.
The moments are spread over the processor time of the undisturbed fit, from start to report, so other load hardly
matters. It needs psutil. After each kill every result file that exists must be readable. At the end all files must
equal those of the undisturbed fit bit for bit, except times and paths, and except the checkpoint before the last.

Prints a Markdown table with machine and date. Options of a quick trial:
-- --iterations 6 --levels 2 --widths 32 --shares 1 --batch 2 --subdivisions 2
"""

import argparse
import datetime
import json
import math
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import psutil
import torch
import trimesh
from accuracy import processor
from PIL import Image

from mi_ring.objects.ring_file import load_fit, read_state

ROOT = Path(__file__).parents[1]
TIMES = re.compile(r"(<tr><th>Fit time</th><td>)[^<]*|\"seconds\": [0-9.e+-]+")  #: what differs from run to run


def readable(folder: Path) -> list[str]:
    """Names of the result files of a folder that are there. Raises whatever their readers do if one is damaged.

    What grows beside them (`.name.….partial`) and the lock belong to the process that was killed.
    """
    found = []
    for path in sorted(folder.glob("*")):
        if path.name.startswith("."):
            continue
        found.append(path.name)
        if path.name == "ring.pt":
            load_fit(path)
        elif path.suffix == ".pt":
            read_state(path, "a checkpoint", "")
        elif path.suffix == ".ply":
            assert trimesh.load(path).is_watertight, path
        elif path.suffix == ".json":
            json.loads(path.read_bytes())
        elif path.suffix == ".jsonl":  # of which the last line may be half: it is added to
            [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]
        elif path.suffix == ".png":
            with Image.open(path) as image:
                image.load()
        elif path.suffix == ".html":
            assert path.read_text("utf-8").endswith("</html>"), path
        elif path.suffix == ".xml":
            assert path.read_text("utf-8").endswith("</scene>"), path
        else:
            assert path.is_dir(), f"{path}: what is it?"
    return found


def plain(value: object) -> object:
    """The state of a checkpoint without the times in it, comparable."""
    if isinstance(value, torch.Tensor):
        return str(value.dtype), tuple(value.shape), value.numpy(force=True).tobytes()
    if isinstance(value, dict):
        return {key: plain(own) for key, own in value.items() if key not in ("seconds", "costs")}
    return [plain(own) for own in value] if isinstance(value, list | tuple) else value


def content(path: Path) -> object:
    """Of a result file, without what says how long it took."""
    if path.name == "checkpoint.before.pt":
        return None  # of whatever moment
    if path.name == "config.json":
        return {key: value for key, value in json.loads(path.read_bytes()).items() if key not in ("out", "resume")}
    if path.name == "checkpoint.pt":
        return plain(read_state(path, "a checkpoint", ""))
    if path.suffix in (".html", ".jsonl"):
        return TIMES.sub("", path.read_text("utf-8"))
    return path.read_bytes()


def busy(process: subprocess.Popen) -> float:
    """Seconds of processor that it has taken, threads included; infinite when it has ended."""
    try:
        return sum(psutil.Process(process.pid).cpu_times()[:2]) if process.poll() is None else math.inf
    except psutil.NoSuchProcess:
        return math.inf


def iteration(folder: Path) -> int:
    """Of the checkpoint that is there; -1 if there is none."""
    try:
        return read_state(folder / "checkpoint.pt", "a checkpoint", "")["fit"]["iteration"]
    except ValueError:
        return -1


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", type=Path, default=ROOT / "scenes/pot2.xml", metavar="SCENE.xml")
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder of both results, of which that of the undisturbed fit is "
                        "taken if it is there; by default they are removed")  # fmt: skip
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    own, options = parser.parse_args(words[:end]), words[end + 1 :]
    place = own.keep or Path(tempfile.mkdtemp(prefix="mi_ring-stress-"))
    begun, chance = time.monotonic(), random.Random(own.seed)
    folders = {name: place / name / "run" for name in ("whole", "killed")}
    commands = {
        name: [sys.executable, "-m", "mi_ring.fit", own.scene, "--out", folder, "--deterministic", *options]
        for name, folder in folders.items()
    }
    note, complaints = place / "seconds.txt", place / "complaints.txt"
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    if not note.is_file():
        subprocess.run(list(map(str, commands["whole"])), check=True, **silent)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        note.write_text(f"{used.ru_utime + used.ru_stime:.1f}")
    took = float(note.read_text())
    print(f"{processor()}; {datetime.date.today()}; {' '.join(options)}\n", flush=True)
    print(f"Undisturbed: {took:.0f} s of processor\n\n| kill | after, s | iteration | files that were there |")
    print("|---|---|---|---|", flush=True)
    folder, kills, finished = folders["killed"], 0, 0
    while True:
        resume = ["--resume"] * any(folder.glob("checkpoint*.pt"))
        with complaints.open("w") as said:
            process = subprocess.Popen(list(map(str, [*commands["killed"], *resume])), **silent | {"stderr": said})
        moment = chance.uniform(0, took) if kills < own.kills else math.inf
        while process.poll() is None and busy(process) < moment:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)  # nothing, if it has ended
        if process.wait() == -signal.SIGKILL:
            kills += 1
            files = readable(folder) if folder.is_dir() else []
            print(f"| {kills} | {moment:.1f} | {iteration(folder)} | {', '.join(files)} |", flush=True)
            continue
        if process.returncode:
            sys.exit(f"status {process.returncode} after {kills} kills: {complaints.read_text()[-500:]}")
        if kills >= own.kills:
            break
        finished += 1  # too few kills yet: once more from the start
        shutil.rmtree(folder)
    names = readable(folders["whole"])
    assert names == readable(folder), (names, readable(folder))
    different = []
    for path in sorted(folders["whole"].rglob("*")):
        other = folder / path.relative_to(folders["whole"])
        if path.is_file() and not path.name.startswith(".") and content(path) != content(other):
            different.append(str(path.relative_to(folders["whole"])))
    print(f"\n{kills} kills, {finished} fits finished between them, {time.monotonic() - begun:.0f} s. Different: "
          f"{', '.join(different) or 'none'} of {len(names)} files")  # fmt: skip
    if not own.keep:
        shutil.rmtree(place)
    sys.exit(bool(different))


if __name__ == "__main__":
    main()
