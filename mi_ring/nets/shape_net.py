"""Shape-Net: a recurrent ResNet. It integrates a flow that deforms the domain into the object (paper, section 3)."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mi_ring.nets.chunks import backward_in_chunks, forward_in_chunks
from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import MLP, WIDTH, Layers, _plain
from mi_ring.nets.registry import register_network

SPEED = 2.0  #: largest component of the velocity: in unit time, a point can cross the unit sphere

Velocity = Callable[[Tensor], Tensor]


class Flow(nn.Module):
    """Base class of Shape-Net: the flow Φ(x, t) = x + ∫₀ᵗ V(Φ(x, s)) ds of a velocity field V, by Euler steps.

    V does not depend on time. To replace Shape-Net, derive a class with a method `velocity`, or write a module with
    `forward`, `velocity`, `flow` and `steps`. Points are in the normalised frame, in which the domain is about as large
    as the unit sphere. The initial velocity should be small, so that the fit starts from the domain.
    """

    steps: int = 20  #: T: steps from the domain to the object

    def velocity(self, x: Tensor) -> Tensor:
        """Compute the velocity V(x) at points (..., 3). The result has the shape and type of x."""
        raise NotImplementedError

    def velocity_of(self, step: int) -> Velocity:
        """Return the velocity field V of Euler step number `step`, counted from 0: a function of points (..., 3).

        A plain ResNet has another field for each step. All other networks have one field.
        """
        return self.velocity

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Compute Φ(x, `steps` / T) for points (V, 3), by the first `steps` of the T Euler steps `x ← x + V(x) / T`."""
        for step in range(steps):
            x = x + 1 / self.steps * self.velocity_of(step)(x)
        return x

    def forward(self, x: Tensor, time: float = 1.0) -> Tensor:
        """Compute Φ(x, time) for points (V, 3) and a `time` in [0, 1].

        If `time` is not a multiple of 1 / T, the last step is short.
        """
        steps = int(time * self.steps)
        x, rest = self.flow(x, steps) if steps else x, time - steps / self.steps
        return x + rest * self.velocity_of(steps)(x) if rest else x


class VelocityField(MLP):
    """The velocity field V: an MLP with positional encoding. In the paper it has 771 neurons.

    A tanh limits each component to `SPEED`, as in the authors' "Diffeomorphic Neural Surface Parameterization",
    SIGGRAPH 2022. The initial velocity is almost 0, so that the fit starts from the domain.
    """

    def __init__(self, encoding: PosEnc | None = None, width: int = WIDTH) -> None:
        super().__init__(3, 3, encoding, width)
        with torch.no_grad():
            self.output.weight.mul_(1e-2)
            self.output.bias.zero_()

    def velocity(self, x: Tensor) -> Tensor:
        """Compute the velocity V(x) at points (..., 3). The result has the shape and type of x."""
        return SPEED * torch.tanh(self.evaluate(x).to(x.dtype))


@register_network("shapenet")
class ShapeNet(VelocityField, Flow):
    """The paper's Shape-Net: all steps use one velocity field."""

    def __init__(self, steps: int = 20, encoding: str = "linear", frequencies: int = 16) -> None:
        super().__init__(PosEnc(frequencies, encoding))
        self.steps = steps

    def arguments(self) -> dict:
        """Return the arguments of the constructor as a dict, to save them."""
        return {"steps": self.steps, **self.encoding.arguments()}

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Compute Φ(x, `steps` / T) for points (V, 3), by the first `steps` of the T Euler steps.

        The derivatives are hand-written. Under `torch.autocast`, matrix products are in bfloat16. One backward pass
        through the result is possible, for first derivatives. Within `plain_autograd`, several passes and derivatives
        of any order are possible.
        """
        if _plain.get():
            return super().flow(x, steps)
        return _EulerSteps.apply(x, SPEED / self.steps, steps, *self.operands(x))


class _EulerSteps(torch.autograd.Function):
    """Euler steps `x ← x + scale · tanh(MLP(x))`. For each step it stores the activations and the tanh."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, scale: float, steps: int, encoding: PosEnc, dtype: torch.dtype, keep: bool,
        *parameters: Tensor,
    ) -> Tensor:  # fmt: skip
        ctx.layers = layers = Layers(encoding, dtype, parameters)
        ctx.scale = scale
        ctx.save_for_backward(*parameters)

        def flow(x: Tensor, keep: bool) -> tuple[Tensor, list]:
            stored = []
            for _ in range(steps):
                activations, output = layers.forward(x, keep)
                direction = torch.tanh(output.to(x.dtype))
                x = x + scale * direction
                if keep:
                    stored.append((activations, direction))
            return x, stored

        return forward_in_chunks(ctx, flow, x, keep)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple:
        def backward(g: Tensor, stored: list, sums: list[Tensor]) -> Tensor:
            for activations, direction in reversed(stored):
                g = g + ctx.layers.backward(ctx.scale * g * (1 - direction * direction), activations, sums)
            return g

        gradient, sums = backward_in_chunks(ctx, backward, gradient)
        return gradient, *[None] * 5, *sums
