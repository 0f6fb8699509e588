"""Masks that nobody has to draw: a first guess, then GrabCut in each photograph and votes of all in space, in turn.

Votes keep what most photographs that show a place call object, so that lamps, highlights and the neighbours of one
photograph drop out, and GrabCut finds the outline that the coarse votes leave open. What fills a hollow in some
photographs, a shadow for one, drops out where a few others see through it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage
from skimage.filters import threshold_otsu

from mi_ring.capture.grabcut import disk, grabcut, overlap
from mi_ring.geometry.camera import nearest_point
from mi_ring.photogrammetry.reduced_photographs import View
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

SHOWN = 0.25  #: share of the photographs that must show a place, else it is not the object
AGREE = 0.9  #: share of those that must call it object
RESOLUTION = 96  #: voxels along an edge of the space that is looked at
FEWEST = 30  #: voxels of an object: a few agree anywhere, and then agree perfectly
SETTLED = 0.995  #: share of the masks' union that is the same as before
MISSES, SOME = 2.0, 0.01  #: a mask that misses so many times the usual and some is wrong, of what all say together
DARKEST = 1e-3  #: radiance below which nothing is told


class Care(NamedTuple):
    """How masks are settled."""

    agree: float  #: share of the masks that must call a place object
    band: float  #: of the object's size, by which their common outline may be off
    rounds: int  #: at most
    strict: bool = True  #: does a mask that misses much more than the others have no vote?


WHEREABOUTS = Care(AGREE, 0.04, 6, False)
HOLLOWS = Care(0.96, 0.15, 2)  #: shadows fill them, until a few photographs see through
OUTLINES = Care(0.96, 0.04, 2)


@dataclass
class Body:
    """Voxels that the photographs take for the object."""

    corner: np.ndarray  #: (3,) of the first voxel's centre
    spacing: float
    voxels: np.ndarray  #: (n, n, n) bool

    @cached_property
    def points(self) -> np.ndarray:
        """(N, 3) centres of the object's voxels."""
        return self.corner + self.spacing * np.argwhere(self.voxels)

    def coverage(self, view: View) -> np.ndarray:
        """(H, W) uint8: which pixels show it."""
        row, column, inside = view.places(self.points)
        mask = np.zeros(view.shown.shape, np.uint8)
        mask[row[inside], column[inside]] = 1
        return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disk(self.pixels(view) + 1))

    def reach(self, view: View, coverage: np.ndarray) -> np.ndarray:
        """(H, W) uint8: where the object may be by its coverage of the view, which is coarse by a voxel."""
        return cv2.dilate(coverage, disk(self.pixels(view)))

    def pixels(self, view: View) -> float:
        """How wide a voxel is in a view."""
        away = np.median(np.linalg.norm(self.points - view.camera.position, axis=1))
        return float(self.spacing * view.camera.focal.mean() / away)


