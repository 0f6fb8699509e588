"""A material whose colours have a texture that is finer than any mesh."""

from typing import Any

import torch
from torch import Tensor

from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.registry import architecture_of, build, register_network
from mi_ring.objects.detail import Grid


@register_network("sharpened-material")
class SharpenedMaterial(MaterialNet):
    """The material of another network, whose albedo is multiplied by a texture: exp(grid)."""

    def __init__(self, net: dict, grid: dict) -> None:
        """Make a material whose grid is 0. `net`: result of `architecture_of`. `grid`: arguments of `Grid`.

        Raises ValueError if the material has no colour without gloss, or if the grid has not three channels.
        """
        base = build(net)
        super().__init__(base.bsdf_parameters)
        if not base.albedo or grid["channels"] != 3:
            raise ValueError(f"a texture of {grid['channels']} channels does not suit the material")
        self.base: Any = base
        self.grid = Grid(**grid)

    @classmethod
    def of(cls, net: MaterialNet, grid: Grid) -> "SharpenedMaterial":
        """Multiply the albedo of `net` by exp(`grid`), whose three channels are red, green and blue."""
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

    def texture(self, s: Tensor) -> Tensor:
        factors = torch.exp(self.grid(s.reshape(-1, 3)).reshape(s.shape))
        self.grid.latest.clear()  # the weights take more memory than a texture of the same points
        return factors

    def texture_cell(self) -> float:
        return self.grid.cells[-1]
