"""The loop of a fit: sample the domain, deform, render, weigh, step."""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import recompute_normals
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import Calibration, overall, refined_of
from mi_ring.fitting.config import Config
from mi_ring.fitting.covariance import deviations
from mi_ring.fitting.indirect_average import Averages
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.light_selection import lighting_of
from mi_ring.fitting.lighting import AMBIGUOUS, Lighting, frames, lit, smoothed
from mi_ring.fitting.mask_refinement import REDRAWN, find_outlines, with_outlines
from mi_ring.fitting.nan_guard import Caution
from mi_ring.fitting.optimizers import optimizers_of
from mi_ring.fitting.other_light import with_surroundings
from mi_ring.fitting.powers import Looker, lookers_of
from mi_ring.fitting.processes import current
from mi_ring.fitting.restraint import Restraint
from mi_ring.fitting.rounds import Rounds
from mi_ring.fitting.schedule import stages_of
from mi_ring.fitting.start import require_settings, starting_ring
from mi_ring.fitting.state import restore, state_of
from mi_ring.fitting.summary import summary
from mi_ring.fitting.terms import Term, default_terms
from mi_ring.fitting.validation import confirm, kept_out
from mi_ring.geometry.domain import Sphere
from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.shape_net import Flow
from mi_ring.objects.ring_file import ring_of
from mi_ring.output import results
from mi_ring.rendering import bridge
from mi_ring.system.machine import autocast, device, release_memory

LOG_EVERY = 5  #: iterations between entries of the log
#: Names that `Iteration.entry` has.
RESERVED = {"iteration", "seconds", "loss", "weights", "learning_rate", "stage", "vertices", "crossing", "unexplained"}
UNSEEING = set(default_terms) - {"rgb", "mask"}  #: terms that look at no photograph
RAMP = 0.05  #: over how much of a fit refinement sets in

TermLike = Term | Callable[[Iteration], Tensor | None]


