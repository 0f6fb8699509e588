"""Validation on held-out photographs: do details, a texture and the refined calibration predict them better?

Surface and material are not fitted again with the given calibration. So the comparison favours the refined calibration.
"""

import copy
import math
from typing import Any

import numpy as np
import torch

from mi_ring.calibration.unknowns import UNKNOWNS
from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import recorded
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

#: Of the pictures compared: width, for textures the least one [px]; samples per pixel; number.
COMPARED_WIDTH, SPP, MOST = 256, 4, 16
#: Options that are refined for single photographs, and so are unknown of those that are held out.
PER_PHOTOGRAPH = {unknown.option for unknown in UNKNOWNS.values() if unknown.single}


def unexplained(problem: Problem, refined: Capture, surface: Surface, indirect: bool, width: int) -> float:
    """Render held-out photographs. Returns the mean absolute error on the object, divided by the mean observed value.

    Each prediction is first multiplied by the factor that fits its photograph best. `refined`: the capture with the
    calibration to use. `surface`: shows the object. `indirect`: True renders interreflection. `width`: largest width of
    the pictures compared [px]. Returns NaN if no held-out photograph shows the object.
    """
    shares = []
    for k in problem.held_out[:: -(-len(problem.held_out) // MOST)]:
        shot = refined.shots[k]
        scale = -(-shot.size[0] // width)
        rgb, coverage = prediction.draw(surface, refined.photograph(k, scale), SPP, shadows=refined.shadows,
                                    indirect=indirect)  # fmt: skip
        seen = refined.observe([k], scale)
        inside = seen.surely(coverage) & ~seen.clipped.any(-1)
        observed, predicted = (recorded(linear[0].numpy(), shot, scale)[inside[0]] for linear in (seen.rgb, rgb))
        if len(observed):
            factor = (observed * predicted).sum() / max((predicted**2).sum(), 1e-12)
            shares.append(float(np.abs(factor * predicted - observed).sum() / observed.sum()))
    return float(np.mean(shares)) if shares else np.nan


def texture_helps(
    problem: Problem, refined: Capture, surface: Surface, ring: FittedObject, sharp: FittedObject
) -> bool:
    """Test whether held-out photographs are predicted better with a texture. Returns True if none shows the object.

    `refined`: the capture after calibration. `ring`, `sharp`: the object without and with the texture. `surface` shows
    `sharp` afterwards.
    """
    if not len(problem.held_out):
        return True

    def error(shown: FittedObject) -> float:
        surface.show(shown, *shown.domain.sample(shown.subdivisions))
        return unexplained(problem, refined, surface, ring.indirect, max(COMPARED_WIDTH, *problem.config.widths))

    without, with_texture = error(ring), error(sharp)
    return not with_texture >= without  # NaN: none shows the object


@torch.no_grad()
def validate(problem: Problem, model: Model, renderer: Renderer, level: int) -> dict[str, Any]:
    """Reset each option of `--refine` that does not improve the prediction of held-out photographs. Changes `model`.

    Details that do not improve it are removed first; `put_back` then contains "detail". To reset an option is to give
    its unknowns the values of the capture. Options of single photographs are not reset.

    Returns a dict. `put_back`: list of the reset options. `unexplained`: mean relative error of the predictions after
    that. `before`: the same error with the capture's values for all unknowns. The last two are missing if no held-out
    photograph shows the object; `before` is also missing if nothing is refined.
    """
    calibration, reset = model.calibration, []

    def now(width: int = COMPARED_WIDTH) -> float:
        model.update_albedo()
        surface, capture = renderer.show(model, level), model.calibrated(problem.capture)
        return unexplained(problem, capture, surface, model.ring.indirect, width)

    found = now()
    if math.isnan(found):
        return {"put_back": []}
    if model.detailed:
        width = max(COMPARED_WIDTH, *problem.config.widths)  # smaller pictures do not show details
        with_details, detailed = now(width), model.remove_detail()
        if now(width) <= with_details:
            found, reset = now(), ["detail"]
            model.ring.subdivisions = problem.config.subdivisions
            for network in detailed:
                network.base.release()  # type: ignore[union-attr, operator]  # torch's types of modules
        else:
            model.ring.shape_net, model.ring.brdf_net = detailed
    if calibration is None:
        return {"unexplained": found, "put_back": reset}
    for option in [option for option in calibration.refined if option not in PER_PHOTOGRAPH]:
        pairs = calibration.current_and_given(option)
        if all(torch.equal(current, given) for current, given in pairs):
            continue
        refined = [current.clone() for current, _ in pairs]
        for current, given in pairs:
            current.copy_(given)
        without = now()
        if without <= found:
            found, reset = without, [*reset, option]
        else:
            for (current, _), value in zip(pairs, refined):
                current.copy_(value)
            model.update_albedo()
    result = copy.deepcopy(calibration.state_dict())
    for option in {*calibration.refined, "ambient"}:
        for current, given in calibration.current_and_given(option):
            current.copy_(given)
    before = now()
    calibration.load_state_dict(result)
    model.update_albedo()
    return {"unexplained": found, "before": before, "put_back": reset}
