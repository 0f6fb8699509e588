"""Runs a fit from its first iteration to its results, with progress bar, log and checkpoints.

It writes results also after signals and errors, and if the disk is full.
"""

import contextlib
import math
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import trimesh
from tqdm import tqdm

from mi_ring.errors import InputError
from mi_ring.fitting.budget import Costs, measure, seconds_per_iteration
from mi_ring.fitting.checkpoint import BEFORE, digests, write_checkpoint
from mi_ring.fitting.coat_selection import described
from mi_ring.fitting.detail_stage import FEWEST_PHOTOGRAPHS
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.processes import ProcessLost
from mi_ring.geometry.domain import Sphere
from mi_ring.geometry.meshes import genus
from mi_ring.output import results
from mi_ring.output.fit_result import FitResult
from mi_ring.system.command import SIGNALS
from mi_ring.system.optional import installed
from mi_ring.system.progress import progress, tolerating_closed_output

CHECKPOINT_SECONDS = 30.0
INPUTS_LEVEL = 4  #: level of the surface in inputs.png
WORTH_MEASURING = 60  #: iterations: shorter fits do not measure how long an iteration takes


@contextlib.contextmanager
def ending_signals() -> Iterator[Callable[[], int]]:
    """Context manager that catches the signals that end a fit, so that the fit can end in order.

    Yields a function that returns the number of the first signal received, or 0. After the first signal, Ctrl-C ends
    the program at once. Other signals have no effect when they are repeated: shells and schedulers may send them
    repeatedly.
    """
    received: list[int] = []

    def hear(number: int, frame: object) -> None:
        received.append(number)  # without printing: it may interrupt a print
        signal.signal(signal.SIGINT, signal.default_int_handler)

    handled = [n for n in SIGNALS if n == signal.SIGINT or signal.getsignal(n) != signal.SIG_IGN]  # not under nohup
    before = {number: signal.signal(number, hear) for number in handled}
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Keeper:
    """Writes log, checkpoints and results of a fit into its folder.

    If writing a checkpoint fails, it tries again later. If the fit has several processes, only the first one writes.
    `prepare`: a function that makes the folder again, if somebody has removed it.
    """

    def __init__(self, fit: Fit, folder: Path, prepare: Callable[[], None]) -> None:
        self.fit, self.folder, self.prepare = fit, folder, prepare
        self.writes = fit.problem.processes.rank == 0
        self.files = digests(fit.problem.given, fit.problem.config) if self.writes else {}
        self.saved, self.failing = -math.inf, False

    def follow(self, it: Iteration) -> None:
        """Write log and checkpoint if they are due after the iteration `it`. If this fails, the user gets a message.

        A checkpoint is due every 30 seconds and at the end of each stage.
        """
        log = self.fit.course.log
        if not self.writes:
            return
        if log and log[-1]["iteration"] == it.number:
            self.attempt(lambda: results.add_to_log(self.folder, log[-1]))
        due = it.number == it.stage.last or time.monotonic() - self.saved > CHECKPOINT_SECONDS
        if due and it.number < self.fit.iterations:  # after the last iteration it is written in any case
            self.attempt(self.checkpoint)
            self.saved = time.monotonic()

    def checkpoint(self) -> None:
        """Write a checkpoint and the whole log now. Raises InputError or OSError if that fails."""
        if not self.writes:
            return
        if not self.folder.is_dir():  # somebody has removed it
            self.prepare()
        results.write_log(self.folder, self.fit.course.log)
        write_checkpoint(self.fit, self.files, self.folder)

    def attempt(self, write: Callable[[], None]) -> None:
        """Call `write`. If it fails, print a message, once until it succeeds again. The error is not raised."""
        try:
            write()
        except (InputError, OSError) as error:
            if not self.failing:
                tqdm.write(f"{str(error).partition(';')[0]}; the fit goes on and tries again")
            self.failing = True
        else:
            self.failing = False

    def finish(self, fitted_scene: bytes) -> None:
        """Write the results. `fitted_scene`: content of the scene file with the fitted object.

        If they cannot be written to the results folder, they are written to a new temporary folder, and InputError,
        which names this folder, is raised.
        """
        if not self.writes:
            return
        self.warn_of_changes()
        result = self.fit.result()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            results.write(self.folder, result, fitted_scene)
        except (InputError, OSError) as error:
            what = str(error).partition(";")[0]
            path = Path(what.partition(":")[0])
            if not path.is_relative_to(self.folder) and path.name in {Path(file).name for file in self.files}:
                raise InputError(f"{what}; {self.folder} has what could be written: restore the file, then the same "
                                 "command and --resume") from error  # fmt: skip
            raise InputError(f"{what}; {self.rescue(result, fitted_scene)}") from error

    def warn_of_changes(self) -> None:
        """Print which input files have changed since the fit began. Its results then come from both contents."""
        with contextlib.suppress(OSError):  # a file that has gone is reported where it is needed
            now = digests(self.fit.problem.given, self.fit.problem.config)
            if changed := [name for name, content in now.items() if content != self.files.get(name)]:
                print(f"{', '.join(sorted(changed))}: changed while the fit ran. Texture and report show the new "
                      "files, surface and material the old ones; fit again")  # fmt: skip

    def rescue(self, result: FitResult, fitted_scene: bytes) -> str:
        """Write as much as possible of checkpoint and results to a new temporary folder.

        `fitted_scene`: content of the scene file with the fitted object. Returns a text for the user that names the
        folder.
        """
        saved = ""
        try:
            elsewhere = Path(tempfile.mkdtemp(prefix=f"mi_ring-{self.folder.name}-")) / self.folder.name
            results.prepare_folder(elsewhere, result.given.path, result.settings, resume=True)
            results.write_log(elsewhere, result.log)
            write_checkpoint(self.fit, self.files, elsewhere)
            saved = f"what could be written is in {elsewhere} instead, with a checkpoint"
            with contextlib.suppress(InputError, OSError):  # the scene may have gone with the folder
                fitted_scene = results.fitted_scene(result.given, result.ring, elsewhere)
            results.write(elsewhere, result, fitted_scene)
        except (InputError, OSError):
            left = "what the last checkpoint there has is left, for --resume; make room or choose another place"
            return saved or left
        return f"the results are in {elsewhere} instead"


