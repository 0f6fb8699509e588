"""Decides which unknowns of calibration a fit refines."""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from mi_ring.calibration.calibration import OPTIONS, Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.capture.decoding import has_open_curve
from mi_ring.capture.pairs import camera_numbers, varies_in_exposure
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.problem import Problem
from mi_ring.scene.assembly import has_table, lamps_of
from mi_ring.scene.lights import shared_emitters

#: What `--refine auto` stands for. With enough photographs, `cameras` are added, `falloff` for a flash that moves with
#: the camera and has no known cone, and `contrast` for sRGB files of an unknown camera. `scale` is added where the
#: lights' intensities cannot be true. Gradients move a flash only beside the lens: one farther ahead looks
#: like a darker surface. Not `curve`: it looks like another reflectance, too.
AUTO = "light", "power", "ambient"
#: What is refined under each kind of unknown light.
UNDER_UNKNOWN_LIGHT = {"environment": {"ambient"}, "turntable": {"ambient"}, "lamps": {"light", "ambient", "lamps"}}
FEWEST = 10  #: photographs that tell cone, contrast and poses: fewer do not show how much their errors differ
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

        Raises InputError if `falloff` or `contrast` is asked for with fewer than 10 photographs, or `cameras` with
        terms `rgb` or `mask` of the loss that are not the default ones: the solver of poses needs their derivatives.
        """
        reflectance = problem.seen.reflectance(center, problem.exposure)
        albedo, capture, config = math.pi * reflectance, problem.capture, problem.config
        asked, count = TOLD_BY_MANY & {*config.refine}, len(problem.seen.photographs.mainly)
        several = count >= FEWEST
        if asked and not several:
            raise InputError(f"{capture.path}: --refine {min(asked)}: the fit has {count} photographs with a light of "
                             f"their own, which do not tell it; leave it out, or give at least {FEWEST}")  # fmt: skip
        if "cameras" in config.refine and not problem.usual_loss:
            raise InputError("terms: rgb, mask: must be the default ones for --refine cameras, which needs their "
                             "derivatives; give your terms other names")  # fmt: skip
        open_unknowns: set[str] = set()
        if several and "auto" in config.refine and not capture.known:
            open_unknowns |= {"falloff"} if Rig(capture, center, problem.exposure).open_cone else set()
            open_unknowns |= {"contrast"} if has_open_curve(capture.shots) else set()
            open_unknowns |= {"cameras"} if problem.usual_loss and cameras_differ(problem.seen) else set()
        refined = refined_of(problem.seen, config, problem.lighting.kind, albedo, open_unknowns)
        return cls(reflectance, refined, albedo / ALBEDO if "scale" in refined and albedo >= 1 else 1.0)

    @property
    def albedo(self) -> float:
        """Albedo of the object, computed from the lights' intensities. If it exceeds 1, the intensities are wrong."""
        return math.pi * self.reflectance


def cameras_differ(capture: Capture) -> bool:
    """Test whether a capture has at least 10 cameras, all different, except that a pair shares one."""
    cameras = {shot.camera.to_world.tobytes() for shot in capture.shots}
    return len(cameras) >= FEWEST and len(cameras) == len({*camera_numbers(capture).tolist()})


def refined_of(
    capture: Capture, config: Config, light: str, albedo: float, open_unknowns: Collection[str] = ()
) -> tuple[str, ...]:
    """List the values of `--refine` that a fit refines, in a fixed order. The capture decides what `auto` means.

    `light`: kind of the light, such as "capture" or "lamps". `albedo`: of the object, computed from the lights'
    strengths. `open_unknowns`: those of `cameras`, `falloff` and `contrast` that photographs can tell better than the
    scene file.
    """
    names: set[str] = set(config.refine)
    auto = "auto" in names and not capture.known
    unknown = UNDER_UNKNOWN_LIGHT.get(light)
    if unknown or capture.photographs.dark:
        names |= unknown or ({"ambient"} if auto and not shared_emitters(capture.scene) else set())
        names |= {"gain"} if auto and "power" not in names else set()
    elif auto:
        subtracted = set() if capture.photographs.in_room.any() else {"ambient"}
        names |= {*open_unknowns} - ({"falloff"} if "vignetting" in names else set())
        names |= {*AUTO} - subtracted - ({"power"} if "gain" in names else set())
        if config.indirect and albedo >= 1 and not has_table(capture.scene):
            names.add("scale")
        names |= {"gain"} if varies_in_exposure(capture) else set()
    given = capture.lobes is not None or (capture.room is not None and capture.room.any())
    if capture.photographs.mixed and not (given or shared_emitters(capture.scene)):
        names.add("ambient")  # nothing else lights some of the photographs
    return tuple(name for name in OPTIONS if name in names and (name != "lamps" or lamps_of(capture.scene)))


def finds_small_lights(calibration: Calibration, config: Config) -> bool:
    """Test whether a fit finds lobes: if the settings allow it, and the only light is an unknown room."""
    alone = calibration.room.alone and not calibration.rig.lit.any()
    return config.small_lights > 0 and alone and "ambient" in calibration.refined
