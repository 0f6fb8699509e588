"""Finds room, flash and exposures, by least squares in which surface and material are unknown, too.

As long as a fit does not know of a room, surface, material and powers explain its light. As long as it does not know
the powers, the surface explains a part of them, where few photographs see it. So the errors of a prediction show hardly
anything of either. The joint equations tell what explains all photographs together.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.comparison import ROOM
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.model import Model
from mi_ring.fitting.normal_equations import Layout
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.scene.lights import shared_emitters

DOUBT = 0.03  #: share of the flash that a room seems to have where the true reflectance is not one of the model's
SOLVED = "light", "power", "gain"  #: unknowns that are solved for beside the room
WIDTH = 64  #: of the compared pictures [px]
MOST = 40  #: photographs that are compared for the room alone: more hardly tell more, and take longer
#: Errors of cameras, masks and surface look like powers or gains that differ by so much (log, standard deviation).
DOUBT_OF_EXPOSURES = 0.04
ROUNDS = 8  #: in which the width of their prior is learnt
FAINT = 0.01  #: least brightness of a room for the next number [exposure]
SIDES = 0.3  #: standard deviation of the other harmonics of a room, as a share of the first


@torch.no_grad()
def solve_jointly(problem: Problem, model: Model, renderer: Renderer, level: int) -> dict[str, Tensor]:
    """Find the room beside other light. If a flash is the only other light and varies, find those of `SOLVED`, too.

    Returns new values of the calibration: a dict from names of unknowns to tensors in the shape of the unknown, in
    units of its prior; of "ambient" the harmonics (BASIS, 3), of which a part is `believed`. It is empty if no
    photographs can be compared. Renders the surface at a `level` of the mesh. The calibration does not change.
    """
    calibration = model.calibration
    assert calibration is not None
    room, rig = calibration.room, calibration.rig
    # With other lights the derivatives by a power would be those of all light.
    alone = rig.flash is not None and rig.lit.all() and not shared_emitters(problem.capture.scene)
    names = [name for name in SOLVED if name in calibration.unknowns and alone]
    names = names if {"power", "gain"} & {*names} else []  # a flash alone is found by its gradient
    if not (names or "ambient" in calibration.refined):
        return {}
    most = None if names else MOST
    joint = JointEquations.of(problem, model, renderer, level, most, WIDTH)
    layout, unit = joint.layout, ROOM * problem.exposure
    here = layout.places("ambient")
    given, now = (part.double().numpy(force=True) for part in (room.given, room.harmonics))
    current = layout.values()
    current[here] = (now - given)[layout.room].ravel() / unit
    right, precision = joint.vector + joint.matrix @ current, np.ones(layout.count)
    if not joint.matrix.any() or not np.isfinite(right).all():
        return {}
    result, solution = {}, current.copy()
    if layout.room:
        first = np.linalg.solve(joint.matrix + np.diag(precision), right)[here[:3]]
        bright = max(float((given[0] + unit * first).mean()), FAINT * problem.exposure)
        precision[here[3:]] = (unit / (SIDES * bright)) ** 2
    covariance = np.linalg.inv(joint.matrix + np.diag(precision))
    if layout.room:
        more, deviation = np.zeros_like(given), np.zeros_like(given)
        more[layout.room] = unit * (covariance @ right)[here].reshape(-1, 3)
        deviation[0] = unit * np.sqrt(np.diag(covariance)[here[:3]])
        found = given + believed(calibration, more, deviation) * more
        found[:, found[0] < 0] = 0  # a room with negative mean radiance is impossible
        result["ambient"] = torch.from_numpy(found)
        solution[here] = (found - given)[layout.room].ravel() / unit
    if names:  # beside the room that is believed, and all else as it is; moved toward as far as exposures differ
        own = np.concatenate([layout.places(name) for name in names])
        others = np.setdiff1d(np.arange(layout.count), own)
        ahead = ahead_of_lens(layout, covariance, covariance @ right) if "light" in names else 0.0
        right = right - joint.matrix[:, others] @ solution[others]
        solution, width = with_learnt_width(layout, names, own, joint.matrix, right)
        share = max(0.0, 1 - (DOUBT_OF_EXPOSURES / width) ** 2) if width else 0.0
        for name in names:
            before = calibration.get_parameter(name).detach().double().cpu()
            value = before + share * (torch.from_numpy(solution[layout.places(name)]).view_as(before) - before)
            if name == "light" and not rig.free[2]:
                value[:, 2] = ahead
            if not torch.equal(value, before):
                result[name] = value
    return result


def ahead_of_lens(layout: Layout, covariance: np.ndarray, solution: np.ndarray) -> float:
    """Return how far a flash is believed to be ahead of where the capture says, in the unit of `LightPlace`.

    Brightness alone does not tell it, but how brightness changes with the distance. `covariance` (N, N), `solution`
    (N,): of all unknowns together. The share that is believed is that of `believed`.
    """
    place = layout.places("light")[2]
    doubt = np.ravel(layout.calibration.unknowns["light"].doubt)[2] / layout.calibration.widths["light"]
    variance = covariance[place, place] + doubt**2
    return float(solution[place] * max(0.0, 1 - variance / max(solution[place] ** 2, variance)))


def with_learnt_width(
    layout: Layout, names: Sequence[str], own: np.ndarray, matrix: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, float]:
    """Solve for the unknowns at the places `own`. The prior of powers or gains is as wide as these turn out to differ.

    `matrix` (N, N) and `right` (N,): normal equations, without priors, of all unknowns. `names`: those to solve for.
    Returns (the solution (N,), 0 at other places; the standard deviation of powers or gains, 0 if there are none). The
    width is that of the largest evidence, by expectation-maximisation ("Empirical Bayes", Carlin and Louis 2000).
    """
    result, precision, width = np.zeros(layout.count), np.ones(layout.count), 0.0
    centring = layout.centring()
    for _ in range(ROUNDS):
        covariance = np.linalg.inv(matrix[np.ix_(own, own)] + np.diag(precision[own]))
        result[own] = covariance @ right[own]
        result = centring @ result
        for name in {"power", "gain"} & {*names}:
            here = layout.places(name)
            squares = result[here] ** 2 + np.diag(covariance)[np.isin(own, here)]
            precision[here] = 1 / squares.mean()
            width = layout.calibration.widths[name] * float(squares.mean()) ** 0.5
    return result, width


def believed(calibration: Calibration, more: np.ndarray, deviation: np.ndarray) -> float:
    """Return the share, 0 to 1, of found room light that a fit uses.

    `more` (BASIS, 3): the light that was found beyond that of the capture. `deviation` (BASIS, 3): standard deviation
    of its first harmonic. The share is 1 − error² / light², as in "Estimation with quadratic loss" (James and Stein
    1961). The error has three parts: the deviation, the difference of the colours, and `doubt`.
    """
    if (least := doubt(calibration)) == 0:
        return 1.0
    light, error = (calibration.room_share(torch.from_numpy(part)).double() for part in (more, deviation))
    mean = float(light.mean())
    variance = float(error.mean()) ** 2 + float(light.var()) / 3 + least**2
    return max(0.0, 1 - variance / mean**2) if mean > 0 else 0.0


def doubt(calibration: Calibration) -> float:
    """Return the share of the flash below which a room is not believed.

    It is 0 if the scene tells of harmonics of a room, or if photographs have no light of their own.
    """
    certain = calibration.room.given.any() or not calibration.rig.lit.all()
    return 0.0 if certain else DOUBT
