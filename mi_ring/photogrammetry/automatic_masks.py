"""Automatic masks: from a first guess, GrabCut in each photograph and a vote of all masks on voxels alternate.

A voxel stays if it is in the masks of most photographs that show it. The vote removes lamps and highlights, because
these are in few masks. It also empties a concavity that some masks fill, for example with a shadow.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from skimage.filters import threshold_otsu

from mi_ring.capture.brightness_masks import pieces
from mi_ring.capture.grabcut import disk, grabcut, overlap
from mi_ring.geometry.camera import nearest_point
from mi_ring.photogrammetry.reduced_photographs import Masks, ReducedView, Views
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

MIN_VISIBLE = 0.25  #: share of the photographs that must show a voxel of the object
MIN_AGREEMENT = 0.9  #: share of those that must have the voxel in their mask
RESOLUTION = 96  #: voxels along an edge of the grid
MIN_VOXELS = 30  #: of an object: a few voxels get a unanimous vote by chance
CONVERGED = 0.995  #: overlap of the masks with those of the iteration before
#: A mask is an outlier if the share of the silhouette that it misses is above MAX_MISSING · median + OFFSET.
MAX_MISSING, OFFSET = 2.0, 0.01
MIN_RADIANCE = 1e-3  #: lower radiance counts as this


class RefinementSettings(NamedTuple):
    """Settings for the refinement of masks by votes on voxels and GrabCut in turn."""

    agreement: float  #: share of the masks that must contain a voxel
    band: float  #: width of the band around the silhouette in which GrabCut decides [object's size]
    iterations: int  #: maximum number
    finds: str  #: what it finds, for the progress bar
    reject_outliers: bool = True  #: leave incomplete masks out of the vote


LOCATION = RefinementSettings(MIN_AGREEMENT, 0.04, 6, "the object's place", False)
#: high agreement, because few photographs see through a concavity
CONCAVITIES = RefinementSettings(0.96, 0.15, 2, "openings")
OUTLINES = RefinementSettings(0.96, 0.04, 2, "outlines")


@dataclass
class VoxelObject:
    """The object as a set of voxels in a regular grid, in the frame of the cameras."""

    corner: np.ndarray  #: (3,) centre of the first voxel
    spacing: float
    voxels: np.ndarray  #: (n, n, n) bool

    @cached_property
    def points(self) -> np.ndarray:
        """Centres (N, 3) of the object's voxels."""
        return self.corner + self.spacing * np.argwhere(self.voxels)

    def silhouette(self, view: ReducedView) -> np.ndarray:
        """Project the voxels to a view. Returns a mask (H, W) uint8: 1 where the view shows the object, otherwise 0."""
        row, column, inside = view.project(self.points)
        mask = np.zeros(view.valid.shape, np.uint8)
        mask[row[inside], column[inside]] = 1
        return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disk(self.voxel_pixels(view) + 1))

    def voxel_pixels(self, view: ReducedView) -> float:
        """Return the width of a voxel in a view [px], at the median distance of the object."""
        distance = np.median(np.linalg.norm(self.points - view.camera.position, axis=1))
        return float(self.spacing * view.camera.focal.mean() / distance)


