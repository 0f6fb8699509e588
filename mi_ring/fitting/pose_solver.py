"""Solves for the poses of cameras by Gauss-Newton steps. They divide the gradient of the loss by its curvature.

A fit sees each photograph a few dozen times. Adam's steps do not depend on the size of an error: they move correct
cameras away, or are too short for wrong ones. This module computes the curvature from the motion of a picture's pixels
with its camera. This is direct image alignment, as in "Lucas-Kanade 20 Years On" (Baker and Matthews, IJCV 2004). The
surface takes the place of the template.

A wrong surface moves a part of a picture, a wrong camera all of it. So only what the quarters of photographs have in
common is taken for an error of the camera, as in `ExposureSolver`.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.exposure_solver import SEVERAL, quarters, shared_part
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.losses import colour_error, perceived
from mi_ring.fitting.schedule import Rate
from mi_ring.fitting.terms import doubt, shows
from mi_ring.images import blur

#: Damping: shares of the diagonal, and of its largest entry, that are added to the diagonal. The latter slows down
#: directions that pictures hardly determine, for instance rotation about the axis of a round object.
DAMPING, FLOOR = 0.1, 0.01
LONGEST = 3.0  #: longest step [standard deviations]
INITIAL, DECAY = 1.0, 0.5  #: factor of the steps: it decreases to average over iterations
LEAST = 1e-9  #: least curvature: what photographs do not determine stays unchanged
TOLD = 0.05  #: least structure that tells a shift, relative to that in the other direction, and of the whole picture
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


class Pull(NamedTuple):
    """How an iteration's loss pulls at the poses of its photographs."""

    curvature: Tensor  #: (n, 6, 6) Gauss-Newton Hessians with respect to poses [standard deviations of their priors]
    #: (n, 5, 2) how far the object is moved to the right and downward, from where it would be by the capture's cameras
    #: [focal lengths]: by the correction so far and what is left of it in the picture, then in each quarter of it; NaN
    #: or 0: unknown
    shifts: Tensor


class PoseSolver(torch.optim.Optimizer):
    """Estimates camera poses, the unknowns `turn` and `move`, by Gauss-Newton steps.

    Call `look` in each iteration, then `step`.
    """

    def __init__(self, calibration: Calibration, near: bool) -> None:
        """Prepare to solve for the poses of a calibration.

        `near`: the fit starts near the object, so that steps can begin early.
        """
        super().__init__([{"params": [calibration.turn, calibration.move]}], {"lr": INITIAL})
        self.rate = Rate(INITIAL, DECAY, NEAR if near else FAR)
        self.camera = calibration.rig.camera  #: (P,) number of each photograph's camera
        self.state[calibration.turn] = {"measured": torch.zeros(len(calibration.turn), 5, 2)}
        self.seen: tuple[Tensor, Tensor] | None = None  #: cameras and their curvature

    @property
    def measured(self) -> Tensor:
        """(cameras, 5, 2): the last shifts that were told of each camera, see `Pull`; 0: none was."""
        (group,) = self.param_groups
        return self.state[group["params"][0]]["measured"]

    @property
    def shared(self) -> float:
        """How much of the variance of shifts, in both directions, the quarters have in common, 0 to 1.

        It is 0 as long as the pictures of fewer than four cameras tell it, and 1 if there are fewer cameras.
        """
        known = (self.measured != 0).all(1, keepdim=True)
        if known.sum() < SEVERAL:
            return float(2 * len(known) < SEVERAL)
        mean = (known * self.measured).sum(0) / known.sum(0).clamp(min=1)
        centred = torch.where(known, self.measured - mean, 0)
        return float(shared_part(torch.cat(centred.unbind(-1))[..., None]))

    def look(self, it: Iteration) -> None:
        """Store the numbers of an iteration's cameras, the Hessians of its loss and the shifts, for `step`."""
        self.seen = None
        if it.progress >= self.rate.start:
            cameras = self.camera[torch.from_numpy(it.batch.all_photographs)]
            matrices, shifts = map(it.batch.share.gathered, pull(it))
            for camera, shift in zip(cameras.tolist(), shifts):
                known = shift.isfinite() & (shift != 0)
                self.measured[camera] = torch.where(known, shift, self.measured[camera])
            self.seen = summed(cameras, matrices)

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Move the poses of the cameras that `look` has stored to where a Gauss-Newton step leads, times `shared`.

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
        step *= (LONGEST / step.norm(dim=1, keepdim=True)).clamp(max=1)
        pose = torch.cat([turn[index], move[index]], 1)
        pose += group["lr"] * (self.shared * (pose - step) - pose)
        turn[index], move[index] = pose[:, :3], pose[:, 3:]


