"""Interreflection in the photographs, averaged over the iterations of a fit."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mi_ring.fitting.processes import ALONE, Share
from mi_ring.rendering.global_illumination import GlobalIllumination

LATEST = 0.1  #: share of the newest picture, once there are so many


class Averages:
    """What interreflection adds to each photograph, as the last iterations that met it have seen it.

    The surface changes slowly, and few paths are traced at a time: their average has little noise at many pixels.
    """

    def __init__(self) -> None:
        #: By the photograph: how many pictures, and their average (h, w, 4) with the object's coverage.
        self.pictures: dict[int, tuple[int, Tensor]] = {}

    def of(self, around: GlobalIllumination, index: np.ndarray, share: Share | None = None) -> GlobalIllumination:
        """The same light, with the average of their interreflection, of photographs `index` (N,) or a share."""
        share = share or Share(ALONE, len(index))
        averages = []
        pictures = share.gathered(torch.cat([around.radiance, around.alpha[..., None]], -1))
        for k, new in zip(index.tolist(), pictures):
            count, average = self.pictures.get(k, (0, new))
            if average.shape != new.shape:
                count, average = 0, new
            average = average.to(new)
            # What is not would stay: the iteration goes without it.
            if bool(new.isfinite().all()):
                average = average + (new - average) * max(1 / (count + 1), LATEST)
                self.pictures[k] = count + 1, average
            averages.append(average.nan_to_num(0.0, 0.0, 0.0))
        shown = torch.stack(averages[share.part])
        return replace(around, radiance=shown[..., :3] / shown[..., 3:].clamp(min=1e-2) * around.alpha[..., None])
