"""Photographs that are kept out of a fit: does what was refined explain them better?

Surface and material stay as they were fitted, together with what was refined: that is a judgement of them all, and what
is put back is not made up for.
"""

import copy
import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import recorded
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import OF_ONE, UNKNOWNS
from mi_ring.rendering import bridge

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit

#: Of all photographs; what is of one is not known where it is out.
SHARED = set(UNKNOWNS) - OF_ONE
WIDTH, SPP, MOST = 256, 4, 16  #: of the pictures that are compared, and how many of them


def kept_out(capture: Capture, every: int) -> np.ndarray:
    """Indices of one photograph of so many, from the middle of the first so many on; none if `every` is 0.

    Raises InputError if that is none or all of them.
    """
    several = len(capture)
    found = np.arange(several)[every // 2 :: every] if every else np.arange(0)
    if every and several < 2:
        raise InputError(f"{capture.path}: --holdout: there is one photograph alone; leave it out")
    if every and not 0 < len(found) < several:
        raise InputError(f"{capture.path}: --holdout: is {every}, which keeps {len(found)} of {several} photographs "
                         f"out; give 2 to {2 * several - 1}")  # fmt: skip
    return found


def unexplained(fit: "Fit", capture: Capture) -> float:
    """Share of the object's light in photographs that are kept out, each at its best exposure, that is not predicted.

    The surface must have been shown. `capture`: with the calibration that is asked about.
    """
    shares = []
    for k in fit.held_out[:: -(-len(fit.held_out) // MOST)]:
        scale = -(-capture.shots[k].size[0] // WIDTH)
        rgb, coverage = bridge.draw(fit.surface, capture.photograph(k, scale), SPP, shadows=capture.shadows,
                                    indirect=fit.ring.indirect)  # fmt: skip
        seen, shot = capture.observe([k], scale), capture.shots[k]
        inside = seen.surely(coverage) & ~seen.clipped.any(-1)
        observed, predicted = (recorded(linear[0].numpy(), shot, scale)[inside[0]] for linear in (seen.rgb, rgb))
        if len(observed):
            factor = (observed * predicted).sum() / max((predicted**2).sum(), 1e-12)
            shares.append(float(np.abs(factor * predicted - observed).sum() / observed.sum()))
    return float(np.mean(shares)) if shares else np.nan


def confirm(fit: "Fit") -> dict:
    """Put back what was refined for all photographs and explains those that were kept out no better than before.

    Returns what is unexplained of them (`unexplained`; `before`: with all unknowns as they began, but this surface) and
    what was `put_back`; nothing is unexplained nor put back where they show nothing that is surely the object.
    """
    calibration = fit.calibration

    def unexplained_now() -> float:
        fit.follow_power()
        fit.surface.show(fit.ring, *fit.ring.domain.sample(fit.stages[-1].level))
        return unexplained(fit, fit.calibrated())

    now = unexplained_now()
    if math.isnan(now):
        return {"put_back": []}
    back: list[str] = []
    if calibration is None:
        return {"unexplained": now, "put_back": back}
    for name in [name for name in calibration.refined if name in SHARED]:
        unknowns = [calibration.unknown(own) for own in UNKNOWNS[name] or [name]]
        found = [unknown.detach().clone() for unknown, _ in unknowns]
        if all(torch.equal(one, given) for one, (_, given) in zip(found, unknowns)):  # nothing could be put back
            continue
        with torch.no_grad():
            for unknown, given in unknowns:
                unknown.copy_(given)
            without = unexplained_now()
            if without <= now:
                now, back = without, [*back, name]
            else:
                for one, (unknown, _) in zip(found, unknowns):
                    unknown.copy_(one)
                fit.follow_power()
    found_by_now = copy.deepcopy(calibration.state_dict())
    with torch.no_grad():
        for name in (*calibration.widths, "ambient"):
            unknown, given = calibration.unknown(name)
            unknown.copy_(given)
        before = unexplained_now()
    calibration.load_state_dict(found_by_now)
    fit.follow_power()
    return {"unexplained": now, "before": before, "put_back": back}
