"""The multilayer perceptron that both networks are, differentiated by hand."""

from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.encoding import PosEnc

SLOPE = 0.01  #: of the leaky ReLU
CHUNK = 8192  #: points that a thread computes at once, at most


class MLP(nn.Module):
    """`outputs` functions of a point: its encoding, hidden layers of `width` leaky ReLUs, a linear layer."""

    def __init__(self, depth: int, outputs: int, width: int, frequencies: int):
        super().__init__()
        self.encoding = PosEnc(frequencies)
        sizes = [self.encoding.width] + [width] * depth
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes, sizes[1:]))
        self.output = nn.Linear(width, outputs)

    def evaluate(self, x: Tensor) -> Tensor:
        """The functions (..., outputs) at points (..., 3); in bfloat16 under `torch.autocast`."""
        return _Evaluate.apply(x.reshape(-1, 3), *self.constants(x)).unflatten(0, x.shape[:-1])

    def constants(self, x: Tensor) -> list:
        """What `_Evaluate` takes besides points (..., 3): precision, are gradients wanted, weights and biases."""
        dtype = self.hidden[0](self.encoding(x.reshape(-1, 3)[:0])).dtype  # what autocast makes of it, on any device
        parameters = [p for layer in [*self.hidden, self.output] for p in (layer.weight, layer.bias)]
        return [dtype, torch.is_grad_enabled(), *parameters]


class Layers:
    """Weights and biases in the precision of the products, ahead and back."""

    def __init__(self, dtype: torch.dtype, parameters):
        self.dtype = dtype
        self.weights, self.biases = ([p.detach().to(dtype) for p in parameters[k::2]] for k in (0, 1))
        self.frequencies = self.weights[0].shape[1] // 6
        self.encode = PosEnc(self.frequencies)

    def ahead(self, x: Tensor) -> tuple[list[Tensor], Tensor]:
        """The encoding and the activations of the hidden layers, and the output, of points (n, 3)."""
        activations = [self.encode(x).to(self.dtype)]
        for w, b in zip(self.weights[:-1], self.biases):
            activations.append(F.leaky_relu_(F.linear(activations[-1], w, b), SLOPE))
        return activations, F.linear(activations[-1], self.weights[-1], self.biases[-1])

    def zeros(self) -> list[Tensor]:
        """To sum up the parameters' gradients in, in float32 at least: all weights, then all biases."""
        dtype = torch.promote_types(self.dtype, torch.float32)
        return [torch.zeros_like(p, dtype=dtype) for p in (*self.weights, *self.biases)]

    def back(self, gradient: Tensor, activations: list[Tensor], sums: list[Tensor]) -> Tensor:
        """From the gradient of the output to that of the points; those of the parameters are added to `sums`."""
        gradient = gradient.to(self.dtype)
        for k in reversed(range(len(self.weights))):
            sums[k] += gradient.T @ activations[k]
            sums[len(self.weights) + k] += gradient.sum(0)
            gradient = gradient @ self.weights[k]
            if k:
                gradient = torch.ops.aten.leaky_relu_backward(gradient, activations[k], SLOPE, True)
        (cosine, sine), (by_cosine, by_sine) = activations[0].chunk(2, dim=1), gradient.chunk(2, dim=1)
        omega = torch.arange(1, self.frequencies + 1, dtype=sums[0].dtype, device=gradient.device)
        phase = (cosine * by_sine - sine * by_cosine) * omega.repeat_interleave(3)
        return phase.unflatten(1, (self.frequencies, 3)).sum(1)


class _Evaluate(torch.autograd.Function):
    """An MLP at points (n, 3). Only encoding and activations are kept, in the precision of the products."""

    @staticmethod
    def forward(ctx, x, dtype, keep, *parameters):
        layers = Layers(dtype, parameters)

        @torch.no_grad()
        def ahead(x):
            activations, output = layers.ahead(x)
            return output, activations if keep else None

        ctx.layers = layers
        outputs, ctx.kept = zip(*in_parallel(ahead, chunks(x.detach())))
        return torch.cat(outputs)

    @staticmethod
    def backward(ctx, gradient):
        layers = ctx.layers

        @torch.no_grad()
        def back(gradient, activations):
            sums = layers.zeros()
            return layers.back(gradient, activations, sums), sums

        gradients, sums = zip(*in_parallel(back, chunks(gradient), ctx.kept))
        ctx.kept = None
        return torch.cat(gradients), None, None, *in_order(sums)


def in_order(sums) -> list[Tensor]:
    """Of each chunk's `Layers.zeros`, added to: the totals, in the order of the parameters."""
    totals = [sum(parts) for parts in zip(*sums)]
    half = len(totals) // 2
    return [total for pair in zip(totals[:half], totals[half:]) for total in pair]


def chunks(x: Tensor):
    """Points (n, 3), or what there is of each, in parts that `in_parallel` computes one per thread."""
    if x.device.type != "cpu":
        return [x]
    return x.split(max(1, min(CHUNK, -(-len(x) // torch.get_num_threads()))))


def in_parallel(function, *arguments) -> list:
    """`map` over as many threads as torch is set to use, each computing alone."""
    threads = min(torch.get_num_threads(), len(arguments[0]))
    if threads == 1:
        return list(map(function, *arguments))
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        return list(pool.map(function, *arguments))
