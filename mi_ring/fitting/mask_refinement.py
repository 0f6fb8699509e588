"""Mask refinement: during a fit, GrabCut finds new masks near the outline of the current surface."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.capture.grabcut import grabcut, overlap
from mi_ring.fitting.model import Model
from mi_ring.fitting.renderer import Renderer
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.rendering import prediction
from mi_ring.system.progress import progress

LARGEST = 512  #: largest side of the pictures in which masks are found [px]
BAND = 0.04  #: how far the surface may be off, relative to the object's size
PLAUSIBLE = 0.8  #: overlap with the surface's coverage below which a mask is not used
BRIGHTNESS = 0.25  #: linear brightness of the object in these pictures

Masks: TypeAlias = dict[int, Tensor]  #: (h, w) uint8, 0 or 1, perhaps of reduced size, by photograph


def find_masks(capture: Capture, exposure: float, model: Model, renderer: Renderer, level: int) -> Masks:
    """Segment the object in all photographs, near the outline of the current surface. Renders the surface.

    Returns a dict from the index of a photograph to its new mask (h, w) uint8, 0 or 1. The mask may be smaller than the
    photograph. A photograph whose new mask is implausible is left out. Photographs from one viewpoint share a mask.
    `exposure`: mean radiance of the object. `level`: level of the mesh that is rendered.
    """
    capture = model.calibrated(capture)
    surface = renderer.show(model, level)
    places: dict[tuple, list[int]] = {}
    for k, shot in enumerate(capture.shots):
        places.setdefault((shot.size, shot.camera.to_world.tobytes()), []).append(k)

    def seen_from(index: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (mean picture (h, w, 3), predicted coverage (h, w), certain background (h, w)).

        `index`: the photographs from one viewpoint.
        """
        scale = -(-max(capture.shots[index[0]].size) // LARGEST)
        seen = capture.observe(index, scale)
        _, coverage = prediction.draw(surface, capture.photograph(index[0], scale), spp=4, shadows=False)
        picture = to_bytes(linear_to_srgb(seen.rgb.mean(0).numpy() * (BRIGHTNESS / exposure)))
        background = np.zeros(picture.shape[:2], bool)
        if seen.valid is not None:
            background |= ~seen.valid.numpy().any(0)
        return picture, (coverage[0].numpy() > 0.5).astype(np.uint8), background

    def mask_of(given: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray | None:
        mask = grabcut(*given, BAND)
        return mask if overlap(mask, given[1]) >= PLAUSIBLE else None

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # rendering stays on this thread
        found = list(progress(pool.map(mask_of, map(seen_from, places.values())), "masks", len(places)))
    return {
        k: torch.from_numpy(mask)
        for index, mask in zip(places.values(), found)
        if mask is not None and mask.any()
        for k in index
    }


def with_masks(capture: Capture, masks: Mapping[int, Tensor]) -> Capture:
    """Return a copy of the capture with new masks. `masks`: a dict from the index of a photograph to its new mask.

    A mask is (h, w) uint8, 0 or 1. It is enlarged to the size of the photograph. Other photographs keep their masks.
    What `capture` has cached with the old masks is removed.
    """

    def enlarged(mask: Tensor, size: tuple[int, int]) -> np.ndarray:
        (width, height), (rows, columns) = size, mask.shape
        scale = width // columns  # what remains at the border is narrower than a pixel of the mask
        whole = cv2.resize(255 * mask.numpy(), (scale * columns, scale * rows), interpolation=cv2.INTER_LINEAR)
        return np.pad(whole, ((0, height - scale * rows), (0, width - scale * columns)), "edge")

    if not masks:
        return capture
    capture.observations.clear()
    readers = {k: partial(enlarged, mask, capture.shots[k].size) for k, mask in masks.items()}
    return replace(capture, masks=capture.masks.replaced(readers))
