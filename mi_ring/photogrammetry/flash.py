"""The flash and the light of the room, by how bright photographs show the white paper of the printed sheet."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mi_ring.geometry.hull import evenly
from mi_ring.photogrammetry.board import White
from mi_ring.rendering.lights import SIDEWAYS

PAPER = 0.8  #: albedo of white paper
#: Standard deviations of priors: of the flash's place across the lens and along its axis [median distance from the
#: cameras to the squares], of the exponent of its cone, of the room's light [that of the flash], of the share that the
#: object sends back; of each photograph's exposure and white balance beside what EXIF data say, and if they say nothing
#: [logarithm].
OFFSET, DEPTH, CONE, ROOM, BOUNCED, TOLD, UNTOLD = 0.1, 0.02, 1.0, 0.1, 1.0, 0.3, 1.0
ERROR = 0.1  #: of a square's brightness, relative; much of it is alike for all of a photograph
ROBUST = 0.02  #: relative error beyond which a square counts less: it is in a shadow, or shines
DARK = 1e-4  #: radiance below which nothing is told
FEW = 3  #: places that are too few for a median
MOST = 60  #: photographs that are asked together
NOTHING = 0.003, 0.05  #: light of the room [that of the flash] and exponent of a cone that are none
CUT = 0.1  #: difference of the margin from the paper [logarithm] that says that it is something else


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
    power: np.ndarray  #: (3,) the flash's intensity at the usual exposure
    intensities: dict[str, np.ndarray]  #: (3,) by the photograph's name; exposure and white balance are part of them

    @property
    def ambient(self) -> np.ndarray:
        """(3,) radiance of a room that is alike from all sides, at the usual exposure."""
        return self.room / np.pi * self.power


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
    def of(cls, white: White, pose: np.ndarray, axes: np.ndarray) -> "Paper":
        """What one photograph shows."""
        count = len(white.places)
        return cls(white.places, np.log(np.maximum(white.colours, DARK)), np.tile(pose[:3, 3], (count, 1)),
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
    squares: Mapping[str, White], poses: Mapping[str, np.ndarray], axes: Mapping[str, np.ndarray],
    exposures: Mapping[str, float], offset: np.ndarray, ball: Ball | None = None,
) -> Flash | None:  # fmt: skip
    """The flash that makes white paper as bright as it is; None if there is none.

    `squares`, by the photograph's name; `poses` (4, 4); `axes` (3, 3): from those of most photographs to those of each;
    `exposures`: relative ones, NaN where nothing tells. Unknown are, for all photographs, the flash's `offset` (3,), of
    which this is the guess, its cone, what the room sends to the paper, by the flash's power, and what the object does,
    the `ball`; and each photograph's intensity. The least squares of logarithms, robust, with the priors above: how
    brightness falls off over the paper, and from one photograph to the next, tells one from another. The margin is part
    of it if it is as bright as the squares say.
    """
    inner = {name: White(*(part[~paper.beside] for part in paper)) for name, paper in squares.items()}
    inner = {n: paper for n, paper in inner.items() if n in poses and len(paper.places) and poses[n][2, 3] > 0}
    if not inner:
        return None
    known = np.array([exposures[name] for name in inner])
    widths = np.where(np.isfinite(known), TOLD, UNTOLD)[:, None]
    known = np.log(np.where(np.isfinite(known), known, 1.0))[:, None]
    shared, power = shared_light(inner, poses, axes, known, widths, offset, ball)
    shown = {n: Paper.of(squares[n], poses[n], axes[n]) for n in inner}
    strengths = strengths_of(list(shown.values()), known + power, widths, shared, ball)
    margin = np.concatenate([
        (own.radiance - own.expected(*shared, ball) - strength)[squares[name].beside]
        for (name, own), strength in zip(shown.items(), strengths)
    ])  # fmt: skip
    if len(margin) and np.abs(np.median(margin, 0)).max() < CUT:
        shared, power = shared_light({n: squares[n] for n in inner}, poses, axes, known, widths, offset, ball)
    else:
        shown = {n: Paper.of(paper, poses[n], axes[n]) for n, paper in inner.items()}
    strengths = np.exp(strengths_of(list(shown.values()), known + power, widths, shared, ball))
    place, falloff, room, _ = shared
    away = np.median([np.linalg.norm(poses[name][:3, 3]) for name in inner])
    least, round_ = NOTHING
    room = room if (room * away**2).max() > least else 0 * room
    return Flash(place, falloff if falloff > round_ else 0.0, room, np.exp(power), dict(zip(inner, strengths)))


Shared = tuple[np.ndarray, float, np.ndarray, np.ndarray]  #: as `Paper.expected` takes it


def shared_light(
    squares: Mapping[str, White], poses: Mapping[str, np.ndarray], axes: Mapping[str, np.ndarray], known: np.ndarray,
    widths: np.ndarray, offset: np.ndarray, ball: Ball | None,
) -> tuple[Shared, np.ndarray]:  # fmt: skip
    """What is alike in all photographs; and logarithms of intensities (3,) at the exposure 1.

    `known`, `widths` (count, 1): logarithms of exposures, and their standard deviations.
    """
    some = evenly(len(squares), MOST)
    known, widths, names = known[some], widths[some], [list(squares)[k] for k in some]
    shown = [Paper.of(squares[name], poses[name], axes[name]) for name in names]
    paper = Paper(*(np.concatenate(parts) for parts in zip(*shown)))
    of = np.repeat(np.arange(len(some)), [len(own.places) for own in shown])
    unit = float(np.median(np.linalg.norm(paper.lenses - paper.places, axis=1)))
    units = np.array([OFFSET * unit, OFFSET * unit, DEPTH * unit, CONE, *[ROOM / unit**2] * 3, *[BOUNCED] * 3])

    def light(x: np.ndarray) -> Shared:
        values = x[:10] * units
        return offset + values[:3], float(values[3]), values[4:7], values[7:]

    def residuals(x: np.ndarray) -> np.ndarray:
        powers = known + x[10:13] + widths * x[13:].reshape(-1, 3)
        error = (paper.radiance - powers[of] - paper.expected(*light(x), ball)) / ERROR
        return np.concatenate([error.ravel(), x[13:], x[:10]])

    def robust(z: np.ndarray) -> np.ndarray:
        """What squares of residuals count, and its first two derivatives: ``soft_l1``, but those of priors wholly."""
        told = np.arange(len(z)) < paper.radiance.size
        root = np.sqrt(1 + z)
        return np.where(told, [2 * (root - 1), 1 / root, -0.5 / root**3], [z, 1 + 0 * z, 0 * z])

    start = np.zeros(13 + 3 * len(some))
    start[3:10] = 0.3  # away from the bounds
    start[10:13] = np.median(paper.radiance - known[of] - paper.expected(*light(start), ball), 0)
    lowest = np.full(len(start), -np.inf)
    lowest[3:10] = 0  # neither cone, nor room, nor object takes light away
    found = least_squares(residuals, start, bounds=(lowest, np.inf), loss=robust, f_scale=ROBUST / ERROR).x
    return light(found), found[10:13]


def strengths_of(
    papers: Sequence[Paper], expected: np.ndarray, widths: np.ndarray, shared: Shared, ball: Ball | None
) -> np.ndarray:  # fmt: skip
    """(count, 3) logarithms of each photograph's intensity, where most of its paper says the same.

    `expected` (count, 3) and their standard deviations, `widths` (count, 1), by exposures.
    """
    result = []
    for paper, prior, width in zip(papers, expected, widths):
        told = paper.radiance - paper.expected(*shared, ball)
        found = np.median(told, 0) if len(told) > FEW else prior
        for _ in range(20):  # reweighted least squares, with the loss of `shared_light`
            weight = (1 + ((told - found) / ROBUST) ** 2) ** -0.5 / ERROR**2
            found = ((weight * told).sum(0) + prior / width**2) / (weight.sum(0) + 1 / width**2)
        result.append(found)
    return np.array(result)
