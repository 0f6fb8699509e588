"""What lights the object: the light of each photograph, and the room's or an environment's beside it."""

from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.rendering.lights import Light
from mi_ring.rendering.rooms import BASIS, COUNT, harmonics_toward

LightKind = Literal["flash", "point", "distant"]
RoomKind = Literal["constant", "harmonics"]

ROWS = 128  #: of the picture of a room, in which its harmonics are drawn
TINT, WAVES = 0.12, 0.5  #: of the light of a room: how colours differ, and brightness with direction, about 1
DARKEST = 0.15  #: radiance of a room in its darkest direction, by its mean


def lights_of(
    kind: LightKind, cameras: list[Camera], offset: tuple[float, float, float], spread: float,
    random: np.random.Generator,
) -> list[Light]:  # fmt: skip
    """Lights so strong that they bring 1 W/m² to a surface at the origin that faces them, in the median.

    Every point light has the same intensity. `offset`: of a flash from the lens, left, up and forward, by the distance
    from the camera to the origin; `spread`: how far others are from the camera at most, seen from the origin [degrees].
    """
    if kind == "flash":
        places = [c.position + np.linalg.norm(c.position) * c.to_world[:3, :3] @ offset for c in cameras]
    else:
        places = [strayed(camera.position, np.radians(spread), random) for camera in cameras]
    if kind == "distant":
        return [Light("directional", -place / np.linalg.norm(place), np.ones(3)) for place in places]
    intensity = np.full(3, np.median([place @ place for place in places] or [0]))
    return [Light("point", place, intensity) for place in places]


def strayed(position: np.ndarray, spread: float, random: np.random.Generator) -> np.ndarray:
    """As far from the origin as a position (3,), in a direction within `spread` [radians] of it, all alike likely."""
    cosine, turn = random.uniform(np.cos(spread), 1), random.uniform(0, 2 * np.pi)
    axis = position / np.linalg.norm(position)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    across = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    return np.linalg.norm(position) * (cosine * axis + np.sqrt(1 - cosine**2) * across)


def room_of(kind: RoomKind, in_camera: bool, random: np.random.Generator) -> np.ndarray:
    """Radiance (BASIS, 3) in the harmonics of `mi_ring.rendering.rooms`, whose mean over directions is about 1.

    `in_camera`: it stands still with the camera beside a turntable, not with the object.
    """
    harmonics = np.zeros((COUNT, 3))
    colour = 1 + TINT * random.uniform(-1, 1, 3)
    harmonics[0] = colour * np.sqrt(4 * np.pi)  # times the first harmonic, which is 1 / sqrt(4 pi)
    if kind == "harmonics":
        waves = random.normal(0, WAVES, (COUNT - 1, 1)) * colour
        darkest = (seen_from_within(np.vstack([0 * waves[:1], waves]), np.eye(4)) / colour).min()
        harmonics[1:] = waves * min(1.0, (1 - DARKEST) / -darkest)
    room = np.zeros((BASIS, 3))
    room[:COUNT] = harmonics
    if in_camera:
        room[COUNT:], room[1:COUNT] = harmonics[1:], 0
    return room


def seen_from_within(room: np.ndarray, to_world: np.ndarray, rows: int = ROWS) -> np.ndarray:
    """Radiance (rows, 2 rows, 3) of harmonics (COUNT or BASIS, 3) as `envmap` has it, for a camera with this pose."""
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    theta, phi = np.pi * v.ravel(), 2 * np.pi * u.ravel()
    # Mitsuba's: y up, and -z in the middle of the picture's borders
    direction = mi.Vector3f(*(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)))
    values = np.zeros((len(theta), 3))
    for row, harmonic in zip(room, harmonics_toward(direction, mi.Matrix4f(to_world))):
        values += np.asarray(dr.detach(harmonic) + dr.zeros(mi.Float, len(theta)))[:, None] * row
    return values.reshape(rows, 2 * rows, 3)


def environment_of(radiance: np.ndarray) -> mi.Emitter:
    """An environment of radiances (H, W, 3) by latitude and longitude, y up."""
    return mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(radiance.astype(np.float32))})
