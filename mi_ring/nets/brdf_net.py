"""BRDF-Net: the material at every point of the domain (paper, section 3)."""

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
    """A parameter of a BSDF that BRDF-Net predicts: its name, channels (1 or 3), and range."""

    name: str
    channels: int  #: 1 or 3
    low: float
    high: float  #: inf: no upper limit
    start: float = 0.0  #: added to the network's output before that is mapped to the range

    @property
    def attribute(self) -> str:
        """Name of the mesh attribute that has the parameter's values."""
        return f"vertex_{self.name}"


ALBEDO = "diffuse", "reflectance", "diffuse_reflectance", "base_color"  #: Mitsuba's names of the colour without gloss
#: Mitsuba's names of the strength of highlights, and of their width
SPECULAR = "specular", "specular_reflectance", "coat"
ROUGHNESS = "roughness", "alpha", "coat_roughness"

#: The paper's five numbers.
COOK_TORRANCE = (
    Parameter("diffuse", 3, 0.0, math.inf),
    Parameter("specular", 1, 0.0, math.inf, -2.0),
    Parameter("roughness", 1, 0.0, 1.0, -0.5),
)
#: A sixth number: the roughness of the matte part. 0 is the paper's.
ROUGH = Parameter("diffuse_roughness", 1, 0.0, 1.0, -3.0)
#: A second specular lobe: strength and width of a coat. Without it, the reflectance is the paper's.
COAT = Parameter("coat", 1, 0.0, math.inf, -3.0), Parameter("coat_roughness", 1, 0.0, 1.0, -1.5)


class MaterialNet(nn.Module):
    """Base class of BRDF-Net: a network that maps a point of the domain to the parameters of a BSDF.

    Each parameter stays within its range. To replace BRDF-Net, derive a class with a method `evaluate`.
    """

    bsdf_parameters: tuple[Parameter, ...]
    scale: Tensor  #: order of magnitude of the reflectances, in the scene's units of light

    def __init__(self, parameters: Sequence[Parameter] = COOK_TORRANCE, scale: float = 1.0) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.set_parameters(parameters, scale)

    def set_parameters(self, parameters: Sequence[Parameter], scale: float) -> None:
        """Set the BSDF parameters that the network predicts. They must be in the order of the outputs of `evaluate`.

        A colour takes three outputs. `scale`: order of magnitude of the reflectances, in the scene's unit of light.
        """
        self.bsdf_parameters = tuple(Parameter(*p) for p in parameters)
        self.scale.fill_(scale)

    @property
    def albedo(self) -> Parameter | None:
        """The parameter that is the albedo, the colour without gloss. None if there is none."""
        return next((p for p in self.bsdf_parameters if p.name in ALBEDO and p.channels == 3), None)

    @property
    def outputs(self) -> int:
        """Number of values that `evaluate` must return per point: one or three for each parameter."""
        return sum(p.channels for p in self.bsdf_parameters)

    def evaluate(self, s: Tensor) -> Tensor:
        """Compute unbounded values (..., `outputs`) at domain points (..., 3). They should be about 0 before a fit."""
        raise NotImplementedError

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        """Compute the parameters at domain points (..., 3).

        Returns a dict by name: (..., 3) for colours, (...) for others. A sigmoid maps the output of `evaluate` to the
        range of a parameter. If the range has no upper limit, softplus times `scale` is used, so that the network's
        outputs are about 1 in any unit of light.
        """
        raw = self.evaluate(s).float().split([p.channels for p in self.bsdf_parameters], -1)
        result = {}
        for parameter, x in zip(self.bsdf_parameters, raw):
            x = (x if parameter.channels == 3 else x[..., 0]) + parameter.start
            if math.isinf(parameter.high):
                result[parameter.name] = parameter.low + self.scale * F.softplus(x)
            else:
                result[parameter.name] = parameter.low + (parameter.high - parameter.low) * torch.sigmoid(x)
        return result

    def texture(self, s: Tensor) -> Tensor | None:
        """Compute factors (..., 3) of the albedo at domain points (..., 3). Returns None if there is no texture.

        `forward` leaves it out, because it is too fine for the vertices of a mesh. A class with a texture must also
        have a method `texture_cell`. What changes the texture must be a parameter or a buffer.
        """
        return None

    def texture_cell(self) -> float | None:
        """Return the size of the texture's finest detail, a length on its domain. Returns None without a texture."""
        return None

    def fine(self, s: Tensor) -> dict[str, Tensor]:
        """Compute the parameters, with the texture, at domain points (..., 3)."""
        values, factors, colour = self(s), self.texture(s), self.albedo
        if factors is None or not colour:
            return values
        return values | {colour.name: (values[colour.name] * factors).clamp(colour.low, colour.high)}


@register_network("brdfnet")
class BRDFNet(MLP, MaterialNet):
    """The paper's BRDF-Net, an MLP of 1,285 neurons: Ψ(s) = (ρʳ, ρᵍ, ρᵇ, ρᵞ, r): diffuse, specular, roughness.

    It can also predict the parameters of another BSDF. The input is the point s of the domain, not the point of the
    deformed surface.
    """

    def __init__(
        self, scale: float = 1.0, parameters: Sequence[Parameter] = COOK_TORRANCE, encoding: str = "linear",
        frequencies: int = 16,
    ) -> None:  # fmt: skip
        super().__init__(5, sum(Parameter(*p).channels for p in parameters), PosEnc(frequencies, encoding))
        self.set_parameters(parameters, scale)

    @torch.no_grad()
    def add_parameters(self, parameters: Sequence[Parameter]) -> list[tuple[nn.Parameter, nn.Parameter]]:
        """Predict further BSDF parameters, in place. Their outputs are 0 at first: `start` says what they are.

        The last layer gets larger tensors. Returns pairs (old tensor, new tensor), for optimisers.
        """
        self.set_parameters([*self.bsdf_parameters, *parameters], float(self.scale))
        before, pairs = self.output, []
        self.output = nn.Linear(before.in_features, self.outputs, device=before.weight.device)
        for old, new in zip(before.parameters(), self.output.parameters(), strict=True):
            new.zero_()[: len(old)] = old
            pairs.append((old, new))
        return pairs

    def arguments(self) -> dict:
        """Return the arguments of the constructor as a dict, to save them.

        `scale` is not among them: it is a saved weight.
        """
        return {"parameters": [tuple(p) for p in self.bsdf_parameters], **self.encoding.arguments()}
