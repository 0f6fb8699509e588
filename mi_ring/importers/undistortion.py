"""Removes lens distortion from images."""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb
from mi_ring.importers.camera_models import Lens

TILE = 512  #: side of the squares that are interpolated at once [px], so that their arrays fit into the cache
MOST_TILES = 100  #: whose interpolation is remembered: those of 24 megapixels, a third of a gigabyte


class Window(NamedTuple):
    """A rectangle of the undistorted photograph, and the scale to which it is reduced."""

    left: int  #: first column [px of the photograph]
    top: int  #: first row [px of the photograph]
    width: int  #: [px of the window]
    height: int
    scale: int = 1  #: width of a pixel of the window [px of the photograph]

    @classmethod
    def whole(cls, lens: Lens, longest: int) -> "Window":
        """Return a window of the whole photograph, reduced by a whole number to at most `longest` pixels.

        `longest`: limit of the longer side [px].
        """
        scale = -(-max(lens.size) // longest)
        return cls(0, 0, lens.size[0] // scale, lens.size[1] // scale, scale)


@lru_cache(maxsize=1)
def source_positions(lens: Lens, window: Window) -> np.ndarray:
    """Return where the distorted photograph shows each pixel of the window: rows and columns (2, H, W) [px].

    The centre of the first pixel is at 0.
    """
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    left, top, width, height, scale = window
    rays = np.ones((height, width, 3))
    rays[..., 0] = (left + (np.arange(width) + 0.5) * scale - cx) / fx
    rays[..., 1] = ((top + (np.arange(height) + 0.5) * scale - cy) / fy)[:, None]
    pixels = lens.colmap.img_from_cam(rays.reshape(-1, 3))
    return np.stack([pixels[:, 1], pixels[:, 0]]).reshape(2, height, width) - 0.5


class Interpolation(NamedTuple):
    """Where the source image shows the N pixels of a window, for bilinear interpolation in a crop of the source."""

    crop: tuple[slice, slice]  #: rows and columns of the source that are needed
    first: np.ndarray  #: (N,) int32: the upper left one of the four pixels, as an index into the crop, row by row
    row: np.ndarray  #: (N, 1) float32 from 0 to 1: how far the place is below this pixel [px]
    column: np.ndarray  #: (N, 1) float32 from 0 to 1: how far the place is to the right of this pixel [px]
    valid: np.ndarray  #: (N,) bool: does the source show the place?

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Interpolate `values` (H, W, C), those of the crop. Returns (N, C) float32.

        A place outside of the source gets the value of the nearest place inside.
        """
        flat = values.reshape(-1, values.shape[2]).astype(np.float32, copy=False)

        def between_columns(first: np.ndarray) -> np.ndarray:
            left, right = (flat.take(index, 0, mode="clip") for index in (first, first + 1))
            right -= left
            right *= self.column
            right += left
            return right

        above, below = between_columns(self.first), between_columns(self.first + values.shape[1])
        below -= above
        below *= self.row
        below += above
        return below


@lru_cache(maxsize=MOST_TILES)
def interpolation(lens: Lens, window: Window) -> Interpolation:
    """Return how the pixels of a window are interpolated in the distorted photograph."""
    positions = source_positions(lens, window)
    last = np.array(lens.size[::-1])[:, None, None] - 1
    valid = np.all((positions >= -0.5) & (positions <= last + 0.5), 0)
    positions = positions.clip(0, last)
    first = np.minimum(positions.astype(np.int32), np.maximum(last - 1, 0), dtype=np.int32)
    row, column = (positions - first).astype(np.float32).reshape(2, -1, 1)
    low, high = first.min((1, 2)), np.minimum(first.max((1, 2)) + 2, last.ravel() + 1)
    index = (first[0] - low[0]) * (high[1] - low[1]) + (first[1] - low[1])
    crop = slice(low[0], high[0]), slice(low[1], high[1])
    return Interpolation(crop, index.ravel(), row, column, valid.ravel())


def undistort(
    pixels: np.ndarray, lens: Lens, srgb: bool = False, saturation: float = 1.0, window: Window | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Remove the lens distortion of an image. Returns (image (H, W, C), valid (H, W) bool) of a pinhole camera.

    The pinhole camera has the same focal lengths and principal point. `valid` is False where the source image shows
    nothing; these pixels are 0. `srgb`: the first three channels are sRGB-encoded, so they are interpolated as linear
    values. `saturation`: encoded value (1 = full scale) from which a pixel is clipped; infinite for masks. A pixel of
    the result is clipped if any pixel that contributes to it is clipped. `window`: the part to compute, with scale 1;
    None: the whole image.
    """
    window = window or Window(0, 0, *lens.size)
    image = np.empty((window.height, window.width, pixels.shape[2]), pixels.dtype)
    valid = np.empty(image.shape[:2], bool)
    for top, left in product(range(0, window.height, TILE), range(0, window.width, TILE)):
        width, height = min(TILE, window.width - left), min(TILE, window.height - top)
        at = interpolation(lens, Window(window.left + left, window.top + top, width, height))
        place = slice(top, top + height), slice(left, left + width)
        image[place] = interpolated(pixels, at, srgb, saturation).reshape(height, width, -1)
        valid[place] = at.valid.reshape(height, width)
    return image, valid


def interpolated(pixels: np.ndarray, at: Interpolation, srgb: bool, saturation: float) -> np.ndarray:
    """Interpolate an image (H, W, C) at N places, with the options of `undistort`. Returns (N, C), 0 outside of it."""
    source = pixels[at.crop]
    full = 1 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max
    value = source if full == 1 else np.arange(full + 1, dtype=np.float32) / full  # of each pixel, or of each integer
    linear = srgb_to_linear(value) if srgb else value
    linear = linear if full == 1 else linear[source]
    if srgb:  # but not alpha
        linear[..., 3:] = source[..., 3:] / np.float32(full)
    result = at(linear)
    colours = result[:, :3]
    if srgb:
        colours[:] = linear_to_srgb(colours)
    limit = saturation if full == 1 else int(np.searchsorted(value, np.float32(saturation)))
    clipped = source[..., :3] >= limit  # alpha is never clipped
    if clipped.any():
        np.maximum(colours, limit / full, out=colours, where=at(clipped) > 1e-6)
    if full > 1:
        result *= full
        result += 0.5
    result[~at.valid] = 0
    return result.astype(pixels.dtype)
