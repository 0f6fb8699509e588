"""The data from which the files of a fit are written."""

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering.surface import Surface
from mi_ring.scene.lights import Light
from mi_ring.scene.lobes import Lobes


@dataclass(frozen=True)
class FitResult:
    """The data from which the results of a fit are written.

    The fit changes these objects when it continues. So write the results first.
    """

    ring: FittedObject
    surface: Surface  #: to draw the ring; see `drawn`
    given: Capture  #: the input of the fit
    before: Capture  #: the input with the fit's lights and masks, and the calibration before the fit
    capture: Capture  #: the same with the refined calibration
    settings: dict[str, Any]  #: as `Config.settings` returns them
    log: Sequence[dict[str, Any]]  #: entries of log.jsonl
    terms: Sequence[str]  #: names of the loss's terms
    stage_starts: Sequence[int]  #: first iteration of each stage
    width: int  #: largest width of the photographs in the last stage [px]
    iteration: int  #: iterations that are done
    iterations: int  #: iterations of the whole fit
    seconds: float
    unexplained: float  #: mean absolute error in the last iterations, as a share of the object's light
    summary: Callable[[], dict[str, Any]] | None  #: content of calibration.json; None if nothing was refined
    held_out: np.ndarray  #: indices of the photographs that were held out
    validation: dict[str, Any]  #: errors of the held-out photographs; empty if the fit ended early
    masks: Collection[int]  #: indices of photographs with refined masks
    room: np.ndarray | None  #: (BASIS, 3) room light for the scene file, without the scene's own environment
    room_frames: Collection[str] | None  #: axes of the room light in the scene file; None: as in the given scene
    lobes: Lobes | None  #: small lights of the room; None: there are none
    lamps: Sequence[Light] | None  #: lamps for the scene file; None: as in the given scene

    @functools.cached_property
    def calibration(self) -> dict[str, Any] | None:
        """The content of calibration.json; None if nothing was refined.

        The first access renders photographs, which takes time. So first write the files that do not need it.
        """
        return self.summary and self.summary()

    def drawn(self, level: int) -> Surface:
        """Set `surface` to the fitted mesh of this level, which has about 10 · 4^level vertices. Returns `surface`."""
        self.surface.show(self.ring, *self.ring.domain.sample(level))
        return self.surface
