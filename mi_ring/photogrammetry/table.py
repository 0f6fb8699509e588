"""The table that an object stands on: its plane, what it looks like, and what in a photograph is not the table."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from mi_ring.photogrammetry.views import View

FLAT = 0.004  #: distance from the plane, in that of the cameras, up to which a point belongs to it
FEWEST = 0.15  #: share of the points that a table has at least
TEXELS = 320  #: across the table's picture
SIGNIFICANT = 4.0  #: a pixel that differs from the table by so many times the usual is something else
LEAST = 0.2  #: and by so much of its log radiance


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


def not_table(views: Sequence[View], plane: Plane, center: np.ndarray, reach: float) -> list[np.ndarray]:
    """Of each view (H, W) uint8 what differs from the table as the others show it.

    All views are laid onto the plane, where the table looks alike from everywhere, but for how it is lit: a smooth
    function of place, found for each photograph. What stands on it does not.
    """
    axes = plane.axes()
    foot = center - plane.height(center) * plane.normal
    line = np.linspace(-2 * reach, 2 * reach, TEXELS)
    u, v = np.meshgrid(line, line)
    ground = (foot + u[..., None] * axes[0] + v[..., None] * axes[1]).reshape(-1, 3)
    x, y = (u / (2 * reach)).ravel(), (v / (2 * reach)).ravel()
    smooth = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    laid, places = [], []
    for view in views:
        pixel, inside = view.places(ground)
        log = np.log(np.maximum(view.linear, 2e-3))
        laid.append(np.where(inside[:, None], log[pixel[:, 1], pixel[:, 0]], np.nan).astype(np.float32))
        places.append(pixel)
    stack = np.stack(laid)
    for _ in range(3):  # the table's colours and how each photograph is lit, in turn
        table = np.nanmedian(stack, 0)
        for k, own in enumerate(stack):
            difference = (own - table).mean(1)
            known = np.isfinite(difference)
            for _ in range(2):
                light = np.linalg.lstsq(smooth[known], difference[known], rcond=None)[0]
                rest = difference - smooth @ light
                known = np.isfinite(rest) & (np.abs(rest) < 2 * np.nanmedian(np.abs(rest)) + 1e-3)
            stack[k] = own - (smooth @ light)[:, None]
    table = np.nanmedian(stack, 0)
    result = []
    for view, own in zip(views, stack):
        rest = np.abs(own - table).max(1)
        usual = np.nanmedian(rest)
        other = (rest > max(LEAST, SIGNIFICANT * usual)).reshape(TEXELS, TEXELS)
        result.append(back(view, other & np.isfinite(rest).reshape(other.shape), foot, axes, reach))
    return result


def back(view: View, other: np.ndarray, foot: np.ndarray, axes: np.ndarray, reach: float) -> np.ndarray:
    """What was found on the plane, as the view shows it: (H, W) uint8, without specks and with holes filled."""
    height, width = view.shown.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    rays = view.camera.directions(pixels)
    away = (foot - view.camera.position) @ axes[2] / (rays @ axes[2])
    hit = view.camera.position + away[:, None] * rays - foot
    column, row = (((hit @ axis) / (4 * reach) + 0.5) * TEXELS for axis in axes[:2])
    known = (away > 0) & (np.abs(column - TEXELS / 2) < TEXELS / 2) & (np.abs(row - TEXELS / 2) < TEXELS / 2)
    column, row = (np.where(known, a, 0).astype(int) for a in (column, row))
    mask = (known & other[row, column]).reshape(height, width).astype(np.uint8)
    mask = cv2.medianBlur(mask, 5)
    return ndimage.binary_fill_holes(mask).astype(np.uint8)
