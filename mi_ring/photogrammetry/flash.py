"""The flash and the light of the room, by how bright photographs show the white squares of the printed sheet."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mi_ring.capture.capture import evenly

PAPER = 0.8  #: albedo of white paper
#: Standard deviations of priors: of the flash's place across the lens and along its axis [median distance from the
#: cameras to the squares], of the exponent of its cone, of the room's light [that of the flash], of the share that the
#: object sends back, and of each photograph's exposure and white balance beside what EXIF data say [logarithm].
OFFSET, DEPTH, CONE, ROOM, BOUNCED, POWER = 0.1, 0.02, 1.0, 0.1, 1.0, 0.05
ERROR = 0.1  #: of a square's brightness, relative; much of it is alike for all of a photograph
ROBUST = 0.02  #: relative error beyond which a square counts less: it is in a shadow, or shines
DARK = 1e-4  #: radiance below which nothing is told
MOST = 60  #: photographs that are asked together
SIDEWAYS = 1e-3  #: the least cosine from the axis


class Ball(NamedTuple):
    """The object, as far as its light on the paper goes."""

    center: np.ndarray  #: (3,)
    radius: float

    def bounce(self, places: np.ndarray, lights: np.ndarray) -> np.ndarray:
        """Irradiance (n,) of `places` (n, 3) on the sheet by a white ball under lights (n, 3) of intensity 1.

        As of a Lambertian sphere from afar, by its phase (Lambert 1760).
        """
        up, toward = self.center - places, lights - self.center
        lit = np.linalg.norm(toward, axis=1)
        phase = np.arccos(np.clip(-(up * toward).sum(1) / (np.linalg.norm(up, axis=1) * lit), -1, 1))
        seen = (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
        return 2 / 3 * seen * self.share(places) / lit**2

    def share(self, places: np.ndarray) -> np.ndarray:
        """Of the light from all sides on `places` (n, 3) on the sheet what comes from where the ball is: (n,)."""
        up = self.center - places
        away = np.linalg.norm(up, axis=1)
        return ((self.radius / away) ** 2 * np.maximum(up[:, 2], 0) / away).clip(max=1)


class Flash(NamedTuple):
    """What the sheet tells of light. Frame: the sheet's [mm]; cameras have OpenCV's axes."""

    offset: np.ndarray  #: (3,) of the flash from the lens, in the camera's axes as most photographs are shown [mm]
    falloff: float  #: exponent of the cosine about the axis of the lens, like which it shines
    room: np.ndarray  #: (3,) irradiance of the sheet by the room's light, by the flash's intensity [1/mm²]
    intensities: dict[str, np.ndarray]  #: (3,) by the photograph's name; exposure and white balance are part of them

    @property
    def ambient(self) -> np.ndarray:
        """(3,) radiance of a room that is alike from all sides, at the usual exposure."""
        return self.room / np.pi * np.median(list(self.intensities.values()), 0)


def irradiance(way: np.ndarray, normal: np.ndarray, forward: np.ndarray, falloff: float) -> np.ndarray:
    """(n,) of places with a `normal` (3,), by a flash of intensity 1 that is `way` (n, 3) off; 0 from behind.

    It looks `forward` (3,) or (n, 3), and shines like the cosine from there to the power of `falloff`.
    """
    away = np.linalg.norm(way, axis=1)
    cosine = np.maximum(-(way * forward).sum(1) / away, SIDEWAYS)
    return cosine**falloff * np.maximum(way @ normal, 0) / away**3


class Paper(NamedTuple):
    """White paper in photographs: n places of the sheet, and the camera that saw each."""

    places: np.ndarray  #: (n, 3)
    radiance: np.ndarray  #: (n, 3) logarithms
    lenses: np.ndarray  #: (n, 3) where the cameras are
    forward: np.ndarray  #: (n, 3) where they look
    axes: np.ndarray  #: (n, 3, 3) from the axes that the flash's offset is in to the world's

    @classmethod
    def of(cls, squares: tuple[np.ndarray, np.ndarray], pose: np.ndarray, axes: np.ndarray) -> "Paper":
        """What one photograph shows."""
        places, colours = squares
        count = len(places)
        return cls(places, np.log(np.maximum(colours, DARK)), np.tile(pose[:3, 3], (count, 1)),
                   np.tile(pose[:3, 2], (count, 1)), np.tile(pose[:3, :3] @ axes, (count, 1, 1)))  # fmt: skip

    def expected(
        self, offset: np.ndarray, falloff: float, room: np.ndarray, bounced: np.ndarray, ball: Ball | None
    ) -> np.ndarray:  # fmt: skip
        """(n, 3) logarithms of radiance by the flash's intensity; the light is as `Flash` has it.

        `bounced` (3,): how much of its light the `ball` sends back.
        """
        way = self.lenses + self.axes @ offset - self.places
        light = irradiance(way, np.array([0.0, 0, 1]), self.forward, falloff)[:, None]
        if ball:
            light = light + bounced * ball.bounce(self.places, way + self.places)[:, None]
            room = room * (1 - ball.share(self.places))[:, None]
        return np.log(np.maximum(light + room, 1e-12) * PAPER / np.pi)


def find_flash(
    squares: Mapping[str, tuple[np.ndarray, np.ndarray]], poses: Mapping[str, np.ndarray],
    axes: Mapping[str, np.ndarray], exposures: Mapping[str, float], offset: np.ndarray, ball: Ball | None = None,
) -> Flash | None:  # fmt: skip
    """The flash that makes white paper as bright as it is; None if there is none.

    `squares`: by the photograph's name places (n, 3) and colours (n, 3), as `mi_ring.photogrammetry.board.white` has
    them; `poses` (4, 4); `axes` (3, 3): from those of most photographs to those of each; `exposures`: relative ones.
    Unknown are, for all photographs, the flash's `offset` (3,), of which this is the guess, its cone, what the room
    sends to the paper, by the flash's power, and what the object does, the `ball`; and each photograph's intensity. The
    least squares of logarithms, robust, with the priors above: how brightness falls off over the paper, and from one
    photograph to the next, tells one from another.
    """
    names = [n for n in squares if n in poses and len(squares[n][0]) and poses[n][2, 3] > 0]
    if not names:
        return None
    shown = {name: Paper.of(squares[name], poses[name], axes[name]) for name in names}
    some = [names[k] for k in evenly(len(names), MOST)]
    paper = Paper(*(np.concatenate(parts) for parts in zip(*(shown[n] for n in some))))
    of = np.repeat(np.arange(len(some)), [len(shown[n].places) for n in some])
    known = np.log([[exposures[n]] for n in some])
    unit = float(np.median(np.linalg.norm(paper.lenses - paper.places, axis=1)))
    widths = np.array([OFFSET * unit, OFFSET * unit, DEPTH * unit, CONE, *[ROOM / unit**2] * 3, *[BOUNCED] * 3])

    def light(shared: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        """As `Paper.expected` takes it."""
        values = shared * widths
        return offset + values[:3], values[3], values[4:7], values[7:]

    def residuals(x: np.ndarray) -> np.ndarray:
        shared, usual, more = x[:10], x[10:13], x[13:].reshape(-1, 3)
        predicted = (known + usual + POWER * more)[of] + paper.expected(*light(shared), ball)
        return np.concatenate([((paper.radiance - predicted) / ERROR).ravel(), x[13:], shared])

    def robust(squares: np.ndarray) -> np.ndarray:
        """What squares of residuals count, and its first two derivatives: ``soft_l1``, but those of priors wholly."""
        told = np.arange(len(squares)) < paper.radiance.size
        root = np.sqrt(1 + squares)
        return np.where(told, [2 * (root - 1), 1 / root, -0.5 / root**3], [squares, 1 + 0 * squares, 0 * squares])

    start = np.zeros(13 + 3 * len(some))
    start[3:10] = 0.3  # away from the bounds
    start[10:13] = np.median(paper.radiance - known[of] - paper.expected(*light(start[:10]), ball), 0)
    lowest = np.full(len(start), -np.inf)
    lowest[3:10] = 0  # neither cone, nor room, nor object takes light away
    found = least_squares(residuals, start, bounds=(lowest, np.inf), loss=robust, f_scale=ROBUST / ERROR).x[:10]
    place, falloff, room, _ = shared = light(found)
    strengths = {n: np.exp(np.median(own.radiance - own.expected(*shared, ball), 0)) for n, own in shown.items()}
    return Flash(place, float(falloff), room, strengths)
