"""What lights the object: the light of each photograph, and the room's or an environment's beside it."""

from typing import Literal

import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.rendering.spherical_harmonics import BASIS, PER_FRAME, room_envmap
from mi_ring.scene.lights import Light

LightKind = Literal["flash", "point", "distant", "lamp"]
RoomKind = Literal["constant", "harmonics"]

SLOW = 9  #: harmonics of a room that are not 0, those of order 2
TINT, WAVES = 0.12, 0.5  #: of the light of a room: how colours differ, and brightness with direction, about 1
APART = 4  #: directions of which a further lamp has the one that is farthest from the others
WEAKEST = 0.4  #: of a further lamp, by the first
DARKEST = 0.15  #: radiance of a room in its darkest direction, by its mean


def lights_of(
    kind: LightKind, cameras: list[Camera], offset: tuple[float, float, float], spread: float,
    random: np.random.Generator, distance: float = 1.0,
) -> list[Light]:  # fmt: skip
    """Lights so strong that they bring 1 W/m² to a surface at the origin that faces them, in the median.

    Every point light has the same intensity. `offset`: of a flash from the lens, left, up and forward, by the distance
    from the camera to the origin; `spread`: how far others are from the camera at most, seen from the origin [degrees].
    A lamp is in one place for all, at this `distance`.
    """
    if kind == "flash":
        places = [c.position + np.linalg.norm(c.position) * c.to_world[:3, :3] @ offset for c in cameras]
    elif kind == "lamp":
        away = random.normal(size=3)
        places = [distance * away / np.linalg.norm(away)] * len(cameras)
    else:
        places = [strayed(camera.position, np.radians(spread), random) for camera in cameras]
    if kind == "distant":
        return [Light("directional", -place / np.linalg.norm(place), np.ones(3)) for place in places]
    intensity = np.full(3, np.median([place @ place for place in places] or [0]))
    return [Light("point", place, intensity) for place in places]


def others_of(count: int, first: Light, random: np.random.Generator) -> list[Light]:
    """More lamps than the `first`, as far from the origin, in other directions; each weaker, and of another colour."""
    distance, toward = np.linalg.norm(first.vector), [first.vector / np.linalg.norm(first.vector)]
    lights = []
    for _ in range(count):
        tries = random.normal(size=(APART, 3))
        tries /= np.linalg.norm(tries, axis=1, keepdims=True)
        toward.append(tries[(tries @ np.transpose(toward)).max(1).argmin()])
        strength = random.uniform(WEAKEST, 1) * (1 + TINT * random.uniform(-1, 1, 3))
        lights.append(Light("point", distance * toward[-1], first.rgb * strength))
    return lights


def strayed(position: np.ndarray, spread: float, random: np.random.Generator) -> np.ndarray:
    """As far from the origin as a position (3,), in a direction within `spread` [radians] of it, all alike likely."""
    cosine, turn = random.uniform(np.cos(spread), 1), random.uniform(0, 2 * np.pi)
    axis = position / np.linalg.norm(position)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    across = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    return np.linalg.norm(position) * (cosine * axis + np.sqrt(1 - cosine**2) * across)


def room_of(kind: RoomKind, in_camera: bool, random: np.random.Generator) -> np.ndarray:
    """Radiance (BASIS, 3) as `mi_ring.rendering.spherical_harmonics` has it, whose mean over directions is about 1.

    `in_camera`: it stands still with the camera beside a turntable, not with the object.
    """
    harmonics = np.zeros((SLOW, 3))
    colour = 1 + TINT * random.uniform(-1, 1, 3)
    harmonics[0] = colour * np.sqrt(4 * np.pi)  # times the first harmonic, which is 1 / sqrt(4 pi)
    if kind == "harmonics":
        waves = random.normal(0, WAVES, (SLOW - 1, 1)) * colour
        darkest = (room_envmap(np.vstack([0 * waves[:1], waves]), np.eye(4)) / colour).min()
        harmonics[1:] = waves * min(1.0, (1 - DARKEST) / -darkest)
    room = np.zeros((BASIS, 3))
    room[0] = harmonics[0]
    first = PER_FRAME if in_camera else 1
    room[first : first + SLOW - 1] = harmonics[1:]
    return room


def environment_of(radiance: np.ndarray) -> mi.Emitter:
    """An environment of radiances (H, W, 3) by latitude and longitude, y up."""
    return mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(radiance.astype(np.float32))})
