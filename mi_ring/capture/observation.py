"""Photographs as a fit sees them: linear radiance, clipped pixels, masks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.decoding import decode, is_linear, shade
from mi_ring.images import box_filter
from mi_ring.scene.shot import Shot

#: Pixels of all photographs in a `DecodedCache`. A pixel takes up to 200 bytes: what is kept fragments the memory.
REMEMBERED_PIXELS = 2**23


class Observation(NamedTuple):
    """Photographs as a fit sees them, n of one size."""

    rgb: Tensor  #: (n, H, W, 3) linear radiance, 1.0 = full scale of the file
    clipped: Tensor  #: (n, H, W, 3) bool: the scene is at least this bright
    mask: Tensor  #: (n, H, W) the object's coverage in [0, 1]; 0 where there is no mask
    masked: Tensor  #: (n,) bool: which photographs have a mask
    valid: Tensor | None  #: (n, H, W) bool: which pixels say something; the others are black and clipped. None: all do

    def surely(self, coverage: Tensor) -> Tensor:
        """(n, H, W) bool: pixels that are wholly object by their mask, if they have one, and by a `coverage`."""
        mask = torch.where(self.masked.to(self.mask.device)[:, None, None], self.mask, 1.0)
        return torch.minimum(mask, coverage) > 0.99

    def to(self, device: torch.device) -> "Observation":
        """The same on a device."""
        return Observation(*(None if tensor is None else tensor.to(device) for tensor in self))  # type: ignore[arg-type]


class Decoded(NamedTuple):
    """One photograph of an `Observation`."""

    rgb: Tensor  #: (H, W, 3)
    clipped: Tensor  #: (H, W, 3) bool
    mask: Tensor  #: (H, W)
    valid: Tensor | None  #: (H, W) bool


def decoded(shot: Shot, image: np.ndarray, mask: np.ndarray | None, valid: np.ndarray | None, scale: int) -> Decoded:
    """A photograph's radiance by its encoded pixels (H, W, 3), box-filtered `scale` times smaller.

    `mask`, `valid`: (H, W) uint8 as in its files, None where it has none.
    """
    curve = shot.response.gamma, shot.response.contrast
    linear, clipped = decode(image, is_linear(shot.encoding, image), shot.saturation, *curve)
    linear = linear / shade(shot)
    mask = np.zeros(linear.shape[:2], np.uint8) if mask is None else mask
    shown = None
    if valid is not None:
        here = valid > 127
        linear = np.where(here[..., None], linear, 0)
        clipped = clipped | ~here[..., None]  # nothing is known: the scene is at least this black
        shown = box_filter(torch.from_numpy(here).float()[..., None], scale)[..., 0] == 1
    return Decoded(
        box_filter(torch.from_numpy(linear), scale),
        box_filter(torch.from_numpy(clipped).float(), scale) > 0,
        box_filter(torch.from_numpy(mask).float()[..., None] / 255, scale)[..., 0],
        shown,
    )


def together(several: Sequence[Decoded], masked: Sequence[bool]) -> Observation:
    """Decoded photographs of one size as an observation; `masked`: which of them have a mask."""
    rgb, clipped, mask, valid = zip(*several)
    shown = None
    if not all(v is None for v in valid):
        shown = torch.stack([torch.ones_like(m, dtype=torch.bool) if v is None else v for v, m in zip(valid, mask)])
    return Observation(torch.stack(rgb), torch.stack(clipped), torch.stack(mask), torch.tensor(masked), shown)


class DecodedCache:
    """Decoded photographs, each at its last scale, as many as there is room for; none at the scale of its file."""

    def __init__(self) -> None:
        self.kept: dict[int, tuple[int, Decoded]] = {}  # (scale, photograph) by index
        self.pixels = 0  # of all that are kept

    def get(self, k: int, scale: int, decode: Callable[[], Decoded]) -> Decoded:
        """Photograph `k` at a scale; `decode` is called if it is not kept."""
        if k in self.kept:
            before, result = self.kept[k]
            if before == scale:
                return result
            self.pixels -= self.kept.pop(k)[1].mask.numel()
        result = decode()
        pixels = result.mask.numel()
        if scale > 1 and self.pixels + pixels <= REMEMBERED_PIXELS:
            self.kept[k] = scale, result
            self.pixels += pixels
        return result
