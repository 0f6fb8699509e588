"""How accurate is a fit under unknown lamps?

    python benchmarks/lamps.py MESH … [--lamps 1 2 3] [--views 32] [--width 256] [--spp 16] [--out out/lamps]
        [-- OPTIONS OF FIT]

`mi-ring synthesize` path traces each mesh, of plastic, under fixed lamps as far away as the cameras. The scene file has
no useful place for the first lamp and does not mention the others. `--light lamps` finds number, places and strengths.
Two fits are compared with it: one by `--light environment`, and one that knows the lamps exactly.

Prints a Markdown table with machine and date: errors of normals; the number of lamps that was found; the largest error
of a place, relative to its distance from the object; the largest error of a strength, relative to the first lamp.
"""

import argparse
import datetime
import json
import sys
from pathlib import Path

import mi_ring

# isort: split
import numpy as np
import torch
from accuracy import processor, product_speed, table
from environments import PLASTIC, run

from mi_ring.scene.assembly import lamp_lights
from mi_ring.scene.lights import Light

LIGHTS = "lamps", "environment", "capture"


def lamps_in(scene: Path) -> list[Light]:
    """All of a scene whose photographs have one place of their lights."""
    capture = mi_ring.load_capture(scene, images=False)
    return [capture.photographs.lights[0], *lamp_lights(capture.scene)]


def off(found: list[Light], true: list[Light]) -> tuple[float, float]:
    """How far the lamps that were found are from the true ones by these' distances, and how wrong their strengths, in
    the worst case: each the nearest one."""
    nearest = [min(found, key=lambda one: np.linalg.norm(one.vector - lamp.vector)) for lamp in true]
    places = [
        np.linalg.norm(one.vector - lamp.vector) / np.linalg.norm(lamp.vector) for one, lamp in zip(nearest, true)
    ]
    ratios = [one.rgb / nearest[0].rgb / (lamp.rgb / true[0].rgb) - 1 for one, lamp in zip(nearest, true)]
    return 100 * max(places), 100 * float(np.abs(ratios).max())


def main() -> None:
    """The command."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--lamps", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--views", type=int, default=32)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/lamps"))
    args, options = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    args.out.mkdir(parents=True, exist_ok=True)
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}, {speed:.0f} GFLOP/s; {datetime.date.today()}; {args.views} photographs of {args.width}²; "
          f"mi_ring.fit --light … {' '.join(options)}\n", flush=True)  # fmt: skip
    rows = []
    for mesh in args.meshes:
        name = mesh.parents[1].name if mesh.name == "mesh.ply" else mesh.stem
        for count in args.lamps:
            capture = args.out / f"{name}-{count}-{args.seed}"
            usual = ["--size", args.width, args.width, "--material", PLASTIC, "--novel", 0, "--seed", args.seed]
            lit = ["--light", "lamp", "--lamps", count, *(["--wrong-room"] if count > 1 else [])]
            run("mi_ring.synthesize", mesh, capture, "--views", args.views, "--spp", args.spp, *usual, *lit)
            exact = capture / ("truth/exact.xml" if count > 1 else "scene.xml")
            row = [name, str(count)]
            for light in LIGHTS:
                fit = args.out / f"{capture.name}-{light}"
                known = [exact, "--refine", "none"] if light == "capture" else [capture / "scene.xml"]
                run("mi_ring.fit", *known, "--out", fit, "--light", light, *options)
                numbers = json.loads(run("mi_ring.evaluate", fit, "--mesh", capture / "truth/mesh.ply"))
                seconds = json.loads((fit / "log.jsonl").read_text().splitlines()[-1])["seconds"]
                row += [f"{numbers['normal_mean']:.2f}", f"{numbers['normal_median']:.2f}", f"{seconds:.0f}"]
                if light == "lamps":
                    found = lamps_in(fit / "scene.xml")
                    distant = {lamp.kind for lamp in found} == {"directional"}
                    places, strengths = (np.nan, np.nan) if distant else off(found, lamps_in(exact))
                    row += [str(len(found)), f"{places:.1f}", f"{strengths:.0f}"]
            rows.append(row)
            print(*row, sep=", ", file=sys.stderr, flush=True)
    heads = ["mesh", "lamps", "normals, mean °", "median °", "fit s", "found", "places, off by %",
             "strengths, off by %"]  # fmt: skip
    heads += [
        f"{how}{what}" for how in ("by environment, ", "lamps known, ") for what in ("mean °", "median °", "fit s")
    ]
    print(table(heads, rows))


if __name__ == "__main__":
    main()
