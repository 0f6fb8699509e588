"""Indirect light in the photographs, averaged over the iterations of a fit."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mi_ring.rendering.global_illumination import GlobalIllumination

LATEST = 0.1  #: weight of the newest picture, once there are so many


class IndirectAverage:
    """The average interreflection of each photograph over the last iterations that rendered it.

    The surface changes slowly, and few paths are traced in each iteration. The average has little noise at many pixels.
    """

    def __init__(self) -> None:
        #: by photograph: number of pictures, and their average (h, w, 4) with coverage
        self.pictures: dict[int, tuple[int, Tensor]] = {}

    def add(
        self,
        new: GlobalIllumination,
        index: np.ndarray,
        gathered: Callable[[Tensor], Tensor],
        part: slice = slice(None),
    ) -> GlobalIllumination:
        """Add pictures and return them with the average instead of their own interreflection.

        `index` (N,): photographs of all processes. `gathered`: brings pictures of all processes together; `part`: of
        them those of this process.
        """
        averages = []
        pictures = gathered(torch.cat([new.radiance, new.alpha[..., None]], -1))
        for k, picture in zip(index.tolist(), pictures):
            count, average = self.pictures.get(k, (0, picture))
            if average.shape != picture.shape:
                count, average = 0, picture
            average = average.to(picture)
            if bool(picture.isfinite().all()):  # a NaN would stay in the average
                average = average + (picture - average) * max(1 / (count + 1), LATEST)
                self.pictures[k] = count + 1, average
            averages.append(average.nan_to_num(0.0, 0.0, 0.0))
        shown = torch.stack(averages[part])
        return replace(new, radiance=shown[..., :3] / shown[..., 3:].clamp(min=1e-2) * new.alpha[..., None])
