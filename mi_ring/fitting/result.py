"""From the parts of a fit to its `FitResult`."""

from collections.abc import Sequence

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.fitting.course import Course
from mi_ring.fitting.covariance import covariance
from mi_ring.fitting.model import Model
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.fitting.schedule import Schedule
from mi_ring.fitting.summary import summary
from mi_ring.output.fit_result import FitResult
from mi_ring.scene.assembly import lamp_lights

SAME = 1e-5  #: relative difference below which room light is nothing but the scene's own environment


def result_of(
    problem: Problem, model: Model, renderer: Renderer, schedule: Schedule, course: Course, capture: Capture,
    terms: Sequence[str], unexplained: float,
) -> FitResult:  # fmt: skip
    """`capture`: with the masks that the fit ends with. `terms`: names of the loss's terms."""
    calibration, ring, refined = model.calibration, model.ring, model.calibrated(capture)
    record = None
    if calibration:
        record = summary(problem, model, refined, covariance(problem, model, renderer, ring.subdivisions))
    found = calibration is not None
    return FitResult(
        ring, renderer.showing(model, ring.subdivisions), capture, refined, problem.config.settings(), course.log,
        terms, [stage.first for stage in schedule.stages], problem.config.widths[-1], course.iteration,
        schedule.iterations, course.seconds, unexplained, record, problem.held_out, course.validation,
        list(course.masks), room_of(problem, refined) if found else None,
        calibration.room.frames if calibration and problem.lighting.kind != "capture" else None,
        lamp_lights(refined.scene) if calibration and "lamps" in calibration.refined else None,
    )  # fmt: skip


def room_of(problem: Problem, refined: Capture) -> np.ndarray | None:
    """(BASIS, 3) room light without the environment that the scene file has."""
    room = refined.room
    if room is None or problem.environment is None:
        return room
    own = room - problem.environment
    return own if np.abs(own).max() > SAME * np.abs(problem.environment).max() else None
