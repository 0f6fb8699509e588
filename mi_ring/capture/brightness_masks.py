"""Masks by brightness, where a scene has none and the room was dark."""

from functools import partial

import numpy as np
import scipy.ndimage
import torch
from skimage.filters import threshold_otsu

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import decode, is_linear
from mi_ring.images import box_filter


def dark_threshold(capture: Capture) -> float | None:
    """Radiance above which a pixel is not the dark room behind the object; None if the room was not dark."""
    some = [small_brightness(capture, k) for k in capture.spread(50)]
    values = np.concatenate([image.ravel() for image in some])
    if values.max() <= 0:
        return None
    floor = values[values > 0].min()
    split = float(np.exp(threshold_otsu(np.log(np.maximum(values, floor)))))
    dark, bright = values[values <= split], values[values > split]
    border = np.concatenate([np.concatenate([i[0], i[-1], i[:, 0], i[:, -1]]) for i in some])
    # Above the noise of the dark: of what is not near to anything bright.
    apart = [image[scipy.ndimage.maximum_filter(image, 7) <= split] for image in some]
    if not sum(map(len, apart)) or np.median(dark) > 0.05 * np.median(bright) or (border > split).mean() > 0.2:
        return None
    noise = float(np.quantile(np.concatenate(apart), 0.999))
    return max(4 * noise, 1e-3 * float(np.median(bright)))


def find_masks(capture: Capture) -> None:
    """Give the photographs masks of what is brighter than a dark room, if it was dark when they were taken.

    Such a mask shows what the light reaches of the object; the rest of the object may be as dark as the room.
    """
    capture.threshold = dark_threshold(capture)
    if capture.threshold is None:
        return
    found = capture.masks.replaced({k: partial(bright, capture, k) for k in range(len(capture))})
    largest = [pieces(mask > 0)[1].max() / mask.size for mask in found]
    few = 0.02 * np.median(largest)  # hot pixels: the light did not reach the object
    capture.masks = found.replaced({k: None for k, share in enumerate(largest) if share <= few})


def bright(capture: Capture, k: int) -> np.ndarray:
    """The mask (H, W) uint8 of what is brighter than the dark room, but for specks."""
    assert capture.threshold is not None
    labels, sizes = pieces(brightness(capture, k) > capture.threshold)
    return np.where(sizes[labels] > 0.01 * sizes.max(), 255, 0).astype(np.uint8)


def pieces(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (H, W) of the pieces of a mask (H, W) bool, from 1 on, and how many pixels each has, of 0 none."""
    labels, _ = scipy.ndimage.label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels, sizes


def small_brightness(capture: Capture, k: int) -> np.ndarray:
    """`brightness` of about 256 × 256 pixels, the means of blocks."""
    image = torch.from_numpy(brightness(capture, k))[..., None]
    return box_filter(image, max(1, min(image.shape[:2]) // 256))[..., 0].numpy()


def brightness(capture: Capture, k: int) -> np.ndarray:
    """Radiance (H, W) of the brightest colour of each pixel."""
    image = capture.images[k]
    return decode(image, is_linear(capture.sensors[k], image), 1.0)[0].max(-1)
