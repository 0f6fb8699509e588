"""Poses of cameras by Gauss-Newton: how a picture moves with its camera says how far a step may go.

An iteration sees few photographs, and a fit each of them a few dozen times. Steps of a size that does not depend on how
far a camera is off, as Adam's, move right cameras away or reach wrong ones too late. The gradient is that of the loss;
here is what it has to be divided by. Direct image alignment, as in "Lucas-Kanade 20 Years On" (Baker and Matthews,
IJCV 2004), with the surface instead of a template.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.fitting import terms
from mi_ring.fitting.calibration import Calibration
from mi_ring.fitting.iteration import Iteration
from mi_ring.images import blur

#: Of the diagonal, that is added to it (Marquardt); the longest step, in standard deviations.
DAMPING, LONGEST = 0.1, 3.0
#: What a step is multiplied by at first, and the share that this falls to: in the end it averages over iterations.
RATE, DECAY = 1.0, 0.5
NEAR, FAR = 0.2, 0.4  #: progress of the fit when they begin, by how far off its first surface is


def slopes(picture: Tensor) -> Tensor:
    """Central differences of a picture (H, W, C) to the right and down: (H, W, C, 2)."""
    padded = F.pad(picture.movedim(-1, 0), (1, 1, 1, 1), mode="replicate")
    right = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    down = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    return torch.stack([right, down], -1).movedim(0, 2) / 2


def motion(intrinsics: Tensor, size: tuple[int, int], center: Tensor, radius: float) -> Tensor:
    """How far the pixels of a sphere move with the camera: (H, W, 2, 6) [px], right and down.

    For a turn [rad] about each axis of the camera and a step [scene units] along each, Mitsuba's axes. `intrinsics`
    (4,) fx, fy, cx, cy [px]; `size` (width, height); `center` (3,) of the sphere, in the camera's axes; where a ray
    misses it, the depth is that of the point next to it.
    """
    width, height = size
    fx, fy, cx, cy = intrinsics
    x = (cx - torch.arange(width) - 0.5) / fx
    y = (cy - torch.arange(height) - 0.5)[:, None] / fy
    x, y = torch.broadcast_tensors(x, y)
    rays = torch.stack([x, y, torch.ones_like(x)], -1)
    along, length2 = rays @ center, rays.square().sum(-1)
    inside = (along**2 - length2 * (center.square().sum() - radius**2)).clamp(min=0)
    nearness = length2 / (along - inside.sqrt())
    no, one = torch.zeros_like(x), torch.ones_like(x)
    # A point z (x, y, 1) of the camera's axes moves by −ω × z (x, y, 1) − t; here divided by z.
    right, up, forward = (
        torch.stack([no, -one, y, -nearness, no, no], -1),
        torch.stack([one, no, -x, no, -nearness, no], -1),
        torch.stack([-y, x, no, no, no, -nearness], -1),
    )
    return torch.stack([-fx * (right - x[..., None] * forward), -fy * (up - y[..., None] * forward)], -2)


class GaussNewton(torch.optim.Optimizer):
    """Steps of the photographs that an iteration has seen, and of no others.

    It changes `turn` and `move` of a calibration. `near`: is the first surface near the object? Else it begins later.
    """

    def __init__(self, calibration: Calibration, near: bool) -> None:
        unknowns = [calibration.unknown(name)[0] for name in ("turn", "move")]
        group = {"params": unknowns, "initial_lr": RATE, "decay": DECAY, "start": NEAR if near else FAR}
        super().__init__([group], {"lr": RATE})

    def look(self, it: Iteration) -> None:
        """Take note of which photographs an iteration sees, and of the second derivatives of its loss."""
        self.index, self.curvature = torch.from_numpy(it.index), curvature(it)

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """One, for the gradients that the parameters have."""
        (group,) = self.param_groups
        turn, move = group["params"]
        gradient = torch.cat([turn.grad[self.index], move.grad[self.index]], 1)
        damped = self.curvature + DAMPING * torch.diag_embed(self.curvature.diagonal(dim1=1, dim2=2))
        step = torch.linalg.solve(damped, gradient)
        step *= group["lr"] * (LONGEST / step.norm(dim=1, keepdim=True)).clamp(max=1)
        turn[self.index] -= step[:, :3]
        move[self.index] -= step[:, 3:]


@torch.no_grad()
def curvature(it: Iteration) -> Tensor:
    """Second derivatives (n, 6, 6) of the loss of an iteration by `turn` and `move` of its photographs.

    By Gauss-Newton, as if the surface were a sphere; absolute differences as if they were squares of the same slope
    (iteratively reweighted least squares), those below the usual one as if they were that.
    """
    fit, calibration, (n, height, width) = it.fit, it.fit.calibration, it.coverage.shape
    assert calibration is not None
    perceived = [terms.perceived(light, fit.exposure, fit.config.loss) for light in (it.predicted, it.observed)]
    error = (perceived[0] - perceived[1]).abs()
    if fit.config.loss == "l2":
        weight = 2 * torch.ones_like(error)
    else:
        usual = error[it.coverage > 0.5].mean().nan_to_num(1.0).clamp(min=1e-6)
        weight = 1 / error.maximum(usual)
    if (telling := terms.telling(it)) is not None:
        weight = weight * telling[..., None]
    weight *= it.weights.get("rgb", 0.0) / weight.numel()
    outlines = blur(it.coverage, terms.outline_blur(it))
    outlined = 2 * it.weights.get("mask", 0.0) / (max(1, int(it.masked.sum())) * height * width)

    at = calibration.scaled(it.scale)
    unit = torch.tensor([calibration.widths["turn"]] * 3 + [calibration.distance * calibration.widths["move"]] * 3)
    result = torch.eye(6).repeat(n, 1, 1) * it.weights.get("calibration", 0.0) / len(calibration.lens)
    for i, k in enumerate(it.index):
        center = at.cameras[k, :, :3].T @ (calibration.center - at.cameras[k, :, 3])
        moving = motion(at.intrinsics[k], (width, height), center, float(fit.ring.radius)) * unit
        colour, outline = slopes(perceived[0][i]), slopes(outlines[i, ..., None])
        structure = torch.einsum("hwc,hwca,hwcb->hwab", weight[i], colour, colour)
        structure = structure + outlined * it.masked[i] * torch.einsum("hwca,hwcb->hwab", outline, outline)
        result[i] += torch.einsum("hwaj,hwab,hwbk->jk", moving, structure.cpu(), moving)
    return result
