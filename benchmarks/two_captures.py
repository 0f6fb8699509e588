"""How far two real captures of one object are apart, each fitted by itself.

    python benchmarks/two_captures.py FIRST SECOND [--out out/two_captures] [OPTIONS OF mi-ring fit]

FIRST and SECOND are folders of `shared/data/real/nir_flash`, such as cat_A and cat_F. The folder `shared` must be
beside the checkout; its tools convert the captures and compare the meshes where photographs show them. Prints a
Markdown table with machine and date: the flash's cone in both, and the distances. The same command continues after an
interruption.
"""

import argparse
import datetime
import json
import subprocess
import sys
from pathlib import Path

import torch
from accuracy import processor, product_speed, table
from halves import fitted

TOOLS = Path(__file__).resolve().parents[2] / "shared" / "tools"


def run(*command: object) -> str:
    """Standard output of a Python command, which must end well."""
    done = subprocess.run([sys.executable, *map(str, command)], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"failed: {' '.join(map(str, command))}")
    return done.stdout


def scene_of(source: Path, folder: Path) -> Path:
    """The scene file of a capture in a folder, made from its source."""
    scene = folder / "scene.xml"
    if not scene.exists():
        run(TOOLS / "nir_flash.py", source, folder)
        run("-m", "mi_ring.convert", folder / "transforms.json", scene)
    return scene


def cone(record: dict) -> str:
    """The cone of the flash that a fit has found."""
    unknowns = record["unknowns"]
    if "falloff" not in unknowns:
        return "–"
    left, up = unknowns["tilt"]["after"]
    return f"{unknowns['falloff']['after']:.1f}, {left:.1f} {up:.1f}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path, nargs=2, metavar=("FIRST", "SECOND"))
    parser.add_argument("--out", type=Path, default=Path("out/two_captures"))
    arguments, options = parser.parse_known_args()
    records, meshes = [], []
    for source in arguments.captures:
        folder = arguments.out / source.name
        out = folder / "-".join(["fit", *options]).replace("/", "_")
        records.append(fitted(scene_of(source, folder), out, options))
        meshes.append(out / "mesh.ply")
    apart = json.loads(run(TOOLS / "agreement.py", *meshes, "--seen"))
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    normals = f"{apart['normal_mean']:.2f}° / {apart['normal_median']:.2f}°"
    print(table(["captures", "cone, tilt of the first", "of the second", "normals, mean / median", "surfaces"],
                [[" and ".join(source.name for source in arguments.captures), *map(cone, records), normals,
                  f"{apart['distance_mean']:.3f} %"]]))  # fmt: skip


if __name__ == "__main__":
    main()
