"""The terms of the loss, small pure functions. All are means, so that their weights do not depend on sizes."""

import math

import torch
from torch import Tensor


def rgb_loss(predicted: Tensor, observed: Tensor, clipped: Tensor, exposure: float, kind: str) -> Tensor:
    """L_rgb: how far predicted photographs (n, H, W, 3) are from observed ones, in units of `exposure`.

    Where `clipped` (n, H, W, 3) the scene was at least as bright as observed: a brighter prediction is no error.
    `kind`: `l2` squares (the paper), `l1` is robust, `log` is robust and compares ratios rather than differences, so
    that dim surfaces seen at a slant count as much as bright ones, `l1+log` is the mean of both.
    """

    def perceived(photographs: Tensor) -> Tensor:
        linear = photographs / exposure
        if kind in ("l2", "l1"):
            return linear
        log = (4 * linear).clamp(min=-0.5).log1p()
        return log if kind == "log" else (linear + log) / 2  # both rise, so this is the mean of two losses

    error = perceived(predicted) - perceived(observed)
    error = torch.where(clipped, error.clamp(max=0), error)
    return error.square().mean() if kind == "l2" else error.abs().mean()


def mask_loss(coverage: Tensor, mask: Tensor, sigma: float) -> Tensor:
    """Squared difference of coverage and mask (n, H, W), blurred by a Gaussian of `sigma` [px].

    The blur lets an outline feel a mask that it does not touch yet.
    """
    return blur(coverage - mask, sigma).square().mean()


def blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur by `sigma` > 0 [px] of (..., H, W) images, zero outside."""
    radius = int(3 * sigma + 0.5)
    total = sum(math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1))

    def kernel(n):  # as a matrix: two products are ten times faster than two convolutions
        distance = (torch.arange(n)[:, None] - torch.arange(n)).to(images)
        return torch.where(distance.abs() <= radius, torch.exp(-0.5 * (distance / sigma) ** 2) / total, 0)

    return kernel(images.shape[-2]) @ images @ kernel(images.shape[-1])


def velocity_loss(velocity, x: Tensor, laplacian_scale: float, step: float = 0.02) -> Tensor:
    """L_reg = mean ‖(I − αΔ) V(x)‖² at points x (n, 3) of the flow's paths, α = `laplacian_scale`.

    The Laplacian over ℝ³ is the seven-point stencil of width `step`, small against the period of the highest frequency.
    """
    offsets = step * torch.cat([torch.eye(3), -torch.eye(3)]).to(x)
    v = velocity(torch.cat([x[None], x + offsets[:, None]]))
    laplacian = (v[1:] - v[0]).sum(0) / step**2
    return (v[0] - laplacian_scale * laplacian).square().sum(-1).mean()
