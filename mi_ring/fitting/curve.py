"""What lens, gain and curve of cameras make of radiance, as a fit refines them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.images import contrasted

BLACK = 1e-6  #: radiance, in units of the file's, below which an S goes on straight
DARKEST = 1e-4  #: radiance, in units of the exposure, below which the curve is a straight line


class Curve(NamedTuple):
    """One for all photographs, but for the gains. What is None is as the capture says."""

    exponent: Tensor | None  #: logarithm of the exponent: a file's value, decoded, goes like radiance to its power
    contrast: Tensor | None  #: logarithm of how steep the S is
    vignetting: Tensor | None  #: exponent of the cosine about the optical axis
    gammas: Tensor  #: (P,) as the capture has them
    dimmed: Tensor  #: (P,) exponents of vignetting that the capture knows
    exposure: float  #: radiance that the exponent leaves as it is: the object's mean
    gains: Tensor  #: (P, 3) as the capture has them
    gain: Tensor | None = None  #: (P, 3) factors of them that were found

    @property
    def shading(self) -> bool:
        """Does the curve record what the lens has dimmed, or is that dimming unknown?"""
        return self.vignetting is not None or bool(self.dimmed.any())

    def recorded(self, radiance: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None = None) -> Tensor:
        """Radiance (N, ..., 3) as lens, gain and curve record it, decoded by what the capture says of them.

        `index` (N,): which photographs; `cosines` (N, ..., 1): of their pixels, needed for `shading`.
        """
        known, unknown = self.shades(radiance, index, cosines)
        return self.curved(radiance * known * unknown, self.gammas[index]) / known

    @torch.no_grad()
    def linear(self, recorded: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None = None) -> Tensor:
        """Radiance of what was recorded, the inverse of `recorded`; without gradients."""
        known, unknown = self.shades(recorded, index, cosines)
        return self.straight(recorded * known, self.gammas[index]) / known / unknown

    def shades(
        self, like: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None
    ) -> tuple[Tensor | float, Tensor | float]:
        """Factors (N, ..., 3) by lens and gain: what the capture knows of them, and what the fit has found."""
        ones = [1] * (like.ndim - 2)

        def by_photograph(values: Tensor) -> Tensor:
            return values[index].to(like).view(-1, *ones, values.shape[1])

        known: Tensor | float = by_photograph(self.gains) if (self.gains != 1).any() else 1.0
        unknown: Tensor | float = 1.0 if self.gain is None else by_photograph(self.gain)
        if cosines is not None:
            cosines = cosines.to(like)
            known = known * cosines ** by_photograph(self.dimmed[:, None])
            unknown = unknown if self.vignetting is None else unknown * cosines ** self.vignetting.to(like)
        return known, unknown

    def curved(self, radiance: Tensor, gammas: Tensor) -> Tensor:
        """Radiance (N, ...) as the curve records it; `gammas` (N,): as the capture has them."""
        if self.exponent is not None:
            relative = radiance / self.exposure
            radiance = radiance * relative.clamp(min=DARKEST) ** (self.exponent.exp().to(radiance) - 1)
        return radiance if self.contrast is None else steepened(radiance, self.contrast.exp(), gammas)

    @torch.no_grad()
    def straight(self, recorded: Tensor, gammas: Tensor) -> Tensor:
        """Radiance (N, ...) of what the curve recorded; `gammas` (N,): as the capture has them."""
        if self.contrast is not None:
            recorded = steepened(recorded, (-self.contrast).exp(), gammas)
        if self.exponent is None:
            return recorded
        relative, gamma = recorded / self.exposure, float(self.exponent.exp())
        return recorded * relative.clamp(min=DARKEST**gamma) ** (1 / gamma - 1)


def steepened(values: Tensor, contrast: Tensor, gammas: Tensor) -> Tensor:
    """What the curve's S makes of values (N, ...) that a capture decodes with these `gammas` (N,).

    An S of one steepness after another is one of their product's: that of the capture need not be known.
    """
    gammas = gammas.to(values).view(-1, *[1] * (values.ndim - 1))
    lit = values.clamp(min=BLACK)  # below it goes on straight
    return contrasted(lit**gammas, contrast.to(values)) ** (1 / gammas) * (values / lit)
