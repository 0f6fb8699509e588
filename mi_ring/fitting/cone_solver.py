"""Solves for the cone of a flash, from how brightness differs within each photograph.

The logarithm of a flash's intensity is linear in the numbers of its cone: exponent and tilt. So least squares determine
them. Adam is too slow: the flash of a camera may have an exponent of 20, a bare one of 0.
"""

import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.exposure_solver import BLACK, ENOUGH
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.refinement import START
from mi_ring.fitting.schedule import Rate

MEMORY = 0.95  #: factor per iteration of earlier normal equations, which belong to an earlier surface
ERROR = 0.15  #: standard deviation of the logarithm of predicted brightness
INDEPENDENT = 30  #: as many pixels of a photograph have errors that do not depend on each other
MOST = 0.5  #: larger errors count as this: highlights, shadows
UNKNOWNS = "falloff", "tilt"


class ConeSolver(torch.optim.Optimizer):
    """Estimates the unknowns `falloff` and `tilt`. Call `look` in each iteration, then `step`."""

    rate = Rate(0.5, 0.2, START)  #: share of the way to the solution that an estimate moves

    def __init__(self, calibration: Calibration) -> None:
        """Solve for the cone of a calibration's flash."""
        self.calibration = calibration
        self.tensors = [getattr(calibration, name) for name in UNKNOWNS]
        self.widths = torch.tensor([calibration.widths[name] for name in ("falloff", "tilt", "tilt")])
        super().__init__([{"params": self.tensors}], {"lr": self.rate.initial})
        #: normal equations (4, 5) for the numbers of the cone and a factor of the contrast, and the right side
        self.state[self.tensors[0]] = {"equations": torch.zeros(4, 5)}

    def numbers(self) -> Tensor:
        """Return exponent and tilts (3,) as corrections of the capture's, in their own units."""
        return torch.cat([tensor.detach().reshape(-1) for tensor in self.tensors]) * self.widths

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Add the photographs of an iteration to the normal equations.

        They compare logarithms of observed and predicted brightness of pixels in the same photograph, so its exposure
        does not matter. The cone must explain what a factor of the contrast does not: surfaces that are darker at
        grazing angles than predicted look like a cone.
        """
        if it.progress < START or it.stage.settles:
            return
        index, scale, held = it.batch.photographs, it.batch.scale, self.calibration.rig.held[it.batch.photographs]
        directions = self.calibration.directions(index, scale)
        across = torch.einsum("nji,nhwj->nhwi", held[:, :2, :2], directions[..., :2])
        features = torch.cat([directions[..., 2:].log(), across], -1)
        pixels = it.object_pixels() & ~it.observation.clipped.any(-1)
        observed, predicted = it.observation.rgb.mean(-1), it.prediction.rgb.mean(-1)
        pixels &= torch.minimum(observed, predicted) > BLACK * it.context.exposure
        equations = torch.zeros(4, 5)
        for n, inside in enumerate(pixels.cpu()):
            if int(inside.sum()) < ENOUGH:
                continue
            seen, shown = (light[n].cpu()[inside].log() for light in (observed, predicted))
            columns = torch.column_stack([features[n][inside], shown, seen - shown])
            columns -= columns.mean(0)
            columns[:, -1].clamp_(-MOST, MOST)
            columns[:, -1] += columns[:, :3] @ self.numbers()  # as if the prediction were without the cone
            equations += columns[:, :-1].T @ columns / len(columns)
        if not bool((equations := it.batch.share.sum(equations)).isfinite().all()):
            return
        state = self.state[self.tensors[0]]
        state["equations"] = MEMORY * state["equations"] + equations

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Move the estimates toward the solution of the normal equations, with their priors. Does nothing at first."""
        (group,) = self.param_groups
        equations = self.state[self.tensors[0]]["equations"]
        if not equations.any():
            return
        prior = torch.cat([self.widths, torch.ones(1)]) ** -2 * (ERROR**2 / INDEPENDENT)
        solution = torch.linalg.solve(equations[:, :-1] + prior.diag(), equations[:, -1])[:3]
        change = group["lr"] * (solution - self.numbers()) / self.widths
        for tensor, part in zip(self.tensors, change.split([1, 2])):
            tensor += part.reshape(tensor.shape)
