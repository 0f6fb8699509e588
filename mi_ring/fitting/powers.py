"""The power of each photograph's light, or its gain, by what an iteration sees of it.

It is a factor, so that one look says all of it: how much brighter the object was than predicted. Adam's steps, of a
size that does not depend on how far off it is, came to 2.1 % of powers that were off by 15 %, these to 1.2 %.
"""

from collections.abc import Mapping
from typing import TypeAlias

import torch
from torch import Tensor

from mi_ring.fitting.calibration import START, Calibration
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.poses import GaussNewton
from mi_ring.fitting.terms import Term

RATE, DECAY = 0.5, 0.1  #: share of what an iteration says that is believed at first, and what that falls to
PULL = 0.01  #: toward what the scene says, by that
BRIGHT = 0.3  #: radiance from which pixels tell, by the object's median in that photograph and colour
BLACK = 0.01  #: and below which none does, in units of the exposure
ENOUGH = 30  #: pixels


class Powers(torch.optim.Optimizer):
    """Steps of the photographs that an iteration has seen, and of no others: `look` at it, then `step`."""

    def __init__(self, calibration: Calibration, name: str) -> None:
        """`name`: power or gain."""
        self.power, self.width = calibration.unknown(name)[0], calibration.widths[name]
        super().__init__([{"params": [self.power], "initial_lr": RATE, "decay": DECAY, "start": START}], {"lr": RATE})
        #: which photographs, and logarithms (3,) of how much brighter, NaN of colours of which they tell nothing
        self.seen: list[tuple[int, Tensor]] = []

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Take note of how much brighter photographs are than predicted: in the median of the object's pixels.

        In each colour by those that are not much darker in it than the object mostly is. By all photographs that were
        seen together: what is common to them is the reflectance's, which changes in each iteration.
        """
        self.seen = []
        if it.progress < START:
            return
        surely, floor = it.surely() & ~it.clipped.any(-1), BLACK * it.fit.exposure
        brighter = torch.full((len(it.index), 3), torch.nan)
        for n, inside in enumerate(surely):
            if not inside.any():
                continue
            both = torch.stack([it.observed[n][inside], it.predicted[n][inside]])  # (2, pixels, 3)
            telling = both.amin(0) > (BRIGHT * both.median(1).values.amin(0)).clamp(min=floor)
            for colour in range(3):
                observed, predicted = both[:, telling[:, colour], colour]
                if len(observed) >= ENOUGH:
                    brighter[n, colour] = (observed / predicted).log().median()
        brighter = it.share.gathered(brighter)
        told = (~brighter.isnan()).sum(0) >= 2  # colours
        usual = torch.where(told, brighter.nanmean(0), torch.nan)
        found = zip(it.everything.tolist(), brighter - usual)
        self.seen = [(k, one) for k, one in found if not one.isnan().all()]

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """One; none if it has not begun."""
        (group,) = self.param_groups
        for k, brighter in self.seen:
            change = group["lr"] * (brighter / self.width - PULL * self.power[k])
            self.power[k] += change.nan_to_num(0.0)  # of colours of which the photograph tells nothing


Looker: TypeAlias = GaussNewton | Powers  #: an optimiser that goes by more of an iteration than its gradients


def lookers_of(calibration: Calibration, near: bool, given: Mapping[str, Term]) -> list[Looker]:
    """Those of what is unknown of each photograph; `near` and `given` as of `GaussNewton`."""
    found: list[Looker] = [Powers(calibration, name) for name in ("power", "gain") if name in calibration.refined]
    return found + ([GaussNewton(calibration, near, given)] if "cameras" in calibration.refined else [])
