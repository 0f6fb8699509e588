"""Positional encoding shared by Shape-Net and BRDF-Net."""

import torch
from torch import Tensor, nn


class PosEnc(nn.Module):
    """PosEnc(x) = [cos(ωx), sin(ωx)] with ω = 1, 2, …, `frequencies`: linear, not powers of two.

    Maps (..., 3) points to (..., 6 · frequencies) features, 96 of them for the paper's 16 frequencies.
    Order of the features: all cosines, then all sines; within each, frequency-major (ω₁x, ω₁y, ω₁z, ω₂x, …).
    `spacing`: `octaves` has ω = 1, 2, 4, …, 2^(frequencies − 1), as NeRF's; with `none` the features are the points.
    """

    def __init__(self, frequencies: int = 16, spacing: str = "linear") -> None:
        super().__init__()
        if spacing not in ("linear", "octaves", "none"):
            raise ValueError(f"spacing: is {spacing}, must be linear, octaves or none")
        self.frequencies, self.spacing = frequencies, spacing
        self.width = 3 if spacing == "none" else 6 * frequencies

    def arguments(self) -> dict:
        """What makes it anew, as the networks' arguments call it."""
        return {"encoding": self.spacing, "frequencies": self.frequencies}

    def omega(self, dtype: torch.dtype, device: torch.device) -> Tensor:
        """ω (frequencies,)."""
        k = torch.arange(self.frequencies, dtype=dtype, device=device)
        return 2**k if self.spacing == "octaves" else k + 1

    def forward(self, x: Tensor) -> Tensor:
        """Features of points."""
        if self.spacing == "none":
            return x
        phase = (x[..., None, :] * self.omega(x.dtype, x.device)[:, None]).flatten(-2)
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def backward(self, features: Tensor, gradient: Tensor) -> Tensor:
        """From the gradient of the features (n, width) to that of the points (n, 3), in float32 at least."""
        dtype = torch.promote_types(features.dtype, torch.float32)
        if self.spacing == "none":
            return gradient.to(dtype)
        (cosine, sine), (by_cosine, by_sine) = features.chunk(2, dim=1), gradient.chunk(2, dim=1)
        omega = self.omega(dtype, features.device)
        phase = (cosine * by_sine - sine * by_cosine) * omega.repeat_interleave(3)
        return phase.unflatten(1, (self.frequencies, 3)).sum(1)
