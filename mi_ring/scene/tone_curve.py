"""The tone curve of a camera: an exponent, and an S-curve like that of film."""

import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

Pictures = TypeVar("Pictures", np.ndarray, "Tensor")


def contrasted(linear: Pictures, contrast: Any, toe: Any = 0.0) -> Pictures:
    """Apply an S-curve, like the curve of film, to linear values of any shape. Values of at least 1 do not change.

    In terms of the sRGB value v, the curve is vᶜ / (vᶜ + (eᵗ (1 − v))ᶜ), where c is `contrast`, a number above 0, and t
    is `toe`. With a positive toe the dark end of the curve is longer. Contrast 1 and toe 0 change nothing. Contrast
    1 / c and toe −c t undo the curve. Returns linear values.
    """
    where: Any
    if isinstance(linear, np.ndarray):
        where, darker = np.where, math.exp(toe)
    else:
        import torch  # here, because `import mi_ring` does not wait for it

        where, darker = torch.where, torch.as_tensor(toe).exp()
    x = linear.clip(1e-6, 1 - 1e-6)  # so that the powers have finite derivatives
    v = where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    a, b = v**contrast, (darker * (1 - v)) ** contrast
    v = a / (a + b)
    y = where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return where(linear < 1, y * where(linear < x, linear / x, 1.0), linear)  # linear below 1e-6


class ToneCurve(NamedTuple):
    """A camera's tone curve: linear values x ≥ 0 become S(x ^ `gamma`). By default it changes nothing.

    S is an S-curve with `contrast` and `toe`, as `contrasted` takes them.
    """

    gamma: float = 1.0
    contrast: float = 1.0
    toe: float = 0.0

    def applied(self, linear: np.ndarray) -> np.ndarray:
        """Apply the curve to linear values of any shape."""
        powers = linear if self.gamma == 1 else np.maximum(linear, 0) ** self.gamma
        return contrasted(powers, self.contrast, self.toe) if self.bent else powers

    def removed(self, recorded: np.ndarray) -> np.ndarray:
        """Undo the curve: compute linear values from recorded ones of any shape."""
        contrast, toe = 1 / self.contrast, -self.contrast * self.toe
        powers = contrasted(recorded, contrast, toe).astype(recorded.dtype) if self.bent else recorded
        return powers if self.gamma == 1 else np.maximum(powers, 0) ** (1 / self.gamma)

    @property
    def bent(self) -> bool:
        """True if the curve has an S."""
        return (self.contrast, self.toe) != (1, 0)

    def after(self, first: "ToneCurve") -> "ToneCurve":
        """Return one curve for `first` and then this one. The S-curve of `first` acts on values to this `gamma`."""
        toe = first.toe + self.toe / first.contrast
        return ToneCurve(first.gamma * self.gamma, first.contrast * self.contrast, toe)


STRAIGHT = ToneCurve()  #: changes nothing
