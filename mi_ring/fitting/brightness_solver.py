"""Solves for the cone of a flash and the contrast of the camera, from how brightness differs within photographs.

The logarithm of brightness is linear in the numbers of the cone, exponent and tilt, and almost linear in the logarithm
of the contrast. So least squares determine them. Adam is too slow: a narrow flash has an exponent of 40, one without a
cone 0.

A flash that moves to one side changes brightness almost like a tilt. So if its place is refined, the least squares
contain it as well. Adam finds the place; without its columns, place and tilt would follow each other without end.
"""

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.camera_response import contrast_slope
from mi_ring.fitting.exposure_solver import BLACK, ENOUGH
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.refinement import FEWEST, START
from mi_ring.fitting.schedule import Rate

MOST = 0.5  #: errors of logarithms are cut to ± this, so that highlights and shadows do not decide
AIMED = 0.1  #: prior of the tilt, relative to the exponent: how uncertain the flash's axis is [rad]
LEAST_TILT = 0.1  #: and at least this
#: The cone, and the contrast, must explain more than this share of the variance that remains: light from a table, or a
#: wrong material, may explain as much.
DOUBT_OF_CONE, DOUBT_OF_CONTRAST = 0.05, 0.01
RIDGE, FLOOR = 1e-6, 1e-12  #: what is added to the diagonal of the normal equations: relative to it, and besides
LOOKS = 80  #: number of iterations in which the contrast is solved for: later the material would take it bit by bit
GRAZING = 0.2  #: cosine between normal and light below which the change of brightness no longer grows
COLUMNS = 8  #: of `columns`
CONE, CONTRAST, SHOWN, AWAY, PLACE = [0, 1, 2], [3], [4], [5], [6, 7]  #: numbers of them


class BrightnessSolver(torch.optim.Optimizer):
    """Estimates the unknowns `falloff` and `tilt`, and `contrast`. Call `look` in each iteration, then `step`."""

    rate = Rate(0.5, 0.2, START)  #: share of the way to the solution that an estimate moves

    def __init__(self, calibration: Calibration) -> None:
        """Solve for those of the unknowns that a calibration refines, at least one."""
        self.calibration = calibration
        names = [name for name in ("falloff", "tilt", "contrast") if name in calibration.unknowns]
        super().__init__([{"params": [calibration.get_parameter(name) for name in names]}], {"lr": self.rate.initial})
        self.first = self.param_groups[0]["params"][0]
        #: of each photograph, when it was last seen: the products of the columns and the error;
        #: and the number of iterations in which photographs were compared
        self.state[self.first] = {
            "moments": torch.zeros(len(calibration.rig), COLUMNS + 1, COLUMNS + 1),
            "looks": torch.zeros(()),
        }

    @property
    def moments(self) -> Tensor:
        """(P, 9, 9): sums over colours of mean products of the `columns` and, last, the error. 0: not seen yet."""
        return self.state[self.first]["moments"]

    def numbers(self) -> Tensor:
        """Return exponent, tilts and logarithm of the contrast (4,) as corrections of the capture's."""
        value = self.calibration.value
        parts = [value("falloff").reshape(1), value("tilt").expand(2), value("contrast").reshape(1)]
        return torch.cat(parts).detach()

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Compare observed and predicted brightness of the pixels of each photograph of an iteration.

        Only differences within a photograph and colour count, so its exposure does not matter. Photographs without a
        light of their own are left out if there are others.
        """
        if it.progress < START:
            return
        self.state[self.first]["looks"] += 1
        index, rig = it.batch.photographs, self.calibration.rig
        directions = self.calibration.directions(index, it.batch.scale)
        pixels = (it.object_pixels() & ~it.observation.clipped.any(-1)).cpu()
        observed, predicted = it.observation.rgb.cpu(), it.prediction.rgb.cpu()
        slopes = contrast_slope(predicted, rig.response, index, directions[..., 2:])
        sideways = torch.zeros(*pixels.shape, 2)
        if {"falloff", "light"} <= {*self.calibration.unknowns}:
            sideways = flash_slope(self.calibration, index, directions, it.prediction.normals)
        bright = torch.minimum(observed, predicted) > BLACK * it.context.exposure
        found = torch.zeros(len(index), COLUMNS + 1, COLUMNS + 1)
        for n, inside in enumerate(pixels):
            if rig.mixed and not rig.lit[index[n]]:
                continue
            for colour in range(3):
                chosen = inside & bright[n, ..., colour]
                if int(chosen.sum()) < ENOUGH:
                    continue
                seen, shown = (light[n, ..., colour][chosen].log() for light in (observed, predicted))
                turn = rig.held[index[n], :2, :2]
                features = columns(
                    directions[n][chosen], sideways[n][chosen], turn, slopes[n, ..., colour][chosen], shown
                )
                error = ((seen - shown) - (seen - shown).mean()).clamp(-MOST, MOST)
                # Plus what the prediction has already, so that the solution is the whole cone and contrast.
                error = error - error.mean() + features[:, CONE + CONTRAST] @ self.numbers()
                both = torch.column_stack([features, error])
                found[n] += both.T @ both / len(both)
        found = it.batch.share.gathered(found)
        for k, moments in zip(it.batch.all_photographs.tolist(), found):
            if moments.isfinite().all() and moments.any():
                self.moments[k] = moments

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Move the estimates toward the solution. Does nothing before `FEWEST` photographs have been seen."""
        known, calibration = self.moments[self.moments.any(2).any(1)].double(), self.calibration
        if len(known) < FEWEST:
            return
        rate, now = self.param_groups[0]["lr"], self.numbers()
        if "falloff" in calibration.unknowns:
            rig = calibration.rig
            given = float(rig.views.cone[rig.mainly, 0].mean())
            aimed = 0.0 if rig.turned else max(AIMED * abs(given + float(now[0])), LEAST_TILT)
            widths = torch.tensor([calibration.widths["falloff"], aimed, aimed])
            others = CONTRAST + SHOWN + AWAY + (PLACE if "light" in calibration.unknowns else [])
            cone = estimate(known, CONE, others, widths, DOUBT_OF_CONE)
            cone[0] = cone[0].clamp(min=-given)  # no flash is brighter at its sides
            change = rate * (cone - now[:3])
            calibration.get_parameter("falloff").add_(change[0] / calibration.widths["falloff"])
            calibration.get_parameter("tilt").add_(change[1:] / calibration.widths["tilt"])
        if "contrast" in calibration.unknowns and self.state[self.first]["looks"] <= LOOKS:
            # Without the column of another exponent: it is almost the same.
            width = calibration.widths["contrast"]
            contrast = estimate(known, CONTRAST, CONE + AWAY, torch.tensor([width]), DOUBT_OF_CONTRAST)
            contrast = contrast.clamp(min=0)  # cameras raise it; a surface that is not right yet looks like a lower one
            calibration.get_parameter("contrast").add_(rate * (contrast[0] - now[3]) / width)


