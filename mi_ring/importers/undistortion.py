"""Lens distortion undone."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.ndimage

from mi_ring.images import linear_to_srgb, srgb_to_linear
from mi_ring.importers.camera_models import Lens


class Undistorted(NamedTuple):
    """A picture as a camera without distortion would have taken it: same size, focal lengths and principal point."""

    pixels: np.ndarray  #: (H, W, C), of the type of the source
    valid: np.ndarray  #: (H, W) bool: does the source show it? Elsewhere pixels are 0


class Window(NamedTuple):
    """A part of the undistorted picture, perhaps reduced."""

    left: int
    top: int
    width: int  #: of the part as it is written [px]
    height: int
    scale: int = 1  #: how many pixels are one of these, across


def whole(lens: Lens, scale: int = 1) -> Window:
    """All of the picture."""
    return Window(0, 0, lens.size[0] // scale, lens.size[1] // scale, scale)


@lru_cache(maxsize=1)
def distorted(lens: Lens, window: Window) -> np.ndarray:
    """Where in the photograph (2, H, W) [px], row and column, each pixel of the undistorted one is.

    As `scipy.ndimage` counts, whose first pixel's centre is 0.
    """
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    left, top, width, height, scale = window
    x = (left + (np.arange(width) + 0.5) * scale - cx) / fx
    y = (top + (np.arange(height) + 0.5) * scale - cy) / fy
    rays = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones((height, width))], -1).reshape(-1, 3)
    pixels = lens.colmap.img_from_cam(rays).reshape(height, width, 2) - 0.5
    return pixels[..., ::-1].transpose(2, 0, 1)


def undistort(
    pixels: np.ndarray, lens: Lens, srgb: bool = False, saturation: float = 1.0, window: Window | None = None
) -> Undistorted:
    """Resample a picture (H, W, C), linearly in radiance: `srgb` says that its first three channels are encoded.

    What a clipped pixel has a part in, one at or above `saturation` (encoded value, 1 = full scale), is clipped, too:
    a mean of clipped values and others would claim to be exact. Infinite: nothing is, as of masks. `window`: only this
    part of it, not reduced.
    """
    places = distorted(lens, window or whole(lens))
    size = np.array(pixels.shape[:2])
    valid = np.all((places >= -0.5) & (places <= size[:, None, None] - 0.5), 0)  # a pixel is as wide as 1
    low = np.clip(np.floor(places.min((1, 2))), 0, size - 1).astype(int)  # of what is needed
    high = np.clip(np.ceil(places.max((1, 2))) + 1, low + 1, size).astype(int)
    pixels, places = pixels[low[0] : high[0], low[1] : high[1]], places - low[:, None, None]
    full = 1.0 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max

    def resampled(channel: np.ndarray) -> np.ndarray:
        return scipy.ndimage.map_coordinates(channel.astype(np.float32), places, order=1, mode="nearest")

    channels = []
    for c in range(pixels.shape[2]):
        encoded = pixels[..., c].astype(np.float32) / full
        value = linear_to_srgb(resampled(srgb_to_linear(encoded))) if srgb and c < 3 else resampled(encoded)
        clipped = encoded >= saturation
        if c < 3 and clipped.any():  # not of an alpha channel
            value = np.where(resampled(clipped) > 1e-6, np.maximum(value, encoded[clipped].min()), value)
        channels.append(np.where(valid, value, 0))
    result = np.stack(channels, -1)
    if pixels.dtype != np.float32:
        result = np.clip(result * full + 0.5, 0, full)
    return Undistorted(result.astype(pixels.dtype), valid)
