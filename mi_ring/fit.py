"""Reconstruct an object from its photographs: `python -m mi_ring.fit SCENE.xml`."""

import argparse
import contextlib
import ctypes
import dataclasses
import hashlib
import math
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
import tyro
from tqdm import tqdm

from mi_ring import bridge, capture, command, losses, reflectance, results
from mi_ring.config import PRESETS, Config
from mi_ring.domain import Domain, Sphere, closed, load
from mi_ring.errors import InputError, require_file
from mi_ring.hull import genus
from mi_ring.ring import Ring

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of mallopt(3)
CHECKPOINT_SECONDS = 30.0
LOG_EVERY = 5
FIXED_WORK = 3000  # what an iteration costs besides its vertices, in vertices: for the time left
REGULARISED_POINTS = 512  # of the flow's paths, drawn anew in each iteration


class Fit:
    """A reconstruction in progress: networks, optimisers, random numbers and how far it is."""

    def __init__(self, scene: capture.Capture, config: Config):
        self.capture, self.config = scene, config
        if config.deterministic:
            capture.recompute_normals(scene.scene)
        self.random = torch.Generator().manual_seed(config.seed)
        torch.manual_seed(config.seed)
        domain, center, radius = start(scene, config.domain)
        check_place(scene, domain, center, radius)
        self.exposure = scene.exposure()
        parameters, bsdf = reflectance.predicted(scene.path, scene.shape, config.parameters)
        scale = scene.reflectance(center, self.exposure)
        #: Of the light it gets, how much the object reflects: more than all where the lights' intensities are not true.
        self.albedo = math.pi * scale
        if self.albedo >= 1 and all(math.isfinite(p.high) for p in parameters):
            raise InputError(f"{scene.path}: emitter: by the lights' intensities the object reflects {self.albedo:.3g} "
                             "times the light that it gets, which the ranges of --parameters do not reach; give "
                             "the true intensities, or fit cooktorrance")  # fmt: skip
        indirect = config.indirect and self.albedo < 1
        self.ring = Ring(center, radius, scale, domain, parameters, bsdf, indirect, config.steps,
                         config.subdivisions)  # fmt: skip
        self.device = bridge.device()
        self.ring.to(self.device)
        self.surface = bridge.Surface(scene.scene, scene.shape, self.ring)
        self.optimizers = optimizers(self.ring, config)
        self.stages = config.stages(near=not isinstance(domain, Sphere))
        self.iterations = self.stages[-1].last
        self.autocast = autocast(config.precision, self.device)
        self.iteration, self.seconds, self.stage = 0, 0.0, None
        self.failures = 0  # losses or gradients in a row that were not finite

    def deform(self, s):
        """Surface points, and their reflectance by the names of its parameters, at domain points (V, 3)."""
        with self.autocast():
            return self.ring.surface(s), self.ring.brdf_net(s)

    def choose(self):
        """Indices of the photographs of one iteration, all of one size (width, height)."""
        first = int(torch.randint(len(self.capture), (), generator=self.random))
        size = self.capture.sensors[first].size
        alike = self.capture.sizes[size]
        order = torch.randperm(len(alike), generator=self.random)[: self.config.batch]
        return alike[order.numpy()], size

    def regulariser(self, s):
        """L_reg at random points of the paths of `s`, random in time."""
        chosen = torch.randperm(len(s), generator=self.random)[:REGULARISED_POINTS]
        steps = int(torch.randint(self.ring.shape_net.steps, (), generator=self.random))
        net = self.ring.shape_net
        with torch.no_grad(), self.autocast():
            x = net.flow(s[chosen], steps)
        # The velocity in float32 always: its second differences would drown in bfloat16.
        return losses.velocity_loss(net.velocity, x, self.config.laplacian_scale)

    def step(self) -> dict[str, float]:
        """One iteration: sample the domain, deform, render, weigh, step. Returns the loss and its unweighted terms."""
        config = self.config
        started = time.perf_counter()
        self.enter_stage()
        progress = self.iteration / self.iterations
        s, _ = self.ring.domain.sample(self.stage.level, self.random)
        s = s.to(self.device)
        vertices, material = self.deform(s)

        index, size = self.choose()
        scale = -(-size[0] // self.stage.width)
        observed, clipped, mask, masked = (t.to(self.device) for t in self.capture.observe(index, scale))
        photographs = self.capture.photographs.select(index, size, scale)
        predicted, coverage = bridge.render(
            self.surface, photographs, vertices, material,
            spp=config.spp, seed=int(torch.randint(2**31, (), generator=self.random)),
            shadows=config.shadows and self.capture.shadows,
        )  # fmt: skip
        if self.ring.indirect:
            seed = int(torch.randint(2**31, (), generator=self.random))
            predicted = predicted + bridge.interreflection(self.surface, photographs, coverage, seed)

        terms = {"rgb": losses.rgb_loss(predicted, observed, clipped, self.exposure, config.loss)}
        if masked.any() and config.weights.get("mask"):
            sigma = config.blur * (1 - progress / 0.8) * size[0] / scale  # a pixel for the last fifth
            if self.capture.threshold is not None:  # of the object, such masks show what is bright
                lit = torch.maximum(observed, predicted.detach()).amax(-1) > self.capture.threshold
                coverage = torch.where(lit, coverage, 0)
            terms["mask"] = losses.mask_loss(coverage[masked], mask[masked], max(1.0, sigma))
        if config.weights.get("velocity"):
            terms["velocity"] = self.regulariser(s)
        weights = config.weights_at(progress)
        loss = sum(weights.get(name, 0.0) * term for name, term in terms.items())

        for optimizer in self.optimizers:
            optimizer.zero_grad()
        with torch.autograd.set_multithreading_enabled(False):  # Dr.Jit keeps its state by thread
            loss.backward()
        clip = torch.nn.utils.clip_grad_norm_
        # Shape-Net's are clipped lest it diverges, BRDF-Net's only measured.
        norm = clip(self.ring.shape_net.parameters(), 1.0) + clip(self.ring.brdf_net.parameters(), torch.inf)
        healthy = bool((loss.detach() + norm).isfinite())  # the renderer may swallow a NaN on the way back
        self.failures = 0 if healthy else self.failures + 1
        if self.failures >= 10:
            rate = "--muon-rate" if config.optimizer == "muon" else "--learning-rate"
            raise InputError(f"{config.scene}: diverged at iteration {self.iteration}; try a lower {rate}")
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * config.decay**progress
            if healthy:
                optimizer.step()
        self.iteration += 1
        self.seconds += time.perf_counter() - started
        return {"loss": float(loss.detach()), **{name: float(term.detach()) for name, term in terms.items()}}

    def enter_stage(self):
        """Take up the stage that the iteration belongs to."""
        stage = next(s for s in self.stages if self.iteration < s.last)
        if stage != self.stage:
            self.stage = stage
            self.surface.set_faces(self.ring.domain.sample(stage.level)[1])

    def state(self) -> dict:
        return {
            "settings": self.config.settings(),
            "scene": digest(self.config.scene),
            "ring": self.ring.state(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "random": self.random.get_state(),
            "iteration": self.iteration,
            "seconds": self.seconds,
        }

    def restore(self, state: dict):
        """Go on from this state, which `read_checkpoint` has read."""
        self.ring.load_state_dict(state["ring"]["networks"])
        for optimizer, saved in zip(self.optimizers, state["optimizers"]):
            optimizer.load_state_dict(saved)
        self.random.set_state(state["random"])
        self.iteration, self.seconds = state["iteration"], state["seconds"]


def start(scene: capture.Capture, choice) -> tuple[Domain, np.ndarray, float]:
    """The domain of a fit and the sphere that normalises it: what `--domain` asks for, else what the scene says."""
    shape = scene.shape
    if isinstance(choice, tuple):
        return closed(load(choice[1], "--domain"), shape.center, shape.radius)
    if choice == "auto" and shape.domain:
        return shape.domain
    try:
        surface = scene.hull.surface() if choice != "sphere" and scene.whole and scene.hull else None
    except InputError:
        if choice == "hull" or shape.center is None or shape.radius is None:
            raise
        surface = None  # the masks are of no use, but the scene says where the object is
    if surface is None and choice == "hull":
        raise InputError(f"{scene.path}: --domain hull: there are no masks of the whole object from several sides; "
                         "give them, or --domain sphere")  # fmt: skip
    if surface is not None and (choice == "hull" or genus(surface)):
        print(f"Start: the masks' visual hull, of genus {genus(surface)}")
        return closed(surface, shape.center, shape.radius)
    return Sphere(), *scene.sphere()


def check_place(scene: capture.Capture, domain: Domain, center: np.ndarray, radius: float) -> None:
    """Raise InputError if a camera or its light is inside the start surface, or if a camera looks away from it."""
    cameras = np.array(scene.photographs.cameras).reshape(-1, 3, 4)
    lights = np.array(scene.photographs.lights).reshape(-1, 8)
    surface = center + radius * domain.points
    ahead = [((surface - camera[:, 3]) @ camera[:, 2]).max() for camera in cameras]
    if min(ahead) < 0:
        sensor = scene.sensors[int(np.argmin(ahead))]
        raise InputError(f'{scene.path}: photograph "{sensor.id()}", to_world: its camera looks away from the surface '
                         "that the fit starts from; see python -m mi_ring.check")  # fmt: skip
    places = {"to_world: its camera": cameras[:, :, 3],
              "emitter: its light": np.where(lights[:, 3:4] > 0, np.inf, lights[:, :3])}  # fmt: skip
    for what, points in places.items():
        if (inside := domain.contains((points - center) / radius)).any():
            sensor = scene.sensors[int(inside.argmax())]
            raise InputError(
                f'{scene.path}: photograph "{sensor.id()}", {what} is inside the surface that the fit starts from, of '
                f"radius {radius:.4g} about ({', '.join(f'{c:.4g}' for c in center)}); check its place and units"
            )


def read_checkpoint(config: Config) -> dict:
    """The state a fit stopped at. Raises InputError if there is none or if it was made with other settings."""
    require_file(config.scene, "the XML file of a scene")
    path = config.folder / "checkpoint.pt"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        before = state["settings"]
    except FileNotFoundError:
        raise InputError(f"{path}: --resume: no such file; run without --resume to start anew") from None
    except Exception as error:
        raise InputError(f"{path}: --resume: not a checkpoint ({str(error).splitlines()[0]})") from error
    for name, value in config.settings().items():
        if before.get(name) != value:
            raise InputError(f"{path}: --{name.replace('_', '-')}: was {before.get(name)} before, is {value} now; "
                             "give the same settings to resume, or start anew without --resume")  # fmt: skip
    if state["scene"] != digest(config.scene):
        raise InputError(f"{path}: --resume: was made from another scene file than {config.scene}")
    return state


def digest(file: Path) -> str:
    """What tells one scene file from another."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def optimizers(ring: Ring, config: Config) -> list[torch.optim.Optimizer]:
    """Muon for the hidden weight matrices and Adam for everything else, or Adam for all."""
    hidden = [layer.weight for net in (ring.shape_net, ring.brdf_net) for layer in net.hidden]
    if config.optimizer == "adam":
        hidden = []
    rest = [p for p in ring.parameters() if not any(p is h for h in hidden)]
    result: list[torch.optim.Optimizer] = [torch.optim.Adam(rest, lr=config.learning_rate)]
    if hidden:
        result.append(torch.optim.Muon(hidden, lr=config.muon_rate, weight_decay=0.0))
    for optimizer in result:
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
    return result


def autocast(precision: str, device: torch.device):
    """A context in which the networks' matrix products have this precision."""
    if device.type == "cuda":
        fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        fast = torch.cpu._is_amx_tile_supported()  # with AVX512-BF16 alone it is half as fast as float32
    if precision == "bfloat16" or (precision == "auto" and fast):
        return lambda: torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext


def set_variant(variant: str) -> str:
    """Switch Mitsuba to a variant and return its name: that of the processor, where there is no GPU to use."""
    reason = None
    if variant.startswith("cuda"):
        if not torch.cuda.is_available():
            reason = "PyTorch finds none" if torch.version.cuda else "this PyTorch is built without CUDA"
        elif not dr.has_backend(dr.JitBackend.CUDA):
            reason = "Dr.Jit finds none, or its driver is too old"
        else:
            mi.set_variant(variant)
            try:
                mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})  # the first scene loads OptiX
            except RuntimeError as error:
                reason = " ".join(str(error).split())
    if reason:
        print(f"--variant {variant}: no GPU to use ({reason}); going on with llvm_ad_rgb, on the processor")
        variant = "llvm_ad_rgb"
    mi.set_variant(variant)
    return variant


