"""The optimiser of details: Adam that moves a value only as far as the gradients of several iterations agree."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

AT_ONCE = 2**20  #: values of a step that are computed together; more would take more memory for intermediate results


class AgreeingAdam(torch.optim.Optimizer):
    """Adam that does not follow noise. It is for values of which each iteration shows only some, and those with noise.

    A gradient of exactly 0 means that an iteration does not show the value: it changes neither the value nor its
    averages. The others give m, their mean, and v, their mean square, both weighted exponentially as in Adam. m / √v is
    1 or −1 if all gradients agree. If their signs are random, its standard deviation σ is known, and the step
    `lr` · m / √v is shortened by `lr` · `doubt` · σ, at most to 0. The step does not depend on the scale of the loss.

    `params`: as for each optimiser of torch. `lr`: the longest step. `betas`: decay of both averages, as in Adam.
    """

    def __init__(
        self, params: Iterable[Tensor] | Iterable[dict[str, Any]], lr: float,
        betas: tuple[float, float] = (0.9, 0.99), doubt: float = 1.5,
    ) -> None:  # fmt: skip
        super().__init__(params, {"lr": lr, "betas": betas, "doubt": doubt})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]  # closures are not supported
        """Make a step with the gradients that the parameters have now. `closure` is ignored."""
        for group in self.param_groups:
            first, second = group["betas"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state |= {name: torch.zeros_like(p) for name in ("times", "mean", "square")}
                several = p, p.grad, state["times"], state["mean"], state["square"]
                for values, gradient, times, mean, square in zip(*(t.view(-1).split(AT_ONCE) for t in several)):
                    seen = gradient != 0
                    times += seen
                    mean.lerp_(torch.where(seen, gradient, mean), 1 - first)
                    square.lerp_(torch.where(seen, gradient.square(), square), 1 - second)
                    left = torch.exp(times * math.log(first))  # weight of the zeros that the mean began with
                    agreement = mean / (1 - left) / (square / (1 - torch.exp(times * math.log(second)))).sqrt()
                    agreement = agreement.clamp(-1, 1)  # the averages have different memories
                    deviation = ((1 - first) / (1 + first) * (1 + left) / (1 - left)).sqrt()
                    step = agreement.sign() * (agreement.abs() - group["doubt"] * deviation).clamp(min=0)
                    values.sub_(torch.where(seen, step, 0), alpha=group["lr"])
