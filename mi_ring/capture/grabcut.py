"""Refines an approximate outline of the object in a photograph by GrabCut ("GrabCut", Rother et al. 2004)."""

import cv2
import numpy as np


def disk(radius: float) -> np.ndarray:
    """Return a structuring element of OpenCV: a disk with this `radius` [px]. A radius below 1 becomes 1."""
    r = max(1, round(radius))
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * r + 1, 2 * r + 1))


def dilate_by_share(coverage: np.ndarray, share: float) -> np.ndarray:
    """Dilate a mask (H, W) uint8, 0 or 1, by a disk. The radius is `share` · square root of the mask's area [px].

    A negative `share` erodes the mask. Returns a mask of the same kind.
    """
    kernel = disk(abs(share) * np.sqrt(max(1, int(coverage.sum()))))
    return cv2.dilate(coverage, kernel) if share > 0 else cv2.erode(coverage, kernel)


def grabcut(rgb: np.ndarray, coverage: np.ndarray, background: np.ndarray, band: float) -> np.ndarray:
    """Segment the object in a photograph (H, W, 3) uint8 sRGB. Returns a mask (H, W) uint8, 1 on the object.

    `coverage` (H, W) uint8, 0 or 1: approximate mask. `background` (H, W) bool: pixels that certainly do not show the
    object. GrabCut decides only about a band along the outline of `coverage`. The band reaches `band` · s inside the
    outline and 1.5 `band` · s outside, where s is the square root of the mask's area [px].
    """
    seed = np.full(coverage.shape, cv2.GC_BGD, np.uint8)
    seed[dilate_by_share(coverage, 1.5 * band) > 0] = cv2.GC_PR_BGD
    seed[coverage > 0] = cv2.GC_PR_FGD
    seed[dilate_by_share(coverage, -band) > 0] = cv2.GC_FGD
    seed[background] = cv2.GC_BGD
    if not {cv2.GC_FGD, cv2.GC_BGD} <= set(np.unique(seed)):
        return coverage & ~background
    cv2.setRNGSeed(0)  # of this thread
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(rgb[..., ::-1]), seed, (0, 0, 0, 0), *models, 3, cv2.GC_INIT_WITH_MASK)
    return ((seed == cv2.GC_FGD) | (seed == cv2.GC_PR_FGD)).astype(np.uint8)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Return the intersection over union of the masks `a` and `b`. If both are empty, it is 1."""
    union = int(((a > 0) | (b > 0)).sum())
    return int(((a > 0) & (b > 0)).sum()) / union if union else 1.0
