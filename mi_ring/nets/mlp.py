"""The multilayer perceptron of both networks. Its derivatives are written by hand, for speed."""

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
    """Context manager in which networks use PyTorch's own derivatives. They are slower, but of any order.

    Use it for Jacobians, second derivatives and `torch.func` (`jacrev`, `vmap`, …).
    """
    token = _plain.set(True)
    try:
        yield
    finally:
        _plain.reset(token)


class MLP(nn.Module):
    """A multilayer perceptron of points: positional encoding, `depth` hidden layers, and a linear layer.

    The hidden layers have `width` neurons with leaky ReLU. The last layer has `outputs` outputs. `encoding`: None
    stands for the paper's positional encoding.
    """

    def __init__(self, depth: int, outputs: int, encoding: PosEnc | None = None, width: int = WIDTH) -> None:
        super().__init__()
        self.encoding = encoding or PosEnc()
        sizes = [self.encoding.width] + [width] * depth
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(sizes, sizes[1:]))
        self.output = nn.Linear(width, outputs)

    def evaluate(self, x: Tensor) -> Tensor:
        """Compute the outputs (..., outputs) at points (..., 3). Under `torch.autocast` they are bfloat16.

        One backward pass through the result is possible, for first derivatives. Within `plain_autograd`, several passes
        and derivatives of any order are possible.
        """
        if _plain.get():
            x = self.encoding(x)
            for layer in self.hidden:
                x = F.leaky_relu(layer(x), SLOPE)
            return self.output(x)
        values = _Evaluate.apply(x.reshape(-1, 3), *self.operands(x))
        return values.reshape(*x.shape[:-1], self.output.out_features)

    def operands(self, x: Tensor) -> list:
        """List the arguments of the hand-written autograd functions that evaluate this network at points like `x`.

        They are: the encoding; the number format of matrix products; whether gradients are needed; weight and bias of
        each layer.
        """
        dtype = self.hidden[0](self.encoding(x.reshape(-1, 3)[:0])).dtype  # as autocast decides
        parameters = [p for layer in [*self.hidden, self.output] for p in (layer.weight, layer.bias)]
        return [self.encoding, dtype, torch.is_grad_enabled(), *parameters]


class Layers:
    """The layers of an MLP, for forward and backward passes without PyTorch's autograd.

    `dtype`: number format of the matrix products. `parameters`: weight and bias of each layer; they are copied to this
    format.
    """

    def __init__(self, encoding: PosEnc, dtype: torch.dtype, parameters: Sequence[Tensor]) -> None:
        self.encoding, self.dtype = encoding, dtype
        self.weights, self.biases = ([p.detach().to(dtype) for p in parameters[k::2]] for k in (0, 1))

    def forward(self, x: Tensor, keep: bool) -> tuple[list[Tensor], Tensor]:
        """Compute (activations, output (n, outputs)) at points (n, 3).

        `keep`: True returns the activations of the encoding and of all hidden layers, which a backward pass needs.
        False returns only those of the last hidden layer.
        """
        activations = [self.encoding(x).to(self.dtype)]
        for w, b in zip(self.weights[:-1], self.biases):
            activations.append(F.leaky_relu_(F.linear(activations[-1], w, b), SLOPE))
            if not keep:
                del activations[0]
        return activations, F.linear(activations[-1], self.weights[-1], self.biases[-1])

    def zeros(self) -> list[Tensor]:
        """Return a tensor of zeros in the shape of each parameter, in float32 or float64, to sum gradients in."""
        dtype = torch.promote_types(self.dtype, torch.float32)
        return [torch.zeros_like(p, dtype=dtype) for pair in zip(self.weights, self.biases) for p in pair]

    def backward(self, gradient: Tensor, activations: list[Tensor], sums: list[Tensor]) -> Tensor:
        """Compute the gradient (n, 3) with respect to the points, and add the gradients of the parameters to `sums`.

        `gradient` (n, outputs): gradient with respect to the output. `activations`: those of all layers, as the method
        `forward` returns them with `keep`. `sums`: one tensor for each parameter, changed in place.
        """
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
