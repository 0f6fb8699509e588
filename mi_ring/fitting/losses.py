"""Losses as pure functions of tensors. All are means: their weights do not depend on the sizes of photographs."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mi_ring.images import blur

STEP = 0.02  #: of the Laplacian; small against the period of the encoding's highest frequency


def perceived(photographs: Tensor, exposure: float, kind: str) -> Tensor:
    """Divide radiance by `exposure` and convert it to the scale of the colour loss `kind`; see `rgb_loss`."""
    linear = photographs / exposure
    if kind in ("l2", "l1"):
        return linear
    log = (4 * linear).clamp(min=-0.5).log1p()
    return log if kind == "log" else (linear + log) / 2  # both increase: this is the mean of two losses


def colour_error(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, counted: Tensor | None = None
) -> Tensor:
    """Difference (n, H, W, 3) of predicted and observed photographs (n, H, W, 3), after `perceived` of each.

    `clipped` (n, H, W, 3) bool: where the photograph is saturated, a brighter prediction is no error. `counted` (n, H,
    W) bool: pixels to compare; elsewhere the error is 0. None: all pixels.
    """
    error = perceived(predicted, exposure, kind) - perceived(observed, exposure, kind)
    error = torch.where(clipped, error.clamp(max=0), error)
    return error if counted is None else error * counted[..., None]


def rgb_loss(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, counted: Tensor | None = None
) -> Tensor:
    """L_rgb: mean difference of predicted and observed photographs, with the arguments of `colour_error`.

    `kind`: `l2` squares the differences (the paper). `l1` takes absolute differences and is robust. `log` compares
    ratios, so that dim surfaces at grazing angles count as much as bright ones. `l1+log` is the mean of both.
    """
    error = colour_error(predicted, observed, clipped, exposure, kind, counted)
    return error.square().mean() if kind == "l2" else error.abs().mean()


def mask_loss(
    coverage: Tensor, mask: Tensor, sigma: float, valid: Tensor | None = None, doubt: float = math.inf
) -> Tensor:
    """Mean squared difference of coverage and mask (n, H, W), blurred by a Gaussian of `sigma` [px].

    The blur gives an outline a gradient where it does not touch the mask yet. Pixels that are not `valid` (n, H, W)
    count as equal. Differences above `doubt` count less and less, because the mask is probably wrong there
    ("Statistical Methods for Tomographic Image Reconstruction", Geman and McClure 1987).
    """
    difference = coverage - mask if valid is None else (coverage - mask) * valid
    square = blur(difference, sigma).square()
    return (square / (1 + square / doubt**2)).mean()


def velocity_loss(velocity: Callable[[Tensor], Tensor], x: Tensor, laplacian_scale: float) -> Tensor:
    """L_reg = mean ‖(I − αΔ) V(x)‖² at points x (n, 3) on the paths of the flow; α = `laplacian_scale`.

    The Laplacian over ℝ³ is computed by differences to six points at the distance `STEP`.
    """
    offsets = STEP * torch.cat([torch.eye(3), -torch.eye(3)]).to(x)
    v = velocity(torch.cat([x[None], x + offsets[:, None]]))
    laplacian = (v[1:] - v[0]).sum(0) / STEP**2
    return (v[0] - laplacian_scale * laplacian).square().sum(-1).mean()
