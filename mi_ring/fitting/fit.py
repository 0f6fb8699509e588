"""The fit. Each iteration samples, deforms, renders, compares and steps (paper, section 3)."""

import copy
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture, Observation
from mi_ring.errors import InputError
from mi_ring.fitting.coat_selection import select_coat
from mi_ring.fitting.config import Config
from mi_ring.fitting.course import Course
from mi_ring.fitting.iteration import Context, Iteration
from mi_ring.fitting.lighting import AMBIGUOUS, Lighting
from mi_ring.fitting.mask_refinement import find_masks, with_masks
from mi_ring.fitting.model import Model
from mi_ring.fitting.optimisation import Optimisation
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.regulariser_strength import RegulariserStrength
from mi_ring.fitting.renamed import FIT, Renamed
from mi_ring.fitting.renderer import Renderer
from mi_ring.fitting.result import result_of
from mi_ring.fitting.sampler import Batch, Sampler
from mi_ring.fitting.schedule import Schedule
from mi_ring.fitting.start import require_settings, restored, restoring, starting_ring
from mi_ring.fitting.terms import Loss, TermLike
from mi_ring.fitting.validation import validate
from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.shape_net import Flow
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import results
from mi_ring.output.fit_result import FitResult
from mi_ring.system.machine import release_memory

PARTS = "sampler", "renderer", "regulariser", "optimisation"  #: have a state of their own


