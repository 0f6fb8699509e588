"""Shape-Net: a recurrent ResNet that integrates a flow and carries the domain onto the object (paper, section 3)."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mi_ring.nets.chunks import backward_in_chunks, forward_in_chunks
from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import MLP, WIDTH, Layers, _plain
from mi_ring.nets.registry import register_network

SPEED = 2.0  #: bound of the velocity, per unit of time: what is opposite on the unit sphere can be reached

Velocity = Callable[[Tensor], Tensor]


class Flow(nn.Module):
    """Φ(x, t) = x + ∫₀ᵗ V(Φ(x, s)) ds of a time-invariant velocity field V, by Euler steps.

    What Shape-Net is, and what a network of one's own in its place must be: a subclass with a `velocity`. Or any module
    that has `forward`, `velocity`, `flow` and `steps` as here. Points live in the normalised frame, in which the start
    domain is about the unit sphere; a small velocity at first keeps the fit's start there.
    """

    steps: int = 20  #: T: steps from the domain to the object

    def velocity(self, x: Tensor) -> Tensor:
        """V(x) for (..., 3) points, of the same shape and type."""
        raise NotImplementedError

    def velocity_of(self, step: int) -> Velocity:
        """V as it is in a step, counted from 0: the same in all of a flow, but not in those of a plain ResNet."""
        return self.velocity

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Φ(x, steps / T): the first `steps` of the T steps `x ← x + V(x) / T`, of (V, 3) points."""
        for step in range(steps):
            x = x + self.velocity_of(step)(x) / self.steps
        return x

    def forward(self, x: Tensor, time: float = 1.0) -> Tensor:
        """Φ(x, time), `time` in [0, 1]; where that is between two steps, by a shorter one."""
        steps = int(time * self.steps)
        x, rest = self.flow(x, steps) if steps else x, time - steps / self.steps
        return x + rest * self.velocity_of(steps)(x) if rest else x


class VelocityField(MLP):
    """V, one MLP, of 771 neurons in the paper.

    It is bounded by `SPEED` (tanh, as in the authors' "Diffeomorphic Neural Surface Parameterization", SIGGRAPH 2022)
    and starts at almost 0, so that the start surface equals the domain.
    """

    def __init__(self, encoding: PosEnc | None = None, width: int = WIDTH) -> None:
        super().__init__(3, 3, encoding, width)
        with torch.no_grad():
            self.output.weight.mul_(1e-2)
            self.output.bias.zero_()

    def velocity(self, x: Tensor) -> Tensor:
        """V(x) for (..., 3) points, of the same shape and type."""
        return SPEED * torch.tanh(self.evaluate(x).to(x.dtype))


@register_network("shapenet")
class ShapeNet(VelocityField, Flow):
    """The paper's flow: one velocity field for all steps."""

    def __init__(self, steps: int = 20, encoding: str = "linear", frequencies: int = 16) -> None:
        super().__init__(PosEnc(frequencies, encoding))
        self.steps = steps

    def arguments(self) -> dict:
        """What makes it anew."""
        return {"steps": self.steps, **self.encoding.arguments()}

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """As `Flow.flow`, in bfloat16 under `torch.autocast`.

        Differentiable once and by one backward pass, which frees what was kept for it; within
        `mi_ring.nets.mlp.plain_autograd` as often as one likes.
        """
        if _plain.get():
            return super().flow(x, steps)
        return _Flow.apply(x, SPEED / self.steps, steps, *self.operands(x))


class _Flow(torch.autograd.Function):
    """Euler steps as long as `scale` at most. Of each the activations and the direction are kept, nothing else."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, scale: float, steps: int, encoding: PosEnc, dtype: torch.dtype, keep: bool,
        *parameters: Tensor,
    ) -> Tensor:  # fmt: skip
        ctx.layers = layers = Layers(encoding, dtype, parameters)
        ctx.scale = scale
        ctx.save_for_backward(*parameters)

        def flow(x: Tensor, keep: bool) -> tuple[Tensor, list]:
            kept = []
            for _ in range(steps):
                activations, output = layers.forward(x, keep)
                direction = torch.tanh(output.to(x.dtype))
                x = x + scale * direction
                if keep:
                    kept.append((activations, direction))
            return x, kept

        return forward_in_chunks(ctx, flow, x, keep)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple:
        def backward(g: Tensor, kept: list, sums: list[Tensor]) -> Tensor:
            for activations, direction in reversed(kept):
                g = g + ctx.layers.backward(ctx.scale * g * (1 - direction * direction), activations, sums)
            return g

        gradient, sums = backward_in_chunks(ctx, backward, gradient)
        return gradient, *[None] * 5, *sums
