"""Fit a set of Middlebury's multi-view photographs, whose light is unknown, and draw the result.

    python benchmarks/middlebury.py FOLDER [--light lamps] [--halves] [--out out/middlebury] [-- OPTIONS OF FIT]

FOLDER is the unpacked data set: a bright object before a dark background. A mask is what is brighter than a tenth of
full scale, closed and filled. Every eighth photograph is kept out.

Prints the PSNR of these over the pixels of the object, as sRGB, with machine and date. Writes a picture with some
predictions and normals. --halves fits every second photograph, then the others, and prints how far apart the two
surfaces are.
"""

import argparse
import datetime
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mi_ring

# isort: split
import cv2
import numpy as np
import torch
from accuracy import processor, product_speed
from scipy import ndimage

from mi_ring.images import linear_to_srgb, read_image, to_bytes, write_image
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

DARK, CLOSED = 24, 3  #: brightness (of 255) of what is background; how far gaps are closed [px]
SHOWN = 1, 4, 8, 12  #: photographs of the picture


def mask_of(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 1) uint8 of what is bright in (H, W, 3), the largest piece of it, without holes."""
    bright = ndimage.gaussian_filter(pixels.max(-1).astype(float), 1) > DARK
    bright = ndimage.binary_fill_holes(ndimage.binary_closing(bright, iterations=CLOSED))
    labels, count = ndimage.label(bright)
    largest = 1 + np.argmax(ndimage.sum(bright, labels, range(1, count + 1)))
    return np.where(ndimage.binary_opening(labels == largest, iterations=2), 255, 0).astype(np.uint8)[..., None]


def masked_scene(folder: Path, out: Path) -> Path:
    """The scene of the photographs, with masks."""
    scene = out / "scene.xml"
    subprocess.run([sys.executable, "-m", "mi_ring.convert", "middlebury", str(folder), str(scene)], check=True)
    tree = ElementTree.parse(scene)
    for sensor in tree.getroot().findall("sensor"):
        file = out / sensor.find("string[@name='filename']").get("value")
        (out / "masks").mkdir(exist_ok=True)
        write_image(mask_of(read_image(file)), out / "masks" / f"{file.stem}.png")
        ElementTree.SubElement(sensor, "string", name="mask", value=f"masks/{file.stem}.png")
    tree.write(scene)
    return scene


def draw(run: Path, picture: Path) -> list[float]:
    """Write the picture; returns the PSNR of the photographs that were kept out [dB]."""
    capture, ring = mi_ring.load_capture(run / "scene.xml"), mi_ring.load_fit(run)
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    columns, found = [], []
    for k in range(len(capture)):
        photograph, seen = capture.photograph(k), capture.observe([k])
        rgb, coverage = prediction.draw(surface, photograph, 8, indirect=ring.indirect)
        inside, shown = seen.mask[0].numpy() > 0.5, linear_to_srgb(rgb[0].numpy().clip(0, 1))
        if k % 8 == 4:
            error = (shown - linear_to_srgb(seen.rgb[0].numpy().clip(0, 1)))[inside]
            found.append(float(-10 * np.log10(np.mean(error**2))))
        if k in SHOWN:
            alpha = coverage[0].numpy()[..., None]
            normals = prediction.maps(surface, photograph)["normal"][0] / 2 + 0.5
            columns.append(np.concatenate([part * alpha + 1 - alpha for part in (shown, normals)]))
    image = to_bytes(np.concatenate(columns, 1))
    small = cv2.resize(image, None, fx=0.45, fy=0.45, interpolation=cv2.INTER_AREA)
    write_image(small, picture)
    return found


def half_of(scene: Path, first: int) -> Path:
    """A scene of every second photograph of another, from the `first` on, beside it."""
    tree, half = ElementTree.parse(scene), scene.with_name(f"half{first}.xml")
    for sensor in tree.getroot().findall("sensor")[1 - first :: 2]:
        tree.getroot().remove(sensor)
    tree.write(half)
    return half


def fit(scene: Path, run: Path, *options: object) -> str:
    """Fit a scene into a folder; returns the command's arguments."""
    arguments = [scene, "--out", run, *options]
    subprocess.run([sys.executable, "-m", "mi_ring.fit", *map(str, arguments)], check=True)
    return " ".join(map(str, arguments))


def apart(runs: list[Path]) -> str:
    """How far the surfaces of two fits are apart, both ways."""
    found = []
    for run, other in (runs, runs[::-1]):
        command = ["-m", "mi_ring.evaluate", run, "--mesh", other / "mesh.ply", "--seen"]
        found.append(json.loads(subprocess.check_output([sys.executable, *map(str, command)])))
    names = {"normal_mean": "normals, mean °", "normal_median": "median °", "depth_mean": "depth, mean %",
             "depth_median": "median %", "chamfer": "Chamfer distance, % of the diagonal"}  # fmt: skip
    return ", ".join(f"{words} {found[0][name]:.2f} / {found[1][name]:.2f}" for name, words in names.items())


def main() -> None:
    """The command."""
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--light", default="lamps")
    parser.add_argument("--halves", action="store_true", help="two fits of every second photograph each")
    parser.add_argument("--out", type=Path, default=Path("out/middlebury"))
    args, options = parser.parse_args(sys.argv[1:split]), sys.argv[split + 1 :]
    scene = masked_scene(args.folder, args.out)
    usual = ["--light", args.light, *options]
    if args.halves:
        runs = [args.out / f"{args.light}-half{first}" for first in (0, 1)]
        told = " and ".join(fit(half_of(scene, first), run, *usual) for first, run in enumerate(runs))
        found = apart(runs)
    else:
        run = args.out / args.light
        told = fit(scene, run, "--holdout", 8, *usual)
        found = "kept out " + ", ".join(f"{value:.1f} dB" for value in draw(run, args.out / f"{args.light}.jpg"))
    speed = product_speed(4096, 4096, torch.float32) / 1e9
    print(f"{processor()}, {speed:.0f} GFLOP/s; {datetime.date.today()}; mi_ring.fit {told}: {found}")


if __name__ == "__main__":
    main()
