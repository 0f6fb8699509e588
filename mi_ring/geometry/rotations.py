"""Rotation matrices, as tensors."""

import torch
from torch import Tensor


def quarter_turns(places: Tensor, near: float) -> Tensor:
    """Return rotations (P, 3, 3) by multiples of 90° about the optical axis.

    Each moves the first of `places` (P, 3) as near as possible to one of `places`. For a place that is closer than
    `near` to the first, the rotation is the identity.
    """
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).to(places)
    turns = torch.stack([torch.linalg.matrix_power(quarter, k) for k in range(4)])
    away = (turns @ places[0] - places[:, None]).norm(dim=-1)  # (P, 4)
    return turns[torch.where(away[:, 0] < near, 0, away.argmin(1))]


def rotations(vectors: Tensor) -> Tensor:
    """Convert rotation vectors (P, 3) [rad] to rotation matrices (P, 3, 3). The result is differentiable."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3))
