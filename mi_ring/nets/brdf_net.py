"""BRDF-Net: the reflectance at every point of the domain (paper, section 3)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import MLP
from mi_ring.nets.registry import register_network


class Parameter(NamedTuple):
    """A parameter of a BSDF that BRDF-Net predicts."""

    name: str
    channels: int  #: 1 or 3
    low: float
    high: float  #: inf: no upper end
    start: float = 0.0  #: is added to the network's output, before that is brought into the range


#: The paper's five numbers.
COOK_TORRANCE = (
    Parameter("diffuse", 3, 0.0, math.inf),
    Parameter("specular", 1, 0.0, math.inf, -2.0),
    Parameter("roughness", 1, 0.0, 1.0, -0.5),
)


class MaterialNet(nn.Module):
    """The parameters of a BSDF as functions of the domain point, each within its range.

    What BRDF-Net is, and what a network of one's own in its place must be: a subclass with an `evaluate`, whose outputs
    begin around 0. A fit says by `set_parameters` which parameters are meant, and how bright.
    """

    bsdf_parameters: tuple[Parameter, ...]
    scale: Tensor  #: order of magnitude of ρ in the scene's units of light

    def __init__(self, parameters: Sequence[Parameter] = COOK_TORRANCE, scale: float = 1.0) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.set_parameters(parameters, scale)

    def set_parameters(self, parameters: Sequence[Parameter], scale: float) -> None:
        """Take these parameters for what the outputs mean, in their order, a colour as three."""
        self.bsdf_parameters = tuple(Parameter(*p) for p in parameters)
        self.scale.fill_(scale)

    @property
    def outputs(self) -> int:
        """How many functions these parameters take."""
        return sum(p.channels for p in self.bsdf_parameters)

    def evaluate(self, s: Tensor) -> Tensor:
        """(..., outputs) numbers without bounds, about 0 at first, at domain points (..., 3)."""
        raise NotImplementedError

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        """The parameters by name at domain points (..., 3): (..., 3) where they are colours, else (...).

        Softplus times `scale` keeps a parameter without an upper end above its lower one, a sigmoid the others in their
        ranges: the networks see numbers near 1 whatever the photographer's units are.
        """
        raw = self.evaluate(s).float().split([p.channels for p in self.bsdf_parameters], -1)
        result = {}
        for parameter, x in zip(self.bsdf_parameters, raw):
            x = x if parameter.channels == 3 else x[..., 0]
            if math.isinf(parameter.high):
                value = parameter.low + self.scale * F.softplus(x + parameter.start)
            else:
                value = parameter.low + (parameter.high - parameter.low) * torch.sigmoid(x + parameter.start)
            result[parameter.name] = value
        return result


@register_network("brdfnet")
class BRDFNet(MLP, MaterialNet):
    """Ψ(s) = (ρʳ, ρᵍ, ρᵇ, ρᵞ, r): an MLP of 1,285 neurons. Or the parameters of another BSDF.

    On the domain point s, not on the deformed point.
    """

    def __init__(
        self, scale: float = 1.0, parameters: Sequence[Parameter] = COOK_TORRANCE, encoding: str = "linear",
        frequencies: int = 16,
    ) -> None:  # fmt: skip
        super().__init__(5, sum(Parameter(*p).channels for p in parameters), PosEnc(frequencies, encoding))
        self.set_parameters(parameters, scale)

    def arguments(self) -> dict:
        """What makes it anew; `scale` is among the weights."""
        return {"parameters": [tuple(p) for p in self.bsdf_parameters], **self.encoding.arguments()}
