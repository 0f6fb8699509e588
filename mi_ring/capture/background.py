"""Tells whether the background is the same in photographs from several sides of the object."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import read_mask, read_photograph
from mi_ring.capture.observation import observed
from mi_ring.capture.reduction import in_turn, reduced_image, reduced_mask, reduced_valid, whole_mask, windowed
from mi_ring.errors import InputError
from mi_ring.geometry.hull import evenly_spaced

MOST, FEWEST = 16, 3  #: photographs that are compared
WIDTH = 64  #: to which they are reduced [px]
TILE = 8  #: side of the squares of a photograph that are compared [px]
SHOWN = 0.3  #: least share of the squares that both of two photographs must show as background with structure
NEAR = 2  #: pixels around the object that are left out: shadows and blur
COVERED = 8  #: coverage of a pixel by the object, of 255, from which it is no background
COARSE = 3.0  #: standard deviation of the blur that is subtracted [px]: light and lens darken corners of any picture
VARIED = 0.01  #: least standard deviation of what remains in a square, relative to the background's mean
DARK = 0.02  #: pixels below this share of the background's mean are left out: borders of undistorted photographs
TURNED = 10.0  #: least rotation between the cameras of two photographs that are compared [degrees]
STILL, MOVED = 0.3, 0.7  #: largest difference of backgrounds that are the same, and least one of others


def background_moves(capture: Capture) -> bool | None:
    """Test whether photographs from other sides of the object have other backgrounds.

    None: the background does not tell. It is black, plain, cut out or cannot be read, it moves only in part, or too few
    photographs have masks.
    """
    try:
        found = background_difference(capture)
    except InputError:  # a file has gone, of which the fit needs only what is cached
        return None
    return None if found is None or STILL < found < MOVED else found >= MOVED


def background_difference(capture: Capture) -> float | None:
    """Return how much a photograph's background differs from the most similar one from another side of the object.

    0: not at all, 1: completely. It is the median over photographs, and over squares of them: half the variance of the
    difference, divided by the variance, of fine structure alone. None: the background is black, plain or not seen.
    Raises InputError if a file cannot be read.
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
    turns = np.stack([capture.shots[k].camera.to_world[:3, :3] for k in index])
    least = []
    for own, here, turn in zip(pictures, shown, turns):
        angles = np.degrees(np.arccos(((turns * turn).sum((1, 2)) / 2 - 0.5).clip(-1, 1)))
        differences = [difference_of(own, pictures[k], here & shown[k]) for k in np.flatnonzero(angles > TURNED)]
        told = [value for value in differences if value is not None]
        if len(told) >= FEWEST - 1:
            least.append(min(told))
    return float(np.median(least)) if 2 * len(least) > len(index) else None


def difference_of(first: np.ndarray, second: np.ndarray, shown: np.ndarray) -> float | None:
    """Return how much two pictures of fine structure (h, w) differ, as `background_difference` does.

    `shown` (h, w): the pixels to compare. None: too few squares of the pictures have structure.
    """
    height, width = (side // TILE * TILE for side in first.shape)

    def sums(values: np.ndarray) -> np.ndarray:
        return values[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE).sum((1, 3))

    count = sums(shown)
    change, variance = (sums(np.where(shown, squares, 0)) / (2 * count.clip(min=1))
                        for squares in ((first - second) ** 2, first**2 + second**2))  # fmt: skip
    told = (count >= TILE**2 / 2) & (variance > VARIED**2)
    if told.sum() < SHOWN * max(told.size, 1):
        return None
    return float(np.median(change[told] / variance[told]))


def is_seen(capture: Capture, k: int) -> bool:
    """Test whether photograph `k` has a mask and can be read whole."""
    shot = capture.shots[k]
    return capture.masks.readers[k] is not None and not (shot.window and shot.files.filename is None)


def small_background(capture: Capture, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return photograph `k`, whole and small: (mean of linear R, G, B (h, w), which pixels are background (h, w)).

    The background is what is valid, not near the object and not black. Raises InputError if a file cannot be read.
    """
    shot = capture.shots[k]
    whole, read, mask, valid = shot.whole, *(getattr(capture, name).readers[k] for name in ("images", "masks", "valid"))
    if shot.window:
        read = partial(read_photograph, whole, capture.path)
        valid = valid and partial(read_mask, whole, "valid", capture.path)
    window = windowed(whole.size, (0, 0), whole.size, WIDTH)
    rgb = observed(whole.through(window), reduced_image(whole, read, window), None, None, 1).rgb[0].numpy()
    size = 2 * NEAR + 1
    outside = cv2.dilate(reduced_mask(lambda: whole_mask(mask(), shot.window), window), np.ones((size, size))) < COVERED
    if valid:
        outside &= reduced_valid(valid, window) > 0
    picture = rgb.mean(-1)
    if outside.any():
        outside &= picture > DARK * picture[outside].mean()
    return picture, outside


def fine_structure(picture: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return what a picture (h, w) has that is finer than `COARSE`, relative to its mean, without rows and columns.

    A table before a wall is the same in every upright picture: rows say nothing. `shown` (h, w): pixels to use; the
    others become 0.
    """
    weight = shown.astype(np.float32)

    def means(values: np.ndarray, average: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return average(values * weight) / np.maximum(average(weight), 1e-6)

    fine = picture / max(float(picture[shown].mean()) if shown.any() else 0.0, 1e-12)
    fine = fine - means(fine, lambda x: cv2.GaussianBlur(x.astype(np.float32), (0, 0), COARSE))
    for axis in (0, 1):
        fine = fine - means(fine, partial(np.sum, axis=axis, keepdims=True))
    return np.where(shown, fine, 0)
