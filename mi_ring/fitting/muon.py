"""The optimiser Muon for weight matrices. Its steps are gradients with momentum, made orthogonal as matrices."""

from collections.abc import Iterable
from functools import partial

import torch
from torch import Tensor

from mi_ring.nets.chunks import in_parallel

#: Coefficients of the quintic of Newton and Schulz, and how often it is applied (Jordan et al. 2024, "Muon: an
#: optimizer for hidden layers in neural networks").
COEFFICIENTS, ITERATIONS = (3.4445, -4.775, 2.0315), 5
MOMENTUM = 0.95


class Muon(torch.optim.Optimizer):
    """The same optimiser as `torch.optim.Muon`, without weight decay and with a choice of the number format.

    `dtype`: number format in which steps are made orthogonal. PyTorch always uses bfloat16. Most processors emulate it
    and need 20 times as long.
    """

    def __init__(self, params: Iterable[Tensor], lr: float, dtype: torch.dtype) -> None:
        super().__init__(params, {"lr": lr})
        self.dtype = dtype

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update all weight matrices that have gradients once.

        The step of a matrix that has more rows than columns is longer by the factor √(rows / columns).
        """
        for group in self.param_groups:
            params = [p for p in group["params"] if p.grad is not None]
            updates = []
            for p in params:
                state = self.state[p]
                if not state:
                    state["momentum_buffer"] = torch.zeros_like(p.grad)
                momentum = state["momentum_buffer"].lerp_(p.grad, 1 - MOMENTUM)
                updates.append(p.grad.lerp(momentum, MOMENTUM))
            if updates and updates[0].device.type == "cpu":  # small matrices: one per thread is faster than one by all
                updates = in_parallel(torch.no_grad()(partial(orthogonalised, dtype=self.dtype)), updates)
            else:
                updates = [orthogonalised(update, self.dtype) for update in updates]
            for p, update in zip(params, updates):
                ratio = max(1.0, p.shape[0] / p.shape[1]) ** 0.5
                p.add_(update.to(p.dtype), alpha=-group["lr"] * ratio)


def orthogonalised(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an approximately orthogonal matrix near `matrix`: its singular values become numbers between 0.7 and 1.2.

    `dtype`: number format of the computation and the result.
    """
    a, b, c = COEFFICIENTS
    x = matrix.to(dtype)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.T if tall else x
