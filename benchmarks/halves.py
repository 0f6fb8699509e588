"""How precise is a fit of real photographs? Fit every other photograph, then the others, and compare.

    python benchmarks/halves.py SCENE.xml [--out out/halves] [OPTIONS OF mi-ring fit]

Prints a Markdown table with machine and date: the angle between the two flashes, seen from the object, and the distance
of the two surfaces where photographs show them, after a rigid alignment, in % of the diagonal. The same command
continues after an interruption.
"""

import argparse
import datetime
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import torch
from accuracy import processor, product_speed, table

import mi_ring
from mi_ring.capture.scenefile import move_names
from mi_ring.metrics.surfaces import alignment, compare_shapes, load_true_mesh


def half(scene: Path, which: int, path: Path) -> None:
    """A scene file of every other photograph, those that begin with number `which`."""
    root = ElementTree.parse(scene).getroot()
    for sensor in [s for k, s in enumerate(root.findall("sensor")) if k % 2 != which]:
        root.remove(sensor)
    move_names(root, scene.parent, path.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(ElementTree.tostring(root))


def fitted(scene: Path, out: Path, options: list[str]) -> dict:
    """What a fit has refined; it is not made again if there is one by these options."""
    note = out.parent / f"{out.name}.txt"
    if not (out / "report.html").exists() or not note.exists() or note.read_text() != " ".join(options):
        note.unlink(missing_ok=True)
        command = [sys.executable, "-m", "mi_ring.fit", str(scene), "--out", str(out), *options]
        if status := subprocess.run(command, stdout=sys.stderr).returncode:
            sys.exit(status)  # it has said why
        note.write_text(" ".join(options))
    return json.loads((out / "calibration.json").read_text())


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/halves"))
    arguments, options = parser.parse_known_args()
    outs = [arguments.out / str(which) for which in (0, 1)]
    found = []
    for which, out in enumerate(outs):
        half(arguments.scene, which, arguments.out / f"{which}.xml")
        found.append(fitted(arguments.out / f"{which}.xml", out, options))

    capture = mi_ring.load_capture(arguments.scene)
    (one, _), (other, _) = (load_true_mesh(out / "mesh.ply") for out in outs)
    center = other.bounds.mean(0)
    distance = np.median([np.linalg.norm(shot.camera.position - center) for shot in capture.shots])
    flashes = [np.array(record["unknowns"]["light"]["after"]) for record in found]
    apart = np.degrees(np.linalg.norm((flashes[1] - flashes[0])[:2]) / distance)
    above = [np.degrees(np.arctan2(flash[1], distance)) for flash in flashes]
    one.apply_transform(alignment(one, other, False))
    shapes = compare_shapes(one, other, capture.views)
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}; {speed:.0f} GFLOP/s; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    rows = [["flash above the lens, from the object", *(f"{angle:.2f}°" for angle in above), f"{apart:.2f}° apart"],
            ["surface", "", "", f"{shapes['chamfer']:.3f} % apart"]]  # fmt: skip
    print(table([str(arguments.scene), "one half", "the other", ""], rows))


if __name__ == "__main__":
    main()