class Space:
    """The voxels about the point that the cameras look at, and where each view has them."""

    def __init__(self, views: Sequence[View], center: np.ndarray, reach: float) -> None:
        self.views, self.center, self.reach = views, center, reach
        self.axis = np.linspace(-reach, reach, RESOLUTION)
        grid = np.stack(np.meshgrid(*[self.axis] * 3, indexing="ij"), -1).reshape(-1, 3) + center
        self.allowed = np.ones(len(grid), bool)  #: may it be the object?
        self.grid = grid.astype(np.float32)

    @property
    def distance(self) -> float:
        """The middle one of the cameras'."""
        return float(np.median([np.linalg.norm(view.camera.position - self.center) for view in self.views]))

    @classmethod
    def seen_by(cls, views: Sequence[View]) -> "Space":
        """As large as the middle one of the photographs shows."""
        cameras = [view.camera for view in views]
        origins = np.stack([camera.position for camera in cameras])
        center = nearest_point(origins, np.stack([camera.forward for camera in cameras]), "cameras")
        half = np.median([min(camera.size) / 2 / camera.focal.max() for camera in cameras])
        return cls(views, center, 1.2 * float(np.median(np.linalg.norm(origins - center, axis=1)) * half))

    @classmethod
    def about(cls, views: Sequence[View], body: Body) -> "Space":
        """Somewhat larger than what has been found."""
        low, high = body.points.min(0), body.points.max(0)
        return cls(views, (low + high) / 2, 0.6 * float((high - low).max()) + body.spacing)

    def vote(self, masks: Sequence[np.ndarray], agree: float, voters: Sequence[bool] | None = None) -> Body | None:
        """The largest piece of what this share of the masks (H, W) calls object; None if it is next to nothing.

        `voters`: whose masks count; by default all.
        """
        yes, shown = np.zeros(len(self.grid), np.int16), np.zeros(len(self.grid), np.int16)

        def said(view: View, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            row, column, inside = view.places(self.grid)
            return inside, inside & (mask[row, column] > 0)

        voting = [k for k in range(len(masks)) if voters is None or voters[k]]
        for inside, object_ in in_threads(said, [self.views[k] for k in voting], [masks[k] for k in voting]):
            shown += inside
            yes += object_
        object_ = (yes >= agree * shown) & (shown >= SHOWN * len(self.views)) & self.allowed
        pieces, _ = ndimage.label(object_.reshape([len(self.axis)] * 3))
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        if sizes.max() < FEWEST:
            return None
        return Body(self.center + self.axis[0], float(self.axis[1] - self.axis[0]), pieces == sizes.argmax())


def nothing(views: Sequence[View]) -> list[np.ndarray]:
    """Empty masks."""
    return [np.zeros(view.shown.shape, np.uint8) for view in views]


def bright(view: View) -> np.ndarray:
    """(H, W) uint8: what is nearer to the flash than the rest, by Otsu's threshold of the photograph's log radiance."""
    log = np.log(np.maximum(view.linear.max(-1), DARKEST))
    return (log > threshold_otsu(log)).astype(np.uint8)


def outlined(view: View, coverage: np.ndarray, background: np.ndarray, band: float) -> np.ndarray:
    """(H, W) uint8: the object near its coverage (H, W). `background` (H, W) surely is not the object."""
    return grabcut(view.rgb, coverage, ~view.shown | (background > 0), band)


def reliable(views: Sequence[View], masks: Sequence[np.ndarray], covered: Sequence[np.ndarray]) -> list[bool]:
    """Which masks do not miss far more than others of what all say together (H, W each): what a lamp has swallowed."""
    missed = [
        (cover > mask)[view.shown].sum() / max(1, cover.sum()) for view, mask, cover in zip(views, masks, covered)
    ]
    return [share <= MISSES * np.median(missed) + SOME for share in missed]


@dataclass(frozen=True)
class Found:
    """Masks of all views, and how sure they are."""

    masks: list[np.ndarray]  #: (H, W) uint8, 1 the object
    body: Body
    agreement: list[float]  #: of each, intersection over union with what all say together

    @property
    def quality(self) -> float:
        """Of most of them."""
        return float(np.quantile(self.agreement, 0.2))


def settle(
    space: Space, guesses: Sequence[np.ndarray], backgrounds: Sequence[np.ndarray], progress: Progress,
    care: Care = WHEREABOUTS,
) -> Found | None:  # fmt: skip
    """Masks from a first guess of each (H, W): votes and GrabCut in turn until nothing changes.

    `backgrounds` (H, W): what surely is not the object. None if the guesses have nothing in common.
    """
    body, masks = space.vote(guesses, AGREE), list(guesses)
    if body is None:
        return None
    covered = [body.coverage(view) for view in space.views]
    for number in range(care.rounds):
        before = masks
        found = in_threads(partial(outlined, band=care.band), space.views, covered, backgrounds)
        masks = list(progress(found, f"masks, round {number + 1}", len(covered)))
        body = space.vote(masks, care.agree, reliable(space.views, masks, covered) if care.strict else None)
        if body is None:
            return None
        covered = [body.coverage(view) for view in space.views]
        masks = [mask & body.reach(view, cover) for mask, view, cover in zip(masks, space.views, covered)]
        if np.mean([overlap(a, b) for a, b in zip(masks, before)]) > SETTLED:
            break
    return Found(masks, body, [overlap(mask, cover) for mask, cover in zip(masks, covered)])


def resized(mask: np.ndarray, view: View) -> np.ndarray:
    """A mask of another size as large as the view: (H, W) bool."""
    return cv2.resize(mask.astype(np.float32), view.camera.size, interpolation=cv2.INTER_LINEAR) > 0.5


def disputed(mask: np.ndarray, coverage: np.ndarray, pixels: float) -> np.ndarray:
    """(H, W) uint8: where a mask and what all say together, the coverage of voxels so wide, are not of one mind.

    Mostly a shadow that one mask takes for the object.
    """
    wide, narrow = cv2.dilate(coverage, disk(pixels)), cv2.erode(coverage, disk(pixels))
    return ((mask > 0) & (wide == 0)).astype(np.uint8) | ((mask == 0) & (narrow > 0)).astype(np.uint8)


def unsure(mask: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """(H, W) uint8: what looks like the object, touches it and is not in its mask: a rod, a stand, a lamp behind.

    Whether it hides the object cannot be told.
    """
    beside = (guess > 0) & (mask == 0)
    pieces, _ = ndimage.label(beside)
    touching = np.unique(pieces[cv2.dilate(mask, disk(2)) > 0])
    return np.isin(pieces, touching[touching > 0]).astype(np.uint8)