class Fit(Renamed):
    """A reconstruction in progress. ::

        for it in Fit(capture, Config.preset("fast")):
            print(it.number, it.loss)

    `networks`: (Shape-Net, BRDF-Net) to train instead of the paper's, see `Flow` and `MaterialNet`. `terms`: terms of
    the loss by name, each a `Term` or a function of an `Iteration`; default: `default_terms`. `callbacks`: functions of
    each `Iteration` that is done. `state`: that of an interrupted fit, from `state()`. `lighting`: result of
    `choose_lighting`; needed if `config.light` is not "capture". Call `mi_ring.system.machine.set_threads(1)` before a
    deterministic fit. Raises InputError if capture, settings, terms and networks do not go together.
    """

    RENAMED = FIT

    def __init__(
        self, capture: Capture, config: Config | None = None, networks: tuple[Flow, MaterialNet] | None = None,
        terms: Mapping[str, TermLike] | None = None, callbacks: Sequence[Callable[[Iteration], object]] = (),
        state: dict[str, Any] | None = None, lighting: Lighting | None = None,
    ) -> None:  # fmt: skip
        config = Config() if config is None else config
        require_settings(capture, config, lighting)
        self.loss, self.callbacks = Loss(terms, config.weights), list(callbacks)
        if state is not None and networks:
            raise InputError("networks: those of the state are taken; give one of the two")
        lighting, ring = (lighting, None) if state is None else restored(state)
        self.problem = problem = Problem.of(capture, config, lighting or Lighting.of(capture, config), self.loss.usual)
        torch.manual_seed(config.seed)
        self.model = model = Model(problem, (ring or starting_ring(problem, networks)).to(problem.device))
        self.loss.require_velocity(self.ring.shape_net)
        settling = self.problem.lighting.kind in AMBIGUOUS and self.loss.weight("settling") > 0
        self.plan = lambda config: Schedule.of(config, model.starts_near, settling, model.detail_levels)
        self.schedule = self.plan(config)
        self.sampler, self.renderer = Sampler(self.problem), Renderer(self.problem, self.ring)
        self.optimisation = Optimisation(self.problem, self.model)
        self.regulariser, self.course = RegulariserStrength(), Course()
        self.textured: FittedObject | None = None  #: the object with texture, at the end of the fit
        self.capture = self.problem.capture  #: with the masks that are used now
        if state is not None:
            self.restore(copy.deepcopy(state))
        self.optimisation.prepare(self.schedule, self.iteration)

    def __iter__(self) -> Iterator[Iteration]:
        """Run the iterations that are left. Yields each iteration when it is done."""
        while self.iteration < self.iterations:
            yield self.step()

    def run(self) -> FittedObject:
        """Run all iterations that are left. Returns the fitted object, with its texture if there is one."""
        for _ in self:
            pass
        return self.result().ring

    def step(self) -> Iteration:
        """Make one iteration. Raises InputError if the fit diverges, RuntimeError if no iteration is left."""
        if self.iteration >= self.iterations:
            raise RuntimeError(f"the fit is at its end: {self.iterations} iterations are done")
        started = time.perf_counter()
        if "masks" in self.problem.config.refine and self.schedule.masks_due(self.iteration):
            self.refine_masks()
        self.optimisation.find_light(self.renderer, self.schedule, self.iteration, self.capture)
        if self.problem.config.lobes == "auto" and self.schedule.coat_due(self.iteration):
            self.course.coat |= select_coat(self.problem, self.model, self.renderer, self.optimisation, self.capture)
        batch = self.sampler.draw(self.problem, self.schedule, self.ring.domain, self.iteration)
        observation = self.sampler.observe(self.problem, self.capture, batch)
        it = self.optimisation.step(lambda: self.evaluate(batch, observation))
        it.prediction = self.renderer.remember(it.prediction)
        self.regulariser.note(it)
        self.course.iteration += 1
        self.optimisation.prepare(self.schedule, self.iteration)
        self.course.seconds += time.perf_counter() - started
        if it.number in (it.stage.first + 1, it.stage.last):
            release_memory()  # a stage's first iteration needs more than others; the next stage has other sizes
        if (last := it.number == self.iterations) and len(self.problem.held_out):
            masked = replace(self.problem, capture=self.capture)
            self.course.validation = validate(masked, self.model, self.renderer, self.schedule.final_level)
        self.course.record(it, self.optimisation.learning_rate, self.regulariser, last)
        for callback in self.callbacks:
            callback(it)
        return it

    def evaluate(self, batch: Batch, observation: Observation) -> tuple[Tensor, Iteration]:
        """Predict a batch, and return (its loss with the autograd graph, iteration). It does not change the fit."""
        it = Iteration(batch, observation, self.renderer.predict(self.problem, self.model, batch), self.context())
        return self.loss(it), it

    def context(self) -> Context:
        """Collect the parts of the fit that terms of the loss and solvers may read in this iteration."""
        config, one_material = self.problem.config, self.problem.lighting.one_material_until > 0
        return Context(config, self.capture, self.model, self.schedule, self.problem.exposure, one_material,
                       self.regulariser.strength(config.velocity_decay), self.renderer.autocast)  # fmt: skip

    def refine_masks(self) -> None:
        """Find new masks near the outline of the current surface. They replace the masks in `capture` of this fit."""
        parts = self.capture, self.problem.exposure, self.model, self.renderer, self.problem.config.levels[-1]
        self.course.masks |= self.problem.processes.on_first(lambda: find_masks(*parts))
        self.capture = with_masks(self.problem.capture, self.course.masks)

    @property
    def ring(self) -> FittedObject:
        """The fitted object without texture, as it is after the last iteration. Further iterations change it."""
        return self.model.ring

    @property
    def iteration(self) -> int:
        """Number of iterations that are done."""
        return self.course.iteration

    @property
    def iterations(self) -> int:
        """Number of all iterations of this fit, done or not."""
        return self.schedule.iterations

    def calibrated(self) -> Capture:
        """Return the capture with the cameras, lights and camera response that the fit has found so far."""
        return self.model.calibrated(self.capture)

    def preview(self, k: int = 0, width: int = 256, level: int = 4, spp: int = 4) -> np.ndarray:
        """Render photograph `k` from the current model. Returns linear radiance (H, W, 3), at most `width` pixels wide.

        `level`: of the mesh. `spp`: samples per pixel. Not for terms of the loss: it changes what their gradient needs.
        """
        return self.renderer.picture(self.model, self.calibrated(), k, width, level, spp)

    def result(self) -> FitResult:
        """Collect the results of the fit, for the functions of `mi_ring.output`. A texture is found once."""
        found = result_of(self.problem, self.model, self.renderer, self.schedule, self.course, self.capture,
                          list(self.loss.terms), self.regulariser.unexplained, self.textured)  # fmt: skip
        self.textured = found.ring if found.ring is not self.ring else None
        return found

    def save(self, folder: str | Path) -> None:
        """Write `ring.pt`, `mesh.ply`, `scene.xml`, `report.html` and other results into a folder.

        Earlier results are moved aside. Raises InputError if that fails, ValueError for networks without a name.
        """
        results.save(Path(folder), self.result())

    def state(self) -> dict[str, Any]:
        """Return a copy of the fit's state, for `torch.save`. A `Fit` of the same capture continues from it."""
        return copy.deepcopy({  # the next iteration changes it
            "ring": ring_state(self.ring, self.problem.config.settings()), "lighting": tuple(self.problem.lighting),
            "calibration": self.model.calibration and self.model.calibration.state_dict(),
            "course": vars(self.course), **{name: getattr(self, name).state() for name in PARTS},
        })  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state()` of a fit with the same settings, networks and lighting. Else raises InputError."""
        with restoring():
            if self.model.calibration:
                self.model.calibration.load_state_dict(state["calibration"])
            for name in PARTS:
                getattr(self, name).restore(state[name])
            self.course = Course.of(state["course"], self.iterations)
            self.capture = with_masks(self.problem.capture, self.course.masks)
