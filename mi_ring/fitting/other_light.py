"""What photographs show besides the light of their own: interreflection and the light of the room."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Observation
from mi_ring.fitting.calibration import LIT
from mi_ring.fitting.processes import Share
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.photographs import Photographs

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit


def with_surroundings(
    fit: "Fit", predicted: Tensor, coverage: Tensor, photographs: Photographs, seen: Observation, index: np.ndarray,
    scale: int, share: Share,
) -> Tensor:  # fmt: skip
    """Predicted photographs with interreflection and the light of the room, which is found by the way.

    `index`: of all photographs of the iteration, of which these are the `share`.
    """
    calibration = fit.calibration if fit.calibration and "ambient" in fit.calibration.refined else None
    looking = calibration is not None and (photographs.dark or fit.progress >= LIT)
    which = calibration.room.which if calibration and looking else photographs.harmonics
    if not (fit.ring.indirect or which):
        return predicted
    around = GlobalIllumination.of(fit.surface, photographs, coverage, fit.new_seed(), harmonics=which,
                                 indirect=fit.ring.indirect)  # fmt: skip
    if fit.ring.indirect and fit.surface.table is not None:
        around = fit.averages.of(around, index, share)
    if fit.ring.indirect:
        predicted = predicted + (fit.calibration.bounced(around.interreflection) if fit.calibration
                                 else around.interreflection)  # fmt: skip
    before = predicted.detach()
    if photographs.harmonics:
        predicted = predicted + around.occlusion(torch.from_numpy(photographs.room).to(predicted))
    if calibration and looking:
        telling = seen.surely(coverage.detach()) & ~seen.clipped.any(-1)
        observed = calibration.linear(seen.rgb, index[share.part], scale)
        calibration.room.see(around, before, observed, telling, share, fit.progress)
    return predicted
