"""The table that an object stands on: its plane, what it looks like, and what in a photograph is not the table."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from mi_ring.capture.grabcut import disk, grown
from mi_ring.images import srgb_to_linear
from mi_ring.photogrammetry.flash_light import Flash, irradiance
from mi_ring.photogrammetry.reduced_photographs import View
from mi_ring.scene.lights import Light
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

FLAT = 0.004  #: distance from the plane, in that of the cameras, up to which a point belongs to it
FEWEST = 0.15  #: share of the points that a table has at least
TEXELS, SOME = 320, 160  #: across the table's picture if nothing else is said, and to see how it is lit
CHUNK = 50_000  #: texels whose colours are found in one go
SIGNIFICANT = 4.0  #: a pixel that differs from the table by so many times the usual is something else
LEAST = 0.2  #: and by so much of its log radiance
DARKEST = 2e-3  #: radiance below which nothing is told
LOG_RADIANCE = np.log(np.maximum(srgb_to_linear(np.arange(256, dtype=np.float32) / 255), DARKEST))  #: by a byte
#: Where a photograph has the table's pattern: correlation in a window [px], and the pattern's least contrast in it.
CORRELATED, WINDOW, CONTRAST = 0.8, 15, 0.15
#: Where a photograph shows the bare table: it differs from what is expected, in log radiance and two log ratios of
#: colours, by no more than nearly all that is not `NEAR` the object [its size], and that is at least and at most so
#: much. Nothing is told where more of the object `INSIDE` its outline [its size] than a small share looks like it.
NEARLY_ALL, AT_LEAST, AT_MOST = 0.99, (0.1, 0.05, 0.05), (0.4, 0.15, 0.15)
NEAR, INSIDE, CONFUSED = 0.3, 0.1, 0.03
SPECK = 0.015  #: what is not wider does not count [the object's size]


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

    def __init__(self, plane: Plane, center: np.ndarray, reach: float, texels: int = TEXELS) -> None:
        self.texels, self.normal, across = texels, plane.normal, plane.axes()[:2]
        corner = center - plane.height(center) * plane.normal - 2 * reach * across.sum(0)
        #: (4, 3) where the texel of a column and row is: (x, y, z, 1) of (column, row, 1)
        self.to_world = np.vstack([np.stack([*4 * reach / (texels - 1) * across, corner], 1), [0, 0, 1]])
        row, column = np.divmod(np.arange(texels**2), texels)
        self.u, self.v = column / (texels - 1) - 0.5, row / (texels - 1) - 0.5
        self.points = np.stack([column, row, np.ones_like(row)], 1) @ self.to_world[:3].T  #: (texels², 3)

    @property
    def square(self) -> np.ndarray:
        """(4, 4): from the square of -1 to 1 in x and y, facing z, to the texels; the first row is at y = -1."""
        middle = self.to_world @ np.array([(self.texels - 1) / 2, (self.texels - 1) / 2, 1])
        across = self.to_world[:, :2] * self.texels / 2
        normal = np.cross(across[:3, 0], across[:3, 1]) / np.linalg.norm(across[:, 0])
        return np.column_stack([across, [*normal, 0], middle])

    def seen_by(self, view: View, texels: np.ndarray) -> np.ndarray:
        """Texels (texels², …) float32 or uint8 as a view shows them (H, W, …); NaN, or 0, beyond."""
        width, height = view.camera.size
        middle = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # of a pixel
        from_pixel = np.linalg.inv(view.camera.projection @ self.to_world) @ middle
        none = 0 if texels.dtype == np.uint8 else np.nan
        shown = cv2.warpPerspective(
            texels.reshape(self.texels, self.texels, -1), from_pixel, (width, height), borderValue=[none] * 4,
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        )  # fmt: skip
        x, y, one = from_pixel[2]  # of a texel, its inverse depth
        shown[x * np.arange(width) + y * np.arange(height)[:, None] + one <= 0] = none
        return shown


def reflectance(
    views: Sequence[View], lights: Sequence[Light], hidden: Sequence[np.ndarray], ground: Ground, flash: Flash
) -> np.ndarray | None:  # fmt: skip
    """(texels, texels, 3) diffuse albedo of the ground in views under these lights; None if they show nothing of it.

    `hidden` (H, W): where something may hide it from a view; `flash`: what lights have in common. The median of the
    views, in few of which a place is in a shadow or shines; where none shows it, the median of the rest. Light that the
    object sends to the ground or keeps from it is not part of it.
    """
    found = np.full((len(views), ground.texels**2, 3), np.nan, np.float32)
    for own, view, light, mask in zip(found, views, lights, hidden, strict=True):
        row, column, inside = view.places(ground.points)
        inside &= (mask[row, column] == 0) & (view.rgb[row, column].max(-1) < 255)
        way, forward = light.vector - ground.points[inside], view.camera.forward
        direct = irradiance(way, ground.normal, forward, flash.falloff)[:, None]
        seen = np.pi * view.linear[row, column][inside] ** (1 / flash.gamma)
        with np.errstate(divide="ignore", invalid="ignore"):  # where nothing is lit
            own[inside] = np.where(direct > 0, seen / (light.rgb * (direct + flash.room)), np.nan)
    albedo = median(found)
    known = np.isfinite(albedo).all(1)
    if not known.any():
        return None
    albedo[~known] = np.median(albedo[known], 0)
    return albedo.reshape(ground.texels, ground.texels, 3).clip(0, 1)


class Table:
    """The table as views show it together: alike from everywhere, but for how it is lit.

    That is a smooth function of place, found for each view. `hidden` (H, W): where something may hide the table from a
    view; by default nowhere.
    """

    def __init__(
        self, views: Sequence[View], ground: Ground, progress: Progress, hidden: Sequence[np.ndarray] | None = None
    ) -> None:
        self.views, self.ground, self.progress, self.hidden = views, ground, progress, hidden
        x, y = 2 * ground.u, 2 * ground.v
        self.smooth = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1).astype(np.float32)
        self.lights = np.zeros((len(views), self.smooth.shape[1]), np.float32)  #: by `smooth`
        every = -(-ground.texels // SOME)
        some = np.arange(ground.texels**2).reshape(ground.texels, -1)[::every, ::every].ravel()
        stack = self.stack(some)
        for number in range(3):  # the table's colours and how each photograph is lit, in turn
            colours = median(stack)
            for own, light in zip(progress(stack, f"table, round {number + 1}"), self.lights):
                more = lighting(own - colours, self.smooth[some])
                own -= (self.smooth[some] @ more)[:, None]
                light += more
        parts = np.array_split(np.arange(ground.texels**2), -(-(ground.texels**2) // CHUNK))
        #: (texels², 3) log radiance, NaN where not shown
        self.colours = np.concatenate([median(self.stack(part)) for part in progress(parts, "table")])

    def shown(self, number: int, texels: np.ndarray) -> np.ndarray:
        """How a view has some texels (N,): (N, 3) log radiance, as if lit like the others; NaN where not shown."""
        row, column, inside = self.views[number].places(self.ground.points[texels])
        if self.hidden:
            inside &= self.hidden[number][row, column] == 0
        own = log_radiance(self.views[number].rgb[row, column]) - (self.smooth[texels] @ self.lights[number])[:, None]
        return np.where(inside[:, None], own, np.float32(np.nan))

    def stack(self, texels: np.ndarray) -> np.ndarray:
        """The same of all views: (views, N, 3)"""
        return np.stack(list(in_threads(partial(self.shown, texels=texels), range(len(self.views)))))

    def others(self) -> list[np.ndarray]:
        """Of each view (H, W) uint8 what differs from the table as the others show it: what stands on it."""
        result, everywhere = [], np.arange(len(self.colours))
        for number, view in enumerate(self.progress(self.views, "beside the table")):
            rest = np.abs(self.shown(number, everywhere) - self.colours).max(1)
            usual = float(np.nanmedian(rest)) if np.isfinite(rest).any() else 0.0  # it shows nothing of the table
            other = rest > max(LEAST, SIGNIFICANT * usual)
            mask = cv2.medianBlur(self.ground.seen_by(view, other.astype(np.uint8)), 5)
            result.append(ndimage.binary_fill_holes(mask).astype(np.uint8))
        return result

    def patterns(self) -> list[np.ndarray]:
        """Of each view (H, W) uint8 what surely is the table, for the pattern that the others show there is in it."""
        known = self.colours.mean(1)
        return [
            alike(log_radiance(view.rgb).mean(-1), self.ground.seen_by(view, known))
            for view in self.progress(self.views, "pattern of the table")
        ]

    def expected(self, view: View) -> np.ndarray:
        """What a view, a part of one of these, would show of the table alone: (H, W, 3) log radiance, NaN beyond."""
        number = [other.name for other in self.views].index(view.name)
        return self.ground.seen_by(view, self.colours + (self.smooth @ self.lights[number])[:, None])


def bare(
    views: Sequence[View], covered: Sequence[np.ndarray], tables: Sequence[Table], progress: Progress
) -> list[np.ndarray] | None:
    """Of each view (H, W) uint8 what shows the bare table, lit or in a shadow, by the first table that knows it there.

    `covered` (H, W): where the object about is. None if the object itself looks like the table.
    """
    differences = []
    for view in progress(views, "bare table"):
        expected = tables[0].expected(view)
        for table in tables[1:]:
            expected = np.where(np.isfinite(expected), expected, table.expected(view))
        differences.append(difference(log_radiance(view.rgb), expected))
    for shadows in (True, False):
        result, wrong, inside = [], 0, 0
        for view, cover, off in zip(views, covered, differences):
            size, known = np.sqrt(max(1, int(cover.sum()))), view.shown & np.isfinite(off).all(-1)
            around = known & (grown(cover, NEAR) == 0)
            usual = np.quantile(np.abs(off[around]), NEARLY_ALL, 0) if around.any() else 0
            value, red, blue = np.moveaxis(off, -1, 0)
            limit, *limits = np.clip(usual, AT_LEAST, AT_MOST)
            same = known & (np.abs(red) < limits[0]) & (np.abs(blue) < limits[1])
            same &= (value if shadows else np.abs(value)) < limit
            smooth = cv2.medianBlur(same.astype(np.uint8), 5)
            result.append(cv2.morphologyEx(smooth, cv2.MORPH_OPEN, disk(SPECK * size)))
            core = known & (grown(cover, -INSIDE) > 0)
            wrong, inside = wrong + (result[-1][core] > 0).sum(), inside + core.sum()
        if wrong <= CONFUSED * inside:
            return result
    return None


def difference(seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Of log radiances (H, W, 3), of their means and of red and blue by green: (H, W, 3), NaN where not known.

    By what is expected next to a pixel, too, that is nearest to what is seen: the pattern may be off by a pixel.
    """

    def split(log: np.ndarray) -> np.ndarray:
        return np.stack([log.mean(-1), log[..., 0] - log[..., 1], log[..., 2] - log[..., 1]], -1)

    known = np.isfinite(expected).all(-1, keepdims=True)
    near, here = np.where(known, split(expected), 0).astype(np.float32), split(seen)
    window = np.ones((3, 3), np.uint8)
    nearest = np.clip(here, cv2.erode(near, window), cv2.dilate(near, window))
    return np.where(known, here - nearest, np.nan)


def log_radiance(rgb: np.ndarray) -> np.ndarray:
    """Of sRGB (…) uint8: (…) float32"""
    return LOG_RADIANCE[rgb]


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
