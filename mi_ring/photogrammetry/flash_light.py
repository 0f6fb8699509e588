"""The flash and the light of the room, by how bright photographs show the white paper of the printed sheet."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mi_ring.geometry.hull import evenly_spaced
from mi_ring.photogrammetry.marker_sheet import White
from mi_ring.rendering.photograph_lights import MIN_FLASH_COSINE

PAPER = 0.8  #: albedo of white paper
#: Standard deviations of priors: of the flash's place across the lens and along its axis [median distance from the
#: cameras to the squares], of the exponent of its cone, of the room's light [that of the flash], of the share that the
#: object sends back, and of the curve's exponent [logarithm]; of each photograph's exposure and white balance beside
#: what EXIF data say, and if they say nothing [logarithm].
OFFSET, DEPTH, CONE, ROOM, BOUNCED, CURVE, TOLD, UNTOLD = 0.1, 0.02, 1.0, 0.1, 1.0, 0.2, 0.3, 1.0
ERROR = 0.1  #: of a square's brightness, relative; much of it is alike for all of a photograph
ROBUST = 0.02  #: relative error beyond which a square counts less: it is in a shadow, or shines
DARK = 1e-4  #: radiance below which nothing is told
FEW = 3  #: places that are too few for a median
MOST = 60  #: photographs that are asked together
#: What is none: light of the room [that of the flash], the exponent of a cone, and that of a curve [logarithm].
DIM, WIDE, STRAIGHT = 0.003, 0.05, 0.06
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
    gamma: float  #: exponent of the camera's curve: colours go like radiance to its power
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
    cosine = np.maximum(-(way * forward).sum(1) / away, MIN_FLASH_COSINE)
    return cosine**falloff * np.maximum(way @ normal, 0) / away**3


class Paper(NamedTuple):
    """White paper in photographs: n places of the sheet, and the camera that saw each."""

    places: np.ndarray  #: (n, 3)
    seen: np.ndarray  #: (n, 3) logarithms of the colours
    beside: np.ndarray  #: (n,) bool, as `White` has it
    lenses: np.ndarray  #: (n, 3) where the cameras are
    forward: np.ndarray  #: (n, 3) where they look
    axes: np.ndarray  #: (n, 3, 3) from the axes that the flash's offset is in to the world's

    @classmethod
    def of(cls, white: White, pose: np.ndarray, axes: np.ndarray) -> "Paper":
        """What one photograph shows."""
        count, seen = len(white.places), np.log(np.maximum(white.colours, DARK))
        return cls(white.places, seen, white.beside, np.tile(pose[:3, 3], (count, 1)), np.tile(pose[:3, 2], (count, 1)),
                   np.tile(pose[:3, :3] @ axes, (count, 1, 1)))  # fmt: skip

    def inner(self) -> "Paper":
        """Without the margin."""
        return Paper(*(part[~self.beside] for part in self))


class Shared(NamedTuple):
    """What is alike in all photographs, as `Flash` has it."""

    offset: np.ndarray
    falloff: float
    room: np.ndarray
    bounced: np.ndarray  #: (3,) how much of its light the object sends back
    gamma: float
    power: np.ndarray  #: logarithms

    def intensities(self, paper: Paper, ball: Ball | None) -> np.ndarray:
        """(n, 3) logarithms of the flash's, by what each place of the paper says alone."""
        way = paper.lenses + paper.axes @ self.offset - paper.places
        light, room = irradiance(way, np.array([0.0, 0, 1]), paper.forward, self.falloff)[:, None], self.room
        if ball:
            light = light + self.bounced * ball.bounce(paper.places, way + paper.places)[:, None]
            room = room * (1 - ball.share(paper.places))[:, None]
        return paper.seen / self.gamma - np.log(np.maximum(light + room, 1e-12) * PAPER / np.pi)


class Exposures(NamedTuple):
    """What is said of exposures, of `count` photographs."""

    logarithms: np.ndarray  #: (count, 1)
    widths: np.ndarray  #: (count, 1) their standard deviations

    @classmethod
    def of(cls, exposures: np.ndarray) -> "Exposures":
        """Of relative ones (count,), NaN where nothing is said."""
        told = np.isfinite(exposures)
        return cls(np.log(np.where(told, exposures, 1.0))[:, None], np.where(told, TOLD, UNTOLD)[:, None])

    def part(self, index: Sequence[int]) -> "Exposures":
        """Of some photographs."""
        return Exposures(self.logarithms[index], self.widths[index])


