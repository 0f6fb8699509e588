"""BRDF-Net: the reflectance at every point of the domain (paper, section 3)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.mlp import MLP


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


class BRDFNet(MLP):
    """Ψ(s) = (ρʳ, ρᵍ, ρᵇ, ρᵞ, r): an MLP of 1,285 neurons on the domain point s, never on the deformed point.

    Or the parameters of another BSDF. `scale` is the order of magnitude of ρ in the scene's units of light: the
    networks see numbers near 1 whatever the photographer's units are. Softplus times `scale` keeps a parameter without
    an upper end above its lower one, a sigmoid the others in their ranges.
    """

    def __init__(self, scale: float = 1.0, parameters: Sequence[Parameter] = COOK_TORRANCE):
        parameters = tuple(Parameter(*p) for p in parameters)
        super().__init__(depth=5, outputs=sum(p.channels for p in parameters))
        self.bsdf_parameters = parameters
        self.register_buffer("scale", torch.tensor(float(scale)))

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        """The parameters by name at domain points (..., 3): (..., 3) where they are colours, else (...)."""
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
