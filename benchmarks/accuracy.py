"""Fit captures with known truth and print the paper's columns as a Markdown table, with machine and date.

    python benchmarks/accuracy.py scenes/pot2.xml [MORE.xml …] [--out out/accuracy] [OPTIONS OF mi_ring.fit]

The truth of SCENE.xml is in truth/{mesh.ply,scene.xml} beside it, in <scene name>/truth/, or where --truth says. Each
fit is a process of its own: wall time and peak memory are the whole process's, start-up and report included; fit time
is the iterations'.
"""

import argparse
import datetime
import json
import os
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path

COLUMNS = ("normal_mean", "normal_median", "depth_mean", "depth_median", "iou", "psnr_input", "psnr_novel")


def truth_of(scene: Path) -> Path:
    """The folder with the truth of a scene file."""
    folders = [scene.with_suffix("") / "truth", scene.parent / "truth"]
    for folder in folders:
        if (folder / "mesh.ply").is_file():
            return folder
    sys.exit(f"{scene}: no truth: neither {folders[0]}/mesh.ply nor {folders[1]}/mesh.ply exists")


def processor() -> str:
    """What runs this: model of the processor and number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def measure(scene: Path, out: Path, options: list[str], truth: Path) -> dict:
    """Fit one scene and evaluate it."""
    command = [sys.executable, "-m", "mi_ring.fit", str(scene), "--out", str(out), *options]
    started = time.perf_counter()
    subprocess.run(command, check=True, stdout=sys.stderr)
    wall = time.perf_counter() - started
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20  # KiB → GiB; the largest child so far
    evaluate = [sys.executable, "-m", "mi_ring.evaluate", str(out), "--mesh", str(truth / "mesh.ply"),
                "--novel", str(truth / "scene.xml")]  # fmt: skip
    numbers = json.loads(subprocess.run(evaluate, check=True, capture_output=True, text=True).stdout)
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return {**numbers, "fit_seconds": log[-1]["seconds"], "wall_seconds": wall, "memory": memory}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/accuracy"))
    parser.add_argument("--truth", type=Path, help="folder of mesh.ply and scene.xml, of a single scene")
    arguments, options = parser.parse_known_args()
    if arguments.truth and len(arguments.scenes) > 1:
        parser.error("--truth goes with one scene")
    truths = [arguments.truth or truth_of(scene) for scene in arguments.scenes]
    print(f"{processor()}; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    heads = [c.replace("_", " ") for c in COLUMNS]
    print("| scene | " + " | ".join(heads) + " | fit s | wall s | GiB, at most |")
    print("|---" * (len(heads) + 4) + "|", flush=True)
    for scene, truth in zip(arguments.scenes, truths):
        name = scene.stem if scene.stem != "scene" else scene.parent.name
        row = measure(scene, arguments.out / name, options, truth)
        cells = [f"{row[c]:.4f}" if c == "iou" else f"{row[c]:.2f}" for c in COLUMNS]
        cells += [f"{row['fit_seconds']:.0f}", f"{row['wall_seconds']:.0f}", f"{row['memory']:.1f}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
