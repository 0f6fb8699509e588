"""The table under the object: its plane, appearance and albedo, and masks of pixels that show it."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage
from trimesh.geometry import align_vectors
from trimesh.points import plane_fit

from mi_ring.capture.grabcut import dilate_by_share, disk
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.photogrammetry.flash_light import FlashCalibration, irradiance
from mi_ring.photogrammetry.reduced_photographs import Masks, ReducedView, Views
from mi_ring.scene.lights import Light
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

FLATNESS = 0.004  #: a point up to this distance from the plane belongs to it [distance of the cameras]
MIN_MEMBERS = 0.15  #: least share of the points that belong to a table
TEXELS, COARSE_TEXELS = 320, 160  #: width of the table's texture, by default and while its illumination is estimated
CHUNK = 50_000  #: texels per call, to bound memory
#: A pixel is not table if its log radiance differs by more than SIGNIFICANT medians, and by more than MIN_DIFFERENCE.
SIGNIFICANT, MIN_DIFFERENCE = 4.0, 0.2
MIN_RADIANCE = 2e-3  #: lower radiance is replaced by this
LOG_RADIANCE = np.log(np.maximum(srgb_to_linear(np.arange(256, dtype=np.float32) / 255), MIN_RADIANCE))  #: by sRGB byte
#: A window shows the table's pattern: least correlation, width of the window [px], and least contrast in it.
CORRELATED, WINDOW, CONTRAST = 0.8, 15, 0.15
#: A pixel shows the bare table if log radiance and two log colour ratios are as expected. The largest difference is the
#: QUANTILE of the differences far from the object, clipped to LOWEST and HIGHEST.
QUANTILE, LOWEST, HIGHEST = 0.99, (0.1, 0.05, 0.05), (0.4, 0.15, 0.15)
#: Far is farther than NEAR from the object. The object looks like the table if more than the share CONFUSED of its
#: inside, farther than INSIDE from its outline, does. Smaller regions than SPECK do not count [size of the object].
NEAR, INSIDE, CONFUSED, SPECK = 0.3, 0.1, 0.03, 0.015


class Plane(NamedTuple):
    """A plane normal · x = offset, such as the table. Its unit normal points to the side of the cameras."""

    normal: np.ndarray  #: (3,)
    offset: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the signed heights (...) of points (..., 3) above the plane."""
        return points @ self.normal - self.offset

    def axes(self) -> np.ndarray:
        """Return three unit vectors as rows (3, 3): two directions in the plane, and the normal."""
        return align_vectors(self.normal, [0, 0, 1])[:3, :3]