class VoxelGrid:
    """A cube of voxels, and the views that show it.

    `center` (3,): centre of the cube. `half_size`: half of its side length.
    """

    def __init__(self, views: Views, center: np.ndarray, half_size: float) -> None:
        self.views, self.center, self.half_size = views, center, half_size
        self.axis = np.linspace(-half_size, half_size, RESOLUTION)
        points = np.stack(np.meshgrid(*[self.axis] * 3, indexing="ij"), -1).reshape(-1, 3) + center
        self.points = points.astype(np.float32)  #: (N, 3) centres of the voxels
        self.allowed = np.ones(len(points), bool)  #: (N,) may the voxel belong to the object?

    @property
    def camera_distance(self) -> float:
        """Median distance of the cameras from the centre of the cube."""
        return float(np.median([np.linalg.norm(view.camera.position - self.center) for view in self.views]))

    @classmethod
    def seen_by(cls, views: Views) -> "VoxelGrid":
        """Make a grid around the point at which most cameras look. It is large enough to fill a typical photograph."""
        cameras = [view.camera for view in views]
        origins = np.stack([camera.position for camera in cameras])
        center = nearest_point(origins, np.stack([camera.forward for camera in cameras]), "cameras")
        half = np.median([min(camera.size) / 2 / camera.focal.max() for camera in cameras])
        return cls(views, center, 1.2 * float(np.median(np.linalg.norm(origins - center, axis=1)) * half))

    @classmethod
    def around(cls, views: Views, found: VoxelObject) -> "VoxelGrid":
        """Make a grid around the object `found`, a little larger than the object, for other views of it."""
        low, high = found.points.min(0), found.points.max(0)
        return cls(views, (low + high) / 2, 0.6 * float((high - low).max()) + found.spacing)

    def vote(self, masks: Masks, agreement: float, voters: Sequence[bool] | None = None) -> VoxelObject | None:
        """Find the object by a vote of the masks: the largest connected component of voxels that most masks contain.

        `masks`: one per view of the grid, (H, W), above 0 inside. `agreement`: a share, 0 to 1. Of the masks whose
        views show a voxel, this share must contain it. `voters`: for each mask, whether it votes; None: all vote.
        Returns None if the component has too few voxels.
        """
        yes, shown = np.zeros((2, len(self.points)), np.int16)

        def look(view: ReducedView, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            row, column, inside = view.project(self.points)
            return inside, inside & (mask[row, column] > 0)

        pairs = itertools.compress(zip(self.views, masks), voters or itertools.repeat(True))
        for inside, within in in_threads(look, *zip(*pairs)):
            shown += inside
            yes += within
        chosen = (yes >= agreement * shown) & (shown >= MIN_VISIBLE * len(self.views)) & self.allowed
        labels, sizes = pieces(chosen.reshape([RESOLUTION] * 3))
        if sizes.max() < MIN_VOXELS:
            return None
        return VoxelObject(self.center + self.axis[0], float(self.axis[1] - self.axis[0]), labels == sizes.argmax())


def empty_masks(views: Views) -> list[np.ndarray]:
    """Return for each view a mask (H, W) uint8 that is 0 everywhere."""
    return [np.zeros(view.valid.shape, np.uint8) for view in views]


def bright_mask(view: ReducedView) -> np.ndarray:
    """Return a mask (H, W) uint8 of the bright pixels of a view: 1 where the log radiance is above Otsu's threshold.

    Bright pixels show what is near the flash.
    """
    log = np.log(np.maximum(view.linear.max(-1), MIN_RADIANCE))
    return (log > threshold_otsu(log)).astype(np.uint8)


def are_complete(views: Views, masks: Masks, silhouettes: Masks) -> list[bool]:
    """Return a list of bool for the views: True if the view's mask covers its silhouette about as well as others do.

    `masks`, `silhouettes`: one per view, (H, W). A silhouette is the projection of the object that all masks agree on.
    """
    missing = [
        (silhouette > mask)[view.valid].sum() / max(1, silhouette.sum())
        for view, mask, silhouette in zip(views, masks, silhouettes)
    ]
    return [share <= MAX_MISSING * np.median(missing) + OFFSET for share in missing]


class Segmentation(NamedTuple):
    """The object as voxels, with a mask in each view and the agreement of both."""

    masks: list[np.ndarray]  #: (H, W) uint8, 1 the object
    object: VoxelObject
    agreement: list[float]  #: of each mask with the common silhouette, intersection over union


def refine_masks(
    grid: VoxelGrid, guesses: Masks, backgrounds: Masks, progress: Progress, settings: RefinementSettings = LOCATION
) -> Segmentation | None:  # fmt: skip
    """Refine masks by two steps in turn: the masks of all views vote on the object, and GrabCut finds new masks.

    GrabCut starts from the silhouettes of the object. `guesses`: for each view of `grid`, an array (H, W) above 0 on
    the guessed object. `backgrounds`: for each view, an array (H, W) above 0 where the object certainly is not. Returns
    None if the masks do not agree on any object.
    """

    def outline(view: ReducedView, silhouette: np.ndarray, background: np.ndarray) -> np.ndarray:
        return grabcut(view.rgb, silhouette, ~view.valid | (background > 0), settings.band)

    masks, found = list(guesses), grid.vote(guesses, MIN_AGREEMENT)
    silhouettes = [found.silhouette(view) for view in grid.views] if found else []
    for number in range(settings.iterations if found else 0):
        before, outlined = masks, in_threads(outline, grid.views, silhouettes, backgrounds)
        masks = list(progress(outlined, f"masks, {settings.finds}, round {number + 1}", len(silhouettes)))
        voters = are_complete(grid.views, masks, silhouettes) if settings.reject_outliers else None
        if (found := grid.vote(masks, settings.agreement, voters)) is None:
            break
        silhouettes = [found.silhouette(view) for view in grid.views]
        masks = [m & cv2.dilate(s, disk(found.voxel_pixels(v))) for m, v, s in zip(masks, grid.views, silhouettes)]
        if np.mean([overlap(a, b) for a, b in zip(masks, before)]) > CONVERGED:
            break
    agreement = [overlap(mask, silhouette) for mask, silhouette in zip(masks, silhouettes)]
    return Segmentation(masks, found, agreement) if found else None


def resize_mask(mask: np.ndarray, view: ReducedView) -> np.ndarray:
    """Resize a mask (h, w) of 0 and 1 to the size of a view. Returns (H, W) bool: True inside."""
    return cv2.resize(mask.astype(np.float32), view.camera.size, interpolation=cv2.INTER_LINEAR) > 0.5


def disputed_pixels(mask: np.ndarray, silhouette: np.ndarray, tolerance: float) -> np.ndarray:
    """Return a mask (H, W) uint8: 1 where `mask` and `silhouette` differ by more than `tolerance` [px].

    `mask`, `silhouette` (H, W) uint8: above 0 inside. Such pixels often show a shadow.
    """
    wide, narrow = cv2.dilate(silhouette, disk(tolerance)), cv2.erode(silhouette, disk(tolerance))
    return ((mask > 0) & (wide == 0)).astype(np.uint8) | ((mask == 0) & (narrow > 0)).astype(np.uint8)


def touching_pixels(mask: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Return a mask (H, W) uint8: 1 on pieces of `guess` that lie outside `mask` but touch it.

    `mask`, `guess` (H, W) uint8: above 0 inside. For example, such a piece is a rod that holds the object.
    """
    labels, _ = pieces((guess > 0) & (mask == 0))
    touching = np.unique(labels[cv2.dilate(mask, disk(2)) > 0])
    return np.isin(labels, touching[touching > 0]).astype(np.uint8)
