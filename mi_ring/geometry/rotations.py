"""Rotation matrices, as tensors."""

import torch
from torch import Tensor


def quarter_turns(places: Tensor, near: float) -> Tensor:
    """Choose rotations by multiples of 90° about the z axis, each of which moves the first point near another point.

    `places` (P, 3): the points. Returns P matrices (P, 3, 3). Each moves the first point as near as possible to one of
    the points. It is the identity if both are closer than `near` anyway.
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
