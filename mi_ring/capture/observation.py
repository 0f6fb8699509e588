"""The pixels of photographs, as a fit needs them: linear radiance, clipped pixels, masks."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.decoding import LinearImage, clip_value, decode, is_linear, shade
from mi_ring.images import box_filter
from mi_ring.scene.shot import Shot

#: Largest number of pixels in an `ObservationCache`, of about 20 bytes each.
REMEMBERED_PIXELS = 2**24


class Observation(NamedTuple):
    """The pixels of n photographs of one size: radiance, clipped pixels and masks.

    A fit compares renderings with them.
    """

    rgb: Tensor  #: (n, H, W, 3) linear radiance, 1.0 = full scale of the file
    clipped: Tensor  #: (n, H, W, 3) bool: the true radiance is at least this
    mask: Tensor  #: (n, H, W) the object's coverage in [0, 1]; 0 where there is no mask
    masked: Tensor  #: (n,) bool: which photographs have a mask
    valid: Tensor | None  #: (n, H, W) bool; invalid pixels are black and clipped. None: all are valid

    def surely(self, coverage: Tensor) -> Tensor:
        """Return a boolean mask (n, H, W): True where a pixel shows only the object.

        `coverage` (n, H, W): the share of each pixel that the predicted object covers. At these pixels it is above
        0.99. If a photograph has a mask, the mask is above 0.99 there, too.
        """
        mask = torch.where(self.masked.to(self.mask.device)[:, None, None], self.mask, 1.0)
        return torch.minimum(mask, coverage) > 0.99

    def to(self, device: torch.device) -> "Observation":
        """Return the observation with its tensors on `device`."""
        return Observation(*(None if tensor is None else tensor.to(device) for tensor in self))  # type: ignore[arg-type]

    @classmethod
    def joined(cls, several: Sequence["Observation"]) -> "Observation":
        """Join several observations into one. All must be of the same image size."""
        *parts, valid = zip(*several)
        rgb, clipped, mask, masked = map(torch.cat, parts)
        if all(v is None for v in valid):
            return cls(rgb, clipped, mask, masked, None)
        shown = [torch.ones_like(o.mask, dtype=torch.bool) if o.valid is None else o.valid for o in several]
        return cls(rgb, clipped, mask, masked, torch.cat(shown))


def observed(
    shot: Shot, image: np.ndarray | LinearImage, mask: np.ndarray | None, valid: np.ndarray | None, scale: int
) -> Observation:
    """Make the observation of one photograph: decode its pixels, and average blocks of `scale` × `scale` pixels.

    `image` (H, W, 3): encoded pixels. `mask`: (H, W) uint8, 255 on the object; None: no mask. `valid`: (H, W) uint8, 0
    where a pixel is ignored; None: all pixels are valid.
    """
    saturation = clip_value(image, shot.saturation)
    linear, clipped = decode(image, is_linear(shot.encoding, image), saturation, shot.response.curve)
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
    """Cache of the observations of single photographs, with at most `REMEMBERED_PIXELS` pixels in total.

    It keeps one observation for each photograph, the last one, if its pixels are reduced by a factor `scale` above 1.
    """

    def __init__(self) -> None:
        self.kept: dict[int, tuple[int, Observation]] = {}  # scale and observation by index

    def get(self, k: int, scale: int, observe: Callable[[], Observation]) -> Observation:
        """Return the observation of photograph `k`, reduced by the factor `scale`.

        If it is not in the cache, call `observe()`.
        """
        if k in self.kept and self.kept[k][0] == scale:
            return self.kept[k][1]
        self.kept.pop(k, None)
        result = observe()
        pixels = sum(other.mask.numel() for _, other in self.kept.values())
        if scale > 1 and pixels + result.mask.numel() <= REMEMBERED_PIXELS:
            self.kept[k] = scale, result
        return result

    def clear(self) -> None:
        """Remove all observations from the cache."""
        self.kept.clear()
