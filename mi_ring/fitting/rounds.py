"""Which photographs an iteration sees: all of them, in random order, before one comes again."""

import numpy as np
import torch

from mi_ring.capture.capture import Capture


class Rounds:
    """Draws photographs of a capture, of those that are `fitted` (indices)."""

    def __init__(self, capture: Capture, fitted: np.ndarray) -> None:
        self.shots, self.fitted = capture.shots, fitted
        self.alike = {size: np.intersect1d(index, fitted) for size, index in capture.sizes.items()}
        #: Of each size (width, height), those that have not come yet.
        self.waiting: dict[tuple[int, int], list[int]] = {}

    def draw(self, most: int, random: torch.Generator) -> tuple[np.ndarray, tuple[int, int]]:
        """Indices of the next `most` photographs, or of as many as there are of one size, and that size."""
        size = self.shots[self.fitted[int(torch.randint(len(self.fitted), (), generator=random))]].size
        alike = self.alike[size]
        count, waiting = min(most, len(alike)), self.waiting.get(size, [])
        if len(waiting) < count:  # those that are left come again at the end of the next round
            order = alike[torch.randperm(len(alike), generator=random).numpy()].tolist()
            waiting = waiting + [k for k in order if k not in waiting] + waiting
        self.waiting[size] = waiting[count:]
        return np.array(waiting[:count]), size

    def restore(self, waiting: dict[tuple[int, int], list[int]]) -> None:
        """Take up what was left of rounds. Raises ValueError for photographs that are not fitted."""
        if not {k for some in waiting.values() for k in some} <= {*self.fitted.tolist()}:
            raise ValueError("photographs that there are not")
        self.waiting = waiting
