"""Fit real photographs, the skull, and judge it on photographs that the fit has not seen.

    python benchmarks/skull.py PHOTOS OUT [--preset default] [--flash-offset X Y Z] [--fit OPTIONS]

PHOTOS is the folder of all 66 JPEG files. Every eighth photograph, from the fifth on, is kept out of the fit, but not
out of the search for cameras and masks. OUT gets the capture, the fit and predictions of the held-out photographs, from
which `docs/make_skull.py` makes pictures.

Prints how much photographs from almost the same place differ in brightness, and what of it the powers explain. If the
folder `shared` is beside the checkout, it also prints the errors of the cameras against COLMAP with the full-size
photographs, the overlap of the masks, and PSNR of the held-out photographs.
"""

import argparse
import itertools
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from PIL import Image
from trimesh.registration import procrustes

from mi_ring.capture.loading import load_capture
from mi_ring.system.files import write_file

SHARED = Path(__file__).resolve().parents[2] / "shared"
REFERENCE = SHARED / "data/real/flash_skull"

EVERY = 8  #: one of so many photographs is held out
NEAR = np.cos(np.radians(12)), 0.05  #: cameras at almost the same place: cosine of their angle, log of their distances


def run(*arguments: object) -> None:
    """A command of mi_ring, which must end well."""
    command = [sys.executable, "-m", *map(str, arguments)]
    print("$", *command[2:], flush=True)
    if subprocess.run(command).returncode:
        sys.exit(f"failed: {' '.join(command)}")


def held_out(capture: Path, result: Path) -> Path:
    """A scene of the photographs held out alone, uncropped, with the cameras and lights that the fit has found."""
    tree = ElementTree.parse(result / "scene.xml")
    sensors = tree.getroot().findall("sensor")
    held = sorted(sensor.get("id") for sensor in sensors)[EVERY // 2 :: EVERY]
    (width, height), (cx, cy) = uncropped(capture)
    for sensor in sensors:
        if sensor.get("id") not in held:
            tree.getroot().remove(sensor)
            continue
        for field, value in (("cx", cx), ("cy", cy)):
            sensor.find(f"float[@name='{field}']").set("value", str(value))
        for field, value in (("width", width), ("height", height)):
            sensor.find(f"film/integer[@name='{field}']").set("value", str(value))
        for string in sensor.findall("string"):
            if string.get("name") != "filename":
                sensor.remove(string)
    path = result / "held_out.xml"
    write_file(path, ElementTree.tostring(tree.getroot()))
    return path


def uncropped(capture: Path) -> tuple[tuple[int, int], tuple[float, float]]:
    """Size of the photographs and their principal point [px]."""
    import pycolmap

    camera = next(iter(pycolmap.Reconstruction(capture / "work/sparse").cameras.values()))
    return (camera.width, camera.height), (camera.principal_point_x, camera.principal_point_y)


def cameras_off(capture: Path) -> str:
    """How far the cameras are from COLMAP's of the full-size photographs, after a similarity."""
    import pycolmap

    found, true = (
        {Path(i.name).stem: i.projection_center() for i in pycolmap.Reconstruction(f).images.values() if i.has_pose}
        for f in (capture / "work/sparse", REFERENCE / "sparse/0")
    )
    names = sorted(found.keys() & true.keys())
    a, b = (np.array([centers[name] for name in names]) for centers in (found, true))
    _, moved, _ = procrustes(a, b, reflection=False)
    cameras = pycolmap.Reconstruction(REFERENCE / "sparse/0").images.values()
    ahead = np.array([i.cam_from_world().rotation.matrix()[2] for i in cameras])
    origins = np.array([i.projection_center() for i in cameras])
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None]
    center = np.linalg.solve(across.sum(0), (across @ origins[..., None]).sum(0)[:, 0])
    off = np.linalg.norm(moved - b, axis=1) / np.linalg.norm(b - center, axis=1)
    return f"cameras: {len(names)} of 66, off by {off.mean():.3%} of the distance, worst {off.max():.3%}"


