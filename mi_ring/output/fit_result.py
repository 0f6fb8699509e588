"""What the results of a fit are made of."""

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering.surface import Surface
from mi_ring.scene.lights import Light


@dataclass(frozen=True)
class FitResult:
    """A fit, finished or not, with all that its files say about it. Use it before the fit goes on: it is not a copy."""

    ring: FittedObject
    surface: Surface  #: of the ring, to draw it
    given: Capture  #: the capture as it was handed in
    before: Capture  #: the same with the fit's lights and masks, and calibration as before the fit
    capture: Capture  #: the same with calibration as refined
    settings: dict[str, Any]  #: as `Config.settings` returns them
    log: Sequence[dict[str, Any]]  #: entries of log.jsonl
    terms: Sequence[str]  #: names of the loss's terms
    stage_starts: Sequence[int]  #: first iteration of each stage
    width: int  #: largest width of the photographs in the last stage [px]
    iteration: int  #: iterations that are done
    iterations: int  #: iterations of the whole fit
    seconds: float
    unexplained: float  #: mean absolute error on the object, as a share of its light, in the last iterations
    summary: Callable[[], dict[str, Any]] | None  #: content of calibration.json; None if nothing of it was refined
    held_out: np.ndarray  #: indices of the photographs that were held out
    validation: dict[str, Any]  #: how well these are explained; empty if the fit ended early
    masks: Collection[int]  #: photographs whose masks were found anew
    room: np.ndarray | None  #: (BASIS, 3) room light for the scene file, without the scene's own environment
    room_frames: Collection[str] | None  #: axes of the room light in the scene file; None: as in the given scene
    lamps: Sequence[Light] | None  #: lamps for the scene file; None: as in the given scene

    @functools.cached_property
    def calibration(self) -> dict[str, Any] | None:
        """Content of calibration.json; None if nothing of it was refined. It takes renderings: files come first."""
        return self.summary and self.summary()

    def drawn(self, level: int) -> Surface:
        """The surface at this level of the icosphere, ready to be drawn."""
        self.surface.show(self.ring, *self.ring.domain.sample(level))
        return self.surface
