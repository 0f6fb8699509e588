"""Photographs that are kept out of a fit: does what was refined explain them better?"""

from typing import TYPE_CHECKING

import numpy as np
import torch

from mi_ring.capture.capture import Capture
from mi_ring.rendering import bridge

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

SHARED = (
    "focal",
    "light",
    "curve",
    "ambient",
)  #: unknowns of all photographs; those of one are not known where it is kept out
WIDTH, SPP, MOST = 256, 4, 16  #: of the pictures that are compared, and how many of them


def unexplained(fit: "Fit", capture: Capture) -> float:
    """Share of the object's light in photographs that are kept out, each at its best exposure, that is not predicted.

    The surface must have been shown. `capture`: with the calibration that is asked about.
    """
    shares = []
    for k in fit.held_out[:: -(-len(fit.held_out) // MOST)]:
        scale = -(-capture.sensors[k].size[0] // WIDTH)
        rgb, coverage = bridge.draw(fit.surface, capture.photograph(k, scale), SPP, shadows=capture.shadows,
                                    indirect=fit.ring.indirect)  # fmt: skip
        seen, gamma = capture.observe([k], scale), capture.sensors[k].gamma
        inside = seen.surely(coverage) & ~seen.clipped.any(-1)
        observed, predicted = seen.rgb[inside] ** gamma, rgb[inside] ** gamma  # as the file has them
        if len(observed):
            factor = (observed * predicted).sum() / predicted.square().sum().clamp(min=1e-12)
            shares.append(float((factor * predicted - observed).abs().sum() / observed.sum()))
    return float(np.mean(shares)) if shares else np.nan


def confirm(fit: "Fit") -> dict:
    """Put back what was refined for all photographs and explains those that were kept out no better than before.

    Returns what is unexplained of them (`unexplained`, and `before`, without any of it) and what was `put_back`.
    """
    calibration = fit.calibration
    fit.surface.show(fit.ring, *fit.ring.domain.sample(fit.stages[-1].level))
    now = unexplained(fit, fit.calibrated())
    back: list[str] = []
    if calibration is None:
        return {"unexplained": now, "put_back": back}
    for name in [name for name in SHARED if name in calibration.refined]:
        unknown, given = calibration.unknown(name)
        found = unknown.detach().clone()
        with torch.no_grad():
            unknown.copy_(given)
            without = unexplained(fit, fit.calibrated())
            if without <= now:
                now, back = without, [*back, name]
            else:
                unknown.copy_(found)
    return {"unexplained": now, "before": unexplained(fit, fit.capture), "put_back": back}
