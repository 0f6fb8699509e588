"""Reconstruct an object from its photographs: `python -m mi_ring.fit SCENE.xml`."""

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import load_capture, require_scene
from mi_ring.capture.reduction import WIDTH
from mi_ring.errors import InputError
from mi_ring.fit_config import FitConfig, parse_options
from mi_ring.fitting.budget import Costs, all_stages, fewest_seconds, fitting_into, measure, replan
from mi_ring.fitting.checkpoint import read_checkpoint, resumed
from mi_ring.fitting.fine_texture import texture_seconds
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.light_selection import choose_lighting
from mi_ring.fitting.processes import Processes, joined
from mi_ring.fitting.session import run_session
from mi_ring.output import results
from mi_ring.system import command
from mi_ring.system.files import locked, read_json
from mi_ring.system.machine import keep_memory, set_variant, threads_of

MARGIN = 1.2  #: factor of the --minutes that an error message suggests over the measured time, which may vary
PLANNED = "fast", "default", "fine"  #: presets that --minutes chooses from


def main(arguments: Sequence[str]) -> int:
    """Run the command. Returns its exit status: 0, or 128 + the number of the signal that stopped it (130: Ctrl-C)."""
    with joined() as processes:
        return run(arguments, processes)


def run(arguments: Sequence[str], processes: Processes) -> int:
    """Run the command in this process.

    Returns the exit status: 0, or 128 + the number of the signal that stopped the fit. `processes`: all processes that
    compute this fit together.
    """
    started = time.monotonic()
    config, choice, state = processes.on_first(lambda: asked(arguments))
    folder = config.folder
    processes.agreed(lambda: None if processes.rank == 0 else same_variant(config.variant))
    keep_memory()
    width = max(WIDTH, *config.widths)
    load = partial(load_capture, config.scene, masks=config.masks, width=width, pairs=config.pairs)
    capture = processes.agreed(load)
    if capture.shape.ring is not None:
        print(f"{config.scene}: contains a fitted object. The fit ignores it and starts anew")
    if capture.threshold is not None:
        print("No masks given. The room was dark, so masks are found by brightness")
    elif config.masks != "given" and not any(capture.masks.given):
        print("No masks given, and the room was too bright to find masks by brightness: the fit has no masks")
    with threads_of(config.thread_count or processes.threads), contextlib.ExitStack() as held:
        if state:
            fit = processes.agreed(lambda: resumed(state, capture, config, folder))
        else:
            fit = started_fit(capture, config, processes)
        processes.on_first(lambda: results.fitted_scene(capture, fit.ring, folder))  # raises InputError early
        processes.on_first(lambda: held.enter_context(locked(folder)))
        costs = None
        if config.minutes and not state:
            config, costs = planned(choice, fit, started)
            replan(fit, config)
        options = json.loads(json.dumps(dataclasses.asdict(config), default=str))
        prepare = partial(results.prepare_folder, folder, config.scene, options)
        processes.on_first(lambda: prepare(config.resume))
        interrupted = run_session(fit, folder, partial(prepare, resume=True), costs)
    if interrupted:
        print(f"Stopped at iteration {fit.iteration} of {fit.iterations}; go on with the same command and --resume")
    return 128 + interrupted if interrupted else 0


def started_fit(capture: Capture, config: FitConfig, processes: Processes) -> Fit:
    """Make a new fit, before its first iteration. If the light is unknown, coarse fits first find out what kind it is.

    `processes`: all processes that compute this fit together. The recorded duration of the fit includes the coarse
    fits.
    """
    began = time.perf_counter()
    lighting = processes.broadcast(processes.agreed(lambda: choose_lighting(capture, config)))
    seconds = time.perf_counter() - began
    fit = processes.agreed(lambda: Fit(capture, config, lighting=lighting))
    fit.course.seconds = seconds
    return fit


def asked(arguments: Sequence[str]) -> tuple[FitConfig, list[FitConfig], dict | None]:
    """Read the arguments of the command line. Returns (options, alternatives, checkpoint).

    The alternatives are the option sets from which --minutes chooses. The checkpoint is the content of the newest one
    if --resume is given, otherwise None.
    """
    config = parse_options(arguments)
    choice = choice_of(config, arguments)
    require_scene(config.scene)
    variant: Any = set_variant(config.variant)
    config, *choice = (dataclasses.replace(c, variant=variant) for c in (config, *choice))
    if config.resume:
        config = planned_before(config, choice, config.folder)
    return config, choice, read_checkpoint(config.folder, config) if config.resume else None


