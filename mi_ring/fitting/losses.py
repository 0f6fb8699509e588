"""Losses as pure functions of tensors. All are means, so that they do not depend on the size of photographs."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from mi_ring.images import blur

STEP = 0.02  #: of the Laplacian; small against the period of the encoding's highest frequency


def perceived(photographs: Tensor, exposure: float, kind: str) -> Tensor:
    """Convert radiance of any shape to the scale on which the colour loss compares it. First divides by `exposure`.

    `exposure`: mean radiance of the object. `kind`: "l1" and "l2" keep the quotient x, "log" takes log(1 + 4 x),
    "l1+log" takes the mean of both.
    """
    linear = photographs / exposure
    if kind in ("l2", "l1"):
        return linear
    log = (4 * linear).clamp(min=-0.5).log1p()
    return log if kind == "log" else (linear + log) / 2  # both increase: this is the mean of two losses


def colour_error(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, counted: Tensor | None = None
) -> Tensor:
    """Compute the difference (n, H, W, 3) of predicted and observed photographs on the scale of the colour loss `kind`.

    `kind`: "l1", "l2", "log" or "l1+log". `exposure`: mean radiance of the object. `clipped` (n, H, W, 3) bool: True
    where the photograph is saturated; a brighter prediction is no error there. `counted` (n, H, W) bool: pixels to
    compare; in all others the difference is 0. None: all pixels.
    """
    error = perceived(predicted, exposure, kind) - perceived(observed, exposure, kind)
    error = torch.where(clipped, error.clamp(max=0), error)
    return error if counted is None else error * counted[..., None]


def rgb_loss(
    predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str, counted: Tensor | None = None
) -> Tensor:
    """Compute L_rgb, the mean difference of predicted and observed photographs (n, H, W, 3). Returns a scalar.

    `clipped` (n, H, W, 3) bool: saturated values; a brighter prediction is no error there. `exposure`: mean radiance of
    the object. `counted` (n, H, W) bool: pixels to compare; None: all. `kind`: "l2" squares the differences, as in the
    paper. "l1" takes absolute differences, which are less sensitive to outliers. "log" compares logarithms, so that
    dark surfaces count as much as bright ones. "l1+log" is the mean of both.
    """
    error = colour_error(predicted, observed, clipped, exposure, kind, counted)
    return error.square().mean() if kind == "l2" else error.abs().mean()


def mask_loss(
    coverage: Tensor, mask: Tensor, sigma: float, valid: Tensor | None = None, doubt: float = math.inf
) -> Tensor:
    """Compute the mean squared difference of coverage (n, H, W) and mask (n, H, W), both in [0, 1], after a blur.

    `sigma`: standard deviation of the Gaussian blur [px]. Because of the blur, an outline that does not touch the mask
    has a gradient. `valid` (n, H, W): pixels that are compared; None: all. `doubt`: differences above it have a limited
    influence, because the mask is probably wrong there ("Statistical Methods for Tomographic Image Reconstruction",
    Geman and McClure 1987).
    """
    difference = coverage - mask if valid is None else (coverage - mask) * valid
    square = blur(difference, sigma).square()
    return (square / (1 + square / doubt**2)).mean()


def velocity_loss(velocity: Callable[[Tensor], Tensor], x: Tensor, laplacian_scale: float) -> Tensor:
    """Compute L_reg = mean ‖(I − αΔ) V(x)‖² at points x (n, 3) of the flow. V: `velocity`. α: `laplacian_scale`.

    The Laplacian Δ is computed from finite differences to six neighbours of each point.
    """
    offsets = STEP * torch.cat([torch.eye(3), -torch.eye(3)]).to(x)
    v = velocity(torch.cat([x[None], x + offsets[:, None]]))
    laplacian = (v[1:] - v[0]).sum(0) / STEP**2
    return (v[0] - laplacian_scale * laplacian).square().sum(-1).mean()
