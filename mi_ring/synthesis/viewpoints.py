"""Where photographs are taken from: evenly all around, freely by hand, or from one place beside a turntable."""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

CameraKind = Literal["around", "free", "turntable"]

LOWEST = 0.1  #: height of a camera above a table on which the object stands, by its distance
NEARER, FARTHER = 0.98, 1.2  #: free cameras, by the distance of the others
ASTRAY, ROLL = 0.06, 15.0  #: how far free ones aim beside the object, by its radius, and lean [degrees]
GOLDEN = np.pi * (3 - np.sqrt(5))  #: turns along a spiral that is even everywhere


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """A camera-to-world matrix (4, 4), x left, y up, z forward, leaning by `roll` [radians] about where it looks."""
    forward = (target - position) / np.linalg.norm(target - position)
    if abs(forward @ up) > 0.99 * np.linalg.norm(up):  # straight up or down: any other direction is up
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
    """Camera-to-world matrices (4, 4) around an object of this radius at the origin.

    `elevations` [degrees]: of the rings of a turntable, in whose frame the cameras are; `standing`: on a table, so that
    none is below.
    """
    upright = Rotation.align_vectors([up], [[0.0, 0.0, 1.0]])[0].as_matrix()
    low = LOWEST if standing else -1.0
    result = []
    for k in range(count):
        turn, height, away, aim, roll = k * GOLDEN, low + (1 - low) * (k + 0.5) / count, distance, np.zeros(3), 0.0
        if kind == "free":
            turn, height = random.uniform(0, 2 * np.pi), random.uniform(low, 1)
            away = distance * random.uniform(NEARER, FARTHER)
            aim = ASTRAY * radius * random.uniform(-1, 1, 3)
            roll = np.radians(random.normal(0, ROLL))
        elif kind == "turntable":
            ring = k * len(elevations) // count
            first, last = (-(-r * count // len(elevations)) for r in (ring, ring + 1))
            turn = 2 * np.pi * (k - first + ring / len(elevations)) / (last - first)
            height = np.sin(np.radians(elevations[ring]))
        flat = np.sqrt(max(0.0, 1 - height**2))
        direction = upright @ np.array([np.cos(turn) * flat, np.sin(turn) * flat, height])
        result.append(look_at(away * direction, aim, up, roll))
    return result
