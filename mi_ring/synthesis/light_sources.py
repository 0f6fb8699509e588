"""Makes the lights of a synthetic capture: the own light of each photograph, further lamps, and the room's light."""

from typing import Literal

import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.rendering.spherical_harmonics import BASIS, PER_FRAME, room_envmap
from mi_ring.scene.lights import Light
from mi_ring.scene.lobes import Lobes

LightKind = Literal["flash", "point", "distant", "lamp", "none"]
RoomKind = Literal["constant", "harmonics", "windows"]

LOW_ORDERS = 9  #: number of spherical harmonics of orders 0 to 2, which a room has
TINT, CONTRAST = 0.12, 0.5  #: of a room's light: variation of the colours, standard deviation of each harmonic
CANDIDATES = 4  #: random directions for a further lamp or window; the one farthest from the others is taken
WEAKEST = 0.4  #: least intensity of a further lamp or window [largest intensity]
DARKEST = 0.15  #: least radiance of a room in any direction [its mean radiance]
WINDOWS, WINDOWS_SHARE = 3, 0.6  #: in a room of this kind, and their share of its light
SHARPNESS = 20.0, 300.0  #: of a window, between which its logarithm is drawn


def lights_of(
    kind: LightKind, cameras: list[Camera], offset: tuple[float, float, float], spread: float,
    random: np.random.Generator, distance: float = 1.0,
) -> list[Light]:  # fmt: skip
    """Place the own light of each photograph. Returns one light per camera, in the same order.

    `kind`: "flash": a point light fixed to the camera, at `offset`; "point" or "distant": a point or directional light
    in a random direction at most `spread` [deg] from the camera, seen from the origin; "lamp": a point light in a
    random direction at `distance` from the origin, the same for all cameras; "none": black. `offset`: position of the
    flash relative to the lens, left, up and forward [distance from the camera to the origin].

    The median irradiance of a surface at the origin that faces its light is 1 W/m². All point lights have the same
    intensity.
    """
    if kind == "none":
        return [Light("point", camera.position, np.zeros(3)) for camera in cameras]
    if kind == "flash":
        places = [c.position + np.linalg.norm(c.position) * c.to_world[:3, :3] @ offset for c in cameras]
    elif kind == "lamp":
        away = random.normal(size=3)
        places = [distance * away / np.linalg.norm(away)] * len(cameras)
    else:
        places = [rotate_randomly(camera.position, np.radians(spread), random) for camera in cameras]
    if kind == "distant":
        return [Light("directional", -place / np.linalg.norm(place), np.ones(3)) for place in places]
    intensity = np.full(3, np.median([place @ place for place in places] or [0]))
    return [Light("point", place, intensity) for place in places]


def further_lamps(count: int, first: Light, random: np.random.Generator) -> list[Light]:
    """Make `count` point lights in addition to the lamp `first`, all as far from the origin as `first`.

    Their directions are random and far apart. They are weaker than `first` and have other colours.
    """
    distance = np.linalg.norm(first.vector)
    directions, lights = first.vector[None] / distance, []
    for _ in range(count):
        directions = with_another(directions, random)
        strength = random.uniform(WEAKEST, 1) * (1 + TINT * random.uniform(-1, 1, 3))
        lights.append(Light("point", distance * directions[-1], first.rgb * strength))
    return lights


def with_another(directions: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Add a random direction, far from the others, to unit vectors (n, 3). Returns (n + 1, 3)."""
    candidates = random.normal(size=(CANDIDATES, 3))
    candidates /= np.linalg.norm(candidates, axis=1, keepdims=True)
    return np.vstack([directions, candidates[(candidates @ directions.T).max(1).argmin()]])


def rotate_randomly(position: np.ndarray, spread: float, random: np.random.Generator) -> np.ndarray:
    """Rotate `position` (3,) about the origin by a random angle, toward a random side. Returns the new position.

    `spread`: largest angle [rad]. All positions within this angle are equally likely.
    """
    cosine, turn = random.uniform(np.cos(spread), 1), random.uniform(0, 2 * np.pi)
    axis = position / np.linalg.norm(position)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    across = np.cos(turn) * side + np.sin(turn) * np.cross(axis, side)
    return np.linalg.norm(position) * (cosine * axis + np.sqrt(1 - cosine**2) * across)


def random_room(kind: RoomKind, in_camera: bool, random: np.random.Generator) -> tuple[np.ndarray, Lobes | None]:
    """Draw the light of a random room. Returns spherical harmonics (BASIS, 3) of its RGB radiance, and small lights.

    Without small lights the latter is None. The mean radiance is about 1. `kind`: "constant": the same radiance from
    all directions; "harmonics": it varies with the direction; "windows": like "harmonics", but most of the light comes
    from small lights. `in_camera`: True: the light is fixed to the camera; False: it is fixed in the world.
    """
    colour = 1 + TINT * random.uniform(-1, 1, 3)
    room = np.zeros((BASIS, 3))
    room[0] = colour * np.sqrt(4 * np.pi)  # the first harmonic is 1 / sqrt(4 pi)
    if kind != "constant":
        waves = random.normal(0, CONTRAST, (LOW_ORDERS - 1, 1)) * colour
        darkest = (room_envmap(np.vstack([np.zeros(3), waves]), np.eye(4)) / colour).min()
        first = PER_FRAME if in_camera else 1
        room[first : first + LOW_ORDERS - 1] = waves * min(1.0, (1 - DARKEST) / -darkest)
    if kind != "windows":
        return room, None
    return (1 - WINDOWS_SHARE) * room, random_windows(in_camera, random)


def random_windows(in_camera: bool, random: np.random.Generator) -> Lobes:
    """Draw `WINDOWS` small lights of different directions, widths and colours.

    Their mean radiance is `WINDOWS_SHARE`. `in_camera`: as in `random_room`.
    """
    first = random.normal(size=(1, 3))
    toward = first / np.linalg.norm(first)
    while len(toward) < WINDOWS:
        toward = with_another(toward, random)
    least, most = np.log(SHARPNESS)
    sharpness = np.exp(random.uniform(least, most, WINDOWS))
    flux = random.uniform(WEAKEST, 1, (WINDOWS, 1)) * (1 + TINT * random.uniform(-1, 1, (WINDOWS, 3)))
    flux *= WINDOWS_SHARE * 4 * np.pi / flux.mean(1).sum()
    return Lobes(toward, sharpness, flux, np.full(WINDOWS, in_camera))
