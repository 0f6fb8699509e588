"""Render photographs of a fitted object: `python -m mi_ring.render RUN SCENE.xml OUT/`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tqdm import tqdm
from tyro.conf import Positional, arg

from mi_ring import bridge, capture, command
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.errors import InputError
from mi_ring.results import load_ring, write_image, writing


@dataclass(frozen=True)
class RenderConfig:
    """Render every photograph of a scene with the object of a finished fit, under the same file names."""

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit, or its ring.pt."""
    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs to take; their image files need not exist."""
    out: Positional[Annotated[Path, arg(metavar="OUT")]]
    """Folder for the pictures: linear where the scene names an EXR file, 8-bit sRGB for PNG and JPEG."""
    subdivisions: int = 6
    """Level of the mesh: 10 · 4^level + 2 vertices."""
    spp: int = 64
    """Samples per pixel."""


def main(arguments: Sequence[str]) -> None:
    """The command."""
    config = command.parse(RenderConfig, arguments, "mi_ring.render")
    if not 0 <= config.subdivisions <= 8:
        raise InputError(f"--subdivisions: is {config.subdivisions}, must be 0 to 8")
    if config.spp < 1:
        raise InputError(f"--spp: is {config.spp}, must be at least 1")
    ring = load_ring(config.run)
    scene = capture.load(config.scene, images=False)
    names = scene.names
    if len(set(names)) < len(names):
        double = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{config.scene}: filename: {double} occurs twice; pictures would overwrite each other")
    for sensor, name in zip(scene.sensors, names):
        if sensor.filename.suffix.lower() not in (".png", ".exr", ".jpg", ".jpeg"):
            raise InputError(f"{config.scene}: filename: {sensor.filename.name} must end in .png, .jpg or .exr")
        if (config.out / name).resolve() == sensor.filename.resolve():
            raise InputError(f"{config.out}: holds the scene's own photographs; choose another folder")
    with writing(config.out):
        for name in names:
            (config.out / name).parent.mkdir(parents=True, exist_ok=True)
    surface = bridge.Surface(scene.scene, scene.shape, ring)
    surface.show(ring, *ring.domain.sample(config.subdivisions))
    for k, name in enumerate(tqdm(names, desc="rendering", unit="photograph")):
        photograph = scene.photograph(k)
        rgb, _ = bridge.draw(surface, photograph, spp=config.spp, shadows=scene.shadows, indirect=ring.indirect)
        write_picture(rgb[0].numpy(), config.out / name)
    print(f"{len(scene.sensors)} photographs in {config.out}/")


def write_picture(linear: np.ndarray, path: Path) -> None:
    """Write (H, W, 3) linear radiance: EXR as it is, anything else 8-bit sRGB."""
    exr = path.suffix.lower() == ".exr"
    write_image(linear.astype(np.float32) if exr else to_bytes(linear_to_srgb(linear)), path)


if __name__ == "__main__":
    command.run("mi_ring.render", main)
