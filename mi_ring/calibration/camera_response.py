"""The camera response that a fit refines: how vignetting, gain and tone curve change radiance."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from mi_ring.scene.tone_curve import contrasted

BLACK = 1e-6  #: radiance, in units of the file's full scale, below which an S curve is a straight line
DARKEST = 1e-4  #: radiance, in units of the exposure, below which the power curve is a straight line


class CameraResponse(NamedTuple):
    """The camera response of P photographs: vignetting, gains and a tone curve.

    Some fields are known from the capture and constant. The others are refined by the fit, or None if they are not.
    """

    exponent: Tensor | None  #: logarithm of the curve's exponent: the decoded value is radiance to this power
    contrast: Tensor | None  #: logarithm of the steepness of the curve's S
    toe: Tensor | None  #: how much longer the dark end of this S is than the bright end
    vignetting: Tensor | None  #: exponent of the cosine about the optical axis, added to the known one
    gammas: Tensor  #: (P,) exponents that the capture knows
    known_vignetting: Tensor  #: (P,) exponents of vignetting that the capture knows
    exposure: float  #: radiance that the exponent keeps as it is: the object's mean
    gains: Tensor  #: (P, 3) gains that the capture knows
    gain: Tensor | None = None  #: (P, 3) factors of these gains

    @property
    def has_vignetting(self) -> bool:
        """True if there is vignetting, known or refined. Methods then need the argument `cosines`."""
        return self.vignetting is not None or bool(self.known_vignetting.any())

    def recorded(self, radiance: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None = None) -> Tensor:
        """Convert scene radiance (N, ..., 3) to recorded values without the capture's known response.

        The pixels of an observation are such values. `index` (N,): indices of the photographs. `cosines` (N, ..., 1):
        cosine of the angle between the ray of a pixel and the optical axis; needed only if there is vignetting.
        """
        known, unknown = self.factors(radiance, index, cosines)
        return self.with_curve(radiance * known * unknown, self.gammas[index]) / known

    @torch.no_grad()
    def linear(self, recorded: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None = None) -> Tensor:
        """Convert recorded values (N, ..., 3), without the known response, to scene radiance.

        The result has no gradient. `index` (N,): indices of the photographs. `cosines` (N, ..., 1): cosine of the angle
        between the ray of a pixel and the optical axis; needed only if there is vignetting.
        """
        known, unknown = self.factors(recorded, index, cosines)
        return self.without_curve(recorded * known, self.gammas[index]) / known / unknown

    @property
    def bent(self) -> bool:
        """True if the fit refines the S of the curve."""
        return self.contrast is not None or self.toe is not None

    def s_curve(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return contrast and toe of the refined S-curve, with the dtype and the device of `like`."""
        contrast, toe = (torch.zeros(()) if part is None else part for part in (self.contrast, self.toe))
        return contrast.exp().to(like), toe.to(like)

    def factors(
        self, like: Tensor, index: Sequence[int] | np.ndarray, cosines: Tensor | None
    ) -> tuple[Tensor | float, Tensor | float]:
        """Return two factors for each pixel, vignetting times gain: (as the capture knows them, as refined by the fit).

        Each is a tensor (N, ..., 3) with the dtype and the device of `like`, a picture (N, ..., 3), or 1.0 if it
        changes nothing. `index` (N,): indices of the photographs. `cosines` (N, ..., 1): cosine of the angle between
        the ray of a pixel and the optical axis; None: no vignetting.
        """
        ones = [1] * (like.ndim - 2)

        def by_photograph(values: Tensor) -> Tensor:
            return values[index].to(like).view(-1, *ones, values.shape[1])

        known: Tensor | float = by_photograph(self.gains) if (self.gains != 1).any() else 1.0
        unknown: Tensor | float = 1.0 if self.gain is None else by_photograph(self.gain)
        if cosines is not None:
            cosines = cosines.to(like)
            known = known * cosines ** by_photograph(self.known_vignetting[:, None])
            unknown = unknown if self.vignetting is None else unknown * cosines ** self.vignetting.to(like)
        return known, unknown

    def with_curve(self, radiance: Tensor, gammas: Tensor) -> Tensor:
        """Apply the refined tone curve to radiance (N, ...).

        `gammas` (N,): exponents of the capture's own tone curve, one for each photograph.
        """
        if self.exponent is not None:
            relative = radiance / self.exposure
            radiance = radiance * relative.clamp(min=DARKEST) ** (self.exponent.exp().to(radiance) - 1)
        return with_contrast(radiance, *self.s_curve(radiance), gammas) if self.bent else radiance

    @torch.no_grad()
    def without_curve(self, recorded: Tensor, gammas: Tensor) -> Tensor:
        """Remove the refined tone curve from recorded values (N, ...), without gradients. Returns radiance (N, ...).

        `gammas` (N,): exponents of the capture's own tone curve, one for each photograph.
        """
        if self.bent:
            contrast, toe = self.s_curve(recorded)
            recorded = with_contrast(recorded, 1 / contrast, -contrast * toe, gammas)
        if self.exponent is None:
            return recorded
        relative, gamma = recorded / self.exposure, float(self.exponent.exp())
        return recorded * relative.clamp(min=DARKEST**gamma) ** (1 / gamma - 1)


def with_contrast(values: Tensor, contrast: Tensor, toe: Tensor, gammas: Tensor) -> Tensor:
    """Apply an S-curve of steepness `contrast` and with a `toe` to decoded values (N, ...). 1 and 0 change nothing.

    `gammas` (N,): exponents with which the values were decoded. Two S-curves one after the other are one S-curve, as in
    `ToneCurve.after`. So the capture's own is not needed here.
    """
    gammas = gammas.to(values).view(-1, *[1] * (values.ndim - 1))
    lit = values.clamp(min=BLACK)  # below it the curve is a straight line
    return contrasted(lit**gammas, contrast.to(values), toe.to(values)) ** (1 / gammas) * (values / lit)


@torch.no_grad()
def contrast_slope(
    recorded: Tensor, response: CameraResponse, index: Sequence[int] | np.ndarray, cosines: Tensor
) -> Tensor:
    """Compute the derivative of the logarithm of recorded values by the logarithm of the contrast.

    `recorded` (N, H, W, 3): values without the known response, as in `CameraResponse.recorded`. `index` (N,): indices
    of the photographs. `cosines` (N, H, W, 1): cosine of the angle between the ray of a pixel and the optical axis.
    Returns a tensor of the shape of `recorded`. It is 0 at full scale and above.
    """
    known, _ = response.factors(recorded, index, cosines if response.has_vignetting else None)
    values, one = (recorded * known).clamp(BLACK, 1 - BLACK), torch.ones(()).to(recorded)
    with forward_ad.dual_level():
        changed = with_contrast(values, forward_ad.make_dual(one, one), 0 * one, response.gammas[index])
        return forward_ad.unpack_dual(changed.log()).tangent