def set_threads(config: Config) -> None:
    """Set the number of threads of torch and Dr.Jit.

    Parallel sums depend on the order in which threads finish: one thread is what determinism costs.
    """
    threads = 1 if config.deterministic else config.threads or len(os.sched_getaffinity(0))
    torch.set_num_threads(threads)
    dr.set_thread_count(threads)


@contextlib.contextmanager
def threads_of(config: Config):
    """The fit's threads, and those of before at the end. Not for reading: on one, Mitsuba waits forever for an EXR."""
    before = torch.get_num_threads(), dr.thread_count()
    set_threads(config)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        dr.set_thread_count(before[1])


def keep_memory() -> None:
    """Have glibc keep freed memory, for the rest of the process.

    The system takes longer to hand out and clear pages than most operations take to use them.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # glibc alone has it
    if mallopt:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


@contextlib.contextmanager
def interruptible():
    """Yields a function that tells whether Ctrl-C was pressed. A second Ctrl-C ends the program at once."""
    pressed = []

    def press(number, frame):
        pressed.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        tqdm.write("\nInterrupted: writing what there is (Ctrl-C again to drop it)")

    before = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


def train(fit: Fit, folder: Path, interrupted) -> None:
    """Iterate to the end or until interrupted, with a progress bar, a log and checkpoints in `folder`."""
    vertices = {stage.level: len(fit.ring.domain.sample(stage.level)[0]) for stage in fit.stages}
    work = [vertices[s.level] + FIXED_WORK for s in fit.stages for _ in range(s.first, s.last)]
    saved = time.monotonic()
    bar = tqdm(
        total=sum(work), initial=sum(work[: fit.iteration]), smoothing=0.1,
        bar_format="{desc} |{bar:20}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}",
    )  # fmt: skip
    results.start_log(folder, fit.iteration)
    with bar:
        while fit.iteration < fit.iterations and not interrupted():
            terms = fit.step()
            stage = fit.stages.index(fit.stage) + 1
            where = f"stage {stage}/{len(fit.stages)}, iteration {fit.iteration}/{fit.iterations}"
            bar.set_description_str(where, refresh=False)
            bar.set_postfix_str(f"loss {terms['loss']:.4f}", refresh=False)
            bar.update(work[fit.iteration - 1])
            if fit.iteration % LOG_EVERY == 0 or fit.iteration == fit.iterations:
                entry = {"iteration": fit.iteration, "seconds": round(fit.seconds, 3), **terms,
                         "learning_rate": fit.optimizers[0].param_groups[0]["lr"], "stage": stage,
                         "vertices": vertices[fit.stage.level]}  # fmt: skip
                results.log(folder, entry)
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                results.save(fit.state(), folder / "checkpoint.pt")
                saved = time.monotonic()
    results.save(fit.state(), folder / "checkpoint.pt")


def main(arguments: Sequence[str]) -> int:
    """The command. Returns its exit status: 0, or 130 if it was interrupted."""
    config = parse(arguments)
    config = dataclasses.replace(config, variant=set_variant(config.variant))
    state = read_checkpoint(config) if config.resume else None
    keep_memory()
    scene = capture.load(config.scene, masks=config.masks)
    if scene.threshold is not None:
        print("Masks: found by brightness, for the room was dark")
    elif config.masks != "given" and all(mask is None for mask in scene.masks):
        print("No masks, and the room was not dark enough to find the object by its brightness: going on without")
    with threads_of(config):
        return reconstruct(scene, config, state)


def reconstruct(scene: capture.Capture, config: Config, state: dict | None) -> int:
    """Fit, from that state on if it is given, and write the results. Returns the exit status of the command."""
    fit = Fit(scene, config)
    folder = config.folder
    if state:
        fit.restore(state)
    fitted_scene = results.scene_xml(config.scene, folder, config.subdivisions, fit.ring.bsdf)
    results.prepare(folder, config)
    with interruptible() as interrupted:
        print(f"{len(scene)} photographs; results go to {folder}/; Ctrl-C ends early and keeps what there is")
        if config.indirect and not fit.ring.indirect:
            print("Interreflection is left out: by the lights' intensities, which must be true for it, the object "
                  f"reflects {fit.albedo:.3g} times the light that it gets")  # fmt: skip
        if not state:
            results.write_inputs(folder / "inputs.png", fit)
        try:
            train(fit, folder, interrupted)
        except Exception:
            results.write(folder, fit, fitted_scene)
            raise
        results.write(folder, fit, fitted_scene)
    if fit.iteration < fit.iterations:
        print(f"Stopped at iteration {fit.iteration} of {fit.iterations}; go on with the same command and --resume")
        return 130
    return 0


def parse(arguments: Sequence[str]) -> Config:
    """The configuration: the preset's settings under those given on the command line."""
    early = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    early.add_argument("--preset", nargs="?", default="default")
    preset = early.parse_known_args(arguments)[0].preset
    return command.parse(Config, arguments, "mi_ring.fit", Config(tyro.MISSING, **PRESETS.get(preset, {})))


if __name__ == "__main__":
    command.run("mi_ring.fit", main)
