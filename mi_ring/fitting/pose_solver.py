"""Solves for the poses of cameras by Gauss-Newton steps. They divide the gradient of the loss by its curvature.

A fit sees each photograph a few dozen times. Adam's steps do not depend on the size of an error: they move correct
cameras away, or are too short for wrong ones. This module computes the curvature from the motion of a picture's pixels
with its camera. This is direct image alignment, as in "Lucas-Kanade 20 Years On" (Baker and Matthews, IJCV 2004). The
surface takes the place of the template.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.calibration.calibration import Calibration
from mi_ring.errors import InputError
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.losses import colour_error, perceived
from mi_ring.fitting.schedule import Rate
from mi_ring.fitting.terms import Term, default_terms
from mi_ring.images import blur

#: Damping: shares of the diagonal, and of its largest entry, that are added to the diagonal. The latter slows down
#: directions that pictures hardly determine, for instance rotation about the axis of a round object.
DAMPING, FLOOR = 0.1, 0.01
LONGEST = 3.0  #: longest step [standard deviations]
INITIAL, DECAY = 1.0, 0.5  #: factor of the steps: it decreases to average over iterations
LEAST = 1e-9  #: least curvature: what photographs do not determine stays unchanged
NEAR, FAR = 0.2, 0.4  #: progress at which steps begin, for a start near the object and far from it


def slopes(picture: Tensor) -> Tensor:
    """Compute the image gradient of a picture (H, W, C) by central differences.

    Returns (H, W, C, 2): derivatives to the right and downward, per pixel.
    """
    padded = F.pad(picture.movedim(-1, 0), (1, 1, 1, 1), mode="replicate")
    right = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    down = padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    return torch.stack([right, down], -1).movedim(0, 2) / 2


def motion(intrinsics: Tensor, size: tuple[int, int], center: Tensor, radius: float) -> Tensor:
    """Compute how points of a sphere move in the picture if the camera moves. Returns a Jacobian (H, W, 2, 6).

    The two rows are the motion to the right and downward [px]. The six columns are the rotation [rad] about each of the
    camera's axes and the translation [scene units] along each of them (x left, y up, z forward). `intrinsics` (4,): fx,
    fy, cx, cy [px], without distortion. `size`: (width, height) of the picture [px]. `center` (3,), `radius`: the
    sphere, in camera coordinates; it is made smaller if the camera is inside. If the ray of a pixel misses the sphere,
    the point of the ray nearest to the sphere is used.
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


class PoseSolver(torch.optim.Optimizer):
    """Estimates camera poses, the unknowns `turn` and `move`, by Gauss-Newton steps.

    Call `look` in each iteration, then `step`.
    """

    def __init__(self, calibration: Calibration, near: bool, terms: Mapping[str, Term]) -> None:
        """Prepare to solve for the poses of a calibration.

        `near`: the fit starts near the object, so that steps can begin early. `terms`: the terms of the loss by name.
        Raises InputError if `rgb` or `mask` is not the default term: `curvature` holds only for the default terms.
        """
        for name in "rgb", "mask":
            if terms.get(name, default_terms[name]) is not default_terms[name]:
                raise InputError(f"terms: {name}: must be the default one for --refine cameras, which has to know how "
                                 "it changes with them; give yours another name")  # fmt: skip
        super().__init__([{"params": [calibration.turn, calibration.move]}], {"lr": INITIAL})
        self.rate = Rate(INITIAL, DECAY, NEAR if near else FAR)
        self.seen: tuple[Tensor, Tensor] | None = None  #: cameras and their curvature
        self.camera = calibration.rig.camera  #: (P,) number of each photograph's camera

    def look(self, it: Iteration) -> None:
        """Store the numbers of an iteration's cameras and the Gauss-Newton Hessians of its loss, for `step`."""
        self.seen = None
        if it.progress >= self.rate.start:
            cameras = self.camera[torch.from_numpy(it.batch.all_photographs)]
            self.seen = summed(cameras, it.batch.share.gathered(curvature(it)))

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Change the poses of the cameras that `look` has stored, by a Gauss-Newton step.

        Does nothing before refinement begins.
        """
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


def summed(cameras: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Sum the matrices (n, 6, 6) of photographs with the same camera. Returns (different cameras (m,), sums (m, 6, 6)).

    `cameras` (n,): number of the camera of each photograph.
    """
    different, place = cameras.unique(return_inverse=True)
    if len(different) == len(cameras):
        return cameras, matrices
    return different, matrices.new_zeros(len(different), 6, 6).index_add(0, place, matrices)


@torch.no_grad()
def curvature(it: Iteration) -> Tensor:
    """Compute the Gauss-Newton Hessian (n, 6, 6) of an iteration's loss with respect to the pose of each photograph.

    The pose is three rotations and three translations [standard deviations of their priors]. The Hessian contains
    colours, silhouettes and prior. It approximates the surface by a sphere. Absolute differences are treated by
    iteratively reweighted least squares; those below the mean get the weight of the mean.
    """
    context, seen, prediction = it.context, it.observation, it.prediction
    calibration, (n, height, width) = context.model.calibration, prediction.coverage.shape
    assert calibration is not None
    rig, kind, counted = calibration.rig, context.config.loss, it.counted()
    error = colour_error(prediction.rgb, seen.rgb, seen.clipped, context.exposure, kind, counted).abs()
    if kind == "l2":
        weight = 2 * torch.ones_like(error)
    else:
        covered = error[prediction.coverage > 0.5]
        total, count = it.batch.share.sum(torch.stack([covered.sum(), torch.ones_like(covered).sum()]))
        mean = (total / count).nan_to_num(1.0).clamp(min=1e-6)
        weight = 1 / error.maximum(mean)
    weight *= ~seen.clipped | (error > 0)  # where it is clipped, a prediction may be brighter
    if counted is not None:
        weight *= counted[..., None]
    weight *= it.weights.get("rgb", 0.0) / (len(it.batch.all_photographs) * weight[0].numel())
    colours = perceived(prediction.rgb, context.exposure, kind)
    silhouettes = blur(prediction.coverage, it.outline_blur())
    masked = max(1.0, float(it.batch.share.sum(seen.masked.sum())))
    mask_weight = 2 * it.weights.get("mask", 0.0) / (masked * height * width)

    at, radius = calibration(it.batch.scale), float(context.model.ring.radius)
    unit = torch.tensor([calibration.widths["turn"]] * 3 + [rig.distance * calibration.widths["move"]] * 3)
    prior = it.weights.get("calibration", 0.0) / len(rig)
    result = torch.eye(6).repeat(n, 1, 1) * max(prior, LEAST)
    for i, k in enumerate(it.batch.photographs):
        center = at.cameras[k, :, :3].T @ (rig.center - at.cameras[k, :, 3])
        moving = motion(at.intrinsics[k], (width, height), center, radius) * unit
        colour, outline = slopes(colours[i]), slopes(silhouettes[i, ..., None])
        structure = torch.einsum("hwc,hwca,hwcb->hwab", weight[i], colour, colour)
        structure = structure + mask_weight * seen.masked[i] * torch.einsum("hwca,hwcb->hwab", outline, outline)
        result[i] += torch.einsum("hwaj,hwab,hwbk->jk", moving, structure.cpu(), moving)
    return result
