"""One iteration of a fit, as the terms of its loss, callbacks and loops see it."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Observation
from mi_ring.fitting.processes import Share
from mi_ring.fitting.schedule import Stage
from mi_ring.rendering.photographs import Photographs

if TYPE_CHECKING:
    from mi_ring.fitting.fit import Fit


@dataclass
class Iteration:
    """What an iteration has sampled, predicted and weighed. Tensors are attached while the terms are computed.

    It holds its pictures: keep numbers, not iterations. V vertices; n photographs of H × W pixels, those of the capture
    box-filtered to the stage's width.
    """

    fit: "Fit"
    number: int  #: from 1
    progress: float  #: share of the iterations that shape the surface before it, in [0, 1]; 1: it stands still
    stage: Stage
    s: Tensor  #: (V, 3) domain points
    faces: np.ndarray  #: (F, 3)
    vertices: Tensor  #: (V, 3) [scene units]
    material: dict[str, Tensor]  #: parameters of the BSDF by name, (V, 3) or (V,)
    index: np.ndarray  #: (n,) which photographs
    scale: int  #: how many pixels of the files are one of theirs, across
    photographs: Photographs  #: their cameras and lights
    observed: Tensor  #: (n, H, W, 3) linear radiance
    clipped: Tensor  #: (n, H, W, 3) bool: the scene is at least as bright as observed
    mask: Tensor  #: (n, H, W) the object's coverage by the masks, in [0, 1]
    masked: Tensor  #: (n,) bool: which photographs have a mask
    valid: Tensor | None  #: (n, H, W) bool: which pixels say something; None: all do
    predicted: Tensor  #: (n, H, W, 3) linear radiance
    coverage: Tensor  #: (n, H, W) the object's coverage as predicted, in [0, 1]
    everything: np.ndarray  #: (N,) which photographs all processes together see
    share: Share  #: what this one has of them
    loss: float = 0.0  #: the weighted sum of the terms
    terms: dict[str, float] = field(default_factory=dict)  #: unweighted, by name
    weights: dict[str, float] = field(default_factory=dict)  #: of the terms, in this iteration

    def entry(self) -> dict:
        """A line of the log. The terms of the loss, under their own names, are unweighted."""
        fit = self.fit
        return {
            "iteration": self.number, "seconds": round(fit.seconds, 3), "loss": self.loss, **self.terms,
            "weights": self.weights, "learning_rate": fit.optimizers[0].param_groups[0]["lr"],
            "stage": fit.stages.index(self.stage) + 1, "vertices": len(self.vertices),
            "crossing": fit.restraint.crossing, "unexplained": fit.restraint.unexplained,
        }  # fmt: skip

    def surely(self) -> Tensor:
        """(n, H, W) bool: where pixels are wholly object, by their masks, if they have any, and as predicted."""
        seen = Observation(self.observed, self.clipped, self.mask, self.masked, self.valid)
        return seen.surely(self.coverage.detach())

    def unexplained(self) -> float:
        """How much of the object's light is not as predicted, as a share of it; NaN where no light of it is seen."""
        with torch.no_grad():
            surely = self.surely()
            error = (self.predicted - self.observed)[surely]
            error = torch.where(self.clipped[surely], error.clamp(max=0), error)
            wrong, light = self.share.sum(torch.stack([error.abs().sum(), self.observed[surely].sum()]))
            return float(wrong / light)

    def detach(self) -> None:
        """Let go of the graph, when the backward pass is done."""
        self.vertices, self.predicted, self.coverage = (
            tensor.detach() for tensor in (self.vertices, self.predicted, self.coverage)
        )
        self.material = {name: value.detach() for name, value in self.material.items()}
