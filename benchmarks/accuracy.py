"""Fit captures with known truth and print, as Markdown with machine and date, how near they come and what it costs.

    python benchmarks/accuracy.py CAPTURE [MORE …] [--seeds 0 1 2] [--out out/accuracy] [OPTIONS OF mi_ring.fit]

A capture is a scene file or a folder with a scene.xml. For each, and seed, the curve of the normals' mean error against
fit time, then a table of the paper's columns and one of where the time went; the worst of several seeds, column by
column, is a line of its own. The truth of SCENE.xml is in truth/mesh.ply beside it, and that of novel views in
truth/scene.xml, or both in <scene name>/truth/ or where --truth says. Each fit is a process of its own. Fit time is the
iterations' alone; wall time and peak memory are the whole process's, start-up and report included. GFLOP/s is the speed
of float32 products of 4096³ right after the fit: what the machine could do then.
"""

import argparse
import collections
import contextlib
import copy
import datetime
import functools
import json
import math
import multiprocessing
import resource
import statistics
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

COLUMNS = ("normal_mean", "normal_median", "depth_mean", "depth_median", "iou", "psnr_input", "psnr_novel")
HIGHER_IS_BETTER = ("iou", "psnr_input", "psnr_novel", "GFLOP/s")
COSTS = ("fit s", "wall s", "GiB, at most", "GFLOP/s")
POINTS = 8  #: of the curve
REPEATS = 7  #: of what is timed by itself


def scene_file(path: str) -> Path:
    """The scene file that is meant, where a capture's folder is given, too."""
    return Path(path) / "scene.xml" if Path(path).is_dir() else Path(path)


def truth_of(scene: Path) -> Path:
    """The folder with the truth of a scene file."""
    folders = [scene.with_suffix("") / "truth", scene.parent / "truth"]
    for folder in folders:
        if (folder / "mesh.ply").is_file():
            return folder
    sys.exit(f"{scene}: no truth: neither {folders[0]}/mesh.ply nor {folders[1]}/mesh.ply exists")


def processor() -> str:
    """What runs this: model of the processor and number of cores."""
    from mi_ring.system import machine  # here, for the reason given in watch()

    return machine.processor()


def watch() -> dict[str, float]:
    """Seconds by part of all fits of this process, from now on."""
    from mi_ring.fitting.muon import Muon  # here, not in the parent: a process begins with its parent's peak memory
    from mi_ring.nets import shape_net
    from mi_ring.rendering import bridge
    from mi_ring.rendering.global_illumination import GlobalIllumination

    # isort: split
    import torch

    seconds = {"flow": 0.0, "rendering": 0.0, "optimiser": 0.0}

    def timed(part, function):
        @functools.wraps(function)
        def run(*args, **kwargs):
            before = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                seconds[part] += time.perf_counter() - before

        return run

    for part, cls in (("flow", shape_net._Flow), ("rendering", bridge._Differentiable)):
        cls.forward, cls.backward = (staticmethod(timed(part, f)) for f in (cls.forward, cls.backward))
    GlobalIllumination.of = timed("rendering", GlobalIllumination.of)
    for cls in (torch.optim.Adam, Muon):
        cls.step = timed("optimiser", cls.step)
    return seconds