def same_variant(variant: str) -> None:
    """Switch Mitsuba in this process to `variant`, with which the first process computes.

    Raises InputError if this process cannot use it.
    """
    if set_variant(variant) != variant:
        raise InputError(f"--variant {variant}: this process has no GPU to use; give llvm_ad_rgb")


def choice_of(config: FitConfig, arguments: Sequence[str]) -> list[FitConfig]:
    """List the option sets from which --minutes chooses. `config`: the options as given.

    There is one for each preset that does not contradict the other options. If --preset is given, or if --minutes is
    not given, the list contains only `config`. Raises InputError if --minutes and --iterations are both given.
    """
    if config.minutes and given(arguments, "--iterations"):
        raise InputError("--minutes: chooses --iterations; give one of the two")
    choice = []
    if config.minutes and not given(arguments, "--preset"):
        for name in PLANNED:
            with contextlib.suppress(InputError):
                choice.append(parse_options([*arguments, "--preset", name]))
    return choice or [config]


def planned(choice: Sequence[FitConfig], fit: Fit, started: float) -> tuple[FitConfig, Costs]:
    """Choose the option set of `choice` whose fit takes --minutes. Measures how long iterations of `fit` take.

    `started`: start time of the command on the clock `time.monotonic` [s]. Returns (option set with its number of
    iterations, measured seconds per iteration). Raises InputError if --minutes is too short for every option set.
    """
    minutes, processes = choice[0].minutes, fit.problem.processes
    spent = processes.broadcast(time.monotonic() - started)
    if spent > 60 * minutes:
        raise InputError(f"--minutes: is {minutes:g}, but the start alone has taken {spent:.0f} s; give more")
    costs = processes.broadcast(measure(fit, all_stages(fit, choice)))
    spent = processes.broadcast(time.monotonic() - started)
    if (needed := spent + fewest_seconds(choice, fit.plan, costs)) > 60 * minutes:
        raise InputError(f"--minutes: is {minutes:g}, too few for a fit of this capture on this machine; give "
                         f"{math.ceil(MARGIN * needed / 6) / 10:g} or more")  # fmt: skip
    left = 60 * minutes - spent
    chosen = fitting_into(left, choice, fit.plan, costs)
    if chosen.detail in ("texture", "both"):
        left -= texture_seconds(fit.capture, fit.problem.fitted)
        chosen = fitting_into(max(left, fewest_seconds([chosen], fit.plan, costs)), [chosen], fit.plan, costs)
    print(f"In about {minutes:g} minutes: --preset {chosen.preset} --iterations {chosen.iterations} "
          f"--detail {chosen.detail}")  # fmt: skip
    return chosen, costs


def planned_before(config: FitConfig, choice: Sequence[FitConfig], folder: Path) -> FitConfig:
    """Find the options that --minutes chose when the fit was started. They are read from config.json in `folder`.

    `config`: the options of this call. `choice`: the option sets from which --minutes chooses. Returns `config` if
    --minutes is not given or config.json cannot be read. Raises InputError if --minutes is not the same as before.
    """
    try:
        before = read_json(folder / "config.json")
        minutes, preset, iterations = float(before["minutes"]), before["preset"], int(before["iterations"])
    except (ValueError, LookupError, TypeError, OverflowError):
        return config  # reading the checkpoint reports what is wrong
    if minutes != config.minutes:
        said = [f"{value:g}" if value else "not given" for value in (minutes, config.minutes)]
        raise InputError(f"{folder}: --minutes: was {said[0]} before, is {said[1]} now; give the same")
    if not minutes:
        return config
    config = next((c for c in choice if c.preset == preset), config)
    return dataclasses.replace(config, iterations=iterations)


def given(arguments: Sequence[str], option: str) -> bool:
    """Test whether `option`, such as --preset, is among the arguments."""
    return any(argument.split("=")[0] == option for argument in arguments)


if __name__ == "__main__":
    command.run("mi_ring.fit", main)