def train(fit: Fit, keeper: Keeper, interrupted: Callable[[], int], costs: Costs | None) -> None:
    """Run the iterations of a fit until its end or an interruption, with progress bar, log and checkpoints.

    `interrupted`: returns the number of the signal that interrupts the fit, or 0. `costs`: for the progress bar, a dict
    from (mesh level, photograph width) to seconds per iteration; None: measure them now.
    """
    if costs is None and fit.iterations - fit.iteration >= WORTH_MEASURING and not interrupted():
        left = [stage for stage in fit.schedule.stages if stage.last > fit.iteration]
        costs = fit.problem.processes.broadcast(measure(fit, left, interrupted))
    stages = fit.schedule.stages
    each = [seconds_per_iteration(stage, stages, costs) if costs else 1.0 for stage in stages]
    work = [seconds for stage, seconds in zip(stages, each) for _ in range(stage.first, stage.last)]
    bar = progress(
        None, total=sum(work), initial=sum(work[: fit.iteration]), smoothing=0.1, leave=True,
        bar_format="{desc} |{bar:20}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}",
    )  # fmt: skip
    if keeper.writes:
        results.write_log(keeper.folder, fit.course.log)
    stop = 0
    with bar:
        while fit.iteration < fit.iterations and not (stop := interrupted()):
            retreats, lobes = fit.optimisation.guard.retreats, {**fit.course.coat}
            it = fit.step()
            if fit.course.coat != lobes:
                bar.write(described(fit.course.coat))
            if fit.optimisation.guard.retreats > retreats:
                bar.write(f"Iteration {it.number}: loss, gradient or weights were not finite; going on from the last "
                          "ones that were, by smaller steps")  # fmt: skip
            stage = stages.index(it.stage) + 1
            doing = ", light and material settle" * it.stage.settles
            where = f"stage {stage}/{len(stages)}{doing}, iteration {it.number}/{fit.iterations}"
            bar.set_description_str(where, refresh=False)
            bar.set_postfix_str(f"loss {it.loss:.4f}", refresh=False)
            bar.update(work[it.number - 1])
            keeper.follow(it)
    if stop:
        print("Interrupted: writing what there is (Ctrl-C again to drop it)", flush=True)
    keeper.checkpoint()


