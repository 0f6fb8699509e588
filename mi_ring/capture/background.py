"""Tells from the background whether the camera stood still while the object turned in front of it."""

from functools import partial

import cv2
import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import read_mask, read_photograph
from mi_ring.capture.observation import observed
from mi_ring.capture.reduction import in_turn, reduced_image, reduced_mask, reduced_valid, whole_mask, windowed
from mi_ring.geometry.hull import evenly_spaced

MOST, FEWEST = 16, 3  #: photographs that are compared
WIDTH = 64  #: to which they are reduced [px]
SHOWN = 0.1  #: least share of the pixels that both of two photographs must show as background
NEAR = 2  #: pixels around the object that are left out: shadows and blur
COARSE = 3.0  #: standard deviation of the blur that is subtracted [px]: light and lens darken corners of any picture
VARIED = 0.01  #: least standard deviation of what remains, relative to the background's mean
STILL, MOVES = 0.2, 0.6  #: largest difference of a background that stands still, and smallest of one that moves


def stands_still(capture: Capture) -> bool | None:
    """Test whether the camera stood still, because photographs have the same background.

    True: it did, or there were several cameras that did. False: the background moves. None: it does not tell; it is
    black, uniform or cut out, or there are too few photographs with masks. Raises InputError if a file cannot be read.
    """
    difference = background_difference(capture)
    if difference is None or STILL < difference < MOVES:
        return None
    return difference <= STILL


def background_difference(capture: Capture) -> float | None:
    """Return how much a photograph's background differs from the most similar one: 0 not at all, 1 completely.

    The result is the median over photographs. The difference is half the variance of the difference, divided by the
    variance, of fine structure alone. None: the background is black, uniform or not seen.
    """
    sizes: dict[tuple[int, int], list[int]] = {}
    for k, shot in enumerate(capture.shots):
        if is_seen(capture, k):
            sizes.setdefault(shot.whole.size, []).append(k)
    alike = max(sizes.values(), key=len, default=[])
    if len(alike) < FEWEST or not capture.lit_room:
        return None
    index = [alike[k] for k in evenly_spaced(len(alike), MOST)]
    seen = in_turn(partial(small_background, capture), capture, index, "looking at the background")
    pictures, shown = np.stack([fine_structure(*one) for one in seen]), np.stack([one[1] for one in seen])
    least = []
    for k in range(len(index)):
        both = np.delete(shown, k, 0) & shown[k]
        others, own, count = np.delete(pictures, k, 0), pictures[k], both.sum((1, 2))
        change, variance = (np.where(both, squares, 0).sum((1, 2)) / (2 * count.clip(min=1))
                            for squares in ((others - own) ** 2, others**2 + own**2))  # fmt: skip
        told = (count >= SHOWN * own.size) & (variance > VARIED**2)
        if told.sum() >= FEWEST - 1:
            least.append((change[told] / variance[told]).min())
    return float(np.median(least)) if 2 * len(least) > len(index) else None


def is_seen(capture: Capture, k: int) -> bool:
    """Test whether photograph `k` has a mask and can be read whole."""
    shot = capture.shots[k]
    return capture.masks.readers[k] is not None and not (shot.window and shot.files.filename is None)


def small_background(capture: Capture, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return photograph `k`, whole and small: (mean of linear R, G, B (h, w), which pixels are background (h, w)).

    The background is what is valid and not near the object.
    """
    shot = capture.shots[k]
    whole, read, mask, valid = shot.whole, *(getattr(capture, name).readers[k] for name in ("images", "masks", "valid"))
    if shot.window:
        read = partial(read_photograph, whole, capture.path)
        valid = valid and partial(read_mask, whole, "valid", capture.path)
    window = windowed(whole.size, (0, 0), whole.size, WIDTH)
    rgb = observed(whole.through(window), reduced_image(whole, read, window), None, None, 1).rgb[0].numpy()
    size = 2 * NEAR + 1
    outside = cv2.dilate(reduced_mask(lambda: whole_mask(mask(), shot.window), window), np.ones((size, size))) < 8
    if valid:
        outside &= reduced_valid(valid, window) > 0
    return rgb.mean(-1), outside


def fine_structure(picture: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return what a picture (h, w) has that is finer than `COARSE`, relative to its mean, without rows and columns.

    A table before a wall is the same in every upright picture: rows say nothing. `shown` (h, w): pixels to use; the
    others become 0.
    """
    weight = shown.astype(np.float32)

    def means(values: np.ndarray, average) -> np.ndarray:  # type: ignore[no-untyped-def]  # a linear function
        return average(values * weight) / np.maximum(average(weight), 1e-6)

    fine = picture / max(float(picture[shown].mean()) if shown.any() else 0.0, 1e-12)
    fine = fine - means(fine, lambda x: cv2.GaussianBlur(x.astype(np.float32), (0, 0), COARSE))
    for axis in (0, 1):
        fine = fine - means(fine, lambda x, axis=axis: x.sum(axis, keepdims=True))
    return np.where(shown, fine, 0)
