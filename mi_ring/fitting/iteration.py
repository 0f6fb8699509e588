"""One iteration of a fit: the values that terms of the loss, solvers and callbacks read."""

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
    """The state of a fit that terms of the loss and solvers may read beside an iteration's batch and prediction."""

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

    Do not store iterations: each uses much memory.
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
        """Progress of the fit before this iteration, from 0 to 1.

        It stays 1 in the last stage, when the surface is fixed.
        """
        return self.batch.progress

    @property
    def stage(self) -> Stage:
        """The stage of the schedule that this iteration belongs to."""
        return self.batch.stage

    def object_pixels(self) -> Tensor:
        """Return a boolean mask (n, H, W): True where a pixel shows only the object.

        The predicted coverage of the pixel must be above 0.99 and, if the photograph has a mask, the mask, too.
        """
        return self.observation.surely(self.prediction.coverage.detach())

    def counted(self) -> Tensor | None:
        """Return a boolean mask (n, H, W) of the pixels that the colour loss compares; None: all pixels.

        In a lit room only the object's pixels are compared, because the background is bright.
        """
        return self.object_pixels() if self.context.capture.lit_room or self.stage.detail else None

    def outline_blur(self) -> float:
        """Return the standard deviation [px] of the Gaussian that blurs silhouettes in the mask loss."""
        return self.context.schedule.outline_blur(self.progress, self.batch.size[0] / self.batch.scale)

    @torch.no_grad()
    def unexplained(self) -> float:
        """Return the share of the observed light that the prediction does not explain.

        It is the sum of absolute errors, divided by the sum of observed radiance, over pixels that show only the
        object. It is NaN if the observed radiance is 0.
        """
        pixels = self.object_pixels()
        error = (self.prediction.rgb - self.observation.rgb)[pixels]
        error = torch.where(self.observation.clipped[pixels], error.clamp(max=0), error)
        wrong, light = self.batch.share.sum(torch.stack([error.abs().sum(), self.observation.rgb[pixels].sum()]))
        return float(wrong / light)
