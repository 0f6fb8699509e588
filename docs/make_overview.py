"""The README's picture: a photograph, the fitted mesh, and the fitted object under new lamps, from the same camera.

python docs/make_overview.py RUN docs/skull/overview.jpg [--photograph 32]

RUN is a results folder whose photographs are 8-bit files. The mesh is drawn in grey. Mitsuba's `path` renders mesh and
object. The three pictures are cropped to the object.
"""

import argparse
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mi_ring  # noqa: F401  (chooses LLVM before Mitsuba is imported)

# isort: split
import mitsuba as mi
import numpy as np
from make_picture import labelled
from PIL import Image

from mi_ring.images import linear_to_srgb

WIDTH = 420  #: of each picture [px]
BORDER = 0.12  #: around the object, as a share of its extent in the picture
NEUTRAL, WARM, COLD = (14, 14, 14), (20, 16, 11), (4, 6, 11)  #: radiance of the lamps


def photograph(run: Path, name: str) -> np.ndarray:
    """The photograph (H, W, 3) that the sensor `name` of the run shows, as sRGB from 0 to 1."""
    sensor = ElementTree.parse(run / "scene.xml").find(f"sensor[@id='{name}']")
    if sensor is None:
        raise SystemExit(f"{run}/scene.xml: has no photograph {name}")
    image = Image.open(run / sensor.find("string[@name='filename']").get("value")).convert("RGB")
    return np.array(image) / 255.0


def pictures(run: Path, name: str, spp: int) -> dict[str, np.ndarray]:
    """The three pictures by their labels, as sRGB from 0 to 1, cropped and `WIDTH` pixels wide."""
    scene = mi.load_file(str(run / "scene.xml"), parallel=False)
    sensor = next(sensor for sensor in scene.sensors() if sensor.id() == name)
    left, up, forward = np.array(mi.traverse(sensor)["to_world"].matrix).reshape(4, 4)[:3, :3].T
    grey = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    mesh = {"type": "ply", "filename": str(run / "mesh.ply"), "bsdf": grey}
    fitted = {"type": "shapenet", "weights": str(run / "ring.pt"), "flash": False, "bsdf": {"type": "cooktorrance"}}
    box = mi.load_dict(mesh).bbox()
    centre, radius = np.array(box.center()).ravel(), np.linalg.norm(np.array(box.extents()).ravel()) / 2

    def lamp(direction: np.ndarray, radiance: tuple[float, float, float]) -> dict:
        """A sphere that shines, four radii of the object away."""
        place = centre + 4 * radius * direction / np.linalg.norm(direction)
        light = {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}
        return {"type": "sphere", "center": place.tolist(), "radius": 0.9 * float(radius), "emitter": light}

    def rendered(shape: dict, sky: float, **lamps: dict) -> np.ndarray:
        """Radiance (H, W, 3), scaled so that a hundredth of the object is above 0.8."""
        lights = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": sky}}, **lamps}
        path = mi.load_dict({"type": "path", "hide_emitters": True, "max_depth": 5})
        world = mi.load_dict({"type": "scene", "object": shape, **lights}, parallel=False)
        rgb = np.array(mi.render(world, sensor=sensor, integrator=path, spp=spp))[..., :3]
        return 0.8 * rgb / np.quantile(rgb[rgb.any(-1)].max(-1), 0.99)

    clay = rendered(mesh, 0.25, key=lamp(0.9 * left + 0.8 * up - forward, NEUTRAL))
    relit = rendered(
        fitted, 0.05, key=lamp(0.7 * up - left - 0.45 * forward, WARM), rim=lamp(left + 0.3 * up + 0.6 * forward, COLD)
    )
    rows, columns = (np.flatnonzero(clay.any((2, axis))) for axis in (1, 0))
    border = round(BORDER * max(np.ptp(rows), np.ptp(columns)))
    window = tuple(slice(max(0, seen[0] - border), seen[-1] + border) for seen in (rows, columns))

    def shown(picture: np.ndarray) -> np.ndarray:
        """The window, in the width that is shown."""
        image = Image.fromarray((np.clip(picture[window], 0, 1) * 255).astype(np.uint8))
        height = round(WIDTH * image.height / image.width)
        return np.array(image.resize((WIDTH, height), Image.Resampling.LANCZOS)) / 255.0

    found = {"photograph": photograph(run, name), "mesh": linear_to_srgb(clay), "new light": linear_to_srgb(relit)}
    return {label: shown(picture) for label, picture in found.items()}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="results folder of a fit")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--photograph", default="32", help="its id in the scene file")
    parser.add_argument("--spp", type=int, default=256, help="samples per pixel")
    options = parser.parse_args()
    sheet = labelled(pictures(options.run, options.photograph, options.spp))
    Image.fromarray(sheet).save(options.picture, quality=90)


if __name__ == "__main__":
    main()
