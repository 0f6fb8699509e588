"""Simulates errors of captures: sensor noise, quantisation, varying exposure, and wrong cameras and lights."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.scene.shot import Shot

Format = Literal["exr", "png16", "png8"]

NOISE_LIMIT = 16.0  #: radiance is clipped to this before noise is added [full scale]
HALF_LIMIT = 6e4  #: radiance is clipped to this before it is written as half floats


def with_noise(linear: np.ndarray, electrons: float, read: float, random: np.random.Generator) -> np.ndarray:
    """Return linear values with simulated sensor noise. The value 1 is full scale. Values above 16 are clipped first.

    `electrons`: number of electrons at full scale, for shot noise; 0: no shot noise. `read`: standard deviation of the
    read noise [electrons]; without shot noise, its unit is 1/10,000 of full scale.
    """
    full = electrons or 10_000.0  # unit of read noise if there is no shot noise
    value = np.clip(linear, 0, NOISE_LIMIT) * full
    if electrons:
        value = random.poisson(value).astype(float)
    return (value + random.normal(0, read, value.shape)) / full


def encode(linear: np.ndarray, kind: Format) -> np.ndarray:
    """Encode linear pixels (H, W, 3) for an image file of this kind. Values out of range are clipped.

    exr: linear float16. png16: linear uint16. png8: sRGB uint8.
    """
    if kind == "exr":
        return np.clip(linear, 0, HALF_LIMIT).astype(np.float16)
    if kind == "png16":
        return (np.clip(linear, 0, 1) * 65535 + 0.5).astype(np.uint16)
    return to_bytes(linear_to_srgb(linear))


def exposures(count: int, spread: float, random: np.random.Generator) -> np.ndarray:
    """Draw random exposure factors (count, 3): one for each of `count` photographs and each colour.

    They are lognormal with median 1. `spread`: standard deviation of the factor that R, G and B of a photograph share
    [%]; each colour has a further factor with a third of this spread.
    """
    return np.exp(random.normal(0, spread / 100, (count, 1)) + random.normal(0, spread / 300, (count, 3)))


def miscalibrated(
    shots: Sequence[Shot], center: np.ndarray, random: np.random.Generator, turned: float = 0.0, shifted: float = 0.0,
    scaled: float = 0.0,
) -> tuple[Shot, ...]:  # fmt: skip
    """Return copies of the photographs with random errors of cameras and lights. 0 means no error of this kind.

    `center` (3,): middle of the object; the distance from a camera to it is the unit of translations. `turned`:
    standard deviation of a camera's rotation about each axis [deg] and of its translation along each axis [% of the
    distance]; a flash moves with the camera. `shifted`: length of the translation of each point light [% of the
    distance]; its direction relative to the camera is random but the same for all. `scaled`: standard deviation of a
    lognormal factor of each light's intensity [%].
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
                in_camera = camera.to_world[:3, :3].T @ (light.vector - camera.position)
                light = light._replace(vector=to_world[:3, :3] @ in_camera + to_world[:3, 3])
            shot = replace(shot, camera=camera._replace(to_world=to_world))
        if shifted and point:
            light = light._replace(vector=light.vector + camera.to_world[:3, :3] @ direction * shifted / 100 * distance)
        if scaled:
            light = light._replace(rgb=light.rgb * np.exp(random.normal(0, scaled / 100)))
        wrong.append(replace(shot, light=light))
    return tuple(wrong)
