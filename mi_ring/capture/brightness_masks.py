"""Makes masks from brightness, for photographs of a dark room that have no masks."""

from dataclasses import replace
from functools import partial

import numpy as np
import scipy.ndimage
import torch
from skimage.filters import threshold_otsu

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import decode, is_linear
from mi_ring.images import box_filter


def with_masks_by_brightness(capture: Capture) -> Capture:
    """Return a copy of the capture with new masks, which contain the bright pixels of each photograph.

    Pixels above a threshold are bright. One threshold is estimated from all photographs together. If the room was lit,
    `capture` itself is returned. A mask contains only the lit part of the object, because the rest may be as dark as
    the room. A photograph in which no light reaches the object gets no mask.
    """
    threshold = dark_threshold(capture)
    if threshold is None:
        return capture
    found = capture.masks.replaced({k: partial(bright, capture, k, threshold) for k in range(len(capture))})
    largest = [pieces(mask > 0)[1].max() / mask.size for mask in found]
    few = 0.02 * np.median(largest)  # such a mask has hot pixels only: the light did not reach the object
    masks = found.replaced({k: None for k, share in enumerate(largest) if share <= few})
    return replace(capture, threshold=threshold, masks=masks)


def dark_threshold(capture: Capture) -> float | None:
    """Estimate the radiance below which a pixel may show the dark room. Returns None if the room was lit.

    The unit is full scale of the photographs' files.
    """
    some = [small_brightness(capture, k) for k in capture.spread(50)]
    values = np.concatenate([image.ravel() for image in some])
    if values.max() <= 0:
        return None
    floor = values[values > 0].min()
    split = float(np.exp(threshold_otsu(np.log(np.maximum(values, floor)))))
    dark, bright = values[values <= split], values[values > split]
    border = np.concatenate([np.concatenate([i[0], i[-1], i[:, 0], i[:, -1]]) for i in some])
    # Measure the noise in the dark, away from bright pixels.
    apart = [image[scipy.ndimage.maximum_filter(image, 7) <= split] for image in some]
    if not sum(map(len, apart)) or np.median(dark) > 0.05 * np.median(bright) or (border > split).mean() > 0.2:
        return None
    noise = float(np.quantile(np.concatenate(apart), 0.999))
    return max(4 * noise, 1e-3 * float(np.median(bright)))


def bright(capture: Capture, k: int, threshold: float) -> np.ndarray:
    """Make a mask (H, W) uint8 of photograph `k`: 255 where its radiance is above `threshold`, else 0.

    Connected components that are smaller than 1 % of the largest one are left out.
    """
    labels, sizes = pieces(brightness(capture, k) > threshold)
    return np.where(sizes[labels] > 0.01 * sizes.max(), 255, 0).astype(np.uint8)


def pieces(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the connected components of a boolean mask. Returns (labels in the shape of the mask, pixels per label).

    Label 0 is the background. It counts as 0 pixels.
    """
    labels, _ = scipy.ndimage.label(mask)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels, sizes


def small_brightness(capture: Capture, k: int) -> np.ndarray:
    """Return the brightness (h, w) of photograph `k`, averaged over square blocks.

    The shorter side keeps 256 pixels or more. Brightness is the largest linear radiance of the three colour channels. A
    smaller photograph is not reduced.
    """
    image = torch.from_numpy(brightness(capture, k))[..., None]
    return box_filter(image, max(1, min(image.shape[:2]) // 256))[..., 0].numpy()


def brightness(capture: Capture, k: int) -> np.ndarray:
    """Return the brightness (H, W) of photograph `k`: the largest linear radiance of the three colour channels."""
    image = capture.images[k]
    return decode(image, is_linear(capture.shots[k].encoding, image), 1.0)[0].max(-1)
