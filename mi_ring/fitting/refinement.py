"""Decides which unknowns of calibration a fit refines."""

import math
from typing import NamedTuple

import numpy as np

from mi_ring.calibration.calibration import OPTIONS
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.problem import Problem
from mi_ring.scene.assembly import has_table, lamps_of
from mi_ring.scene.lights import shared_emitters

#: What `--refine auto` stands for; `falloff` is added for a flash that moves with the camera and has no known cone,
#: `scale` where the lights' intensities cannot be true. Of a flash it refines the place beside the lens: a flash
#: farther ahead looks like a darker surface. Not `curve`: it looks like another reflectance, too.
AUTO = "light", "power", "ambient"
#: What is refined under each kind of unknown light.
UNDER_UNKNOWN_LIGHT = {"environment": {"ambient"}, "turntable": {"ambient"}, "lamps": {"light", "ambient", "lamps"}}
FEWEST = 10  #: photographs that tell a cone: fewer do not show how much their errors differ
START = 0.2  #: progress of the fit at which refinement begins


class Refinement(NamedTuple):
    """What a fit refines, and how bright the object and the lights are before the first iteration."""

    reflectance: float  #: of the object, according to the lights' intensities
    refined: tuple[str, ...]  #: options of `--refine`
    power: float  #: initial factor of all lights' strengths

    @classmethod
    def of(cls, problem: Problem, center: np.ndarray) -> "Refinement":
        """Decide from the settings and the capture what to refine. `center` (3,): centre of the object [scene units].

        `power` of the result is 1, unless the lights' strengths are refined and those of the capture are impossibly
        weak. It is then the factor of all lights that gives the object a usual albedo.
        """
        reflectance = problem.seen.reflectance(center, problem.exposure)
        albedo = math.pi * reflectance
        rig = Rig(problem.capture, center, problem.exposure)
        open_cone = rig.open_cone and len(problem.fitted) >= FEWEST
        refined = refined_of(problem.seen, problem.config, problem.lighting.kind, albedo, open_cone)
        return cls(reflectance, refined, albedo / ALBEDO if "scale" in refined and albedo >= 1 else 1.0)

    @property
    def albedo(self) -> float:
        """Albedo of the object, computed from the lights' intensities. If it exceeds 1, the intensities are wrong."""
        return math.pi * self.reflectance


def refined_of(capture: Capture, config: Config, light: str, albedo: float, open_cone: bool) -> tuple[str, ...]:
    """List the values of `--refine` that a fit refines, in a fixed order. The capture decides what `auto` means.

    `light`: kind of the light, such as "capture" or "lamps". `albedo`: of the object, computed from the lights'
    strengths. `open_cone`: photographs can tell the cone of the flash, and the capture does not tell it.
    """
    names: set[str] = set(config.refine)
    auto = "auto" in names and not capture.known
    unknown = UNDER_UNKNOWN_LIGHT.get(light)
    if unknown or capture.photographs.dark:
        names |= unknown or ({"ambient"} if auto and not shared_emitters(capture.scene) else set())
        names |= {"gain"} if auto and "power" not in names else set()
    elif auto:
        subtracted = {"ambient"} if all(shot.files.ambient for shot in capture.shots) else set()
        names |= {"falloff"} if open_cone and "vignetting" not in names else set()
        names |= {*AUTO} - subtracted - ({"power"} if "gain" in names else set())
        if config.indirect and albedo >= 1 and not has_table(capture.scene):
            names.add("scale")
    return tuple(name for name in OPTIONS if name in names and (name != "lamps" or lamps_of(capture.scene)))
