"""The pixels of photographs for a fit: linear radiance, clipped pixels, masks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.decoding import LinearImage, decode, is_linear, shade
from mi_ring.images import box_filter
from mi_ring.scene.shot import Shot

#: Largest number of pixels in an `ObservationCache`, of about 20 bytes each.
REMEMBERED_PIXELS = 2**24


class Observation(NamedTuple):
    """The pixels of n photographs of one size, with which a fit compares: radiance, clipped pixels, masks."""

    rgb: Tensor  #: (n, H, W, 3) linear radiance, 1.0 = full scale of the file
    clipped: Tensor  #: (n, H, W, 3) bool: the true radiance is at least this
    mask: Tensor  #: (n, H, W) the object's coverage in [0, 1]; 0 where there is no mask
    masked: Tensor  #: (n,) bool: which photographs have a mask
    valid: Tensor | None  #: (n, H, W) bool; invalid pixels are black and clipped. None: all are valid

    def surely(self, coverage: Tensor) -> Tensor:
        """Find pixels (n, H, W) bool that show only the object, by `coverage` (n, H, W) and by the masks, if any."""
        mask = torch.where(self.masked.to(self.mask.device)[:, None, None], self.mask, 1.0)
        return torch.minimum(mask, coverage) > 0.99

    def to(self, device: torch.device) -> "Observation":
        """Move the tensors to a device."""
        return Observation(*(None if tensor is None else tensor.to(device) for tensor in self))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, several: Sequence["Observation"]) -> "Observation":
        """Join several observations of one size into one."""
        *parts, valid = zip(*several)
        rgb, clipped, mask, masked = map(torch.cat, parts)
        if all(v is None for v in valid):
            return cls(rgb, clipped, mask, masked, None)
        shown = [torch.ones_like(o.mask, dtype=torch.bool) if o.valid is None else o.valid for o in several]
        return cls(rgb, clipped, mask, masked, torch.cat(shown))


def observed(
    shot: Shot, image: np.ndarray | LinearImage, mask: np.ndarray | None, valid: np.ndarray | None, scale: int
) -> Observation:
    """Make the observation of one photograph: decode pixels (H, W, 3), and reduce them `scale` times by a box filter.

    `mask`, `valid`: (H, W) uint8 as in the files; None if the photograph has none.
    """
    curve = shot.response.gamma, shot.response.contrast
    linear, clipped = decode(image, is_linear(shot.encoding, image), shot.saturation, *curve)
    linear = linear / shade(shot)
    coverage = np.zeros(linear.shape[:2], np.uint8) if mask is None else mask
    shown = None
    if valid is not None:
        here = valid > 127
        linear = np.where(here[..., None], linear, 0)
        clipped = clipped | ~here[..., None]  # unknown: the radiance is at least 0
        shown = box_filter(torch.from_numpy(here).float()[..., None], scale)[None, ..., 0] == 1
    return Observation(
        box_filter(torch.from_numpy(linear), scale)[None],
        box_filter(torch.from_numpy(clipped).float(), scale)[None] > 0,
        box_filter(torch.from_numpy(coverage).float()[..., None] / 255, scale)[None, ..., 0],
        torch.tensor([mask is not None]),
        shown,
    )


class ObservationCache:
    """Caches observations of single photographs, of the last used scale only, up to `REMEMBERED_PIXELS`.

    At scale 1, nothing is cached.
    """

    def __init__(self) -> None:
        self.kept: dict[int, tuple[int, Observation]] = {}  # scale and observation by index

    def get(self, k: int, scale: int, observe: Callable[[], Observation]) -> Observation:
        """Return the observation of photograph `k` at this scale. Calls `observe` if it is not in the cache."""
        if k in self.kept and self.kept[k][0] == scale:
            return self.kept[k][1]
        self.kept.pop(k, None)
        result = observe()
        pixels = sum(other.mask.numel() for _, other in self.kept.values())
        if scale > 1 and pixels + result.mask.numel() <= REMEMBERED_PIXELS:
            self.kept[k] = scale, result
        return result
