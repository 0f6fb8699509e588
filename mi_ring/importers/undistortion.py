"""Removes lens distortion from images."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.images import linear_to_srgb
from mi_ring.importers.camera_models import Lens

AT_ONCE = 2**22  #: pixels; interpolating them takes about half a gigabyte


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
    x = (left + (np.arange(width) + 0.5) * scale - cx) / fx
    y = (top + (np.arange(height) + 0.5) * scale - cy) / fy
    rays = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones((height, width))], -1).reshape(-1, 3)
    return lens.colmap.img_from_cam(rays).reshape(height, width, 2)[..., ::-1].transpose(2, 0, 1) - 0.5


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
    rows = max(1, AT_ONCE // window.width)
    strips = [window._replace(top=top, height=min(rows, window.top + window.height - top))
              for top in range(window.top, window.top + window.height, rows)]  # fmt: skip
    parts = [undistort_part(pixels, lens, srgb, saturation, strip) for strip in strips]
    images, valid = (np.concatenate(part) for part in zip(*parts))
    return images, valid


def undistort_part(
    pixels: np.ndarray, lens: Lens, srgb: bool, saturation: float, window: Window
) -> tuple[np.ndarray, np.ndarray]:
    """Remove the lens distortion in one window of an image. Returns (image (H, W, C), valid (H, W) bool).

    The window must be small, because its arrays are of floats. `pixels`: the whole distorted image. `srgb`: the first
    three channels are sRGB-encoded. `saturation`: encoded value (1 = full scale) from which a pixel is clipped;
    infinite for masks.
    """
    positions = source_positions(lens, window)
    size = np.array(pixels.shape[:2])
    valid = np.all((positions >= -0.5) & (positions <= size[:, None, None] - 0.5), 0)
    low = np.clip(np.floor(positions.min((1, 2))), 0, size - 1).astype(int)  # first and last source pixels needed
    high = np.clip(np.ceil(positions.max((1, 2))) + 1, low + 1, size).astype(int)
    pixels, positions = pixels[low[0] : high[0], low[1] : high[1]], positions - low[:, None, None]
    full = 1.0 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max

    def resampled(channel: np.ndarray) -> np.ndarray:
        return scipy.ndimage.map_coordinates(channel.astype(np.float32), positions, order=1, mode="nearest")

    channels = []
    for c in range(pixels.shape[2]):
        encoded = pixels[..., c].astype(np.float32) / full
        value = linear_to_srgb(resampled(srgb_to_linear(encoded))) if srgb and c < 3 else resampled(encoded)
        clipped = encoded >= saturation
        if c < 3 and clipped.any():  # alpha is never clipped
            value = np.where(resampled(clipped) > 1e-6, np.maximum(value, encoded[clipped].min()), value)
        channels.append(np.where(valid, value, 0))
    result = np.stack(channels, -1)
    if pixels.dtype != np.float32:
        result = np.clip(result * full + 0.5, 0, full)
    return result.astype(pixels.dtype), valid
