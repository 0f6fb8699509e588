"""A plain ResNet that can replace Shape-Net, for the paper's ablation. Its blocks do not share weights."""

from typing import Any

from torch import nn

from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import WIDTH
from mi_ring.nets.registry import register_network
from mi_ring.nets.shape_net import Flow, ShapeNet, Velocity, VelocityField


@register_network("resnet")
class ResNet(Flow):
    """A plain ResNet of T = `steps` blocks `x ← x + Vₖ(x) / T`. Each block k has its own weights.

    `width`: neurons per layer of each block. None: so many that all blocks together have as many parameters as
    Shape-Net; this is about 42 for T = 20. With 256, the width of Shape-Net, the ResNet has T times as many parameters.
    """

    def __init__(
        self, steps: int = 20, encoding: str = "linear", frequencies: int = 16, width: int | None = None
    ) -> None:  # fmt: skip
        super().__init__()
        self.steps, self.width = steps, width
        self.encoding = PosEnc(frequencies, encoding)
        widths = [width] * steps if width else equal_widths(steps, self.encoding)
        self.blocks = nn.ModuleList(VelocityField(self.encoding, w) for w in widths)

    def arguments(self) -> dict:
        """Return the arguments of the constructor as a dict, to save them."""
        return {"steps": self.steps, "width": self.width, **self.encoding.arguments()}

    def velocity_of(self, step: int) -> Velocity:
        """Return the velocity field Vₖ of block k = `step`, counted from 0: a function of points (..., 3)."""
        block: Any = self.blocks[step]
        return block.velocity


def equal_widths(blocks: int, encoding: PosEnc) -> list[int]:
    """Choose the widths of `blocks` blocks that together have about as many parameters as one block of width `WIDTH`.

    Returns a list of widths [neurons per layer]. The first blocks are one neuron wider than the others where this makes
    the number of parameters more equal.
    """

    def parameters(width: int) -> int:
        return (encoding.width + 1) * width + 2 * (width + 1) * width + 3 * (width + 1)

    whole = parameters(WIDTH)
    narrow = max(w for w in range(1, WIDTH + 1) if blocks * parameters(w) <= whole or w == 1)
    missing = whole - blocks * parameters(narrow)
    wide = max(0, round(missing / (parameters(narrow + 1) - parameters(narrow))))
    return [narrow + 1] * wide + [narrow] * (blocks - wide)


def shape_net_of(kind: str, steps: int, encoding: str, frequencies: int) -> Flow:
    """Make the network that deforms the domain, with random weights. `kind`: "ring", "resnet" or "wide-resnet".

    "ring" is Shape-Net. "resnet" is a plain ResNet with as many parameters. "wide-resnet" is a plain ResNet as wide as
    Shape-Net. `steps`: Euler steps or blocks. `encoding`, `frequencies`: spacing and number of the frequencies of the
    positional encoding.
    """
    if kind == "ring":
        return ShapeNet(steps, encoding, frequencies)
    return ResNet(steps, encoding, frequencies, WIDTH if kind == "wide-resnet" else None)
