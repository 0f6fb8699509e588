"""How accurate a fit is, and what it costs: captures with known truth are fitted and evaluated.

    python benchmarks/accuracy.py CAPTURE [MORE …] [--seeds 0 1 2] [--out out/accuracy] [OPTIONS OF mi-ring fit]

CAPTURE is a scene file, or a folder with scene.xml. The truth is truth/mesh.ply, and truth/scene.xml for novel views,
beside the scene file or in <scene name>/; --truth names another folder. Each fit is a process of its own.

Prints a Markdown table, one line per fit and one with the worst of several seeds in each column: errors of normals [°]
and depth [% of the diagonal], silhouettes, PSNR [dB], time of the iterations and of the whole command, peak memory, and
GFLOP/s, the speed of float32 products of 4096³ right after the fit. A fit with details gets a second line with the
errors of its networks alone. `mi-ring paper timing` prints the errors during a fit.

Other benchmarks use the functions of this script.
"""

import argparse
import datetime
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

COLUMNS = ("normal_mean", "normal_median", "depth_mean", "depth_median", "iou", "psnr_input", "psnr_novel")
HIGHER_IS_BETTER = ("iou", "psnr_input", "psnr_novel", "GFLOP/s")
COSTS = ("fit s", "wall s", "GiB, at most", "GFLOP/s")
REPEATS = 7  #: of what is timed by itself


def scene_file(path: str) -> Path:
    """The scene file of a capture, which may be given as a folder."""
    return Path(path) / "scene.xml" if Path(path).is_dir() else Path(path)


def truth_of(scene: Path) -> Path:
    """The folder with the truth of a scene file."""
    folders = [scene.with_suffix("") / "truth", scene.parent / "truth"]
    for folder in folders:
        if (folder / "mesh.ply").is_file():
            return folder
    sys.exit(f"{scene}: no truth: neither {folders[0]}/mesh.ply nor {folders[1]}/mesh.ply exists")


def processor() -> str:
    """Model of the processor and number of cores."""
    from mi_ring.system import machine

    return machine.computer()


def product_speed(rows: int, width: int, dtype) -> float:
    """FLOP/s of (rows, width) @ (width, width): the median of some runs after one to warm up."""
    import torch

    a, b = torch.randn(rows, width).to(dtype), torch.randn(width, width).to(dtype)
    times, seconds = max(1, 2**33 // (rows * width * width)), []
    for _ in range(REPEATS + 1):
        before = time.perf_counter()
        for _ in range(times):
            torch.mm(a, b)
        seconds.append(time.perf_counter() - before)
    return times * 2 * rows * width * width / statistics.median(seconds[1:])


def measure(scene: Path, out: Path, options: list[str], truth: Path) -> dict[str, float]:
    """Fit a scene and evaluate it: the numbers of `mi-ring evaluate` and COSTS."""
    import torch

    started = time.perf_counter()
    fit = [sys.executable, "-m", "mi_ring.fit", str(scene), "--out", str(out), *options]
    _, status, usage = os.wait4(subprocess.Popen(fit, stdout=sys.stderr).pid, 0)  # stdout is for Markdown
    if status:
        sys.exit(f"failed: {' '.join(fit[2:])}")
    wall, speed = time.perf_counter() - started, product_speed(4096, 4096, torch.float32)
    last = (out / "log.jsonl").read_text("utf-8").splitlines()[-1]
    memory = usage.ru_maxrss / 2**20  # KiB → GiB
    costs = dict(zip(COSTS, (json.loads(last)["seconds"], wall, memory, speed / 1e9)))
    return evaluated(out, truth) | costs


def evaluated(out: Path, truth: Path) -> dict[str, float]:
    """The numbers of `mi-ring evaluate` for a results folder."""
    evaluate = [sys.executable, "-m", "mi_ring.evaluate", str(out), "--mesh", str(truth / "mesh.ply")]
    if (novel := truth / "scene.xml").is_file():
        evaluate += ["--novel", str(novel)]
    numbers = json.loads(subprocess.run(evaluate, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return {"psnr_novel": math.nan} | numbers


def networks_alone(out: Path) -> Path | None:
    """Write a results folder with the networks of another one, without details. Returns it; None if there are none."""
    import mi_ring
    from mi_ring.nets.registry import architecture_of
    from mi_ring.objects.detail import DetailedFlow
    from mi_ring.objects.fitted_object import FittedObject
    from mi_ring.objects.ring_file import ring_state
    from mi_ring.output.ply import write_mesh
    from mi_ring.system.files import write_state

    ring = mi_ring.load_fit(out)
    flow, material = ring.shape_net, ring.brdf_net
    if isinstance(flow, DetailedFlow):
        flow = flow.base.network
    while "net" in architecture_of(material)["arguments"]:
        material = getattr(material.base, "network", material.base)
    if material is ring.brdf_net and flow is ring.shape_net:
        return None
    level = json.loads((out / "config.json").read_text())["subdivisions"]
    plain = FittedObject(ring.center, float(ring.radius), domain=ring.domain, bsdf=ring.bsdf, indirect=ring.indirect,
                         subdivisions=level, networks=(flow, material), ground=ring.ground)  # fmt: skip
    folder = out.with_name(f"{out.name}_networks")
    folder.mkdir(exist_ok=True)
    for name in ("scene.xml", "config.json"):
        shutil.copy(out / name, folder)
    if (out / "masks").is_dir():
        shutil.copytree(out / "masks", folder / "masks", dirs_exist_ok=True)
    write_state(ring_state(plain), folder / "ring.pt")
    write_mesh(plain, level, folder / "mesh.ply")
    return folder


def table(heads, rows) -> str:
    """Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [heads, ["---"] * len(heads), *rows])


def cells(values) -> list[str]:
    """One line of the table, from COLUMNS and COSTS."""
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
    print(f"{processor()}; {datetime.date.today()}; mi-ring fit {' '.join(options)}\n")
    results = []
    for scene, truth in zip(arguments.scenes, truths):
        name, rows = scene.stem if scene.stem != "scene" else scene.parent.name, []
        for seed in arguments.seeds:
            label = name if len(arguments.seeds) == 1 else f"{name}, seed {seed}"
            out = arguments.out / (name if seed == 0 else f"{name}_{seed}")
            row = measure(scene, out, [*options, "--seed", str(seed)], truth)
            rows.append([row[c] for c in (*COLUMNS, *COSTS)])
            results.append([label, *cells(rows[-1])])
            print(f"{label}: {', '.join(results[-1][1:])}", file=sys.stderr)  # a later failure does not lose it
            if alone := networks_alone(out):
                numbers = evaluated(alone, truth)
                results.append([f"{label}, networks", *cells([numbers.get(c, math.nan) for c in (*COLUMNS, *COSTS)])])
        if len(rows) > 1:
            worst = [min(v) if c in HIGHER_IS_BETTER else max(v) for c, v in zip([*COLUMNS, *COSTS], zip(*rows))]
            results.append([f"**{name}, worst**", *cells(worst)])
    print(table(["scene", *(c.replace("_", " ") for c in [*COLUMNS, *COSTS])], results))


if __name__ == "__main__":
    main()