def find_plane(points: np.ndarray, cameras: np.ndarray, center: np.ndarray, half_size: float) -> Plane | None:
    """Find the table: the plane with the most points around the object, by RANSAC.

    `points` (N, 3): sparse points. `cameras` (K, 3): positions of the cameras, which must be above the plane. `center`
    (3,): middle of the object. `half_size`: points up to twice this distance from `center` are used. Returns None if no
    plane contains enough points.
    """
    near = points[np.linalg.norm(points - center, axis=1) < 2 * half_size]
    if len(near) < 50:
        return None
    random, best = np.random.default_rng(0), 0
    found: Plane | None = None
    thickness = FLATNESS * float(np.median(np.linalg.norm(cameras - center, axis=1)))
    for _ in range(1000):
        a, b, c = near[random.choice(len(near), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal *= np.sign(normal @ (cameras.mean(0) - a)) / length
        plane = Plane(normal, float(a @ normal))
        height = plane.height(near)
        count = int((np.abs(height) < thickness).sum())
        above = (plane.height(cameras) > 0).mean() > 0.98 and (height > -3 * thickness).mean() > 0.9
        if above and count > best:
            best, found = count, plane
    if found is None or best < MIN_MEMBERS * len(near):
        return None
    for _ in range(3):
        middle, normal = plane_fit(near[np.abs(found.height(near)) < thickness])
        normal *= np.sign(normal @ found.normal)
        found = Plane(normal, float(normal @ middle))
    return found


class TexelGrid:
    """A square of texels in a plane, whose sides are 4 · `half_size` long.

    The middle of the square is below `center` (3,). `texels`: number of texels along each side.
    """

    def __init__(self, plane: Plane, center: np.ndarray, half_size: float, texels: int = TEXELS) -> None:
        self.texels, self.normal, across = texels, plane.normal, plane.axes()[:2]
        corner = center - plane.height(center) * plane.normal - 2 * half_size * across.sum(0)
        #: (4, 3) from (column, row, 1) of a texel to (x, y, z, 1)
        self.from_texel = np.vstack([np.stack([*4 * half_size / (texels - 1) * across, corner], 1), [0, 0, 1]])
        row, column = np.divmod(np.arange(texels**2), texels)
        self.u, self.v = column / (texels - 1) - 0.5, row / (texels - 1) - 0.5
        self.points = np.stack([column, row, np.ones_like(row)], 1) @ self.from_texel[:3].T  #: (texels², 3)

    @property
    def to_world(self) -> np.ndarray:
        """Transform (4, 4) from Mitsuba's rectangle (x and y from -1 to 1, normal z) to this square in the world.

        Row 0 of the texels is at y = -1.
        """
        middle = self.from_texel @ np.array([(self.texels - 1) / 2, (self.texels - 1) / 2, 1])
        across = self.from_texel[:, :2] * self.texels / 2
        normal = np.cross(across[:3, 0], across[:3, 1]) / np.linalg.norm(across[:, 0])
        return np.column_stack([across, [*normal, 0], middle])

    def render(self, view: ReducedView, texels: np.ndarray) -> np.ndarray:
        """Draw the texture `texels` (texels², …) as a view shows it. Returns (H, W, …), with nearest texels.

        Outside of the square, the result is NaN for float32 and 0 for uint8.
        """
        width, height = view.camera.size
        pixel_centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        from_pixel = np.linalg.inv(view.camera.projection @ self.from_texel) @ pixel_centre
        none = 0 if texels.dtype == np.uint8 else np.nan
        shown = cv2.warpPerspective(
            texels.reshape(self.texels, self.texels, -1), from_pixel, (width, height), borderValue=[none] * 4,
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        )  # fmt: skip
        x, y, one = from_pixel[2]  # gives the inverse depth
        shown[x * np.arange(width) + y * np.arange(height)[:, None] + one <= 0] = none
        return shown


def estimate_albedo(
    views: Views, lights: Sequence[Light], hidden: Masks, grid: TexelGrid, flash: FlashCalibration
) -> np.ndarray | None:
    """Estimate the table's diffuse albedo. Returns (texels, texels, 3) in [0, 1], or None if no view shows the table.

    It is the median over the views, without interreflection. Texels that no view shows get the median of the others.
    `lights`: the flash for each view. `hidden`: for each view, an array (H, W) above 0 where something may hide the
    table. `flash`: its cone, the room light and the camera's response are used.
    """
    found = np.full((len(views), grid.texels**2, 3), np.nan, np.float32)
    for own, view, light, mask in zip(found, views, lights, hidden, strict=True):
        row, column, inside = view.project(grid.points)
        inside &= (mask[row, column] == 0) & (view.rgb[row, column].max(-1) < 255)
        to_light = light.vector - grid.points[inside]
        direct = irradiance(to_light, grid.normal, view.camera.forward, flash.falloff)[:, None]
        seen = np.pi * view.linear[row, column][inside] ** (1 / flash.gamma)
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 where the flash does not reach
            own[inside] = np.where(direct > 0, seen / (light.rgb * (direct + flash.room)), np.nan)
    albedo = nan_median(found)
    known = np.isfinite(albedo).all(1)
    if not known.any():
        return None
    albedo[~known] = np.median(albedo[known], 0)
    return albedo.reshape(grid.texels, grid.texels, 3).clip(0, 1)


class TableAppearance:
    """The table's appearance: one texture for all views, times a smooth illumination of each view.

    Both are estimated from the views by the constructor. `hidden`: for each view, an array (H, W) above 0 where
    something may hide the table; None: nothing hides it.
    """

    def __init__(self, views: Views, grid: TexelGrid, progress: Progress, hidden: Masks | None = None) -> None:
        self.views, self.grid, self.progress, self.hidden = views, grid, progress, hidden
        x, y = 2 * grid.u, 2 * grid.v
        self.basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1).astype(np.float32)  #: (texels², 6)
        self.lighting = np.zeros((len(views), 6), np.float32)  #: each view's log illumination in this basis
        every = -(-grid.texels // COARSE_TEXELS)
        some = np.arange(grid.texels**2).reshape(grid.texels, -1)[::every, ::every].ravel()
        stack = self.observe_all(some)
        for number in range(3):  # estimate texture and illumination in turn
            texture = nan_median(stack)
            for own, lighting in zip(progress(stack, f"table, round {number + 1}"), self.lighting):
                change = fit_lighting(own - texture, self.basis[some])
                own -= (self.basis[some] @ change)[:, None]
                lighting += change
        parts = np.array_split(np.arange(grid.texels**2), -(-(grid.texels**2) // CHUNK))
        #: (texels², 3) log radiance, NaN where no view shows the texel
        self.texture = np.concatenate([nan_median(self.observe_all(part)) for part in progress(parts, "table")])

    def observe(self, number: int, texels: np.ndarray) -> np.ndarray:
        """Return the log radiance (N, 3) of texels in view `number`, minus the log illumination of this view.

        `texels` (N,): indices of the texels. The result is NaN where the view does not show the texel.
        """
        row, column, inside = self.views[number].project(self.grid.points[texels])
        if self.hidden:
            inside &= self.hidden[number][row, column] == 0
        own = LOG_RADIANCE[self.views[number].rgb[row, column]] - (self.basis[texels] @ self.lighting[number])[:, None]
        return np.where(inside[:, None], own, np.float32(np.nan))

    def observe_all(self, texels: np.ndarray) -> np.ndarray:
        """Return the log radiance (views, N, 3) of texels in each view, minus the log illumination of the view.

        `texels` (N,): indices of the texels. The result is NaN where a view does not show the texel.
        """
        return np.stack(list(in_threads(partial(self.observe, texels=texels), range(len(self.views)))))

    def foreign_masks(self) -> list[np.ndarray]:
        """Return a mask (H, W) uint8 for each view: 1 where the picture differs from the table, otherwise 0.

        Something stands there, such as the object.
        """
        result, everywhere = [], np.arange(len(self.texture))
        for number, view in enumerate(self.progress(self.views, "beside the table")):
            rest = np.abs(self.observe(number, everywhere) - self.texture).max(1)
            usual = float(np.nanmedian(rest)) if np.isfinite(rest).any() else 0.0  # the view shows no table
            differs = rest > max(MIN_DIFFERENCE, SIGNIFICANT * usual)
            mask = cv2.medianBlur(self.grid.render(view, differs.astype(np.uint8)), 5)
            result.append(ndimage.binary_fill_holes(mask).astype(np.uint8))
        return result

    def pattern_masks(self) -> list[np.ndarray]:
        """Return a mask (H, W) uint8 for each view: 1 where the picture certainly shows the table, by its pattern."""
        known = self.texture.mean(1)
        return [
            match_pattern(LOG_RADIANCE[view.rgb].mean(-1), self.grid.render(view, known))
            for view in self.progress(self.views, "pattern of the table")
        ]

    def expected(self, view: ReducedView) -> np.ndarray:
        """Predict the log radiance (H, W, 3) of a view as if there were no object; NaN where it is unknown.

        `view`: one of the views, or another window of the same photograph.
        """
        number = [other.name for other in self.views].index(view.name)
        return self.grid.render(view, self.texture + (self.basis @ self.lighting[number])[:, None])


def bare_table(
    views: Views, silhouettes: Masks, tables: Sequence[TableAppearance], progress: Progress
) -> list[np.ndarray] | None:
    """Return a mask (H, W) uint8 for each view: above 0 where the picture shows only the table.

    `silhouettes`: for each view, a rough mask (H, W) of the object. `tables`: appearances of the table. Each pixel is
    compared with the first appearance that covers it. At first, darker pixels count as table in shadow. If too much of
    the object then looks like the table, darker pixels no longer count. Returns None if that does not help.
    """
    differences = []
    for view in progress(views, "bare table"):
        expected = tables[0].expected(view)
        for table in tables[1:]:
            expected = np.where(np.isfinite(expected), expected, table.expected(view))
        differences.append(colour_difference(LOG_RADIANCE[view.rgb], expected))
    for shadows in (True, False):
        result, wrong, inside = [], 0, 0
        for view, silhouette, difference in zip(views, silhouettes, differences):
            size, known = np.sqrt(max(1, int(silhouette.sum()))), view.valid & np.isfinite(difference).all(-1)
            around = known & (dilate_by_share(silhouette, NEAR) == 0)
            usual = np.quantile(np.abs(difference[around]), QUANTILE, 0) if around.any() else 0
            limits = np.clip(usual, LOWEST, HIGHEST)
            darker = difference[..., 0] if shadows else np.abs(difference[..., 0])
            same = known & (darker < limits[0]) & (np.abs(difference[..., 1:]) < limits[1:]).all(-1)
            smooth = cv2.medianBlur(same.astype(np.uint8), 5)
            result.append(cv2.morphologyEx(smooth, cv2.MORPH_OPEN, disk(SPECK * size)))
            core = known & (dilate_by_share(silhouette, -INSIDE) > 0)
            wrong, inside = wrong + (result[-1][core] > 0).sum(), inside + core.sum()
        if wrong <= CONFUSED * inside:
            return result
    return None


def colour_difference(seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return differences between log radiances `seen` and `expected`, all (H, W, 3); NaN where `expected` is unknown.

    The channels are the differences of the mean, of red/green and of blue/green. A pixel of `seen` is compared with the
    nearest value in 3 × 3 pixels of `expected`, because the texture may be shifted by a pixel.
    """

    def split(log: np.ndarray) -> np.ndarray:
        return np.stack([log.mean(-1), log[..., 0] - log[..., 1], log[..., 2] - log[..., 1]], -1)

    known = np.isfinite(expected).all(-1, keepdims=True)
    near, here = np.where(known, split(expected), 0).astype(np.float32), split(seen)
    window = np.ones((3, 3), np.uint8)
    nearest = np.clip(here, cv2.erode(near, window), cv2.dilate(near, window))
    return np.where(known, here - nearest, np.nan)


def nan_median(stack: np.ndarray) -> np.ndarray:
    """Return the median over the first axis, ignoring NaN. If all values are NaN, the median is NaN.

    Of two values in the middle, the lower one is returned. This is much faster than `np.nanmedian`.
    """
    middle = np.maximum(np.isfinite(stack).sum(0) - 1, 0) // 2
    return np.take_along_axis(np.sort(stack, 0), middle[None], 0)[0]


def fit_lighting(difference: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Fit an illumination to log differences by robust least squares. Returns the coefficients (6,) of `basis`.

    `difference` (N, 3): differences of log radiance, whose mean over the channels is fitted; NaN: unknown. `basis` (N,
    6): the basis functions at the N points.
    """
    mean = difference.mean(1)
    known = np.isfinite(mean)
    if not known.any():
        return np.zeros(basis.shape[1])
    for _ in range(2):
        lighting = np.linalg.lstsq(basis[known], mean[known], rcond=None)[0]
        rest = mean - basis @ lighting
        known = np.isfinite(rest) & (np.abs(rest) < 2 * np.nanmedian(np.abs(rest)) + 1e-3)
    return lighting


def match_pattern(seen: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Return a mask (H, W) uint8: 1 where a picture certainly shows the table's pattern, by local correlation.

    `seen` (H, W): log radiance of the picture. `table` (H, W): expected log radiance of the table; NaN where it is
    unknown.
    """
    known = np.isfinite(table)
    mean = partial(cv2.blur, ksize=(WINDOW, WINDOW))
    a, b = seen.astype(np.float32), np.where(known, table, 0).astype(np.float32)
    a, b = a - mean(a), b - mean(b)
    deviations = np.sqrt(np.maximum(mean(a * a), 1e-9)), np.sqrt(np.maximum(mean(b * b), 1e-9))
    matches = mean(a * b) > CORRELATED * deviations[0] * deviations[1]
    certain = matches & (deviations[1] > CONTRAST) & (mean(known.astype(np.float32)) == 1)
    return cv2.erode(certain.astype(np.uint8), np.ones((WINDOW // 2, WINDOW // 2), np.uint8))