def peak_memory() -> float:
    """Of this process [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # KiB → GiB


def median_seconds(*functions) -> list[float]:
    """Median time of a call of each, called in turn so that a busy machine slows all alike, after one to warm up."""
    times = [[] for _ in functions]
    for _ in range(REPEATS + 1):
        for function, results in zip(functions, times):
            before = time.perf_counter()
            function()
            results.append(time.perf_counter() - before)
    return [statistics.median(results[1:]) for results in times]


def there_and_back(function, x, autocast):
    """To be timed: the forward pass of a network, or of the flow, in a context of this kind, and the backward pass."""

    def run():
        with autocast():
            y = function(x)
        y.backward(y.new_ones(y.shape))

    return run


def product_speed(rows: int, width: int, dtype) -> float:
    """FLOP/s of (rows, width) @ (width, width)."""
    import torch  # here, for the reason given in watch()

    a, b = torch.randn(rows, width).to(dtype), torch.randn(width, width).to(dtype)
    times = max(1, 2**33 // (rows * width * width))
    return times * 2 * rows * width * width / median_seconds(lambda: [torch.mm(a, b) for _ in range(times)])[0]


def watched_fit(arguments: list[str], truth: Path, points: int) -> dict:
    """Run `mi_ring.fit` in this process and look on.

    Returns the curve of so many points, (seconds, means of `surfaces.compare_surfaces`) each; seconds by part, of the
    fit and of all; peak memory [GiB]; FLOP/s of the machine.
    """
    started = time.perf_counter()
    seconds, parts = watch(), collections.Counter()
    from mi_ring import fit
    from mi_ring.metrics import surfaces
    from mi_ring.scene import plain_mesh
    from mi_ring.system import machine

    # isort: split
    import numpy as np
    import torch

    course, running = [], None

    class Watched(fit.Fit):
        def step(self):
            nonlocal running
            running, before = self, dict(seconds)
            it = super().step()
            parts.update({part: seconds[part] - before[part] for part in seconds})
            if self.iteration * points // self.iterations > len(course):
                course.append((self.seconds, copy.deepcopy(self.ring.state_dict())))
            return it

    fit.Fit = Watched
    with contextlib.redirect_stdout(sys.stderr):  # what goes to stdout is Markdown
        fit.main(arguments)
    wall = time.perf_counter() - started
    memory = peak_memory()
    with machine.threads_of(0):
        speed = product_speed(4096, 4096, torch.float32)

    (mesh, true), ring = surfaces.load_true_mesh(truth / "mesh.ply"), running.ring
    diagonal = np.linalg.norm(mesh.extents)
    s, faces = ring.domain.sample(running.config.subdivisions)
    curve = []
    for at, state in course:
        ring.load_state_dict(state)
        with torch.no_grad():
            guess = plain_mesh.scene_of(ring.surface(s.to(running.device)).cpu().numpy(), faces)
        curve.append((at, surfaces.compare_surfaces(running.capture, guess, true, diagonal)[0]))
    return {"curve": curve, "parts": dict(parts), "fit_seconds": running.seconds, "wall": wall, "memory": memory,
            "speed": speed}  # fmt: skip


def alone(function, *arguments):
    """Call a function in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measure(scene: Path, out: Path, options: list[str], truth: Path, points: int = 0) -> dict:
    """Fit one scene in a new process and evaluate it."""
    watched = alone(watched_fit, [str(scene), "--out", str(out), *options], truth, points)
    evaluate = [sys.executable, "-m", "mi_ring.evaluate", str(out), "--mesh", str(truth / "mesh.ply")]
    if (novel := truth / "scene.xml").is_file():
        evaluate += ["--novel", str(novel)]
    numbers = json.loads(subprocess.run(evaluate, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return {"psnr_novel": math.nan} | numbers | watched


def table(heads, rows) -> str:
    """Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [heads, ["---"] * len(heads), *rows])


def cells(values) -> list[str]:
    """Of one line of the table: COLUMNS, then COSTS."""
    formats = ["{:.4f}" if c == "iou" else "{:.2f}" for c in COLUMNS] + ["{:.0f}", "{:.0f}", "{:.1f}", "{:.0f}"]
    return ["-" if math.isnan(v) else f.format(v) for f, v in zip(formats, values)]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="+", type=scene_file, help="scene files, or folders with a scene.xml")
    parser.add_argument("--out", type=Path, default=Path("out/accuracy"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--truth", type=Path, help="folder of mesh.ply and scene.xml, of a single scene")
    arguments, options = parser.parse_known_args()
    if arguments.truth and len(arguments.scenes) > 1:
        parser.error("--truth goes with one scene")
    truths = [arguments.truth or truth_of(scene) for scene in arguments.scenes]
    print(f"{alone(processor)}; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    results, parts = [], []
    for scene, truth in zip(arguments.scenes, truths):
        name, rows = scene.stem if scene.stem != "scene" else scene.parent.name, []
        for seed in arguments.seeds:
            label = name if len(arguments.seeds) == 1 else f"{name}, seed {seed}"
            out = arguments.out / (name if seed == 0 else f"{name}_{seed}")
            row = measure(scene, out, [*options, "--seed", str(seed)], truth, POINTS)
            curve = [(f"{seconds:.0f}", f"{errors['normal_mean']:.2f}") for seconds, errors in row["curve"]]
            seconds, errors = zip(*curve)
            print(table([f"{label}, fit time s", *seconds], [["normals, mean error °", *errors]]), flush=True)
            print()
            costs = row["fit_seconds"], row["wall"], row["memory"], row["speed"] / 1e9
            rows.append([*(row[c] for c in COLUMNS), *costs])
            results.append([label, *cells(rows[-1])])
            print(f"{label}: {', '.join(results[-1][1:])}", file=sys.stderr)  # lest a failure later lose it
            rest = row["fit_seconds"] - sum(row["parts"].values())
            parts.append([label, *(f"{s:.0f}" for s in [*row["parts"].values(), rest])])
        if len(rows) > 1:
            worst = [min(v) if c in HIGHER_IS_BETTER else max(v) for c, v in zip([*COLUMNS, *COSTS], zip(*rows))]
            results.append([f"**{name}, worst**", *cells(worst)])
    print(table(["scene", *(c.replace("_", " ") for c in [*COLUMNS, *COSTS])], results))
    print("\nSeconds of the fit:\n")
    print(table(["scene", *row["parts"], "rest"], parts))


if __name__ == "__main__":
    main()
