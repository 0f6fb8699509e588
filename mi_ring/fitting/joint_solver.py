"""Finds room, flash and exposures, by least squares in which surface and material are unknown, too.

As long as a fit does not know of a room, surface, material and powers explain its light. As long as it does not know
the powers, the surface explains a part of them, where few photographs see it. So the errors of a prediction show hardly
anything of either. The joint equations tell what explains all photographs together.
"""

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.unknowns import DOUBT_AHEAD
from mi_ring.fitting.comparison import ROOM
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.model import Model
from mi_ring.fitting.normal_equations import Layout
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer

DOUBT = 0.03  #: share of the flash that a room seems to have where the true reflectance is not one of the model's
SOLVED = "light", "power", "gain"  #: unknowns that may be solved for beside the room
WIDTH = 64  #: of the compared pictures [px]
MOST = 40  #: photographs that are compared for the room alone: more hardly tell more, and take longer
#: Errors of cameras, masks and surface look like powers or gains that differ by so much (log, standard deviation).
DOUBT_OF_EXPOSURES = 0.04
ROUNDS = 8  #: in which the width of their prior is learnt
FAINT = 0.01  #: least brightness of a room for the next number [exposure]
SIDES = 0.3  #: standard deviation of the other harmonics of a room, as a share of the first


@torch.no_grad()
def solve_jointly(
    problem: Problem, model: Model, renderer: Renderer, level: int, known: Collection[str] = ()
) -> dict[str, Tensor]:
    """Find the room beside other light. If a flash is the only other light and varies, find those of `SOLVED`, too.

    `known`: names of unknowns that stay as they are.

    Returns new values of the calibration: a dict from names of unknowns to tensors in the shape of the unknown, in
    units of its prior; of "ambient" the harmonics (BASIS, 3), of which a part is `believed`. It is empty if no
    photographs can be compared. Renders the surface at a `level` of the mesh. The calibration does not change.
    """
    calibration = model.calibration
    assert calibration is not None
    room, rig = calibration.room, calibration.rig
    # With other lights the derivatives by a power would be those of all light.
    exposure = calibration.exposure_of_flash
    sought = [name for name in ("light", exposure) if name not in known] if exposure else []
    names = [name for name in sought if name in calibration.unknowns]
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
    if exposure:  # beside the room and the flash's distance that are believed, and all else as it is
        own = np.concatenate([layout.places(name) for name in names])
        if "light" in names and not rig.free[2]:
            place = layout.places("light")[2]
            solution[place] = ahead_of_lens(layout, covariance, covariance @ right)
            own = own[own != place]
        others = np.setdiff1d(np.arange(layout.count), own)
        system, beside = joint.matrix[np.ix_(own, own)], joint.matrix[np.ix_(own, others)]
        right = right[own] - beside @ solution[others]
        solution[own], width = with_learnt_width(layout, exposure, own, system, right)
        share = credible(width, DOUBT_OF_EXPOSURES)  # the less exposures differ, the more all stay
        solution[own] = current[own] + share * (solution[own] - current[own])
        for name in names:
            value = solution[layout.places(name)].reshape(calibration.get_parameter(name).shape)
            if (value != current[layout.places(name)].reshape(value.shape)).any():
                result[name] = torch.from_numpy(value)
    return result


def ahead_of_lens(layout: Layout, covariance: np.ndarray, solution: np.ndarray) -> float:
    """Return how far a flash is believed to be ahead of where the capture says, in the unit of `LightPlace`.

    Brightness alone does not tell it, but how brightness changes with the distance. `covariance` (N, N), `solution`
    (N,): of all unknowns together.
    """
    place = layout.places("light")[2]
    error = np.hypot(covariance[place, place] ** 0.5, DOUBT_AHEAD / layout.calibration.widths["light"])
    return float(solution[place] * credible(solution[place], error))


def credible(value: float, error: float) -> float:
    """Return the share of a value that is used: 1 − error² / value², at least 0.

    It is that of "Estimation with quadratic loss" (James and Stein 1961). `error`: standard deviation of the value.
    """
    return max(0.0, 1 - (error / value) ** 2) if value else 0.0


def with_learnt_width(
    layout: Layout, exposure: str, own: np.ndarray, matrix: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, float]:
    """Solve for n unknowns. The prior of the powers or gains is as wide as these turn out to differ.

    `own` (n,): places of the unknowns in the vector of all. `exposure`: "power" or "gain", which is among them.
    `matrix` (n, n), `right` (n,): their normal equations without priors. Returns (the solution (n,), the standard
    deviation of the powers or gains). The width is that of the largest evidence, by expectation-maximisation
    ("Empirical Bayes", Carlin and Louis 2000).
    """
    precision, mine = np.ones(len(own)), np.isin(own, layout.places(exposure))
    centring, width = layout.centring()[np.ix_(own, own)], 0.0
    result = np.zeros(len(own))
    for _ in range(ROUNDS):
        covariance = np.linalg.inv(matrix + np.diag(precision))
        result = centring @ covariance @ right
        variance = float((result[mine] ** 2 + np.diag(covariance)[mine]).mean())
        precision[mine], width = 1 / variance, layout.calibration.widths[exposure] * variance**0.5
    return result, width


def believed(calibration: Calibration, more: np.ndarray, deviation: np.ndarray) -> float:
    """Return the share, 0 to 1, of found room light that a fit uses.

    `more` (BASIS, 3): the light that was found beyond that of the capture. `deviation` (BASIS, 3): standard deviation
    of its first harmonic. The error of the light has three parts: the deviation, the difference of the colours, and
    `doubt`.
    """
    if (least := doubt(calibration)) == 0:
        return 1.0
    light, error = (calibration.room_share(torch.from_numpy(part)).double() for part in (more, deviation))
    mean = float(light.mean())
    variance = float(error.mean()) ** 2 + float(light.var()) / 3 + least**2
    return credible(mean, variance**0.5) if mean > 0 else 0.0


def doubt(calibration: Calibration) -> float:
    """Return the share of the flash below which a room is not believed.

    It is 0 if the scene tells of harmonics of a room, or if photographs have no light of their own.
    """
    certain = calibration.room.given.any() or not calibration.rig.lit.all()
    return 0.0 if certain else DOUBT
