"""Decides which unknowns of calibration a fit refines."""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from mi_ring.calibration.calibration import OPTIONS
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.problem import Problem
from mi_ring.image_headers import encoding_of
from mi_ring.scene.assembly import has_table, lamps_of
from mi_ring.scene.lights import shared_emitters

#: What `--refine auto` stands for; `falloff` is added for a flash that moves with the camera and has no known cone,
#: `contrast` for sRGB files of an unknown camera, `scale` where the lights' intensities cannot be true. Of a flash it
#: refines the place beside the lens: a flash farther ahead looks like a darker surface. Not `curve`: it looks like
#: another reflectance, too.
AUTO = "light", "power", "ambient"
#: What is refined under each kind of unknown light.
UNDER_UNKNOWN_LIGHT = {"environment": {"ambient"}, "turntable": {"ambient"}, "lamps": {"light", "ambient", "lamps"}}
FEWEST = 10  #: photographs that tell cone and contrast: fewer do not show how much their errors differ
TOLD_BY_MANY = {"falloff", "contrast"}  #: these options need that many
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

        Raises InputError if `falloff` or `contrast` is asked for with fewer than 10 photographs.
        """
        reflectance = problem.seen.reflectance(center, problem.exposure)
        albedo, capture = math.pi * reflectance, problem.capture
        several = len(problem.fitted) >= FEWEST
        if asked := TOLD_BY_MANY & {*problem.config.refine} if not several else None:
            raise InputError(f"{capture.path}: --refine {min(asked)}: the fit has {len(problem.fitted)} photographs, "
                             f"which do not tell it; leave it out, or give at least {FEWEST}")  # fmt: skip
        told = {"falloff"} if several and Rig(capture, center, problem.exposure).open_cone else set()
        told |= {"contrast"} if several and has_open_curve(capture) else set()
        refined = refined_of(problem.seen, problem.config, problem.lighting.kind, albedo, told)
        return cls(reflectance, refined, albedo / ALBEDO if "scale" in refined and albedo >= 1 else 1.0)

    @property
    def albedo(self) -> float:
        """Albedo of the object, computed from the lights' intensities. If it exceeds 1, the intensities are wrong."""
        return math.pi * self.reflectance


def has_open_curve(capture: Capture) -> bool:
    """Return True if photographs are files in sRGB, and the scene file does not tell their camera's curve."""
    shots, file = capture.shots, capture.shots[0].files.filename
    told = any(shot.response.gamma != 1 or shot.response.contrast != 1 or shot.files.ambient for shot in shots)
    encoding = shots[0].encoding
    return not told and file is not None and (encoding_of(file) if encoding == "auto" else encoding) == "srgb"


def refined_of(
    capture: Capture, config: Config, light: str, albedo: float, told: Collection[str] = ()
) -> tuple[str, ...]:
    """List the values of `--refine` that a fit refines, in a fixed order. The capture decides what `auto` means.

    `light`: kind of the light, such as "capture" or "lamps". `albedo`: of the object, computed from the lights'
    strengths. `told`: those of `falloff` and `contrast` that the photographs can tell and the scene file does not.
    """
    names: set[str] = set(config.refine)
    auto = "auto" in names and not capture.known
    unknown = UNDER_UNKNOWN_LIGHT.get(light)
    if unknown or capture.photographs.dark:
        names |= unknown or ({"ambient"} if auto and not shared_emitters(capture.scene) else set())
        names |= {"gain"} if auto and "power" not in names else set()
    elif auto:
        subtracted = {"ambient"} if all(shot.files.ambient for shot in capture.shots) else set()
        names |= {*told} - ({"falloff"} if "vignetting" in names else set())
        names |= {*AUTO} - subtracted - ({"power"} if "gain" in names else set())
        if config.indirect and albedo >= 1 and not has_table(capture.scene):
            names.add("scale")
    return tuple(name for name in OPTIONS if name in names and (name != "lamps" or lamps_of(capture.scene)))
