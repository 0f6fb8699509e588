"""A fit from its first iteration to its results: progress, log, checkpoints, Ctrl-C."""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import trimesh
from tqdm import tqdm

from mi_ring.fitting.budget import Costs, measure
from mi_ring.fitting.checkpoint import digests, write_checkpoint
from mi_ring.fitting.fit import Fit
from mi_ring.geometry.domain import Sphere
from mi_ring.geometry.meshes import genus
from mi_ring.output import results
from mi_ring.system.optional import installed
from mi_ring.system.progress import progress

CHECKPOINT_SECONDS = 30.0
TELLING = 60  #: iterations: shorter fits do without measuring how long theirs take


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether Ctrl-C was pressed. A second Ctrl-C ends the program at once."""
    pressed: list[int] = []

    def press(number: int, frame: object) -> None:
        pressed.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        tqdm.write("\nInterrupted: writing what there is (Ctrl-C again to drop it)")

    before = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


def train(fit: Fit, folder: Path, interrupted: Callable[[], bool], costs: Costs | None) -> None:
    """Iterate to the end or until interrupted, with a progress bar, a log and checkpoints in `folder`."""
    if costs is None and fit.iterations - fit.iteration >= TELLING:
        costs = measure(fit, [stage for stage in fit.stages if stage.last > fit.iteration])
    work = [(costs or {}).get((s.level, s.width), 1.0) for s in fit.stages for _ in range(s.first, s.last)]
    saved, files = time.monotonic(), digests(fit.capture, fit.config)
    bar = progress(
        None, total=sum(work), initial=sum(work[: fit.iteration]), smoothing=0.1, leave=True,
        bar_format="{desc} |{bar:20}| {percentage:3.0f}% {elapsed}<{remaining}{postfix}",
    )  # fmt: skip
    results.write_log(folder, fit.log)
    with bar:
        while fit.iteration < fit.iterations and not interrupted():
            it = fit.step()
            stage = fit.stages.index(it.stage) + 1
            where = f"stage {stage}/{len(fit.stages)}, iteration {it.number}/{fit.iterations}"
            bar.set_description_str(where, refresh=False)
            bar.set_postfix_str(f"loss {it.loss:.4f}", refresh=False)
            bar.update(work[it.number - 1])
            if fit.log[-1:] and fit.log[-1]["iteration"] == it.number:
                results.add_to_log(folder, fit.log[-1])
            if time.monotonic() - saved > CHECKPOINT_SECONDS:
                write_checkpoint(fit, files, folder)
                saved = time.monotonic()
    write_checkpoint(fit, files, folder)


def start_of(fit: Fit) -> str:
    """What a fit starts from."""
    domain, place = fit.ring.domain, "({:.4g}, {:.4g}, {:.4g})".format(*fit.ring.center.tolist())
    if isinstance(domain, Sphere):
        missing = fit.config.domain == "auto" and fit.capture.whole and not installed("gpytoolbox")
        better = "; the masks' hull would be a better one, for which the package gpytoolbox is needed" * missing
        return f"a sphere of radius {float(fit.ring.radius):.4g} about {place}{better}"
    return f"a surface of genus {genus(trimesh.Trimesh(domain.points, domain.faces, process=False))} about {place}"


def run_session(fit: Fit, folder: Path, costs: Costs | None = None) -> bool:
    """Run a fit in a folder that has been prepared and write its results, whatever ends it. Was it interrupted?

    `costs`: of its iterations, if they have been measured already.
    """
    fitted_scene = results.fitted_scene(fit, folder)
    with interruptible() as interrupted:
        print(f"{len(fit.capture)} photographs; results go to {folder}/; Ctrl-C ends early and keeps what there is")
        if fit.config.indirect and not fit.ring.indirect:
            print("Interreflection is left out: by the lights' intensities, which must be true for it, the object "
                  f"reflects {fit.albedo:.3g} times the light that it gets")  # fmt: skip
        elif fit.albedo >= 1 and fit.calibration and "scale" in fit.calibration.refined:
            print(f"By the lights' intensities the object reflects {fit.albedo:.3g} times the light that it gets: how "
                  "strong they are is found by interreflection (--refine scale)")  # fmt: skip
        if not fit.iteration:
            print(f"Start: {start_of(fit)}")
            results.write_inputs(folder / "inputs.png", fit)
        try:
            train(fit, folder, interrupted, costs)
        except Exception:
            results.write(folder, fit, fitted_scene)
            raise
        results.write(folder, fit, fitted_scene)
    return fit.iteration < fit.iterations
