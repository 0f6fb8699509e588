"""Masks as unknowns: found anew in the course of a fit, by GrabCut about what the surface covers by then."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.capture.grabcut import grabcut, overlap
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.rendering import bridge
from mi_ring.system.progress import progress

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

REDRAWN = 0.5, 0.75  #: progress of the fit at which masks are found anew
LONGEST = 512  #: pixels at most along the pictures in which they are found
BAND = 0.04  #: of the object's size, by which the surface may be off
SURE = 0.8  #: overlap with what the surface covers, below which a mask is not believed
BRIGHTNESS = 0.25  #: of the object in these pictures, linear


def find_outlines(fit: "Fit") -> dict[int, Tensor]:
    """What photographs show of the object by the index of each: (h, w) uint8, 0 or 1, perhaps reduced.

    Those that are not sure are left out. Photographs from one place are looked at together.
    """
    capture = fit.calibrated()
    fit.surface.show(fit.ring, *fit.ring.domain.sample(fit.stages[-1].level))
    places: dict[tuple, list[int]] = {}
    for k, shot in enumerate(capture.shots):
        places.setdefault((shot.size, shot.camera.to_world.tobytes()), []).append(k)

    def seen_from(index: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Picture, coverage, and what surely is background."""
        scale = -(-max(capture.shots[index[0]].size) // LONGEST)
        seen = capture.observe(index, scale)
        _, coverage = bridge.draw(fit.surface, capture.photograph(index[0], scale), spp=4, shadows=False)
        picture = to_bytes(linear_to_srgb(seen.rgb.mean(0).numpy() * (BRIGHTNESS / fit.exposure)))
        background = np.zeros(picture.shape[:2], bool)
        if seen.valid is not None:
            background |= ~seen.valid.numpy().any(0)
        return picture, (coverage[0].numpy() > 0.5).astype(np.uint8), background

    def outlined(given: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray | None:
        mask = grabcut(*given, BAND)
        return mask if overlap(mask, given[1]) >= SURE else None

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # what draws does so on this thread
        masks = pool.map(outlined, map(seen_from, places.values()))
        found = list(progress(masks, "masks", len(places)))
    return {
        k: torch.from_numpy(mask)
        for index, mask in zip(places.values(), found)
        if mask is not None and mask.any()
        for k in index
    }


def with_outlines(capture: Capture, outlines: Mapping[int, Tensor]) -> Capture:
    """The capture with these masks instead of its own, as `find_outlines` gives them."""

    def enlarged(outline: Tensor, size: tuple[int, int]) -> np.ndarray:
        (width, height), (rows, columns) = size, outline.shape
        scale = width // columns  # what is over is less than a pixel of the outline's
        whole = cv2.resize(255 * outline.numpy(), (scale * columns, scale * rows), interpolation=cv2.INTER_LINEAR)
        return np.pad(whole, ((0, height - scale * rows), (0, width - scale * columns)), "edge")

    readers = {k: partial(enlarged, outline, capture.shots[k].size) for k, outline in outlines.items()}
    return replace(capture, masks=capture.masks.replaced(readers))
