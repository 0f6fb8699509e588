"""A fit: sample, deform, render, compare, step (paper, section 3)."""

import copy
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import recompute_normals
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.course import Course
from mi_ring.fitting.iteration import Context, Iteration
from mi_ring.fitting.lighting import AMBIGUOUS, Lighting
from mi_ring.fitting.mask_refinement import REFINED_AT, Masks, find_masks, with_masks
from mi_ring.fitting.model import Model
from mi_ring.fitting.optimisation import Optimisation
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.regulariser_strength import RegulariserStrength
from mi_ring.fitting.renderer import Renderer
from mi_ring.fitting.result import result_of
from mi_ring.fitting.sampler import Sampler
from mi_ring.fitting.schedule import Schedule
from mi_ring.fitting.start import require_settings, starting_ring
from mi_ring.fitting.terms import Loss, TermLike
from mi_ring.fitting.validation import validate
from mi_ring.geometry.domain import Sphere
from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.shape_net import Flow
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_of, ring_state
from mi_ring.output import results
from mi_ring.output.fit_result import FitResult
from mi_ring.rendering import bridge
from mi_ring.system.machine import release_memory

LOG_EVERY = 5  #: iterations between entries of the log
PARTS = "sampler", "renderer", "regulariser", "optimisation"  #: parts of a fit with a state of their own


