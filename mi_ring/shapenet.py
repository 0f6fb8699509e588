"""Shape-Net: a recurrent ResNet that integrates a flow and carries the domain onto the object (paper, section 3)."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from mi_ring.mlp import MLP, Layers, backward_in_chunks, forward_in_chunks

SPEED = 2.0  #: bound of the velocity, per unit of time: what is opposite on the unit sphere can be reached


class ShapeNet(MLP):
    """Φ(x, t) = x + ∫₀ᵗ V(Φ(x, s)) ds with one time-invariant velocity field V, an MLP of 771 neurons.

    Points live in the normalised frame in which the start domain is about the unit sphere. V is bounded by `SPEED`
    (tanh, as in the authors' "Diffeomorphic Neural Surface Parameterization", SIGGRAPH 2022) and starts at almost 0,
    so that the start surface equals the domain.
    """

    def __init__(self, steps: int = 20):
        super().__init__(depth=3, outputs=3)
        self.steps = steps
        with torch.no_grad():
            self.output.weight.mul_(1e-2)
            self.output.bias.zero_()

    def velocity(self, x: Tensor) -> Tensor:
        """V(x) for (..., 3) points, of the same shape and type."""
        return SPEED * torch.tanh(self.evaluate(x).to(x.dtype))

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Φ(x, steps / T): the first `steps` of the T Euler steps, of (V, 3) points.

        `x ← x + V(x) / T` again and again; in bfloat16 under `torch.autocast`.
        Differentiable once and by one backward pass, which frees what was kept for it.
        """
        return _Flow.apply(x, SPEED / self.steps, steps, *self.operands(x))

    def forward(self, x: Tensor, time: float = 1.0) -> Tensor:
        """Φ(x, time), `time` in [0, 1]; where that is between two Euler steps, by a part of the second."""
        steps = int(time * self.steps)
        x, rest = self.flow(x, steps) if steps else x, time - steps / self.steps
        return x + rest * self.velocity(x) if rest else x


class _Flow(torch.autograd.Function):
    """Euler steps as long as `scale` at most. Of each the activations and the direction are kept, nothing else."""

    @staticmethod
    def forward(ctx, x, scale, steps, encoding, dtype, keep, *parameters):
        ctx.layers = layers = Layers(encoding, dtype, parameters)
        ctx.scale = scale
        ctx.save_for_backward(*parameters)

        def flow(x):
            kept = []
            for _ in range(steps):
                activations, output = layers.forward(x, keep)
                direction = torch.tanh(output.to(x.dtype))
                x = x + scale * direction
                if keep:
                    kept.append((activations, direction))
            return x, kept

        return forward_in_chunks(ctx, flow, x)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient):
        def backward(g, kept, sums):
            for activations, direction in reversed(kept):
                g = g + ctx.layers.backward(ctx.scale * g * (1 - direction * direction), activations, sums)
            return g

        gradient, sums = backward_in_chunks(ctx, backward, gradient)
        return gradient, *[None] * 5, *sums
