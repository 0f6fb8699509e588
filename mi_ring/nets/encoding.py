"""Positional encoding shared by Shape-Net and BRDF-Net."""

import torch
from torch import Tensor, nn


class PosEnc(nn.Module):
    """Positional encoding: PosEnc(x) = [cos(ωx), sin(ωx)] maps points (..., 3) to features (..., 6 · frequencies).

    `spacing`: "linear", as in the paper: ω = 1, 2, …, frequencies. "octaves", as in NeRF: ω = 1, 2, 4, …,
    2^(frequencies − 1). "none": the features are the points themselves. The features are first all cosines, then all
    sines. The order within both is ω₁x, ω₁y, ω₁z, ω₂x, … Raises ValueError for another `spacing`.
    """

    def __init__(self, frequencies: int = 16, spacing: str = "linear") -> None:
        super().__init__()
        if spacing not in ("linear", "octaves", "none"):
            raise ValueError(f"spacing: is {spacing}, must be linear, octaves or none")
        self.frequencies, self.spacing = frequencies, spacing
        self.width = 3 if spacing == "none" else 6 * frequencies

    def arguments(self) -> dict:
        """Return the spacing and the number of frequencies as {"encoding": `spacing`, "frequencies": `frequencies`}.

        Shape-Net and BRDF-Net have constructor arguments of these names.
        """
        return {"encoding": self.spacing, "frequencies": self.frequencies}

    def omega(self, dtype: torch.dtype, device: torch.device) -> Tensor:
        """Return the frequencies ω as a tensor (frequencies,)."""
        k = torch.arange(self.frequencies, dtype=dtype, device=device)
        return 2**k if self.spacing == "octaves" else k + 1

    def forward(self, x: Tensor) -> Tensor:
        """Compute the features (..., `width`) of points (..., 3)."""
        if self.spacing == "none":
            return x
        phase = (x[..., None, :] * self.omega(x.dtype, x.device)[:, None]).flatten(-2)
        return torch.cat([phase.cos(), phase.sin()], dim=-1)

    def backward(self, features: Tensor, gradient: Tensor) -> Tensor:
        """Compute the gradient (n, 3) with respect to the points, in float32 or float64.

        `features` (n, width): the result of `forward` at the points. `gradient` (n, width): gradient with respect to
        `features`.
        """
        dtype = torch.promote_types(features.dtype, torch.float32)
        if self.spacing == "none":
            return gradient.to(dtype)
        (cosine, sine), (by_cosine, by_sine) = features.chunk(2, dim=1), gradient.chunk(2, dim=1)
        omega = self.omega(dtype, features.device)
        phase = (cosine * by_sine - sine * by_cosine) * omega.repeat_interleave(3)
        return phase.unflatten(1, (self.frequencies, 3)).sum(1)
