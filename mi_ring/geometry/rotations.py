"""Rotation matrices, as tensors."""

import torch
from torch import Tensor


def quarter_turns(places: Tensor, near: float) -> Tensor:
    """Rotations (P, 3, 3) by multiples of 90° about the optical axis that map the first of `places` (P, 3) to each.

    They are the identity for places closer than `near` to the first.
    """
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).to(places)
    turns = torch.stack([torch.linalg.matrix_power(quarter, k) for k in range(4)])
    away = (turns @ places[0] - places[:, None]).norm(dim=-1)  # (P, 4)
    return turns[torch.where(away[:, 0] < near, 0, away.argmin(1))]


def rotations(vectors: Tensor) -> Tensor:
    """Rotation matrices (P, 3, 3) from rotation vectors (P, 3) [rad]; differentiable."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3))
