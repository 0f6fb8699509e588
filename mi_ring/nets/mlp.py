"""The multilayer perceptron of both networks, with derivatives written by hand for speed."""

import contextlib
import contextvars
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from mi_ring.nets.chunks import backward_in_chunks, forward_in_chunks
from mi_ring.nets.encoding import PosEnc

_plain = contextvars.ContextVar("plain", default=False)

WIDTH = 256  #: of the hidden layers
SLOPE = 0.01  #: of the leaky ReLU


@contextlib.contextmanager
def plain_autograd() -> Iterator[None]:
    """A context manager in which networks use PyTorch's own derivatives: slower, but of any order.

    Use it for Jacobians, second derivatives and `torch.func` (`jacrev`, `vmap`, …).
    """
    token = _plain.set(True)
    try:
        yield
    finally:
        _plain.reset(token)


class MLP(nn.Module):
    """A perceptron of a point: encoding, `depth` hidden layers with leaky ReLU, linear layer with `outputs`."""

    def __init__(self, depth: int, outputs: int, encoding: PosEnc | None = None, width: int = WIDTH) -> None:
        super().__init__()
        self.encoding = encoding or PosEnc()
        sizes = [self.encoding.width] + [width] * depth
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes, sizes[1:]))
        self.output = nn.Linear(width, outputs)

    def evaluate(self, x: Tensor) -> Tensor:
        """The outputs (..., outputs) at points (..., 3); in bfloat16 under `torch.autocast`.

        They allow one backward pass and first derivatives; within `plain_autograd`, any number of both.
        """
        if _plain.get():
            x = self.encoding(x)
            for layer in self.hidden:
                x = F.leaky_relu(layer(x), SLOPE)
            return self.output(x)
        values = _Evaluate.apply(x.reshape(-1, 3), *self.operands(x))
        return values.reshape(*x.shape[:-1], self.output.out_features)

    def operands(self, x: Tensor) -> list:
        """Collect the last arguments of `_Evaluate` and of `_EulerSteps`.

        They are: encoding, type of the matrix products, whether gradients are needed, weights and biases by layer.
        """
        dtype = self.hidden[0](self.encoding(x.reshape(-1, 3)[:0])).dtype  # as autocast decides
        parameters = [p for layer in [*self.hidden, self.output] for p in (layer.weight, layer.bias)]
        return [self.encoding, dtype, torch.is_grad_enabled(), *parameters]


class Layers:
    """The layers of an MLP in the precision of the matrix products, with `forward` and `backward`."""

    def __init__(self, encoding: PosEnc, dtype: torch.dtype, parameters: Sequence[Tensor]) -> None:
        self.encoding, self.dtype = encoding, dtype
        self.weights, self.biases = ([p.detach().to(dtype) for p in parameters[k::2]] for k in (0, 1))

    def forward(self, x: Tensor, keep: bool) -> tuple[list[Tensor], Tensor]:
        """Compute activations and output at points (n, 3).

        Activations are those of the encoding and all hidden layers; without `keep`, of the last hidden layer alone.
        """
        activations = [self.encoding(x).to(self.dtype)]
        for w, b in zip(self.weights[:-1], self.biases):
            activations.append(F.leaky_relu_(F.linear(activations[-1], w, b), SLOPE))
            if not keep:
                del activations[0]
        return activations, F.linear(activations[-1], self.weights[-1], self.biases[-1])

    def zeros(self) -> list[Tensor]:
        """Zeros for the sums of the parameters' gradients; at least float32."""
        dtype = torch.promote_types(self.dtype, torch.float32)
        return [torch.zeros_like(p, dtype=dtype) for pair in zip(self.weights, self.biases) for p in pair]

    def backward(self, gradient: Tensor, activations: list[Tensor], sums: list[Tensor]) -> Tensor:
        """The gradient of the points from the `gradient` of the output. Adds the parameters' gradients to `sums`."""
        gradient = gradient.to(self.dtype)
        for k in reversed(range(len(self.weights))):
            sums[2 * k] += gradient.T @ activations[k]
            sums[2 * k + 1] += gradient.sum(0)
            gradient = gradient @ self.weights[k]
            if k:
                gradient = torch.ops.aten.leaky_relu_backward(gradient, activations[k], SLOPE, True)
        return self.encoding.backward(activations[0], gradient)


class _Evaluate(torch.autograd.Function):
    """An MLP at points (n, 3). It stores the encoding and the activations, in the precision of the products."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, encoding: PosEnc, dtype: torch.dtype, keep: bool, *parameters: Tensor) -> Tensor:
        ctx.layers = layers = Layers(encoding, dtype, parameters)
        ctx.save_for_backward(*parameters)

        def forward(x: Tensor, keep: bool) -> tuple[Tensor, list[Tensor] | None]:
            activations, output = layers.forward(x, keep)
            return output, activations if keep else None

        return forward_in_chunks(ctx, forward, x, keep)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple:
        gradient, sums = backward_in_chunks(ctx, ctx.layers.backward, gradient)
        return gradient, None, None, None, *sums
