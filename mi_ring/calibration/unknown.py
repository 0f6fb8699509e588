"""An unknown of calibration: the base class, and what a fit has found."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from torch import Tensor

from mi_ring.calibration.light_tensors import LightTensors
from mi_ring.calibration.rig import Estimate, Rig
from mi_ring.capture.capture import Capture
from mi_ring.scene.shot import Shot


class Found(NamedTuple):
    """The capture before and after a fit, and other values from which unknowns describe their results."""

    rig: Rig
    before: Capture  #: as the capture says
    after: Capture  #: as found
    power: float  #: factor of all lights' strengths that was found
    lamps: LightTensors  #: the scene's own lamps as found
    several: bool  #: Are the photographs' lights the first of several unknown lamps?

    def means(self, of: Callable[[Shot], float]) -> tuple[float, float]:
        """Return the mean of the number `of(shot)` over all photographs: (before the fit, after the fit).

        Photographs without a light of their own are left out if there are others.
        """
        sides = ([side.shots[k] for k in self.rig.mainly] for side in (self.before, self.after))
        before, after = (float(np.mean([of(shot) for shot in shots])) for shots in sides)
        return before, after


@dataclass(frozen=True)
class Unknown(ABC):
    """Base class of the unknowns of calibration.

    It has `components` numbers per photograph, camera, lens, light or lamp, or for the whole capture; `per` says which.
    """

    name: str
    option: str  #: of `--refine`
    width: float  #: standard deviation of the prior, in the unknown's own unit
    per: Literal["capture", "photograph", "camera", "lens", "light", "lamp"]
    components: int = 1
    own_lights: bool = False  #: Is it a property of the photographs' own lights?

    #: What it changes in a picture. view: how things are seen and lit; recording: only how that is recorded; light: the
    #: photograph's own light by a factor of each colour; gain: the same of all that is recorded; indirect: only that.
    changes: ClassVar[Literal["view", "recording", "light", "gain", "indirect"]] = "view"
    #: Standard deviation, in the unknown's own unit, that photographs cannot reduce: another reflectance than those of
    #: the model looks like such a change. Measured by `benchmarks/coverage.py`.
    doubt: ClassVar[float] = 0.0
    solved: ClassVar[bool] = False  #: Has it a solver in `fitting`? Others follow their gradient by Adam.

    def shape(self, rig: Rig) -> tuple[int, ...]:
        """Return the shape of the parameter: (number of photographs, cameras, lenses, lights or lamps; components).

        The first number is missing if `per` is "capture". The second is missing if there is one component.
        """
        several = () if self.per == "capture" else (rig.count(self.per),)
        return several + (self.components,) * (self.components > 1)

    def width_for(self, rig: Rig) -> float:
        """Return the standard deviation of the prior for this rig, in the unknown's own unit."""
        return self.width

    def doubt_for(self, rig: Rig) -> float | np.ndarray:
        """Return the `doubt` for this rig: one number, or one for each component."""
        return self.doubt

    def rows(self, rig: Rig, index: np.ndarray) -> list[np.ndarray]:
        """Find the rows of the parameter that affect the photographs `index` (n,).

        Returns a list of arrays (n,), each with one row number per photograph. For an unknown of lamps, the list has
        one array for each lamp, because all lamps light every photograph. For all other unknowns it has one array.
        """
        if self.per == "lamp":  # all lamps light all photographs
            return [np.full_like(index, k) for k in range(rig.count("lamp"))]
        numbers = {"camera": rig.camera, "lens": rig.lens, "light": rig.place}
        if self.per in numbers:
            return [numbers[self.per][index].numpy()]
        return [index if self.per == "photograph" else np.zeros_like(index)]

    def concerns(self, rig: Rig, lit: bool) -> bool:
        """Test whether it changes photographs that have a light of their own (`lit`), or those that have none."""
        return lit or not (self.own_lights and rig.mixed)

    @property
    def single(self) -> bool:
        """True if it is of single photographs, or of the cameras of single photographs."""
        return self.per in ("photograph", "camera")

    @abstractmethod
    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        """Return the estimate `now`, changed by this unknown. `value`: its current value, in the unknown's own unit."""

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any] | None:
        """Describe the result of the fit: (meaning in words, value before the fit, value after, standard deviation).

        Returns None if each photograph has its own value. `value`, `std`: final value and standard deviation, in the
        unknown's own unit.
        """
        return None

    def describe_photograph(self, value: np.ndarray, std: np.ndarray, rig: Rig) -> tuple[str, Any, Any] | None:
        """Describe the result for one photograph: (key in calibration.json, value, standard deviation).

        Returns None if photographs share the unknown. `value`, `std`: final value and standard deviation for this
        photograph, in the unknown's own unit.
        """
        return None
