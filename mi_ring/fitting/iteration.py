"""One iteration of a fit, as terms of the loss, solvers and callbacks see it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from mi_ring.capture.capture import Capture, Observation
from mi_ring.fitting import renamed
from mi_ring.fitting.config import Config
from mi_ring.fitting.model import Model
from mi_ring.fitting.renderer import Prediction
from mi_ring.fitting.sampler import Batch
from mi_ring.fitting.schedule import Schedule, Stage


@dataclass(frozen=True)
class Context:
    """What terms of the loss and solvers may read, besides the batch, the observation and the prediction."""

    config: Config
    capture: Capture
    model: Model
    schedule: Schedule
    exposure: float  #: mean radiance of the object
    one_material: bool  #: Is the object probably of one material?
    regulariser: float  #: strength of the regulariser, a factor of its weight
    autocast: Callable[[], Any]  #: context for products of the networks


@dataclass
class Iteration(renamed.Renamed):
    """One iteration: its batch, the observed photographs, the prediction and the loss.

    Do not keep it: it uses much memory.
    """

    batch: Batch
    observation: Observation
    prediction: Prediction
    context: Context
    loss: float = 0.0  #: the weighted sum of the terms
    terms: dict[str, float] = field(default_factory=dict)  #: unweighted, by name
    weights: dict[str, float] = field(default_factory=dict)  #: of the terms, in this iteration

    RENAMED = renamed.ITERATION

    @property
    def number(self) -> int:
        """Number of the iteration, from 1."""
        return self.batch.number

    @property
    def progress(self) -> float:
        """Share of the iterations that shape the surface, in [0, 1], that are done before this one."""
        return self.batch.progress

    @property
    def stage(self) -> Stage:
        """The stage of the schedule that this iteration belongs to."""
        return self.batch.stage

    def object_pixels(self) -> Tensor:
        """Find pixels (n, H, W) bool that show only the object, by the prediction and, if there is one, the mask."""
        return self.observation.surely(self.prediction.coverage.detach())

    def counted(self) -> Tensor | None:
        """Pixels (n, H, W) bool that the colour loss compares. None: all pixels.

        In a lit room they are the object's pixels, because the background is bright there.
        """
        return self.object_pixels() if self.context.capture.lit_room else None

    def outline_blur(self) -> float:
        """Standard deviation [px] of the Gaussian that blurs silhouettes in the mask loss."""
        return self.context.schedule.outline_blur(self.progress, self.batch.size[0] / self.batch.scale)

    @torch.no_grad()
    def unexplained(self) -> float:
        """Sum of absolute errors on the object, divided by the sum of observed radiance there; NaN if that is 0."""
        pixels = self.object_pixels()
        error = (self.prediction.rgb - self.observation.rgb)[pixels]
        error = torch.where(self.observation.clipped[pixels], error.clamp(max=0), error)
        wrong, light = self.batch.share.sum(torch.stack([error.abs().sum(), self.observation.rgb[pixels].sum()]))
        return float(wrong / light)
