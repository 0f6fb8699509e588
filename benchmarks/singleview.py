"""Fit DiLiGenT's photographs, one real camera and 96 distant lights, and print how near the normals come.

    python benchmarks/singleview.py ball.npz [cat.npz …] [--out out/singleview] [OPTIONS OF mi_ring.fit]

The files hold `mask` (H, W), `pixels_uint16` (lights, pixels of the mask, 3), `light_dir` (lights, 3; x right, y up, z
to the viewer), `light_int` (lights, 3), `normal_gt` (H, W, 3; the same axes, 0 where none is known) and `K` (3, 3).
Each becomes a scene file with 16-bit photographs. One camera does not say how far away the object is: it is put at a
metre and a half.
"""

import argparse
import contextlib
import datetime
import json
import sys
from pathlib import Path

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import mitsuba as mi
import numpy as np
from accuracy import alone, peak_memory, processor, table

DISTANCE = 1500.0  # [mm]
SENSOR = """
  <sensor type="photograph" id="{id}">
    <string name="filename" value="images/{id}.png"/> <string name="mask" value="mask.png"/>
    <float name="fx" value="{fx}"/> <float name="fy" value="{fy}"/> <float name="cx" value="{cx}"/> <float name="cy" value="{cy}"/>
    <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/></film>
    <emitter type="directional"><vector name="direction" x="{x}" y="{y}" z="{z}"/><rgb name="irradiance" value="{rgb}"/></emitter>
  </sensor>"""  # noqa: E501
SCENE = """<scene version="3.0.0">
  <integrator type="photometric"/>
  <shape type="shapenet" id="object"><bsdf type="cooktorrance"/>
    <point name="center" x="{x}" y="{y}" z="{z}"/><float name="radius" value="{radius}"/></shape>{sensors}
</scene>
"""
AXES = np.array([-1.0, 1.0, -1.0])  # from x right, y up, z back to Mitsuba's camera


def write_scene(data, folder: Path) -> Path:
    """The photographs as a scene; the camera is at the origin and looks along z."""
    mask, K = data["mask"] > 0, data["K"]
    height, width = mask.shape
    (folder / "images").mkdir(parents=True, exist_ok=True)
    mi.Bitmap(mask[..., None].astype(np.uint8) * 255).write(str(folder / "mask.png"))
    sensors = []
    for k, (pixels, direction, rgb) in enumerate(zip(data["pixels_uint16"], data["light_dir"], data["light_int"])):
        image = np.zeros((height, width, 3), np.uint16)
        image[mask] = pixels
        mi.Bitmap(image).write(str(folder / f"images/{k:03}.png"))
        x, y, z = -AXES * direction
        sensors.append(SENSOR.format(
            id=f"{k:03}", fx=K[0, 0], fy=K[1, 1], cx=K[0, 2] + 0.5, cy=K[1, 2] + 0.5, width=width, height=height,
            x=x, y=y, z=z, rgb=" ".join(map(str, rgb)),
        ))  # fmt: skip
    rows, columns = np.nonzero(mask)
    x, y = DISTANCE * np.array([K[0, 2] - columns.mean(), K[1, 2] - rows.mean()]) / [K[0, 0], K[1, 1]]
    radius = np.sqrt(mask.sum() / np.pi) * DISTANCE / K[0, 0]
    (folder / "scene.xml").write_text(SCENE.format(x=x, y=y, z=DISTANCE, radius=radius, sensors="".join(sensors)))
    return folder / "scene.xml"


def fit(file: Path, out: Path, options: list[str]) -> dict:
    """Fit one object in this process and compare its normals with the measured ones."""
    from mi_ring import fit as command  # here, not in the parent: a process begins with its parent's peak memory
    from mi_ring.capture.loading import load_capture
    from mi_ring.metrics import surfaces

    with np.load(file) as archive:
        data = dict(archive)
    mi.set_variant("llvm_ad_rgb")
    scene = write_scene(data, out / "scene")
    with contextlib.redirect_stdout(sys.stderr):  # what goes to stdout is Markdown
        command.main([str(scene), "--out", str(out / "run"), *options])
    _, surface = surfaces.load_true_mesh(out / "run" / "mesh.ply")
    seen, _, normals, _ = surfaces.hits(surface, load_capture(scene).photograph(0))
    inside = ((data["mask"] > 0) & data["normal_gt"].any(-1)).ravel()  # along the cat's outline none are measured
    angles = np.full(len(inside), 90.0)  # where the surface is not: as wrong as can be
    cosine = (normals * AXES * data["normal_gt"].reshape(-1, 3)).sum(1)
    angles[seen] = np.degrees(np.arccos(np.clip(cosine[seen], -1, 1)))
    seconds = json.loads((out / "run/log.jsonl").read_text().splitlines()[-1])["seconds"]
    return {"mean": angles[inside].mean(), "median": np.median(angles[inside]), "missed": (~seen[inside]).mean(),
            "seconds": seconds, "memory": peak_memory()}  # fmt: skip


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/singleview"))
    arguments, options = parser.parse_known_args()
    rows = []
    for file in arguments.files:
        found = alone(fit, file, arguments.out / file.stem, options)
        rows.append([file.stem, f"{found['mean']:.2f}°", f"{found['median']:.2f}°", f"{found['missed']:.2%}",
                     f"{found['seconds']:.0f}", f"{found['memory']:.1f}"])  # fmt: skip
    print(f"{processor()}; {datetime.date.today()}; mi_ring.fit {' '.join(options)}\n")
    print(table(["object", "normals, mean", "median", "missed by the surface", "fit s", "GiB, at most"], rows))


if __name__ == "__main__":
    main()
