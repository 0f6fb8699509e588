"""Solves for the power or the gain of each photograph, from the brightness of the object in it.

Power and gain are factors: one comparison of observed and predicted brightness determines them. Adam's steps do not
depend on the size of an error, so Adam is less exact: from errors of 15 % it ends at 2.1 %, this solver at 1.2 %.

A wrong surface or material makes a part of a photograph brighter than predicted, the exposure all of it. So only what
the quarters of photographs have in common is taken for exposure.
"""

import numpy as np
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
FOLLOWING = 0.5  #: share by which the brightness of all photographs of one size follows that of a batch
SEVERAL = 8  #: least number of photographs that tell how much exposures vary


class ExposureSolver(torch.optim.Optimizer):
    """Estimates the unknown `power` or `gain` of each photograph. Call `look` in each iteration, then `step`."""

    rate = Rate(0.5, 0.1, START)  #: share of the measured difference by which an estimate moves

    def __init__(self, calibration: Calibration, name: str) -> None:
        """Solve for the unknown `name` of a calibration: "power" or "gain"."""
        self.tensor, self.width = getattr(calibration, name), calibration.widths[name]
        self.exposed = {*calibration.rig.exposed[name].tolist()}  #: photographs whose power or gain is unknown
        super().__init__([{"params": [self.tensor]}], {"lr": self.rate.initial})
        sizes, group = np.unique(calibration.rig.sizes, axis=0, return_inverse=True)
        self.group = group.ravel()  #: (P,) number of each photograph's size
        #: (sizes, 1, 1) photographs of each size whose power or gain is unknown
        self.counts = torch.from_numpy(np.bincount(self.group[[*self.exposed]], minlength=len(sizes)))[:, None, None]
        self.state[self.tensor] = {
            "measured": torch.zeros(len(calibration.rig), 5, 3),
            "brighter": torch.zeros(len(sizes), 5, 3),
        }
        self.seen: list[int] = []  #: photographs of the last `look`

    @property
    def measured(self) -> Tensor:
        """(P, 5, 3): log of the exposure as last seen, by colour: of all pixels, then of each quarter; 0: unknown."""
        return self.state[self.tensor]["measured"]

    @property
    def brighter(self) -> Tensor:
        """(sizes, 5, 3): log of how much brighter photographs of each size are than predicted; 0: unknown."""
        return self.state[self.tensor]["brighter"]

    def forget(self) -> None:
        """Forget what has been measured: after a jump of the unknowns it is that of another surface."""
        for values in self.state[self.tensor].values():
            values.zero_()

    @torch.no_grad()
    def look(self, it: Iteration) -> None:
        """Measure the exposure of each photograph of an iteration, and store it for `step`.

        The measure is the median of log(observed / predicted) over bright pixels of the object, for each colour, plus
        the exposure that the prediction has already. The mean over the photographs is subtracted, because the albedo
        explains it. Photographs of an iteration have one size. How much brighter those of other sizes are is known from
        earlier iterations.
        """
        self.seen = []
        if it.progress < START:
            return
        pixels = it.object_pixels() & ~it.observation.clipped.any(-1)
        floor = BLACK * it.context.exposure
        brighter = torch.full((len(it.batch.photographs), 5, 3), torch.nan)
        for n, (k, inside) in enumerate(zip(it.batch.photographs.tolist(), pixels)):
            if k not in self.exposed or not inside.any():
                continue
            both = torch.stack([it.observation.rgb[n][inside], it.prediction.rgb[n][inside]])  # (2, pixels, 3)
            quarter = quarters(inside)[inside]
            compared = both.amin(0) > (BRIGHT * both.median(1).values.amin(0)).clamp(min=floor)
            for colour in range(3):
                observed, predicted = both[:, compared[:, colour], colour]
                ratio = (observed / predicted).log()
                parts = [ratio, *(ratio[quarter[compared[:, colour]] == part] for part in range(4))]
                for part, values in enumerate(parts):
                    if len(values) >= (ENOUGH if part == 0 else ENOUGH // 4):
                        brighter[n, part, colour] = values.median()
        brighter = it.batch.share.gathered(brighter)
        index = it.batch.all_photographs
        group = self.group[index[0]]
        fewest = 1 if len(self.counts) > 1 and self.counts[group] == 1 else 2
        several = (~brighter.isnan()).sum(0) >= fewest  # of each part, in each colour
        # Of each part its own: errors of the parts would depend on each other otherwise.
        mean = torch.where(several, brighter.nanmean(0), torch.nan)
        for k, one in zip(index.tolist(), brighter - mean + self.beside_others(group, mean)):
            if not one[0].isnan().all():
                self.seen.append(k)
                exposure = one + self.width * self.tensor[k]
                self.measured[k] = torch.where(exposure.isnan(), self.measured[k], exposure)

    def beside_others(self, group: int, mean: Tensor) -> Tensor:
        """Return how much brighter (5, 3) photographs of a size are than those of all sizes; 0 if all have one size.

        `group`: number of the size. `mean` (5, 3): that of its photographs in this iteration, NaN where unknown.
        """
        now = self.brighter[group]
        followed = torch.where(now == 0, mean, now + FOLLOWING * (mean - now))
        self.brighter[group] = torch.where(mean.isnan(), now, followed)
        weights = torch.where(self.brighter != 0, self.counts, 0)
        return self.brighter[group] - (weights * self.brighter).sum(0) / weights.sum(0).clamp(min=1)

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        """Change the estimates for the photographs of the last `look`. Does nothing before progress 0.2 of the fit."""
        (group,) = self.param_groups
        shared = shared_part(self.measured)
        for k in self.seen:
            exposure, known = shared * self.measured[k, 0] / self.width, self.measured[k, 0] != 0
            change = group["lr"] * (exposure - (1 + PULL) * self.tensor[k])
            self.tensor[k] += torch.where(known, change, 0.0)


def quarters(inside: Tensor) -> Tensor:
    """Number all pixels (H, W) by the quarter of the object in or beside which they are, 0 to 3.

    `inside` (H, W): True where a pixel shows the object, at least at one.
    """
    row, column = inside.nonzero().double().mean(0)
    height, width = inside.shape
    low = torch.arange(height, device=inside.device) > row
    return 2 * low[:, None] + (torch.arange(width, device=inside.device) > column)


def shared_part(measured: Tensor) -> Tensor:
    """Compute how much of the variance of values the quarters have in common, for each of C kinds (C,), 0 to 1.

    `measured` (P, 5, C): values of photographs and of their quarters, such as exposures by colour; 0: unknown. A value
    times this factor is its best linear estimate. The factor is 1 as long as there are too few photographs whose
    quarters are all known.
    """
    result = torch.ones(measured.shape[-1])
    for kind, values in enumerate(measured.unbind(-1)):
        known = values[(values != 0).all(1)]
        if len(known) >= SEVERAL:
            known = known - known.mean(0)
            pairs = [known[:, a] * known[:, b] for a in range(2, 5) for b in range(1, a)]
            common = torch.stack(pairs).mean()
            result[kind] = (common / known[:, 0].square().mean().clamp(min=1e-12)).clamp(0, 1)
    return result