def summed(cameras: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Sum the matrices (n, 6, 6) of photographs with the same camera. Returns (different cameras (m,), sums (m, 6, 6)).

    `cameras` (n,): number of the camera of each photograph.
    """
    different, place = cameras.unique(return_inverse=True)
    if len(different) == len(cameras):
        return cameras, matrices
    return different, matrices.new_zeros(len(different), 6, 6).index_add(0, place, matrices)


@torch.no_grad()
def pull(it: Iteration) -> Pull:
    """Compute how an iteration's loss pulls at the pose of each photograph.

    A pose is three rotations and three translations [standard deviations of their priors]. The surface is approximated
    by a sphere.
    """
    model, covered = it.context.model, it.prediction.coverage.cpu() > 0.5
    calibration, n = model.calibration, len(covered)
    assert calibration is not None
    rig, at, radius = calibration.rig, calibration(it.batch.scale), float(model.ring.radius)
    unit = torch.tensor([calibration.widths["turn"]] * 3 + [rig.distance * calibration.widths["move"]] * 3)
    prior = it.weights.get("calibration", 0.0) / len(rig)
    matrices, shifts = torch.eye(6).repeat(n, 1, 1) * max(prior, LEAST), torch.zeros(n, 5, 2)
    poses = torch.cat([calibration.turn, calibration.move], 1)
    for i, (k, (corner, first, second)) in enumerate(zip(it.batch.photographs, derivatives(it))):
        center = at.cameras[k, :, :3].T @ (rig.center - at.cameras[k, :, 3])
        (left, top), (height, width) = corner, first.shape[:2]
        intrinsics = at.intrinsics[k] - torch.tensor([0, 0, left, top])
        moving = motion(intrinsics, (width, height), center, radius) * unit
        matrices[i] += moving.reshape(-1, 6).T @ (second @ moving).reshape(-1, 6)
        inside = covered[i, top : top + height, left : left + width]
        if inside.any():
            so_far = (moving[inside] @ poses[rig.camera[k]]).mean(0)
            shifts[i] = (so_far + remaining_shifts(first, second, inside)) / intrinsics[:2]
    return Pull(matrices, shifts)


def derivatives(it: Iteration) -> Iterator[tuple[tuple[int, int], Tensor, Tensor]]:
    """Compute the derivatives of an iteration's loss with respect to a shift of each pixel [px], for each photograph.

    Yields the left upper corner of a box of H × W pixels, beside which nothing depends on a shift, and of colours and
    silhouettes in this box the negative gradient (H, W, 2) and the Gauss-Newton Hessian (H, W, 2, 2). Absolute
    differences are treated by iteratively reweighted least squares; those below the mean get the weight of the mean.
    """
    context, seen, prediction = it.context, it.observation, it.prediction
    kind, counted, sigma = context.config.loss, it.counted(), it.outline_blur()
    error = colour_error(prediction.rgb, seen.rgb, seen.clipped, context.exposure, kind, counted)
    size = error.abs()
    covered = size[prediction.coverage > 0.5]
    total, count = it.batch.share.sum(torch.stack([covered.sum(), torch.ones_like(covered).sum()]))
    least = (total / count).nan_to_num(1.0).clamp(min=1e-6)
    colour_weight = it.weights.get("rgb", 0.0) / (len(it.batch.all_photographs) * error[0].numel())
    masked = max(1.0, float(it.batch.share.sum(seen.masked.sum())))
    mask_weight = 2 * it.weights.get("mask", 0.0) / (masked * seen.mask[0].numel())
    shown = shows(it)
    valid = torch.ones_like(shown) if seen.valid is None else seen.valid
    for i in range(len(error)):
        left, top, box = object_box(prediction.coverage[i], 3 * sigma)
        weight = 2 * torch.ones_like(size[i][box]) if kind == "l2" else 1 / size[i][box].maximum(least)
        weight *= colour_weight * (~seen.clipped[i][box] | (size[i][box] > 0))  # if clipped, more is no error
        if counted is not None:
            weight *= counted[i][box][..., None]
        colour = slopes(perceived(prediction.rgb[i][box], context.exposure, kind))
        first = torch.einsum("hwc,hwc,hwca->hwa", weight, error[i][box], colour)
        second = torch.einsum("hwc,hwca,hwcb->hwab", weight, colour, colour)
        if seen.masked[i] and mask_weight:
            coverage = torch.where(shown[i], prediction.coverage[i], 0)[box]
            outline = slopes(prediction.coverage[i][box][..., None])[..., 0, :].movedim(-1, 0)
            outline = blur((shown & valid)[i][box] * outline, sigma).movedim(0, -1)
            off = blur(valid[i][box] * (coverage - seen.mask[i][box]), sigma)
            trusted = mask_weight / (1 + off.square() / doubt(it) ** 2).square()
            first = first + (trusted * off)[..., None] * outline
            second = second + trusted[..., None, None] * torch.einsum("hwa,hwb->hwab", outline, outline)
        yield (left, top), first.cpu(), second.cpu()


def object_box(coverage: Tensor, margin: float) -> tuple[int, int, tuple[slice, slice]]:
    """Find the pixels where coverage (H, W) is not 0, and a margin [px] around: (left, top, (rows, columns))."""
    ranges = []
    for axis in (0, 1):
        where, more = coverage.amax(axis).nonzero()[:, 0].tolist() or [0], math.ceil(margin) + 1
        ranges.append(slice(max(0, where[0] - more), where[-1] + more + 1))
    columns, rows = ranges
    return columns.start, rows.start, (rows, columns)


def remaining_shifts(first: Tensor, second: Tensor, inside: Tensor) -> Tensor:
    """Compute by least squares how far a picture is from the photograph, and each quarter of it: (5, 2) [px].

    NaN: the quarter has too little structure in one direction, or compared with the whole. `first`, `second`: as
    `derivatives` yields them. `inside` (H, W): the object's pixels.
    """
    part = (quarters(inside)[..., None] == torch.arange(4)).to(first)
    gradient, matrix = torch.einsum("hwq,hwa->qa", part, first), torch.einsum("hwq,hwab->qab", part, second)
    gradient = torch.cat([gradient.sum(0, keepdim=True), gradient])
    matrix = torch.cat([matrix.sum(0, keepdim=True), matrix])
    if not matrix.isfinite().all():
        return torch.full_like(gradient, torch.nan)
    least, most = torch.linalg.eigvalsh(matrix).T
    told = (least > LEAST) & (least > TOLD * most) & (most > TOLD * most[0])
    eye = torch.eye(2).expand_as(matrix)
    shifts = torch.linalg.solve(torch.where(told[:, None, None], matrix, eye), gradient)
    return torch.where(told[:, None], shifts, torch.nan)
