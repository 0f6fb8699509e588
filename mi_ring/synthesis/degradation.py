"""What is wrong with photographs and their calibration: exposure, noise, bits; cameras and lights elsewhere."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.scene.shot import Shot

Format = Literal["exr", "png16", "png8"]

BRIGHTEST = 16.0  #: beyond, what fell onto a sensor is of no interest [full scale]
HIGHEST = 6e4  #: that an EXR of half precision holds


def noisy(linear: np.ndarray, electrons: float, read: float, random: np.random.Generator) -> np.ndarray:
    """Linear values with the noise of a sensor that has so many `electrons` at full scale (0: no shot noise).

    `read`: standard deviation of reading it [electrons of 10,000 at full scale where `electrons` is 0].
    """
    full = electrons or 10_000.0
    value = np.clip(linear, 0, BRIGHTEST) * full
    if electrons:
        value = random.poisson(value).astype(float)
    return (value + random.normal(0, read, value.shape)) / full


def encoded(linear: np.ndarray, kind: Format) -> np.ndarray:
    """Pixels (H, W, 3) as the file has them: half floats, or 16 bits, both linear; or 8 bits, sRGB."""
    if kind == "exr":
        return np.clip(linear, 0, HIGHEST).astype(np.float16)
    if kind == "png16":
        return (np.clip(linear, 0, 1) * 65535 + 0.5).astype(np.uint16)
    return to_bytes(linear_to_srgb(linear))


def exposures(count: int, spread: float, random: np.random.Generator) -> np.ndarray:
    """(count, 3) factors of exposures that differ by so many per cent, and by a third of that in each colour."""
    return np.exp(random.normal(0, spread / 100, (count, 1)) + random.normal(0, spread / 300, (count, 3)))


def miscalibrated(
    shots: Sequence[Shot], center: np.ndarray, random: np.random.Generator, turned: float = 0.0, shifted: float = 0.0,
    scaled: float = 0.0,
) -> tuple[Shot, ...]:  # fmt: skip
    """The same photographs with cameras and lights that are wrong by known amounts.

    `turned`: each camera about each of its axes by a normal angle of so many degrees, and along each by a normal share
    of so many per cent of its distance from the `center` (3,); its flash goes with it. `shifted`: all point lights by
    so many per cent of that distance, in one direction of the cameras' axes. `scaled`: each light's power by a
    lognormal factor of so many per cent.
    """
    wrong = []
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction)
    for shot in shots:
        camera, light = shot.camera, shot.own_light
        distance, point = np.linalg.norm(camera.position - center), light.kind == "point"
        if turned:
            to_world = camera.to_world.copy()
            to_world[:3, :3] @= Rotation.from_rotvec(np.radians(random.normal(0, turned, 3))).as_matrix()
            to_world[:3, 3] += camera.to_world[:3, :3] @ random.normal(0, turned / 100 * distance, 3)
            if point:  # a flash stays where it is in the camera's axes
                own = camera.to_world[:3, :3].T @ (light.vector - camera.position)
                light = light._replace(vector=to_world[:3, :3] @ own + to_world[:3, 3])
            shot = replace(shot, camera=camera._replace(to_world=to_world))
        if shifted and point:
            light = light._replace(vector=light.vector + camera.to_world[:3, :3] @ direction * shifted / 100 * distance)
        if scaled:
            light = light._replace(rgb=light.rgb * np.exp(random.normal(0, scaled / 100)))
        wrong.append(replace(shot, light=light))
    return tuple(wrong)
