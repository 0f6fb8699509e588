"""The optimisation: Muon for hidden weights, Adam for all other parameters, and one step of all optimisers."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from mi_ring.calibration.calibration import Calibration
from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.fitting.agreeing_adam import AgreeingAdam
from mi_ring.fitting.brightness_solver import BrightnessSolver
from mi_ring.fitting.config import Config
from mi_ring.fitting.detail_stage import unfold
from mi_ring.fitting.exposure_solver import ExposureSolver
from mi_ring.fitting.flash_search import find_flash
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.joint_solver import SOLVED, solve_jointly
from mi_ring.fitting.model import Model
from mi_ring.fitting.muon import Muon
from mi_ring.fitting.nan_guard import NanGuard
from mi_ring.fitting.pose_solver import PoseSolver
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.refinement import START, finds_small_lights
from mi_ring.fitting.renderer import Renderer
from mi_ring.fitting.schedule import Rate, Schedule, Stepper, learning_rate
from mi_ring.fitting.small_lights import find_lobes
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.system.machine import has_fast_bfloat16

CALIBRATION_RATE = 0.1  #: Adam's learning rate for unknowns of calibration [standard deviations]
LOBE_TURN, LOBE_SHARPEN = 0.004, 0.03  #: Adam's learning rates for lobes: of directions [rad], of log sharpness
TEXTURE_FACTOR = 3.0  #: longest step of a value of a texture, by the longest step of a displacement
CLIPPED = 1.0  #: norm to which Shape-Net's gradient is clipped: a longer one makes it diverge


def network_steppers(networks: nn.Module, config: Config, device: torch.device) -> list[Stepper]:
    """Make the optimisers of both networks: Muon for hidden weight matrices and Adam for the rest, or only Adam.

    A layer is hidden if it is a linear layer in an `nn.ModuleList` that is the attribute `hidden` of a network or of
    one of its submodules.
    """
    lists = [getattr(part, "hidden", None) for part in networks.modules()]
    layers = [layer for some in lists if isinstance(some, nn.ModuleList) for layer in some]
    hidden = [layer.weight for layer in layers if isinstance(layer, nn.Linear) and config.optimizer == "muon"]
    rest = [p for p in networks.parameters() if not any(p is h for h in hidden)]
    adam = torch.optim.Adam(rest, lr=config.learning_rate)
    result = [Stepper(adam, [Rate(config.learning_rate, config.decay)])]
    if hidden:
        fast = config.precision != "float32" and has_fast_bfloat16(device)
        muon = Muon(hidden, lr=config.muon_rate, dtype=torch.bfloat16 if fast else torch.float32)
        result.append(Stepper(muon, [Rate(config.muon_rate, config.decay)]))
    return result


def calibration_steppers(calibration: Calibration, config: Config) -> list[Stepper]:
    """Make the optimisers of the calibration: Adam for the unknowns that no solver estimates. May return []."""
    groups = calibration.parameters_without_solver()
    if not groups:
        return []
    adam = torch.optim.Adam([{"params": group} for group in groups], lr=CALIBRATION_RATE)
    return [Stepper(adam, [Rate(CALIBRATION_RATE, config.decay, START)] * len(groups))]


def lobe_steppers(calibration: Calibration, config: Config) -> list[Stepper]:
    """Make the optimiser of directions and sharpness of the room's lobes. Returns [] if the fit does not find lobes."""
    if not finds_small_lights(calibration, config):
        return []
    room, rates = calibration.room, (LOBE_TURN, LOBE_SHARPEN)
    adam = torch.optim.Adam([{"params": [room.toward]}, {"params": [room.log_sharpness]}])
    return [Stepper(adam, [Rate(rate, config.decay) for rate in rates])]


def detail_steppers(ring: FittedObject, config: Config) -> list[Stepper]:
    """Make the optimiser of the details."""
    nets: dict[str, tuple[Any, float]] = {"shape": (ring.shape_net, 1.0), "texture": (ring.brdf_net, TEXTURE_FACTOR)}
    chosen = [nets[name] for name in nets if config.detail in (name, "both")]
    optimizer = AgreeingAdam([{"params": [*net.grid.parameters()]} for net, _ in chosen], config.detail_rate)
    return [Stepper(optimizer, [Rate(factor * config.detail_rate, config.decay) for _, factor in chosen])]


@torch.no_grad()
def follow_room(calibration: Calibration, it: Iteration) -> None:
    """Estimate the room's light, in place: add an iteration's photographs to the normal equations and solve them.

    Does nothing if the room's light is not refined, or if all photographs have other light. If some have, the others
    alone count: with a flash, its error may be larger than all light of the room.
    """
    other, seen, batch = it.prediction.other_light, it.observation, it.batch
    if other is None or not calibration.follows_room:
        return
    photographs = it.prediction.photographs
    telling = ~photographs.lit if photographs.mixed else photographs.in_room
    pixels = it.object_pixels() & ~seen.clipped.any(-1)
    pixels &= torch.from_numpy(telling[batch.photographs]).to(pixels.device)[:, None, None]
    observed = calibration.linear(seen.rgb, batch.photographs, batch.scale)
    calibration.room.solve(other, it.prediction.without_room, observed, pixels, it.progress, batch.share.sum)