def masks_off(capture: Path) -> str:
    """Overlap of the masks with the judge's, dilated by 6 px."""
    import cv2

    overlaps = []
    for file in sorted((REFERENCE / "judged").glob("*.png")):
        true = cv2.dilate(np.array(Image.open(file)), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13))) > 127
        shades = np.array(Image.open(capture / f"work/masks/{file.name}").resize(true.shape[::-1], Image.NEAREST))
        judged = shades != 128  # the rod: neither object nor background
        mask = shades == 255
        overlaps.append((mask & true & judged).sum() / ((mask | true) & judged).sum())
    return f"masks: intersection over union {np.mean(overlaps):.3f}, worst {min(overlaps):.3f}"


def neighbours(result: Path) -> str:
    """How much photographs from almost the same place differ in brightness, and how much with their powers taken out.

    Brightness is the median of log radiance at pixels of the mask that are not clipped, times the squared distance. All
    photographs have the same exposure.
    """
    capture = load_capture(result / "scene.xml")
    photographs = json.loads((result / "calibration.json").read_text())["photographs"]
    center, _ = capture.sphere()
    chosen = [k for k, name in enumerate(capture.names) if "power" in photographs.get(name, {})]
    if not chosen:
        return "no powers were refined"
    from_center = np.array([capture.shots[k].camera.position - center for k in chosen])
    distances = np.linalg.norm(from_center, axis=1)
    directions = from_center / distances[:, None]
    levels = []
    for k, distance in zip(chosen, distances):
        seen = capture.observe([k], 8)
        inside = (seen.mask > 0.99) & ~seen.clipped.any(-1) & (seen.rgb > 0).all(-1)
        levels.append(seen.rgb[inside].log().median(0).values.numpy() + 2 * np.log(distance))
    found = np.log([photographs[capture.names[k]]["power"] for k in chosen])
    a, b = np.array([*itertools.combinations(range(len(chosen)), 2)]).T
    near = (directions[a] * directions[b]).sum(1) > NEAR[0]
    near &= np.abs(np.log(distances[a] / distances[b])) < NEAR[1]
    a, b = a[near], b[near]
    brighter, stronger = np.array(levels)[a] - np.array(levels)[b], found[a] - found[b]
    before, after = (100 * np.sqrt(np.square(part).mean(0)) for part in (brighter, brighter - stronger))
    colours = "red {:.1f} %, green {:.1f} %, blue {:.1f} %"
    return (f"{len(a)} pairs of photographs from almost the same place differ in brightness by "
            f"{colours.format(*before)}; with the powers taken out by {colours.format(*after)}")  # fmt: skip


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--flash-offset", nargs=3, default=None)
    parser.add_argument("--fit", nargs=argparse.REMAINDER, default=[], help="more options of the fit")
    options = parser.parse_args()
    capture = options.out
    if not (capture / "scene.xml").exists():
        offset = ["--flash-offset", *options.flash_offset] if options.flash_offset else []
        run("mi_ring.photos", options.photos, capture, *offset)
    if REFERENCE.is_dir():
        print(cameras_off(capture), masks_off(capture), sep="\n", flush=True)
    result = capture / f"fit_{options.preset}"
    run("mi_ring.fit", capture / "scene.xml", "--preset", options.preset, "--holdout", EVERY, "--out", result,
        *options.fit)  # fmt: skip
    if (result / "calibration.json").exists():
        print(neighbours(result), flush=True)
    run("mi_ring.render", result, held_out(capture, result), result / "held_out")
    if REFERENCE.is_dir():
        photographs = capture / "reference"
        if not photographs.is_dir():
            run("mi_ring.convert", "colmap", REFERENCE, photographs / "scene.xml")
        judge = [SHARED / "tools/judge_photos.py", photographs / "images", REFERENCE / "judged", result / "held_out"]
        print(subprocess.run([sys.executable, *map(str, judge)], capture_output=True, text=True).stdout)


if __name__ == "__main__":
    main()
