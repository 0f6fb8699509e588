"""Shape-Net: a recurrent ResNet that integrates a flow and carries the domain onto the object (paper, section 3)."""

from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.encoding import PosEnc

SLOPE = 0.01  #: of the leaky ReLU

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
        """V(x) for (..., 3) points, of the same shape and type."""
        h = self.encoding(x)
        for layer in self.hidden:
            h = F.leaky_relu(layer(h), SLOPE)
        return self.speed * torch.tanh(self.output(h).to(x.dtype))

    def flow(self, x: Tensor, steps: int) -> Tensor:
        """Φ(x, steps / T): the first `steps` of the T Euler steps, of (V, 3) points.

        Equal to `euler(self.velocity, …)`, faster and in a fraction of the memory; in bfloat16 under `torch.autocast`.
        """
        dtype = self.hidden[0](self.encoding(x[:0])).dtype  # what autocast makes of it, on any device
        layers = [*self.hidden, self.output]
        parameters = [p for layer in layers for p in (layer.weight, layer.bias)]
        return _Flow.apply(x, 1 / self.steps, steps, self.speed, dtype, torch.is_grad_enabled(), *parameters)

    def forward(self, x: Tensor, time: float = 1.0) -> Tensor:
        """Φ(x, time), `time` in [0, 1]; where that is between two Euler steps, by a part of the second."""
        steps = int(time * self.steps)
        x, rest = self.flow(x, steps) if steps else x, time - steps / self.steps
        return x + rest * self.velocity(x) if rest else x


def euler(velocity, x: Tensor, dt: float, steps: int) -> Tensor:
    """Integrate dx/dt = velocity(x) by `steps` explicit Euler steps: the same residual block again and again."""
    for _ in range(steps):
        x = x + dt * velocity(x)
    return x


class _Flow(torch.autograd.Function):
    """Euler steps through the velocity field, differentiated by hand.

    Chunks of points are independent and go to one thread each, on a processor. Of each step the
    encoding and the activations are kept, in the precision of the matrix products, and nothing else.
    """

    CHUNK = 8192  # points, at most

    @staticmethod
    def forward(ctx, x, dt, steps, speed, dtype, keep, *parameters):
        weights = [w.detach().to(dtype) for w in parameters[::2]]
        biases = [b.detach().to(dtype) for b in parameters[1::2]]
        encode = PosEnc(weights[0].shape[1] // 6)

        @torch.no_grad()
        def flow(x):
            kept = []
            for _ in range(steps):
                layers = [encode(x).to(dtype)]
                for w, b in zip(weights[:-1], biases):
                    layers.append(F.leaky_relu_(F.linear(layers[-1], w, b), SLOPE))
                direction = torch.tanh(F.linear(layers[-1], weights[-1], biases[-1]).to(x.dtype))
                x = x + dt * speed * direction
                if keep:
                    kept.append((layers, direction))
            return x, kept

        ctx.chunk = min(_Flow.CHUNK, -(-len(x) // torch.get_num_threads())) if x.device.type == "cpu" else len(x)
        ends, ctx.kept = zip(*in_parallel(flow, x.detach().split(ctx.chunk)))
        ctx.weights, ctx.constants = weights, (dt * speed, dtype, encode.frequencies)
        return torch.cat(ends)

    @staticmethod
    def backward(ctx, gradient):
        scale, dtype, frequencies = ctx.constants
        weights = ctx.weights
        omega = torch.arange(1, frequencies + 1, dtype=gradient.dtype, device=gradient.device).repeat_interleave(3)

        @torch.no_grad()
        def pull(g, kept):
            weight_sums = [torch.zeros_like(w, dtype=g.dtype) for w in weights]
            bias_sums = [torch.zeros_like(w[:, 0], dtype=g.dtype) for w in weights]
            for layers, direction in reversed(kept):
                back = (scale * g * (1 - direction * direction)).to(dtype)
                for k in reversed(range(len(weights))):
                    weight_sums[k] += back.T @ layers[k]
                    bias_sums[k] += back.sum(0)
                    back = back @ weights[k]
                    if k:
                        back = torch.ops.aten.leaky_relu_backward(back, layers[k], SLOPE, True)
                cosine, sine = layers[0].chunk(2, dim=1)
                back_cosine, back_sine = back.chunk(2, dim=1)
                phase = (cosine * back_sine - sine * back_cosine) * omega
                g = g + phase.unflatten(1, (frequencies, 3)).sum(1)
            return g, weight_sums, bias_sums

        chunks, weight_sums, bias_sums = zip(*in_parallel(pull, gradient.split(ctx.chunk), ctx.kept))
        ctx.kept = None
        totals = [sum(parts) for pair in zip(zip(*weight_sums), zip(*bias_sums)) for parts in pair]
        return torch.cat(chunks), None, None, None, None, None, *totals


def in_parallel(function, *arguments) -> list:
    """`map` over as many threads as torch is set to use, each computing alone."""
    threads = min(torch.get_num_threads(), len(arguments[0]))
    if threads == 1:
        return list(map(function, *arguments))
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        return list(pool.map(function, *arguments))
