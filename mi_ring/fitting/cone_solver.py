"""Solves for the cone of a flash, from how brightness differs within each photograph.

The logarithm of a flash's intensity is linear in the numbers of its cone: exponent and tilt. So least squares determine
them. Adam is too slow: a narrow flash has an exponent of 40, one without a cone 0.
"""

import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.exposure_solver import BLACK, ENOUGH
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.refinement import FEWEST, START
from mi_ring.fitting.schedule import Rate

MOST = 0.5  #: errors of logarithms are cut to ± this, so that highlights and shadows do not decide
AIMED = 0.1  #: prior of the tilt, relative to the exponent: how uncertain the flash's axis is [rad]
LEAST_TILT = 0.1  #: and at least this
#: A cone must explain more than this share of the variance that remains: light from a table, or a wrong material, may
#: explain as much.
DOUBT = 0.05
RIDGE, FLOOR = 1e-6, 1e-12  #: what is added to the diagonal of the normal equations: relative to it, and besides


class ConeSolver(torch.optim.Optimizer):
    """Estimates the unknowns `falloff` and `tilt`. Call `look` in each iteration, then `step`."""

    rate = Rate(0.5, 0.2, START)  #: share of the way to the solution that an estimate moves

    def __init__(self, calibration: Calibration) -> None:
        """Solve for the cone of a calibration's flash."""
        self.calibration = calibration
        self.falloff, self.tilt = (calibration.get_parameter(name) for name in ("falloff", "tilt"))
        self.widths = torch.tensor([calibration.widths[name] for name in ("falloff", "tilt", "tilt")])
        super().__init__([{"params": [self.falloff, self.tilt]}], {"lr": self.rate.initial})
        #: of each photograph, when it was last seen: means of products of the five columns and the error
        self.state[self.falloff] = {"moments": torch.zeros(len(calibration.rig), 6, 6)}

    @property
    def moments(self) -> Tensor:
        """(P, 6, 6): the columns are those of `columns`, first the cone's; then the error. 0: not seen yet."""
        return self.state[self.falloff]["moments"]

    def numbers(self) -> Tensor:
        """Return exponent and tilts (3,) as corrections of the capture's, in their own units."""
        return torch.cat([self.falloff.detach().reshape(1), self.tilt.detach()]) * self.widths

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Compare observed and predicted brightness of the pixels of each photograph of an iteration.

        Only differences within a photograph count, so its exposure does not matter.
        """
        if it.progress < START or it.stage.settles:
            return
        index, held = it.batch.photographs, self.calibration.rig.held[it.batch.photographs][:, :2, :2]
        directions = self.calibration.directions(index, it.batch.scale)
        pixels = it.object_pixels() & ~it.observation.clipped.any(-1)
        observed, predicted = it.observation.rgb.mean(-1), it.prediction.rgb.mean(-1)
        pixels &= torch.minimum(observed, predicted) > BLACK * it.context.exposure
        found = torch.zeros(len(index), 6, 6)
        for n, inside in enumerate(pixels.cpu()):
            if int(inside.sum()) >= ENOUGH:
                seen, shown = (light[n].cpu()[inside].log() for light in (observed, predicted))
                features = columns(directions[n][inside], held[n], shown)
                error = ((seen - shown) - (seen - shown).mean()).clamp(-MOST, MOST)
                # Plus the cone that the prediction has already, so that the solution is the whole cone.
                error = error - error.mean() + features[:, :3] @ self.numbers()
                both = torch.column_stack([features, error])
                found[n] = both.T @ both / len(both)
        found = it.batch.share.gathered(found)
        for k, moments in zip(it.batch.all_photographs.tolist(), found):
            if moments.isfinite().all() and moments.any():
                self.moments[k] = moments

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Move the estimates toward the solution. Does nothing before `FEWEST` photographs have been seen."""
        (group,) = self.param_groups
        now, known = self.numbers(), self.moments[self.moments.any(2).any(1)].double()
        if len(known) < FEWEST:
            return
        solution, covariance = least_squares(known[:, :-1])
        remaining = known[:, -1].sum(0) @ torch.cat([-solution, torch.ones(1)])
        # Of the cone alone: what the other columns explain as well is not counted.
        matrix = damped(known[:, :-1, :-1].sum(0))
        others = matrix[3:, :3]
        own = matrix[:3, :3] - others.T @ torch.linalg.solve(matrix[3:, 3:], others)
        explained = float(solution[:3] @ own @ solution[:3])
        share = max(0.0, 1 - DOUBT * max(float(remaining), 0.0) / explained) if explained > 0 else 0.0
        rig = self.calibration.rig
        given = float(rig.views.cone[:, 0].mean())
        aimed = 0.0 if rig.turned else max(AIMED * abs(given + float(now[0])), LEAST_TILT)
        prior = torch.tensor([float(self.widths[0]), aimed, aimed]).double().square().diag()
        solution = prior @ torch.linalg.solve(damped(prior + covariance[:3, :3]), solution[:3])
        solution *= share  # "Estimation with quadratic loss", James and Stein 1961
        solution[0] = solution[0].clamp(min=-given)  # no flash is brighter at its sides
        change = group["lr"] * (solution.float() - now) / self.widths
        self.falloff.add_(change[0])
        self.tilt.add_(change[1:])


def columns(directions: Tensor, held: Tensor, shown: Tensor) -> Tensor:
    """Make the columns (n, 5) that explain the errors of n pixels of a photograph, each with mean 0.

    The first three are those of the cone: logarithm of the cosine to the optical axis, directions to the left and up.
    The others explain what looks like a cone: `shown` (n,), the logarithm of predicted brightness, for an error of the
    contrast; and the square of the distance from the middle of the object, for rims that are too bright or too dark.
    `directions` (n, 3): of the pixels' rays in the camera's axes. `held` (2, 2): turns the axes of an upright camera
    into those of this one.
    """
    middle = directions[:, :2] - directions[:, :2].mean(0)
    away = middle.square().sum(1)
    result = torch.column_stack([directions[:, 2].log(), directions[:, :2] @ held, shown, away / away.mean()])
    return result - result.mean(0)


def damped(matrix: Tensor) -> Tensor:
    """Return a symmetric matrix (k, k) with a larger diagonal, so that it has an inverse."""
    return matrix + (RIDGE * matrix.diagonal() + FLOOR).diag()


def least_squares(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Solve least squares with k unknowns. Returns (solution (k,), covariance (k, k)).

    `moments` (P, k, k + 1): normal equations of each of P photographs, with the right side last. The errors of pixels
    of one photograph may depend on each other, so the covariance follows from how much photographs differ
    (cluster-robust: "Longitudinal data analysis using generalized linear models", Liang and Zeger 1986).
    """
    equations = moments.sum(0)
    matrix = equations[:, :-1]
    inverse = torch.linalg.inv(damped(matrix))
    solution = inverse @ equations[:, -1]
    scores = moments[..., -1] - moments[..., :-1] @ solution
    count, unknowns = scores.shape
    return solution, inverse @ (scores.T @ scores) @ inverse * (count / (count - unknowns))
