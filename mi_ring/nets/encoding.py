"""Positional encoding shared by Shape-Net and BRDF-Net."""

import torch
from torch import Tensor, nn


class PosEnc(nn.Module):
    """PosEnc(x) = [cos(ωx), sin(ωx)] with ω = 1, 2, …, `frequencies`: linear, not powers of two.

    Maps (..., 3) points to (..., 6 · frequencies) features, 96 of them for the paper's 16 frequencies.
    Order of the features: all cosines, then all sines; within each, frequency-major (ω₁x, ω₁y, ω₁z, ω₂x, …).
    """

    def __init__(self, frequencies: int = 16) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.width = 6 * frequencies

    def forward(self, x: Tensor) -> Tensor:
        """Features of points."""
        omega = torch.arange(1, self.frequencies + 1, dtype=x.dtype, device=x.device)
        phase = (x[..., None, :] * omega[:, None]).flatten(-2)
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def backward(self, features: Tensor, gradient: Tensor) -> Tensor:
        """From the gradient of the features (n, 6 · frequencies) to that of the points (n, 3), in float32 at least."""
        (cosine, sine), (by_cosine, by_sine) = features.chunk(2, dim=1), gradient.chunk(2, dim=1)
        dtype = torch.promote_types(features.dtype, torch.float32)
        omega = torch.arange(1, self.frequencies + 1, dtype=dtype, device=features.device)
        phase = (cosine * by_sine - sine * by_cosine) * omega.repeat_interleave(3)
        return phase.unflatten(1, (self.frequencies, 3)).sum(1)