@contextlib.contextmanager
def resume_hint(folder: Path) -> Iterator[None]:
    """Context manager that prints how to resume the fit, if a second Ctrl-C ends the program.

    `folder`: the results folder. Nothing is printed if it has no checkpoint.
    """
    try:
        yield
    except KeyboardInterrupt:
        if any((folder / name).is_file() for name in ("checkpoint.pt", BEFORE)):
            print(f"Dropped; {folder} has a checkpoint: go on with the same command and --resume")
        raise


def details_missing(fit: Fit) -> str:
    """Say why a fit that should find details finds none, for the user. Empty if it does, or if none are wanted."""
    config = fit.problem.config
    if config.detail == "none" or not config.detail_share or fit.schedule.stages[-1].detail:
        return ""
    if fit.model.detail_levels:
        return f"{config.iterations} iterations are too few (--iterations, --detail-share)"
    few = len(fit.problem.fitted) < FEWEST_PHOTOGRAPHS
    return f"they need {FEWEST_PHOTOGRAPHS} photographs" if few else "no file could hold those of networks of your own"


def start_of(fit: Fit) -> str:
    """Describe the start surface of a fit in words, for the user."""
    domain, place = fit.ring.domain, "({:.4g}, {:.4g}, {:.4g})".format(*fit.ring.center.tolist())
    if isinstance(domain, Sphere):
        missing = fit.problem.config.domain == "auto" and fit.capture.whole and not installed("gpytoolbox")
        better = "; the masks' hull would be a better one, for which the package gpytoolbox is needed" * missing
        return f"a sphere of radius {float(fit.ring.radius):.4g} about {place}{better}"
    return f"a surface of genus {genus(trimesh.Trimesh(domain.points, domain.faces, process=False))} about {place}"


def run_session(fit: Fit, folder: Path, prepare: Callable[[], None], costs: Costs | None = None) -> int:
    """Run a fit and write its results into `folder`, even if the fit is interrupted or fails.

    Returns the number of the signal that interrupted the fit, or 0. `prepare`: makes the folder again if somebody has
    removed it. `costs`: a dict from (mesh level, photograph width) to seconds per iteration; None: measure them now.
    """
    processes, model, config = fit.problem.processes, fit.model, fit.problem.config
    fitted_scene = processes.on_first(lambda: results.fitted_scene(fit.problem.given, fit.ring, folder))
    with ending_signals() as heard, tolerating_closed_output():

        def interrupted() -> int:
            return processes.maximum(heard())

        keeps = "; Ctrl-C ends early and keeps what there is" * getattr(sys.stdin, "isatty", bool)()
        print(f"{len(fit.capture)} photographs; results go to {folder}/{keeps}")
        if model.calibration:
            print(f"Refined besides surface and material: {', '.join(model.calibration.refined)}")
        if config.indirect and not fit.ring.indirect:
            print("Interreflection is left out: by the lights' intensities, which must be true for it, the object "
                  f"reflects {model.albedo:.3g} times the light that it gets")  # fmt: skip
        elif model.albedo >= 1 and model.calibration and "scale" in model.calibration.refined:
            print(f"With the lights of the scene the object would reflect {model.albedo:.3g} times the light that it "
                  "gets. The fit finds how strong they really are (--refine scale)")  # fmt: skip
        if processes.count > 1:
            print(f"{processes.count} processes share the points and photographs of each iteration")
        if missing := details_missing(fit):
            print(f"No details: {missing}")
        if not fit.iteration:
            print(f"Start: {start_of(fit)}")
            processes.on_first(lambda: results.write_inputs(
                folder / "inputs.png", fit.problem.capture, fit.renderer.show(model, INPUTS_LEVEL)
            ))  # fmt: skip
        keeper = Keeper(fit, folder, prepare)
        with resume_hint(folder):
            try:
                train(fit, keeper, interrupted, costs)
            except ProcessLost:
                raise
            except Exception as error:
                keeper.finish(fitted_scene)
                if isinstance(error, InputError):  # in all processes: `torchrun` would end the first with the others
                    processes.barrier()
                raise
            keeper.finish(fitted_scene)
        return interrupted() if fit.iteration < fit.iterations else processes.maximum(0)