class Optimisation:
    """The optimisers of a model, their learning rates, the solvers of calibration and the guard against NaN."""

    def __init__(self, problem: Problem, model: Model) -> None:
        """Make the optimisers and solvers for a model."""
        self.problem, self.model = problem, model
        self.begin()

    def begin(self) -> None:
        """Make new optimisers and solvers for what the model learns now: the networks and calibration, or details."""
        model, config = self.model, self.problem.config
        #: use more of an iteration than gradients
        self.solvers: list[ExposureSolver | BrightnessSolver | PoseSolver] = []
        if model.detailed:
            self.steppers = detail_steppers(model.ring, config)
        else:
            self.steppers = network_steppers(model.ring, config, self.problem.device)
        # Details do not improve poses: with cameras off by half a pixel, novel views were 0.1 dB worse, not better.
        if (calibration := model.calibration) and not model.detailed:
            self.solvers += [ExposureSolver(calibration, n) for n in ("power", "gain") if n in calibration.refined]
            if {"falloff", "contrast"} & {*calibration.refined}:
                self.solvers.append(BrightnessSolver(calibration))
            if "cameras" in calibration.refined:
                self.solvers.append(PoseSolver(calibration, model.starts_near))
            self.steppers += calibration_steppers(calibration, config) + lobe_steppers(calibration, config)
            self.steppers += [Stepper(solver, [solver.rate]) for solver in self.solvers]
        self.optimizers = [stepper.optimizer for stepper in self.steppers]
        self.guard = NanGuard(model, self.optimizers)

    def step(self, evaluate: Callable[[], tuple[Tensor, Iteration]]) -> Iteration:
        """Evaluate the loss, backpropagate it, and make one step of all optimisers. Returns the iteration.

        `evaluate`: returns (loss, iteration); optimisers may call it several times. No step is made if loss or
        gradients are not finite, or if the loss has no term for these photographs, for example if its only term is
        `mask` and they have no masks. Raises InputError if the fit diverges.
        """
        loss, it = evaluate()
        if self.model.calibration and not it.stage.detail:
            follow_room(self.model.calibration, it)
        for solver in self.solvers:
            solver.look(it)
        if not it.terms:
            return it
        if not loss.requires_grad and not it.stage.settles:  # there `mask` has no gradient
            raise InputError(f"terms: {', '.join(it.terms)}: have no gradients, so the fit would change nothing; "
                             "compute them from it.prediction, by operations of PyTorch")  # fmt: skip
        self.backward(loss, it)
        clip = torch.nn.utils.clip_grad_norm_
        ring, calibration = self.model.ring, self.model.calibration
        norm = clip(ring.shape_net.parameters(), CLIPPED) + clip(ring.brdf_net.parameters(), torch.inf)
        others = [p.grad for p in calibration.parameters() if p.grad is not None] if calibration else []
        # The renderer may lose a NaN on the way back, so the loss is checked, too.
        healthy = bool((it.loss + norm).isfinite()) and all(bool(g.isfinite().all()) for g in others)
        for optimizer, rates, evaluates in self.steppers:
            for group, rate in zip(optimizer.param_groups, rates):
                progress = it.batch.detail_progress if it.stage.detail else it.progress
                group["lr"] = learning_rate(rate, progress) * self.guard.factor
            if healthy and evaluates:
                optimizer.step(lambda: self.backward(*evaluate()))
            elif healthy:
                optimizer.step()
        if calibration and finds_small_lights(calibration, self.problem.config):
            calibration.room.limit_sharpness()
        if not self.guard.note(healthy):
            option = "--muon-rate" if self.problem.config.optimizer == "muon" else "--learning-rate"
            option = "--detail-rate" if it.stage.detail else option
            path = self.problem.capture.path
            wrong = ", ".join(name for name, value in it.terms.items() if not math.isfinite(value))
            raise InputError(f"{path}: diverged at iteration {it.number - 1}{' by the term ' * bool(wrong)}{wrong}; "
                             f"try a lower {option}")  # fmt: skip
        self.model.update_albedo()
        return it

    def prepare(self, schedule: Schedule, iteration: int) -> None:
        """Prepare the model for the stage of `iteration`, counted from 0.

        Networks and calibration are trained first. In the settling stage the surface is frozen, and before its first
        iteration the normal equations of the room's light are emptied. Then details are added and trained alone. At the
        end of each stage they are smoothed where they fold the surface.
        """
        if iteration in [stage.last for stage in schedule.stages if stage.detail]:
            unfold(self.model.ring, schedule.stage(iteration - 1).level)
        stage = schedule.stage(iteration) if iteration < schedule.iterations else None
        if stage and stage.detail and not self.model.detailed:
            self.model.add_detail(schedule.final_level, schedule.trained_level)
            self.begin()
        if self.model.detailed:
            return
        fixed = bool(stage and stage.settles)
        self.model.fix_surface(fixed)
        if fixed and iteration == schedule.shaping and self.model.calibration:
            self.model.calibration.room.forget()
            self.guard.keep()  # so that a retreat does not restore the old equations

    def find_light(self, renderer: Renderer, schedule: Schedule, iteration: int, capture: Capture) -> None:
        """Find a room beside other light, flash and exposures together, or the lobes of a room alone, if it is time.

        `iteration`: the next one, from 0. `capture`: that of the problem, with the masks that are used now.
        """
        calibration = self.model.calibration
        if calibration is None or not {"ambient", *SOLVED} & {*calibration.refined}:
            return
        problem = replace(self.problem, capture=capture)
        level, progress = schedule.stage(iteration).level, schedule.progress(iteration)
        one_material = progress < problem.lighting.one_material_until  # the joint equations have many materials
        if schedule.joint_due(iteration) and not (calibration.room.alone or one_material):
            known: dict[str, Tensor] = {}
            if schedule.flash_due(iteration):
                place = problem.processes.on_first(lambda: find_flash(problem, self.model, renderer, level))
                if place is not None:
                    known["light"] = place
                    calibration.get_parameter("light").data.copy_(place)
            joint = problem.processes.on_first(lambda: solve_jointly(problem, self.model, renderer, level, known))
            values = joint | known
            if not values:
                return
            for name, value in values.items():
                tensor = calibration.room.harmonics if name == "ambient" else calibration.get_parameter(name)
                tensor.data.copy_(value)
                for optimizer in self.optimizers:
                    if isinstance(optimizer, ExposureSolver) and optimizer.tensor is tensor:
                        optimizer.forget()
                    else:
                        optimizer.state.pop(tensor, None)  # it leads away from another value
        elif schedule.lights_due(iteration) and finds_small_lights(calibration, problem.config):
            found = problem.processes.on_first(lambda: find_lobes(problem, self.model, renderer, level, iteration))
            if found is None:
                return
            found.put_into(calibration.room)
            for optimizer in self.optimizers:
                for parameter in (calibration.room.toward, calibration.room.log_sharpness):
                    optimizer.state.pop(parameter, None)  # it is of another lobe
        else:
            return
        self.guard.keep()  # so that a retreat does not restore the old light

    def follow(self, pairs: Iterable[tuple[nn.Parameter, nn.Parameter]]) -> None:
        """Continue with larger parameters: pairs (old, new with further rows). Adam knows no gradients of these yet."""
        for old, new in pairs:
            for optimizer in self.optimizers:
                for group in optimizer.param_groups:
                    group["params"] = [new if p is old else p for p in group["params"]]
                state = optimizer.state.pop(old, {})
                for name, value in state.items():
                    if torch.is_tensor(value) and value.ndim:
                        more = value.new_zeros(len(new) - len(value), *value.shape[1:])
                        state[name] = torch.cat([value, more])
                if state:
                    optimizer.state[new] = state
        self.guard.keep()

    def backward(self, loss: Tensor, it: Iteration) -> float:
        """Backpropagate this process's `loss`, and sum the gradients over all processes.

        Returns the loss of all processes together.
        """
        processes = self.problem.processes
        self.model.zero_grad()
        if processes.count > 1:
            loss = loss + 0 * it.prediction.vertices.sum()  # so that each process takes part in the backward pass
        if loss.requires_grad:
            with torch.autograd.set_multithreading_enabled(False):  # Dr.Jit has one state per thread
                loss.backward()
        processes.sum_gradients([p for o in self.optimizers for group in o.param_groups for p in group["params"]])
        return it.loss

    @property
    def learning_rate(self) -> float:
        """The current learning rate of the first optimiser, which is Adam for the networks."""
        return self.optimizers[0].param_groups[0]["lr"]

    def state(self) -> dict[str, Any]:
        """Return the states of the optimisers and of the guard, for a checkpoint."""
        if not self.model.detailed and isinstance(self.optimizers[0], AgreeingAdam):
            self.begin()  # details were removed at the end: a fit that continues has the optimisers of networks
        return {"optimizers": [o.state_dict() for o in self.optimizers], "guard": self.guard.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, a result of `state()`. The model must have been restored before."""
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        self.guard = NanGuard(self.model, self.optimizers, state["guard"])
