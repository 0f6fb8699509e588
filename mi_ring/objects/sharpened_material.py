"""A material whose colours have a texture that is finer than any mesh."""

from typing import Any

import torch
from torch import Tensor

from mi_ring.nets.brdf_net import MaterialNet, Parameter
from mi_ring.nets.registry import architecture_of, build, register_network
from mi_ring.objects.detail import Grid

ALBEDO = "diffuse", "reflectance", "diffuse_reflectance", "base_color"  #: Mitsuba's names of the colour without gloss


def albedo_of(net: MaterialNet) -> Parameter | None:
    """Return the parameter of a material that is its colour without gloss. Returns None if it has none."""
    return next((p for p in net.bsdf_parameters if p.name in ALBEDO and p.channels == 3), None)


@register_network("sharpened-material")
class SharpenedMaterial(MaterialNet):
    """The material of another network, whose colour is multiplied by exp(grid) at the texels of a texture.

    Vertices of a mesh get the material of the other network: they are too far apart to show the grid.
    """

    def __init__(self, net: dict, grid: dict) -> None:
        """Make a material whose grid is 0. `net`: result of `architecture_of`. `grid`: arguments of `Grid`.

        Raises ValueError if the material has no colour without gloss, or if the grid has not three channels.
        """
        base = build(net)
        super().__init__(base.bsdf_parameters)
        if not albedo_of(self) or grid["channels"] != 3:
            raise ValueError(f"a texture of {grid['channels']} channels does not suit the material")
        self.base: Any = base
        self.grid = Grid(**grid)

    @classmethod
    def of(cls, net: MaterialNet, grid: Grid) -> "SharpenedMaterial":
        """Multiply the colour of `net` by exp(`grid`), whose three channels are red, green and blue.

        `net` must have a colour: see `albedo_of`.
        """
        sharpened = cls(architecture_of(net), grid.arguments())
        sharpened.base, sharpened.grid = net, grid
        sharpened.set_parameters(net.bsdf_parameters, float(net.scale))
        return sharpened

    def arguments(self) -> dict:
        """Return the arguments of the constructor as plain data."""
        return {"net": architecture_of(self.base), "grid": self.grid.arguments()}

    def evaluate(self, s: Tensor) -> Tensor:
        return self.base.evaluate(s)

    def forward(self, s: Tensor) -> dict[str, Tensor]:
        return self.base(s)

    def fine(self, s: Tensor) -> dict[str, Tensor]:
        values, colour = self.base.fine(s), albedo_of(self)
        assert colour
        finer = values[colour.name] * torch.exp(self.grid(s.reshape(-1, 3)).reshape(s.shape))
        return values | {colour.name: finer.clamp(colour.low, colour.high)}
