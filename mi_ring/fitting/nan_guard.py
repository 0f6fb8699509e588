"""A guard against NaN. It restores the last finite parameters and lowers the learning rates."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

PATIENCE = 3  #: consecutive losses or gradients that may be non-finite; a renderer produces one now and then
KEPT_EVERY = 10  #: steps between copies of the parameters
SMALLER = 0.3  #: factor of all learning rates at each retreat
RETREATS = 5  #: number of retreats after which a fit fails


class NanGuard:
    """Detects NaN and infinity in a model and its optimisers, and restores a copy of an earlier, finite state."""

    def __init__(
        self, model: nn.Module, optimizers: Sequence[torch.optim.Optimizer], state: dict[str, Any] | None = None
    ) -> None:
        """Copy the parameters, which must be finite. `state`: result of `state()`, to continue an interrupted fit."""
        self.model, self.optimizers = model, optimizers
        self.factor: float = 1.0  #: of all learning rates
        self.retreats: int = 0  #: how often the copy was restored
        self.failures: int = 0  #: consecutive losses or gradients that were non-finite
        vars(self).update(state or {})
        self.keep()

    @torch.no_grad()
    def finite(self) -> bool:
        """Test whether all parameters, buffers and optimiser states are finite."""
        numbers = [*self.model.parameters(), *self.model.buffers()]
        numbers += [t for o in self.optimizers for state in o.state.values() for t in state.values()]
        tensors = [t for t in numbers if torch.is_tensor(t) and t.is_floating_point() and t.numel()]
        return all(bool(t.sum().isfinite()) for t in tensors)

    def note(self, healthy: bool) -> bool:
        """Record an iteration. After repeated failures, or if the model is not finite, restore the last copy.

        From time to time, a new copy is made. `healthy`: True if loss and gradients were finite and the optimisers have
        made their steps. Returns False if copies were restored too often: the fit has diverged. Returns True otherwise.
        """
        self.failures = 0 if healthy else self.failures + 1
        if self.failures < PATIENCE and self.finite():
            self.steps += healthy
            if self.steps >= KEPT_EVERY:
                self.keep()
            return True
        self.retreats, self.factor, self.failures = self.retreats + 1, self.factor * SMALLER, 0
        for part, state in zip([self.model, *self.optimizers], self.copy, strict=True):
            part.load_state_dict(copy.deepcopy(state))  # type: ignore[attr-defined]
        return self.retreats <= RETREATS

    def keep(self) -> None:
        """Copy the parameters and the optimiser states, which must be finite. The copy replaces the last one."""
        parts: list[Any] = [self.model, *self.optimizers]
        self.copy: list[Any] = []  # frees the memory of the last copy
        self.copy, self.steps = copy.deepcopy([part.state_dict() for part in parts]), 0

    def state(self) -> dict[str, Any]:
        """Return the guard's counters, for a checkpoint. The copy is left out: the checkpoint itself is finite."""
        return {"factor": self.factor, "retreats": self.retreats, "failures": self.failures}
