"""Interreflection in the photographs, averaged over the iterations of a fit.

The surface changes slowly, and few paths are traced in each iteration. The average has little noise.
"""

from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from mi_ring.fitting.sampler import Batch
from mi_ring.rendering.global_illumination import GlobalIllumination

LATEST = 0.1  #: weight of the newest picture, once there are so many

#: By photograph: number of pictures, and their average (h, w, 4) with coverage.
Averages: TypeAlias = dict[int, tuple[int, Tensor]]


def averaged(earlier: Averages, new: GlobalIllumination, batch: Batch) -> tuple[GlobalIllumination, Averages]:
    """Average the interreflection in each photograph of a batch over this iteration and earlier ones.

    `earlier`: a dict from the index of a photograph to (number of averaged pictures, average). `new`: light of this
    iteration. Returns (a copy of `new` with averaged interreflection, new averages of these photographs as a dict of
    the same kind). A picture with NaN or infinite pixels is not averaged.
    """
    shown, averages = [], {}
    pictures = batch.share.gathered(torch.cat([new.radiance, new.alpha[..., None]], -1))
    for k, picture in zip(batch.all_photographs.tolist(), pictures):
        count, average = earlier.get(k, (0, picture))
        if average.shape != picture.shape:
            count, average = 0, picture
        average = average.to(picture)
        if bool(picture.isfinite().all()):  # a NaN would stay in the average
            average = average + (picture - average) * max(1 / (count + 1), LATEST)
            averages[k] = count + 1, average
        shown.append(average.nan_to_num(0.0, 0.0, 0.0))
    own = torch.stack(shown[batch.share.part])
    return replace(new, radiance=own[..., :3] / own[..., 3:].clamp(min=1e-2) * new.alpha[..., None]), averages
