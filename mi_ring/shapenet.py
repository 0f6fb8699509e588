"""Shape-Net: a recurrent ResNet that integrates a flow and carries the domain onto the object (paper, section 3)."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.encoding import PosEnc


class ShapeNet(nn.Module):
    """Φ(x, t) = x + ∫₀ᵗ V(Φ(x, s)) ds with one time-invariant velocity field V, an MLP of 771 neurons.

    Points live in the normalised frame in which the start domain is about the unit sphere. V is bounded (tanh) by
    `speed` per unit of time and starts at almost 0, so that the start surface equals the domain.
    """

    def __init__(self, steps: int = 20, width: int = 256, frequencies: int = 16, speed: float = 2.0):
        super().__init__()
        self.steps, self.speed = steps, speed
        self.encoding = PosEnc(frequencies)
        sizes = [self.encoding.width, width, width, width]
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes, sizes[1:]))
        self.output = nn.Linear(width, 3)
        with torch.no_grad():
            self.output.weight.mul_(1e-2)
            self.output.bias.zero_()

    def velocity(self, x: Tensor) -> Tensor:
        """V(x) for (..., 3) points, same shape, in float32."""
        h = self.encoding(x)
        for layer in self.hidden:
            h = F.leaky_relu(layer(h))
        return self.speed * torch.tanh(self.output(h).float())

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Φ(x, steps / T): the first `steps` of the T Euler steps, (..., 3) points."""
        return euler(self.velocity, x, 1 / self.steps, steps)

    def forward(self, x: Tensor) -> Tensor:
        """Φ(x, 1)"""
        return self.flow(x, self.steps)


def euler(velocity, x: Tensor, dt: float, steps: int) -> Tensor:
    """Integrate dx/dt = velocity(x) by `steps` explicit Euler steps: the same residual block again and again."""
    for _ in range(steps):
        x = x + dt * velocity(x)
    return x
