"""Makes camera poses: evenly around an object, as if hand-held, or around a turntable."""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

CameraKind = Literal["around", "free", "turntable"]

LOWEST = 0.1  #: least height of a camera above the table [its distance]
NEARER, FARTHER = 0.98, 1.2  #: range of distances of hand-held cameras [`distance`]
AIM, ROLL = 0.06, 15.0  #: of hand-held cameras: error of the aim [`radius`], standard deviation of the roll [deg]
GOLDEN = np.pi * (3 - np.sqrt(5))  #: golden angle [rad] of a Fibonacci spiral, whose points are even on a sphere


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Make the camera-to-world matrix (4, 4) of a camera that looks from `position` to `target`; all are (3,).

    The camera's axes are x left, y up, z forward. `up`: direction that is up in the picture; if it is nearly the
    viewing direction, another one is taken. `roll`: rotation about the viewing direction [rad].
    """
    forward = (target - position) / np.linalg.norm(target - position)
    if abs(forward @ up) > 0.99 * np.linalg.norm(up):  # the camera looks along `up`: take another direction
        up = np.roll(up, 1)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left)
    to_world = np.eye(4)
    to_world[:3] = np.stack([left, np.cross(forward, left), forward, position], 1)
    to_world[:3, :3] = Rotation.from_rotvec(roll * forward).as_matrix() @ to_world[:3, :3]
    return to_world


def poses(
    kind: CameraKind, count: int, radius: float, distance: float, up: np.ndarray, random: np.random.Generator,
    elevations: tuple[float, ...] = (20.0, 55.0), standing: bool = False,
) -> list[np.ndarray]:  # fmt: skip
    """Place `count` cameras around an object at the origin. Returns camera-to-world matrices (4, 4).

    `kind`: "around": evenly in all directions; "free": random directions, distances and roll, as if hand-held;
    "turntable": in horizontal rings. `radius`: radius of the object. `distance`: from the origin to a camera. `up`
    (3,): up direction. `elevations`: angles of the rings above the horizontal plane [deg]. `standing`: True: the object
    stands on a table, so no camera of the first two kinds is below it.
    """
    upright = Rotation.align_vectors([up], [[0.0, 0.0, 1.0]])[0].as_matrix()
    low = LOWEST if standing else -1.0
    result = []
    for k in range(count):
        azimuth, height = k * GOLDEN, low + (1 - low) * (k + 0.5) / count
        away, aim, roll = distance, np.zeros(3), 0.0
        if kind == "free":
            azimuth, height = random.uniform(0, 2 * np.pi), random.uniform(low, 1)
            away = distance * random.uniform(NEARER, FARTHER)
            aim = AIM * radius * random.uniform(-1, 1, 3)
            roll = np.radians(random.normal(0, ROLL))
        elif kind == "turntable":
            ring = k * len(elevations) // count
            first, last = (-(-r * count // len(elevations)) for r in (ring, ring + 1))
            azimuth = 2 * np.pi * (k - first + ring / len(elevations)) / (last - first)
            height = np.sin(np.radians(elevations[ring]))
        horizontal = np.sqrt(max(0.0, 1 - height**2))
        direction = upright @ np.array([np.cos(azimuth) * horizontal, np.sin(azimuth) * horizontal, height])
        result.append(look_at(away * direction, aim, up, roll))
    return result
