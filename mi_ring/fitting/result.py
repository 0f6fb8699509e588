"""Collects the results of a fit."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.fitting.course import Course
from mi_ring.fitting.fine_texture import sharpened
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.fitting.schedule import Schedule
from mi_ring.fitting.summary import summary
from mi_ring.fitting.validation import texture_helps
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.output.fit_result import FitResult
from mi_ring.scene.assembly import lamp_lights
from mi_ring.system.command import interrupted
from mi_ring.system.machine import release_memory

SAME = 1e-5  #: relative difference below which room light is nothing but the scene's own environment


def result_of(
    problem: Problem, model: Model, renderer: Renderer, schedule: Schedule, course: Course, capture: Capture,
    terms: Sequence[str], unexplained: float, textured: FittedObject | None = None,
) -> FitResult:  # fmt: skip
    """Collect the results of a fit, from which files are written later. Writes no files, but evaluates the surface.

    At the end of a fit with details of colour, the material first gets a texture from the photographs. It gets none if
    held-out photographs show that details or the texture are wrong. Before, the caches of `capture` are emptied.

    `capture`: the capture with its final masks. `terms`: names of the terms of the loss. `unexplained`: share of the
    observed light that recent predictions do not explain. `textured`: the object with texture, if it is known already.
    """
    calibration, ring, refined = model.calibration, textured or model.ring, model.calibrated(capture)
    started = time.perf_counter()

    def summarised() -> dict[str, Any]:
        masked = replace(problem, capture=capture)
        return summary(problem, model, refined, JointEquations.of(masked, model, renderer, ring.subdivisions))

    # Otherwise the room's axes are those of the scene file.
    found_alone = problem.lighting.kind != "capture" or problem.capture.photographs.mixed
    detailed = schedule.stages[-1].detail and "detail" not in course.validation.get("put_back", [])
    if not textured and course.iteration == schedule.iterations and detailed and problem.config.detail != "shape":
        capture.clear_caches()
        release_memory()  # of the last stage
        try:
            surface = renderer.show(model, ring.subdivisions)
            width = max(problem.config.widths)
            sharp = sharpened(problem.given, capture, refined, surface, ring, problem.fitted, width)
            if sharp is ring or texture_helps(problem, refined, surface, ring, sharp):
                ring = sharp
            else:
                print("The texture is left out: it does not improve the prediction of held-out photographs")
        except Exception as error:  # a file has gone, memory is full; all else can be saved
            if interrupted():
                raise
            release_memory()
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            print(f"There is no texture: {kind}{error}")
        course.seconds += time.perf_counter() - started
    return FitResult(
        ring=ring,
        surface=renderer.show(model, ring.subdivisions),
        given=problem.given,
        before=capture,
        capture=refined,
        settings=problem.config.settings(),
        log=course.log,
        terms=terms,
        stage_starts=[stage.first for stage in schedule.stages],
        width=problem.config.widths[-1],
        iteration=course.iteration,
        iterations=schedule.iterations,
        seconds=course.seconds,
        unexplained=unexplained,
        summary=summarised if calibration else None,
        held_out=problem.held_out,
        validation=course.validation,
        masks=list(course.masks),
        room=room_of(problem, refined) if calibration else None,
        lobes=refined.lobes if calibration else None,
        room_frames=calibration.room.frames if calibration and found_alone else None,
        lamps=lamp_lights(refined.scene) if calibration and "lamps" in calibration.refined else None,
    )


def room_of(problem: Problem, refined: Capture) -> np.ndarray | None:
    """Return the room light that the fit has found, as spherical harmonics (BASIS, 3); None if there is no such light.

    `refined`: the calibrated capture. The light of the scene's own environment map is subtracted.
    """
    room = refined.room
    if room is None or problem.environment is None:
        return room
    own = room - problem.environment
    return own if np.abs(own).max() > SAME * np.abs(problem.environment).max() else None
