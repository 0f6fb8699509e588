"""What keeps a fit from numbers that are none: it goes back to where all was well, and on with smaller steps."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

PATIENCE = 3  #: losses or gradients in a row that may be not finite; a renderer has one now and then
KEPT_EVERY = 10  #: steps between copies of what is fitted
SMALLER = 0.3  #: factor of all learning rates, each time
RETREATS = 5  #: how often, after which a fit gives up


class Caution:
    """Watches what is fitted, `modules` by `optimizers`, and keeps a copy of it."""

    def __init__(
        self, modules: Sequence[nn.Module], optimizers: Sequence[torch.optim.Optimizer],
        state: dict[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """All is well to begin with; `state`: what `state()` was of an interrupted fit."""
        self.parts: list[Any] = [*modules, *optimizers]
        self.modules, self.optimizers = modules, optimizers
        self.factor: float = 1.0  #: of all learning rates
        self.retreats: int = 0  #: how often it has gone back
        self.failures: int = 0  #: losses or gradients in a row that were not finite
        vars(self).update(state or {})
        self.keep()

    @torch.no_grad()
    def finite(self) -> bool:
        """Is all that is fitted, and all that its optimisers remember?"""
        numbers = [t for module in self.modules for t in (*module.parameters(), *module.buffers())]
        numbers += [t for o in self.optimizers for state in o.state.values() for t in state.values()]
        tensors = [t for t in numbers if torch.is_tensor(t) and t.is_floating_point() and t.numel()]
        return all(bool(t.sum().isfinite()) for t in tensors)

    def note(self, healthy: bool) -> bool:
        """Take note of an iteration, which has made its step if it was `healthy`; go back where that is due.

        False when it has done so too often.
        """
        self.failures = 0 if healthy else self.failures + 1
        if self.failures < PATIENCE and self.finite():
            self.steps += healthy
            if self.steps >= KEPT_EVERY:
                self.keep()
            return True
        self.retreats, self.factor, self.failures = self.retreats + 1, self.factor * SMALLER, 0
        for part, state in zip(self.parts, self.copy, strict=True):
            part.load_state_dict(copy.deepcopy(state))
        return self.retreats <= RETREATS

    def keep(self) -> None:
        """Make a copy of what is fitted, which is well."""
        self.copy, self.steps = copy.deepcopy([part.state_dict() for part in self.parts]), 0

    def state(self) -> dict[str, Any]:
        """Numbers for a checkpoint; the copy is not among them: what a checkpoint holds is well."""
        return {"factor": self.factor, "retreats": self.retreats, "failures": self.failures}