def flash_slope(calibration: Calibration, index: np.ndarray, directions: Tensor, normals: Tensor) -> Tensor:
    """Compute how the logarithm of a matte surface's brightness changes if its light moves to the left and up.

    Returns (N, H, W, 2), for a move by the distance from camera to object. `index` (N,): of the photographs.
    `directions` (N, H, W, 3): of the pixels' rays, in the camera's axes. `normals` (N, H, W, 3): in the axes of the
    world. All points count as equally far as the object's centre.

    The brightness is n · v / r³, with the vector v of length r from the point to the light. The derivative of its
    logarithm is n / (n · v) − 3 v / r².
    """
    views, center = calibration(), calibration.rig.center
    cameras = views.cameras[index].detach()
    axes, distance = cameras[..., :3], (cameras[..., 3] - center).norm(dim=-1)
    place = torch.einsum("nji,nj->ni", axes, views.places[index].detach() - cameras[..., 3])
    v = (place / distance[:, None])[:, None, None] - directions
    facing = torch.einsum("nji,nhwj->nhwi", axes, normals)
    along = (facing * v).sum(-1, keepdim=True).clamp(min=GRAZING)
    return (facing / along - 3 * v / v.square().sum(-1, keepdim=True))[..., :2]


def columns(directions: Tensor, sideways: Tensor, held: Tensor, slopes: Tensor, shown: Tensor) -> Tensor:
    """Make the columns (n, 8) that explain the errors of n pixels of a photograph, each with mean 0.

    The first three are those of the cone: logarithm of the cosine to the optical axis, directions to the left and up.
    The fourth is that of the contrast: `slopes` (n,), from `contrast_slope`. The others explain what looks like a cone:
    `shown` (n,), the logarithm of predicted brightness, for an error of the exponent of the camera's curve; the square
    of the distance from the middle of the object, for rims that are too bright or too dark; and `sideways` (n, 2), from
    `flash_slope`, for an error of the flash's place.

    `directions` (n, 3): of the pixels' rays in the camera's axes. `held` (2, 2): turns the axes of an upright camera
    into those of this one.
    """
    middle = directions[:, :2] - directions[:, :2].mean(0)
    away = middle.square().sum(1)
    cone = directions[:, 2].log(), directions[:, :2] @ held
    result = torch.column_stack([*cone, slopes, shown, away / away.mean(), sideways @ held])
    return result - result.mean(0)


def estimate(moments: Tensor, wanted: list[int], others: list[int], widths: Tensor, doubt: float) -> Tensor:
    """Estimate the unknowns of some columns. Returns (k,) float32, nearer to 0 the less they explain.

    `moments` (P, n + 1, n + 1): of photographs, with the error last. `wanted`: numbers of the k columns. `others`:
    numbers of columns that are also solved for. `widths` (k,): standard deviations of the prior. `doubt`: share of the
    remaining variance that they must explain.
    """
    k, which = len(wanted), wanted + others
    own = moments[:, [*which, -1]][..., [*which, -1]]
    solution, covariance = least_squares(own[:, :-1])
    remaining = own[:, -1].sum(0) @ torch.cat([-solution, torch.ones(1)])
    # Of the wanted alone: what the other columns explain as well is not counted.
    matrix = damped(own[:, :-1, :-1].sum(0))
    both = matrix[k:, :k]
    alone = matrix[:k, :k] - both.T @ torch.linalg.solve(matrix[k:, k:], both)
    explained = float(solution[:k] @ alone @ solution[:k])
    share = max(0.0, 1 - doubt * max(float(remaining), 0.0) / explained) if explained > 0 else 0.0
    prior = widths.double().square().diag()
    shrunk = prior @ torch.linalg.solve(damped(prior + covariance[:k, :k]), solution[:k])
    # In the form of "Estimation with quadratic loss" (James and Stein 1961), of strength `doubt`.
    return (share * shrunk).float()


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