class Fit:
    """A reconstruction in progress. ::

        for it in Fit(capture, Config.preset("fast")):
            print(it.number, it.loss)

    `networks`: (Shape-Net, BRDF-Net) to train instead of the paper's, see `Flow` and `MaterialNet`. `terms`: of the
    loss, by name, each a `Term` or a function of an `Iteration`; default: `default_terms`. `callbacks` are called with
    each `Iteration` when it is done. `lighting`: what `choose_lighting` returned; needed unless the scene's own lights
    are used. `state`: what `state()` of an interrupted fit returned, to continue it.

    A deterministic fit needs `mi_ring.system.machine.set_threads(1)` beforehand.

    Raises InputError if capture, settings, terms and networks do not go together.
    """

    def __init__(
        self, capture: Capture, config: Config | None = None, networks: tuple[Flow, MaterialNet] | None = None,
        terms: Mapping[str, TermLike] | None = None, callbacks: Sequence[Callable[[Iteration], object]] = (),
        state: dict[str, Any] | None = None, lighting: Lighting | None = None,
    ) -> None:  # fmt: skip
        config = config or Config()
        self.loss = Loss(terms, config.weights)
        self.callbacks = list(callbacks)
        require_settings(capture, config)
        if state and networks:
            raise InputError("networks: those of the state are taken; give one of the two")
        lighting = Lighting(*state["lighting"]) if state else lighting or Lighting.of(capture, config)
        if config.deterministic:
            recompute_normals(capture.scene)
        self.problem = problem = Problem.of(capture, config, lighting)
        torch.manual_seed(config.seed)
        ring = ring_of(state["ring"]) if state else starting_ring(problem, networks)
        if self.loss.needs_velocity and not hasattr(ring.shape_net, "velocity"):
            raise InputError(f"networks: {type(ring.shape_net).__name__}: has no velocity, which the term of that "
                             "name needs; give it one, or the term the weight 0")  # fmt: skip
        self.model = Model(problem, ring.to(problem.device))
        near = not isinstance(ring.domain, Sphere)  # a hull or a mesh
        settling = lighting.kind in AMBIGUOUS and self.loss.weight("settling") > 0
        self.plan: Callable[[Config], Schedule] = lambda config: Schedule.of(config, near, settling)
        self.schedule = self.plan(config)
        self.sampler, self.renderer = Sampler(problem), Renderer(problem, ring)
        self.optimisation = Optimisation(problem, self.model, near, self.loss.terms)
        self.regulariser = RegulariserStrength()
        self.capture = problem.capture  #: with the masks that are used now
        self.course = Course()
        if state:
            self.restore(state)
        self.fix_surface()

    def __iter__(self) -> Iterator[Iteration]:
        """The iterations that are left, each when it is done."""
        while self.course.iteration < self.iterations:
            yield self.step()

    def run(self) -> FittedObject:
        """Run all iterations that are left. Returns the fitted object."""
        for _ in self:
            pass
        return self.ring

    def step(self) -> Iteration:
        """One iteration. Raises InputError if the fit diverges, RuntimeError if no iteration is left."""
        if self.course.iteration >= self.iterations:
            raise RuntimeError(f"the fit is at its end: {self.iterations} iterations are done")
        started = time.perf_counter()
        self.refine_masks()
        batch = self.sampler.draw(self.problem, self.schedule, self.ring.domain, self.course.iteration)
        observation = self.sampler.observe(self.problem, self.capture, batch)
        prediction = self.renderer.predict(self.problem, self.model, batch)
        it = Iteration(batch, observation, prediction, self.context())
        loss = self.loss(it)
        self.optimisation.step(loss, it)
        self.model.update_albedo()
        it.prediction = prediction.detached()
        self.regulariser.note(it)
        self.course.iteration += 1
        self.fix_surface()
        self.course.seconds += time.perf_counter() - started
        self.finish(it)
        return it

    def finish(self, it: Iteration) -> None:
        """Validate after the last iteration, log, and call the callbacks."""
        last = it.number == self.iterations
        if it.number == it.stage.last:
            release_memory()  # what comes next has other sizes
        if last and len(self.problem.held_out):
            self.course.validation = validate(self.problem, self.model, self.renderer, self.final_level)
        if it.number % LOG_EVERY == 0 or last:
            self.course.log.append(self.log_entry(it))
        for callback in self.callbacks:
            callback(it)

    def replan(self, config: Config) -> None:
        """Change stages, iterations, level or regulariser of a fit that has not begun."""
        self.problem = self.optimisation.problem = replace(self.problem, config=config)
        self.ring.subdivisions, self.schedule = config.subdivisions, self.plan(config)

    def context(self) -> Context:
        """What terms and solvers may know at this iteration."""
        config, problem = self.problem.config, self.problem
        return Context(config, self.capture, self.model, self.schedule, problem.exposure, problem.lighting.plain > 0,
                       self.regulariser.strength(config.velocity_decay), self.renderer.autocast)  # fmt: skip

    def log_entry(self, it: Iteration) -> dict[str, Any]:
        """A line of the log. Terms of the loss are unweighted."""
        return {
            "iteration": it.number, "seconds": round(self.course.seconds, 3), "loss": it.loss, **it.terms,
            "weights": it.weights, "learning_rate": self.optimisation.learning_rate,
            "stage": self.schedule.stages.index(it.stage) + 1, "vertices": len(it.batch.points),
            "crossing": self.regulariser.crossing, "unexplained": self.regulariser.unexplained,
        }  # fmt: skip

    def fix_surface(self) -> None:
        """Fix the surface during the settling stage, and forget the room's light at its start."""
        last, calibration = self.schedule.stages[-1], self.model.calibration
        self.model.fix_surface(last.settles and last.first <= self.course.iteration < last.last)
        if last.settles and self.course.iteration == last.first and calibration:
            calibration.room.forget()
            self.optimisation.guard.keep()  # so that a retreat does not bring it back

    def refine_masks(self) -> None:
        """Find masks anew when that is due."""
        due = [int(progress * self.schedule.shaping) for progress in REFINED_AT]
        if "masks" in self.problem.config.refine and self.course.iteration in due:
            parts = self.capture, self.problem, self.model, self.renderer, self.final_level
            self.use_masks(self.problem.processes.on_first(lambda: find_masks(*parts)))

    def use_masks(self, masks: Masks) -> None:
        """Continue with these masks in place of the capture's."""
        if masks:
            self.course.masks = self.course.masks | masks
            self.capture = with_masks(self.capture, masks)

    @property
    def ring(self) -> FittedObject:
        """The fitted object."""
        return self.model.ring

    @property
    def iteration(self) -> int:
        """Number of iterations that are done."""
        return self.course.iteration

    @property
    def iterations(self) -> int:
        """Number of all iterations."""
        return self.schedule.iterations

    @property
    def final_level(self) -> int:
        """Level of the icosphere in the last stage."""
        return self.schedule.stages[-1].level

    def calibrated(self) -> Capture:
        """The capture with cameras, lights and response as refined so far."""
        return self.model.calibrated(self.capture)

    def preview(self, k: int = 0, width: int = 256, level: int = 4, spp: int = 4) -> np.ndarray:
        """The current prediction of photograph `k`: (H, W, 3) linear radiance, at most `width` pixels wide.

        `level`: of the surface. Not to be called from within a term of the loss: the renderer keeps the picture of the
        iteration for its backward pass.
        """
        capture = self.calibrated()
        photograph = capture.photograph(k, -(-capture.sensors[k].size[0] // width))
        surface = self.renderer.showing(self.model, level)
        rgb, _ = bridge.draw(surface, photograph, spp, shadows=capture.shadows, indirect=self.ring.indirect)
        return rgb[0].numpy()

    def result(self) -> FitResult:
        """What the results are made of: `mi_ring.output` writes them."""
        return result_of(self.problem, self.model, self.renderer, self.schedule, self.course, self.capture,
                         list(self.loss.terms), self.regulariser.unexplained)  # fmt: skip

    def save(self, folder: str | Path) -> None:
        """Write `ring.pt`, `mesh.ply`, `scene.xml`, `report.html` and the others into a folder.

        Earlier results there are moved aside. Raises InputError if a file cannot be written, ValueError for networks
        that are not registered.
        """
        results.save(Path(folder), self.result())

    def state(self) -> dict[str, Any]:
        """What another `Fit` of the same capture needs to continue, for `torch.save`."""
        calibration = self.model.calibration
        return copy.deepcopy({  # the next iteration changes it
            "ring": ring_state(self.ring, self.problem.config.settings()), "lighting": tuple(self.problem.lighting),
            "calibration": calibration and calibration.state_dict(), "course": vars(self.course),
            **{name: getattr(self, name).state() for name in PARTS},
        })  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the `state()` of a fit with the same ring and lighting."""
        state = copy.deepcopy(state)
        if self.model.calibration:
            self.model.calibration.load_state_dict(state["calibration"])
        for name in PARTS:
            getattr(self, name).restore(state[name])
        self.course = Course(**state["course"])
        self.use_masks(self.course.masks)