def find_flash(
    squares: Mapping[str, White], poses: Mapping[str, np.ndarray], axes: Mapping[str, np.ndarray],
    exposures: Mapping[str, float], offset: np.ndarray, ball: Ball | None = None, curved: bool = True,
) -> Flash | None:  # fmt: skip
    """The flash that makes white paper as bright as it is; None if there is none.

    `squares`, by the photograph's name; `poses` (4, 4); `axes` (3, 3): from those of most photographs to those of each;
    `exposures`: relative ones, NaN where nothing tells; `curved`: may the camera have a curve of its own? Unknown are,
    for all photographs, the flash's `offset` (3,), of which this is the guess, its cone, what the room sends to the
    paper, by the flash's power, what the object does, the `ball`, and the curve's exponent; and each photograph's
    intensity. The least squares of logarithms, robust, with the priors above: how brightness falls off over the paper,
    and from one photograph to the next, tells one from another. The margin is part of it if it is as bright as the
    squares say, and the curve if it is far from a straight line.
    """
    names = [n for n in squares if n in poses and not squares[n].beside.all() and poses[n][2, 3] > 0]
    if not names:
        return None
    papers = [Paper.of(squares[name], poses[name], axes[name]) for name in names]
    told = Exposures.of(np.array([exposures[name] for name in names]))
    inner = [paper.inner() for paper in papers]
    shared = shared_light(inner, told, offset, ball, curved)
    strengths = strengths_of(inner, told, shared, ball)
    margin = np.concatenate([(shared.intensities(paper, ball) - strength)[paper.beside]
                             for paper, strength in zip(papers, strengths)])  # fmt: skip
    if len(margin) and np.abs(np.median(margin, 0)).max() < CUT:
        shared = shared_light(papers, told, offset, ball, curved)
    else:
        papers = inner
    if abs(np.log(shared.gamma)) < STRAIGHT:
        shared = shared_light(papers, told, offset, ball, curved=False)
    strengths = np.exp(strengths_of(papers, told, shared, ball))
    away = np.median([np.linalg.norm(poses[name][:3, 3]) for name in names])
    room = shared.room if (shared.room * away**2).max() > DIM else 0 * shared.room
    falloff = shared.falloff if shared.falloff > WIDE else 0.0
    return Flash(shared.offset, falloff, room, shared.gamma, np.exp(shared.power), dict(zip(names, strengths)))


def shared_light(
    papers: Sequence[Paper], told: Exposures, offset: np.ndarray, ball: Ball | None, curved: bool
) -> Shared:  # fmt: skip
    """What is alike in all photographs; the arguments are as `find_flash` has them."""
    some = evenly_spaced(len(papers), MOST)
    papers, told = [papers[k] for k in some], told.part(some)
    paper = Paper(*(np.concatenate(parts) for parts in zip(*papers)))
    of = np.repeat(np.arange(len(some)), [len(own.places) for own in papers])
    unit = float(np.median(np.linalg.norm(paper.lenses - paper.places, axis=1)))
    units = np.array([OFFSET * unit, OFFSET * unit, DEPTH * unit, CONE, *[ROOM / unit**2] * 3, *[BOUNCED] * 3, CURVE])
    usual = slice(len(units), len(units) + 3)  # then come those of each photograph

    def meant(x: np.ndarray) -> Shared:
        values = x[: len(units)] * units
        gamma = float(np.exp(values[10])) if curved else 1.0
        return Shared(offset + values[:3], float(values[3]), values[4:7], values[7:10], gamma, x[usual])

    def residuals(x: np.ndarray) -> np.ndarray:
        shared, own = meant(x), x[usual.stop :]
        powers = told.logarithms + shared.power + told.widths * own.reshape(-1, 3)
        error = shared.gamma * (shared.intensities(paper, ball) - powers[of]) / ERROR
        return np.concatenate([error.ravel(), own, x[: len(units)]])

    def robust(z: np.ndarray) -> np.ndarray:
        """What squares of residuals count, and its first two derivatives: ``soft_l1``, but those of priors wholly."""
        brightness = np.arange(len(z)) < paper.seen.size
        root = np.sqrt(1 + z)
        return np.where(brightness, [2 * (root - 1), 1 / root, -0.5 / root**3], [z, 1 + 0 * z, 0 * z])

    start = np.zeros(usual.stop + 3 * len(some))
    start[3:10] = 0.3  # away from the bounds
    start[usual] = np.median(meant(start).intensities(paper, ball) - told.logarithms[of], 0)
    lowest = np.full(len(start), -np.inf)
    lowest[3:10] = 0  # neither cone, nor room, nor object takes light away
    return meant(least_squares(residuals, start, bounds=(lowest, np.inf), loss=robust, f_scale=ROBUST / ERROR).x)


def strengths_of(papers: Sequence[Paper], told: Exposures, shared: Shared, ball: Ball | None) -> np.ndarray:
    """(count, 3) logarithms of each photograph's intensity, where most of its paper says the same."""
    result = []
    for paper, expected, width in zip(papers, told.logarithms + shared.power, told.widths):
        single = shared.intensities(paper, ball)
        found = np.median(single, 0) if len(single) > FEW else expected
        for _ in range(20):  # reweighted least squares, with the loss of `shared_light`
            weight = (1 + ((single - found) / ROBUST) ** 2) ** -0.5 / ERROR**2
            found = ((weight * single).sum(0) + expected / width**2) / (weight.sum(0) + 1 / width**2)
        result.append(found)
    return np.array(result)
