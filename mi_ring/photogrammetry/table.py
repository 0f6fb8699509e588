"""The table that an object stands on: its plane, what it looks like, and what in a photograph is not the table."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from mi_ring.photogrammetry.motion import Progress
from mi_ring.photogrammetry.views import View

FLAT = 0.004  #: distance from the plane, in that of the cameras, up to which a point belongs to it
FEWEST = 0.15  #: share of the points that a table has at least
TEXELS = 320  #: across the table's picture
SIGNIFICANT = 4.0  #: a pixel that differs from the table by so many times the usual is something else
LEAST = 0.2  #: and by so much of its log radiance
DARKEST = 2e-3  #: radiance below which nothing is told
#: Where a photograph has the table's pattern: correlation in a window [px], and the pattern's least contrast in it.
CORRELATED, WINDOW, CONTRAST = 0.8, 15, 0.15


class Plane(NamedTuple):
    """The points x with normal · x = offset; the normal, of unit length, points to the cameras' side."""

    normal: np.ndarray  #: (3,)
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Of points (..., 3) above it."""
        return points @ self.normal - self.offset

    def axes(self) -> np.ndarray:
        """(3, 3) rows: two directions within it, and the normal."""
        first = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first), self.normal])


def find_plane(points: np.ndarray, cameras: np.ndarray, center: np.ndarray, reach: float) -> Plane | None:
    """The plane under the object: of points (N, 3) within twice the `reach` of `center`; None if there is none.

    By RANSAC. All cameras (K, 3), and most points, are on one side of it.
    """
    near = points[np.linalg.norm(points - center, axis=1) < 2 * reach]
    if len(near) < 50:
        return None
    random, best = np.random.default_rng(0), 0
    found: Plane | None = None
    thickness = FLAT * float(np.median(np.linalg.norm(cameras - center, axis=1)))
    for _ in range(1000):
        a, b, c = near[random.choice(len(near), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        plane = Plane(normal / length, float(a @ normal / length))
        if plane.height(cameras).mean() < 0:
            plane = Plane(-plane.normal, -plane.offset)
        height = plane.height(near)
        count = int((np.abs(height) < thickness).sum())
        outside = (plane.height(cameras) > 0).mean() > 0.98 and (height > -3 * thickness).mean() > 0.9
        if outside and count > best:
            best, found = count, plane
    if found is None or best < FEWEST * len(near):
        return None
    for _ in range(3):
        members = near[np.abs(found.height(near)) < thickness]
        middle = members.mean(0)
        normal = np.linalg.svd(members - middle)[2][2]
        normal *= np.sign(normal @ found.normal)
        found = Plane(normal, float(normal @ middle))
    return found


class Ground:
    """The part of a plane about its point below `center`, as a square of texels `reach` times 4 wide."""

    def __init__(self, plane: Plane, center: np.ndarray, reach: float) -> None:
        self.axes, self.width = plane.axes(), 4 * reach
        self.foot = center - plane.height(center) * plane.normal
        line = np.linspace(-0.5, 0.5, TEXELS)
        self.u, self.v = (grid.ravel() for grid in np.meshgrid(line, line))
        across = self.u[:, None] * self.axes[0] + self.v[:, None] * self.axes[1]
        self.points = self.foot + self.width * across  #: (TEXELS², 3)

    def seen_by(self, view: View, texels: np.ndarray) -> np.ndarray:
        """Texels (TEXELS², …) as a view shows them (H, W, …); NaN, or False, beyond."""
        height, width = view.shown.shape
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
        rays = view.camera.directions(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (self.foot - view.camera.position) @ self.axes[2] / (rays @ self.axes[2])
        hit = view.camera.position + away[:, None] * rays - self.foot
        place = (hit @ self.axes[:2].T / self.width + 0.5) * TEXELS
        known = (away > 0) & ((place >= 0) & (place < TEXELS)).all(1)
        column, row = np.where(known[:, None], place, 0).astype(int).T
        shown = texels[row * TEXELS + column]
        shown[~known] = False if shown.dtype == bool else np.nan
        return shown.reshape(height, width, *texels.shape[1:])


class Table:
    """The table as views show it together: alike from everywhere, but for how it is lit.

    That is a smooth function of place, found for each view.
    """

    def __init__(
        self, views: Sequence[View], plane: Plane, center: np.ndarray, reach: float, progress: Progress
    ) -> None:
        self.views, self.ground, self.progress = views, Ground(plane, center, reach), progress
        x, y = 2 * self.ground.u, 2 * self.ground.v
        smooth = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
        #: How each view has it (views, TEXELS², 3), and how it is (TEXELS², 3): log radiance, NaN where not shown.
        self.stack = np.empty((len(views), len(self.ground.points), 3), np.float32)
        for own, view in zip(self.stack, progress(views, "table")):
            pixel, inside = view.places(self.ground.points)
            own[:] = np.where(inside[:, None], log_radiance(view)[pixel[:, 1], pixel[:, 0]], np.nan)
        for number in range(3):  # the table's colours and how each photograph is lit, in turn
            colours = median(self.stack)
            for own in progress(self.stack, f"table, round {number + 1}"):
                own -= (smooth @ lighting(own - colours, smooth))[:, None]
        self.colours = median(self.stack)

    def others(self) -> list[np.ndarray]:
        """Of each view (H, W) uint8 what differs from the table as the others show it: what stands on it."""
        result = []
        for view, own in zip(self.progress(self.views, "beside the table"), self.stack):
            rest = np.abs(own - self.colours).max(1)
            usual = float(np.nanmedian(rest)) if np.isfinite(rest).any() else 0.0  # it shows nothing of the table
            other = rest > max(LEAST, SIGNIFICANT * usual)
            mask = cv2.medianBlur(self.ground.seen_by(view, other).astype(np.uint8), 5)
            result.append(ndimage.binary_fill_holes(mask).astype(np.uint8))
        return result

    def patterns(self) -> list[np.ndarray]:
        """Of each view (H, W) uint8 what surely is the table, for the pattern that the others show there is in it."""
        known = self.colours.mean(1)
        return [
            alike(log_radiance(view).mean(-1), self.ground.seen_by(view, known))
            for view in self.progress(self.views, "pattern of the table")
        ]


def log_radiance(view: View) -> np.ndarray:
    """(H, W, 3)"""
    return np.log(np.maximum(view.linear, DARKEST))


def median(stack: np.ndarray) -> np.ndarray:
    """Of what is known of the first axis; NaN where nothing is. Much faster than `np.nanmedian`."""
    middle = np.maximum(np.isfinite(stack).sum(0) - 1, 0) // 2
    return np.take_along_axis(np.sort(stack, 0), middle[None], 0)[0]


def lighting(difference: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Coefficients of `smooth` (N, 6), that a photograph's difference from the table (N, 3) is; few may be wrong."""
    mean = difference.mean(1)
    known = np.isfinite(mean)
    if not known.any():
        return np.zeros(smooth.shape[1])
    for _ in range(2):
        light = np.linalg.lstsq(smooth[known], mean[known], rcond=None)[0]
        rest = mean - smooth @ light
        known = np.isfinite(rest) & (np.abs(rest) < 2 * np.nanmedian(np.abs(rest)) + 1e-3)
    return light


def alike(seen: np.ndarray, table: np.ndarray) -> np.ndarray:
    """(H, W) uint8: where the log radiance seen (H, W) has the pattern of the table (H, W), NaN where that is unknown.

    However it is lit, shadows included: by the correlation of both in a window.
    """
    known = np.isfinite(table)
    table = np.where(known, table, 0).astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values.astype(np.float32), (WINDOW, WINDOW))

    a, b = seen - mean(seen), table - mean(table)
    power = np.sqrt(np.maximum(mean(a * a), 1e-9)), np.sqrt(np.maximum(mean(b * b), 1e-9))
    correlated = mean(a * b) > CORRELATED * power[0] * power[1]
    sure = correlated & (power[1] > CONTRAST) & (mean(known) == 1)
    return cv2.erode(sure.astype(np.uint8), np.ones((WINDOW // 2, WINDOW // 2), np.uint8))
