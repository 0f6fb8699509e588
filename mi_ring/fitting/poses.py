"""Poses of cameras by Gauss-Newton: how a picture moves with its camera says how far a step may go.

An iteration sees few photographs, and a fit each of them a few dozen times. Steps of a size that does not depend on how
far a camera is off, as Adam's, move right cameras away or reach wrong ones too late. The gradient is that of the loss;
here is what it has to be divided by. Direct image alignment, as in "Lucas-Kanade 20 Years On" (Baker and Matthews,
IJCV 2004), with the surface instead of a template.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.errors import InputError
from mi_ring.fitting import terms
from mi_ring.fitting.calibration import Calibration
from mi_ring.fitting.iteration import Iteration
from mi_ring.images import blur

#: Shares of the diagonal, and of its largest entry, that are added to it: by the latter a direction that pictures
#: hardly tell (about the optical axis, of what is round) goes slowly. The longest step, in standard deviations.
DAMPING, FLOOR, LONGEST = 0.1, 0.01, 3.0
#: What a step is multiplied by at first, and the share that this falls to: in the end it averages over iterations.
RATE, DECAY = 1.0, 0.5
LEAST = 1e-9  #: of what each unknown is told, so that what no photograph shows stays
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
    (4,) fx, fy, cx, cy [px], of a pinhole: distortion changes little of it; `size` (width, height); `center` (3,) of
    the sphere, in the camera's axes, of which a camera inside it sees a smaller one. Where a ray misses it, the depth
    is that of the point next to it.
    """
    width, height = size
    fx, fy, cx, cy = intrinsics
    radius = min(radius, 0.9 * float(center.norm()))
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
    """Steps of the photographs that an iteration has seen, and of no others: `look` at it, then `step`.

    It changes `turn` and `move` of a calibration. `near`: is the first surface near the object? Else it begins later.
    `given`: terms of the loss. Raises InputError where `rgb` or `mask` is not the default one, whose curvature it has.
    """

    def __init__(self, calibration: Calibration, near: bool, given: Mapping[str, terms.Term]) -> None:
        for name in "rgb", "mask":
            if given.get(name, terms.default_terms[name]) is not terms.default_terms[name]:
                raise InputError(f"terms: {name}: must be the default one for --refine cameras, which has to know how "
                                 "it changes with them; give yours another name")  # fmt: skip
        unknowns = [calibration.unknown(name)[0] for name in ("turn", "move")]
        group = {"params": unknowns, "initial_lr": RATE, "decay": DECAY, "start": NEAR if near else FAR}
        super().__init__([group], {"lr": RATE})
        self.seen: tuple[Tensor, Tensor] | None = None  # which photographs, and the curvature

    def look(self, it: Iteration) -> None:
        """Take note of which photographs an iteration sees, and of the second derivatives of its loss."""
        begun = it.progress >= self.param_groups[0]["start"]
        self.seen = (torch.from_numpy(it.everything), it.share.gathered(curvature(it))) if begun else None

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """One, for the gradients that the parameters have; none if it has not begun, or if there are none."""
        (group,) = self.param_groups
        turn, move = group["params"]
        if self.seen is None or turn.grad is None:
            return
        index, matrix = self.seen
        gradient = torch.cat([turn.grad[index], move.grad[index]], 1)
        own = matrix.diagonal(dim1=1, dim2=2)
        damped = matrix + torch.diag_embed(DAMPING * own + FLOOR * own.amax(1, keepdim=True))
        step = torch.linalg.solve(damped, gradient)
        step *= group["lr"] * (LONGEST / step.norm(dim=1, keepdim=True)).clamp(max=1)
        turn[index] -= step[:, :3]
        move[index] -= step[:, 3:]


@torch.no_grad()
def curvature(it: Iteration) -> Tensor:
    """Second derivatives (n, 6, 6) of the loss of an iteration by `turn` and `move` of its photographs.

    Of its colours, outlines and prior, by Gauss-Newton, as if the surface were a sphere; absolute differences as if
    they were squares of the same slope (iteratively reweighted least squares), those below the usual one as if they
    were that. Masks as if they told of every pixel.
    """
    fit, calibration, (n, height, width) = it.fit, it.fit.calibration, it.coverage.shape
    assert calibration is not None
    kind, telling = fit.config.loss, terms.telling(it)
    error = terms.colour_error(it.predicted, it.observed, it.clipped, fit.exposure, kind, telling).abs()
    if kind == "l2":
        weight = 2 * torch.ones_like(error)
    else:
        covered = error[it.coverage > 0.5]
        total, count = it.share.sum(torch.stack([covered.sum(), torch.ones_like(covered).sum()]))
        usual = (total / count).nan_to_num(1.0).clamp(min=1e-6)
        weight = 1 / error.maximum(usual)
    weight *= ~it.clipped | (error > 0)  # where it is clipped, a prediction may be brighter
    if telling is not None:
        weight *= telling[..., None]
    weight *= it.weights.get("rgb", 0.0) / (len(it.everything) * weight[0].numel())
    colours = terms.perceived(it.predicted, fit.exposure, kind)
    outlines = blur(it.coverage, terms.outline_blur(it))
    masked = max(1.0, float(it.share.sum(it.masked.sum())))
    outlined = 2 * it.weights.get("mask", 0.0) / (masked * height * width)

    at, radius = calibration.scaled(it.scale), float(fit.ring.radius)
    unit = torch.tensor([calibration.widths["turn"]] * 3 + [calibration.distance * calibration.widths["move"]] * 3)
    prior = it.weights.get("calibration", 0.0) / len(calibration.lens)
    result = torch.eye(6).repeat(n, 1, 1) * max(prior, LEAST)
    for i, k in enumerate(it.index):
        center = at.cameras[k, :, :3].T @ (calibration.center - at.cameras[k, :, 3])
        moving = motion(at.intrinsics[k], (width, height), center, radius) * unit
        colour, outline = slopes(colours[i]), slopes(outlines[i, ..., None])
        structure = torch.einsum("hwc,hwca,hwcb->hwab", weight[i], colour, colour)
        structure = structure + outlined * it.masked[i] * torch.einsum("hwca,hwcb->hwab", outline, outline)
        result[i] += torch.einsum("hwaj,hwab,hwbk->jk", moving, structure.cpu(), moving)
    return result