class Fit:
    """A reconstruction in progress: networks, optimisers, random numbers and how far it is. ::

        for it in Fit(capture, Config.preset("fast")):
            print(it.number, it.loss)

    `networks`: (Shape-Net, BRDF-Net), others than the paper's, which are trained in place, as
    `mi_ring.nets.shape_net.Flow` and `mi_ring.nets.brdf_net.MaterialNet` say. `terms`: of the loss, by name, each a
    `Term` or a function of an `Iteration`; by default `default_terms`. `callbacks` are called with each `Iteration`
    when it is done. `state`: what `state()` of an interrupted fit gave, to go on from there. `lighting`: what lights
    the photographs, where that is known better than `Config.light` says.

    A deterministic fit needs `mi_ring.system.machine.set_threads(1)` beforehand.

    Raises InputError where capture, settings, terms and networks do not go together.
    """

    def __init__(
        self, capture: Capture, config: Config | None = None, networks: tuple[Flow, MaterialNet] | None = None,
        terms: Mapping[str, TermLike] | None = None, callbacks: Sequence[Callable[[Iteration], object]] = (),
        state: dict | None = None, lighting: Lighting | None = None,
    ) -> None:  # fmt: skip
        self.given = capture  #: as it was handed in, for another fit: `capture` is lit as this one takes it to be
        self.config: Config = config or Config()
        given = default_terms if terms is None else terms
        self.terms = {name: term if isinstance(term, Term) else Term(term) for name, term in given.items()}
        self.callbacks = list(callbacks)
        self.processes = current()  #: that share out the photographs of each iteration
        if reserved := self.terms.keys() & RESERVED:
            raise InputError(f"terms: {min(reserved)}: the log has an entry of that name; give the term another")
        if not any(self.weight_of(name) for name in self.terms.keys() - UNSEEING):
            raise InputError("weights: no term compares the surface with the photographs; give rgb or mask one above 0")
        require_settings(capture, self.config)
        if state and networks:
            raise InputError("networks: those of the state are taken; give one of the two")
        if unknown := set(self.config.weights) - set(default_terms) - set(self.terms):
            raise InputError(f"weights: {min(unknown)}: there is no such term; there are {', '.join(self.terms)}")
        self.held_out = kept_out(capture, self.config.holdout)
        self.fitted = np.setdiff1d(np.arange(len(capture)), self.held_out)  #: all other photographs
        if self.config.deterministic:
            recompute_normals(capture.scene)
        lighting = Lighting(*state["lighting"]) if state else lighting  # under which `capture` is
        began = time.perf_counter()
        self.lighting = lighting or self.processes.told(lighting_of(capture.part(self.fitted), self.config, Fit))
        self.seconds = time.perf_counter() - began  #: that iterations, and coarse fits before them, have taken
        #: `environment`: harmonics of what the scene says of one, if it says so.
        self.capture, scene, self.environment = smoothed(lit(capture, self.lighting))
        capture = self.capture
        chosen = replace(self.config, light=self.lighting.kind)
        self.random = torch.Generator().manual_seed(self.config.seed)
        torch.manual_seed(self.config.seed)
        seen = capture.part(self.fitted) if len(self.held_out) else capture
        self.exposure = seen.exposure()
        self.ring = ring_of(state["ring"]) if state else starting_ring(seen, chosen, self.exposure, networks)
        regularised = self.terms.get("velocity") is default_terms["velocity"] and self.config.weights["velocity"]
        if regularised and not hasattr(self.ring.shape_net, "velocity"):
            raise InputError(f"networks: {type(self.ring.shape_net).__name__}: has no velocity, which the term of that "
                             "name needs; give it one, or the term the weight 0")  # fmt: skip
        #: Of the light it gets, how much the object reflects: more than all where the intensities are not true.
        self.albedo = math.pi * seen.reflectance(self.ring.center.cpu().numpy(), self.exposure)
        self.device = device()
        self.ring.to(self.device)
        self.shaping_parameters = [p for p in self.ring.shape_net.parameters() if p.requires_grad]
        self.surface = bridge.Surface(scene, capture.shape, self.ring)
        self.optimizers = optimizers_of(self.ring, self.config, self.device)
        self.near = not isinstance(self.ring.domain, Sphere)  #: does it start near the object?
        self.calibration: Calibration | None = None
        self.lookers: list[Looker] = []  #: optimisers that see iterations
        if refined := refined_of(seen, chosen, self.albedo):
            power, center = overall(refined, self.albedo), self.ring.center.cpu().numpy()
            self.calibration = Calibration(capture, refined, center, self.exposure, power, self.fitted,
                                           frames(capture, self.lighting), bool(self.lighting.lamps),
                                           ahead="light" in self.config.refine)  # fmt: skip
            self.lookers = lookers_of(self.calibration, self.near, self.terms)
            self.optimizers += [*self.calibration.optimizers(), *self.lookers]
            self.calibration.room.to(self.device)
        settling = self.lighting.kind in AMBIGUOUS and self.weight_of("settling") > 0
        self.stages_by = partial(stages_of, near=self.near, settling=settling)  #: of settings
        self.stages = self.stages_by(self.config)
        self.iterations = self.stages[-1].last
        self.autocast = autocast(self.config.precision, self.device)
        #: Masks that were found anew, as `mi_ring.fitting.mask_refinement` has them.
        self.outlines: dict[int, Tensor] = {}
        self.iteration = 0
        self.log: list[dict] = []  #: an `Iteration.entry` of every fifth iteration and of the last
        self.restraint, self.averages = Restraint(), Averages()
        self.rounds = Rounds(capture, self.fitted)
        self.confirmed: dict = {}  #: what `confirm` found when the fit was done
        if state:
            restore(self, state)
        fitted = [self.ring, self.calibration] if self.calibration else [self.ring]
        self.caution = Caution(fitted, self.optimizers, state and state["caution"])
        self.settle()

    def __iter__(self) -> Iterator[Iteration]:
        """The iterations that are left, each as it is done."""
        while self.iteration < self.iterations:
            yield self.step()

    def step(self) -> Iteration:
        """One iteration: sample the domain, deform, render, weigh, step.

        Raises InputError if the fit diverges, RuntimeError if there is no iteration left.
        """
        if self.iteration >= self.iterations:
            raise RuntimeError(f"the fit is at its end: {self.iterations} iterations are done")
        started = time.perf_counter()
        if "masks" in self.config.refine and self.iteration in [int(p * self.shaping) for p in REDRAWN]:
            self.take_outlines(self.processes.by_first(lambda: find_outlines(self)))
        it = self.predict()
        loss = self.weigh(it)
        for optimizer in self.lookers:
            optimizer.look(it)
        self.descend(it, loss)
        self.follow_power()
        it.detach()
        self.restraint.note(it, self.shaping)
        self.iteration += 1
        self.settle()
        if self.iteration == it.stage.last:
            release_memory()  # what comes next has other sizes
        self.seconds += time.perf_counter() - started
        if it.number == self.iterations and len(self.held_out):
            self.confirmed = confirm(self)
        if it.number % LOG_EVERY == 0 or it.number == self.iterations:
            self.log.append(it.entry())
        for callback in self.callbacks:
            callback(it)
        return it

    @property
    def shaping(self) -> int:
        """How many iterations shape the surface, before it stands still."""
        return self.stages[-1].first if self.stages[-1].settles else self.iterations

    @property
    def progress(self) -> float:
        """Share of these that are done."""
        return min(1.0, self.iteration / self.shaping)

    def settle(self) -> None:
        """Have the surface stand still if that is due, and the light be what photographs say from then on."""
        last = self.stages[-1]
        for parameter in self.shaping_parameters:  # which in the end may learn again, in another fit
            parameter.requires_grad_(not (last.settles and last.first <= self.iteration < last.last))
        if last.settles and self.iteration == last.first and self.calibration:
            self.calibration.room.forget()
            self.caution.keep()  # not to go back to what is forgotten

    def predict(self) -> Iteration:
        """Sample the domain, deform it, choose photographs and render them."""
        config, number = self.config, self.iteration
        stage = next(s for s in self.stages if number < s.last)
        s, faces = self.ring.domain.sample(stage.level, self.random if config.resample else None)
        s = s.to(self.device)
        points = self.processes.share(len(s))
        with self.autocast():
            vertices, material = self.ring(s[points.part])
        vertices, *parameters = points.joined([vertices, *material.values()])
        material = self.lighting.shared(dict(zip(material, parameters)), self.progress)

        everything, size = self.rounds.draw(config.batch, self.random)
        share = self.processes.share(len(everything))
        index, scale = everything[share.part], -(-size[0] // stage.width)
        seen = self.processes.together(lambda: self.capture.observe(index, scale)).to(self.device)
        photographs = replace(self.capture.photographs.select(index, size, scale), before=share.part.start)
        self.surface.set_faces(faces)
        calibration = [t.to(self.device) for t in self.calibration.scaled(scale)] if self.calibration else []
        if self.calibration:
            photographs = self.calibration.as_found(photographs, calibration)
        predicted, coverage = bridge.render(
            self.surface, photographs, vertices, material, spp=config.spp, seed=self.new_seed(),
            shadows=config.shadows and self.capture.shadows, calibration=calibration,
            lamps=self.calibration.lamp_tensors() if self.calibration else [],
        )  # fmt: skip
        predicted = with_surroundings(self, predicted, coverage, photographs, seen, everything, scale, share)
        if self.calibration:
            predicted = self.calibration.recorded(predicted, index, scale)
        return Iteration(
            self, number + 1, self.progress, stage, s, faces, vertices, material, index, scale, photographs,
            *seen, predicted, coverage, everything, share,
        )  # fmt: skip

    def take_outlines(self, outlines: dict[int, Tensor]) -> None:
        """Go on with these masks, where there are any, instead of those of the capture."""
        if outlines:
            self.outlines = self.outlines | outlines
            self.capture = with_outlines(self.capture, outlines)

    def follow_power(self) -> None:
        """The reflectance takes along what the fit has found of the power of the lights together."""
        if self.calibration and "scale" in self.calibration.refined:
            net, first = self.ring.brdf_net, self.albedo / self.calibration.first_power / math.pi
            net.set_parameters(net.bsdf_parameters, first * self.calibration.reflecting)

    def new_seed(self) -> int:
        """For the renderer."""
        return int(torch.randint(2**31, (), generator=self.random))

    def weight_of(self, name: str) -> float:
        """Of a term, before its schedule; 0 if there is none of that name."""
        return self.config.weights.get(name, self.terms[name].weight) if name in self.terms else 0.0

    def weigh(self, it: Iteration) -> Tensor:
        """This process's share of the weighted sum of the terms; the iteration gets that and each term of all.

        A term is a mean over photographs, or the same in all processes: its sum by their shares is that of all.
        """
        loss, values = torch.zeros((), device=self.device), dict.fromkeys(self.terms, (0.0, 0.0))
        for name, term in self.terms.items():
            weight = self.weight_of(name)
            value = term.function(it) if weight else None
            if value is None:
                continue
            if not isinstance(value, Tensor) or value.ndim:
                raise InputError(f"terms: {name}: must give a scalar tensor or None, not {type(value).__name__} "
                                 f"{tuple(getattr(value, 'shape', ()))}")  # fmt: skip
            it.weights[name] = weight * (term.schedule(it) if term.schedule else 1.0)
            values[name] = float(value.detach()), 1.0
            loss = loss + it.weights[name] * value
        loss = loss * it.share.weight
        found = torch.tensor([*values.values(), (float(loss.detach()), 1.0)], dtype=torch.double)
        found[:-1, 0] *= it.share.weight
        *told, (it.loss, _) = self.processes.sum(found).tolist()
        it.terms = {name: value for name, (value, times) in zip(values, told) if times}
        return loss

    def descend(self, it: Iteration, loss: Tensor) -> None:
        """The backward pass and a step of the optimisers; none if the loss or its gradient is not finite.

        Nor if no term had anything to say: masks alone, and photographs of which none has one.
        """
        if not it.terms:
            return
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        if self.processes.count > 1:
            loss = loss + 0 * it.vertices.sum()  # whose backward pass waits for that of the others
        if loss.requires_grad:
            with torch.autograd.set_multithreading_enabled(False):  # Dr.Jit keeps its state by thread
                loss.backward()
        self.processes.sum_gradients([p for o in self.optimizers for group in o.param_groups for p in group["params"]])
        clip = torch.nn.utils.clip_grad_norm_
        # Shape-Net's are clipped lest it diverges, BRDF-Net's only measured.
        norm = clip(self.ring.shape_net.parameters(), 1.0) + clip(self.ring.brdf_net.parameters(), torch.inf)
        others = [p.grad for p in self.calibration.parameters() if p.grad is not None] if self.calibration else []
        # The renderer may swallow a NaN on the way back.
        healthy = bool((it.loss + norm).isfinite()) and all(bool(g.isfinite().all()) for g in others)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                begun = self.caution.factor * min(1.0, max(0.0, (it.progress - group.get("start", -1.0)) / RAMP))
                group["lr"] = group["initial_lr"] * group.get("decay", self.config.decay) ** it.progress * begun
            if healthy:
                optimizer.step()
        if not self.caution.note(healthy):
            option = "--muon-rate" if self.config.optimizer == "muon" else "--learning-rate"
            raise InputError(f"{self.capture.path}: diverged at iteration {self.iteration}; try a lower {option}")

    def summary(self, refined: Capture) -> dict:
        """What was refined besides surface and material, as `mi_ring.fitting.summary` has it; the surface is shown.

        `refined`: the capture with all of it, as `calibrated` gives it.
        """
        return summary(self, refined, deviations(self))

    def calibrated(self) -> Capture:
        """The capture with cameras, lights and curve as refined by now; the surface is lit so, too."""
        if not self.calibration:
            return self.capture
        self.calibration.relight(self.surface)
        return self.calibration.applied(self.capture)

    def preview(self, k: int = 0, width: int = 256, level: int = 4, spp: int = 4) -> np.ndarray:
        """What photograph `k` of the capture should look like by now: (H, W, 3) linear radiance.

        At most `width` pixels wide, of the surface at a `level`. It changes nothing of the fit; but not from within a
        term, for whose backward pass the renderer keeps what it rendered.
        """
        self.surface.show(self.ring, *self.ring.domain.sample(level))
        photograph = self.calibrated().photograph(k, -(-self.capture.shots[k].size[0] // width))
        rgb, _ = bridge.draw(self.surface, photograph, spp, shadows=self.capture.shadows, indirect=self.ring.indirect)
        return rgb[0].numpy()

    def save(self, folder: str | Path) -> None:
        """Write the results into a folder: `ring.pt`, `mesh.ply`, `scene.xml`, `report.html`, as `mi_ring.fit` does.

        Earlier results there are moved aside.

        Raises InputError if they cannot be written, ValueError for networks that are not registered.
        """
        results.save_fit(Path(folder), self)

    def state(self) -> dict:
        """What another `Fit` of the same capture needs to go on from here, for `torch.save`."""
        return state_of(self)
