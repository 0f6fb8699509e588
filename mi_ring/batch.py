"""Reconstruct many objects, on one machine or many: `python -m mi_ring.batch SCENES… --workers N -- FIT OPTIONS`."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.capture.loading import require_capture
from mi_ring.collection.cluster import Resources, fit_all
from mi_ring.collection.jobs import Job, make_jobs
from mi_ring.errors import InputError
from mi_ring.fit_config import parse_options
from mi_ring.output.index import Entry, write_index
from mi_ring.system import command
from mi_ring.system.files import locked
from mi_ring.system.machine import cores, set_variant
from mi_ring.system.optional import need
from mi_ring.system.progress import progress, tolerating_closed_output

RESERVED = "--out", "--resume", "--threads"  #: options of fits that the batch sets


@dataclass(frozen=True)
class BatchConfig:
    """Reconstruct many objects, several at a time, on this machine or on a Ray cluster.

    Options after -- are options of mi_ring.fit and hold for all fits. If the process or machine of a fit dies, the
    command continues this fit from its last checkpoint. If the input of a fit is wrong, this fit fails and the others
    continue. Give the same command again to make the fits that are not done. It repeats a finished fit only if its
    files or options have changed. The exit status is 1 if a fit is not done.
    """

    scenes: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE.xml")]]
    """Mitsuba XML files. Each names the photographs of one object, for example captures/*/scene.xml."""
    out: Path = Path("out")
    """Folder for all results. Each scene gets a folder of its name, and index.html shows all results.
    OUT/batch has what each fit printed.
    On a cluster, the scenes and this folder must have the same path on all machines."""
    workers: int = 1
    """Number of fits that run at the same time, for example 2. More fits use the cores better, but need more memory."""
    cpus: int = 0
    """Processor cores for each fit. 0: this machine's cores divided by --workers."""
    gpus: float = 0
    """GPUs for each fit. 1: a GPU for each fit. 0.5: two fits share a GPU. 0: the fits use processors only.
    With GPUs, also give --variant cuda_ad_rgb after --, among the options of the fits."""
    memory: float = 0
    """Memory that one fit needs [GiB], for example 4. 0: no limit.
    A machine then runs only as many fits at a time as its memory allows."""
    retries: int = 3
    """Largest number of restarts of a fit whose process has died, 0 or more. A restarted fit continues from its
    checkpoint. If it reaches a new checkpoint, the count begins again at 0.
    Raise the number if other programs often stop the fits."""
    address: str | None = None
    """Address of a Ray cluster, for example auto or 10.0.0.1:6379. Without this option: this machine alone."""

    def __post_init__(self) -> None:
        for name, least in (("workers", 1), ("cpus", 0), ("gpus", 0), ("memory", 0), ("retries", 0)):
            if not least <= getattr(self, name) < 10**6:
                raise InputError(f"--{name}: is {getattr(self, name)}, must be {least} or more")
        if not self.scenes:
            raise InputError("SCENE.xml is missing; name one or more")


def main(arguments: Sequence[str]) -> int:
    """Run the command with these arguments of the command line.

    Returns its exit status: 0, or 1 if not all fits are done.
    """
    own, options = list(arguments), []
    if "--" in own:
        own, options = own[: own.index("--")], own[own.index("--") + 1 :]
    try:
        config = command.parse(BatchConfig, own, "mi_ring.batch")
    except InputError as error:
        if str(error).startswith("Unrecognized") and "--" not in arguments:
            raise InputError(f"{error}; options of fits come after --, as in -- --preset fast") from None
        raise
    if wrong := [option for option in options if option.split("=")[0] in RESERVED]:
        raise InputError(f"{wrong[0]}: is set by the batch; leave it out")
    jobs = make_jobs(config.scenes, config.out, options)
    try:
        fit = parse_options([str(jobs[0].scene), *options])  # a wrong option is wrong for every fit
    except InputError as error:
        raise InputError(f"options of fits, after --: {error}") from None
    need("ray", "mi-ring batch")
    set_variant("llvm_ad_rgb")
    with locked(config.out / "batch"), tolerating_closed_output(), command.resumable():
        todo = unfinished(jobs, fit.masks)
        write_page(jobs, config.out, running=True)
        try:
            if todo:
                fit_and_report(todo, jobs, config)
        except BaseException:
            with contextlib.suppress(InputError):  # the disk may be full
                for job in todo:
                    if job.record.state == "running":
                        job.save(replace(job.record, state="interrupted"))
                write_page(jobs, config.out, running=False)
            raise
        write_page(jobs, config.out, running=False)
        left = [job.name for job in jobs if job.record.state != "done"]
        missing = f", not {', '.join(left)}" * bool(left)
        print(f"{len(jobs) - len(left)} of {len(jobs)} done{missing}: {config.out}/index.html")
    return int(bool(left))


def unfinished(jobs: Sequence[Job], masks: str) -> dict[Job, str]:
    """Find the jobs whose fits must still be made. Returns a dict from each such job to the hash of its input files.

    `masks`: the option --masks of the fits. The state of every job is saved beside its results. A job whose capture is
    invalid is not returned; its saved state is "failed".
    """
    todo: dict[Job, str] = {}
    done = 0
    for job in progress(jobs, "comparing", unit="scene"):
        fingerprint, state, message = job.fingerprint(), "waiting", ""
        if job.is_done(fingerprint):
            state, done = "done", done + 1
        else:
            try:
                require_capture(job.scene, masks)
                todo[job] = fingerprint
            except (InputError, OSError) as error:
                state, message = "failed", command.one_line(str(error))
                print(f"{job.name}: failed: {message}", flush=True)
        job.save(replace(job.record, state=state, message=message, tries=0))
    if done:
        print(f"{done} of {len(jobs)} are done already")
    return todo


def fit_and_report(todo: Mapping[Job, str], jobs: Sequence[Job], config: BatchConfig) -> None:
    """Make the fits of the jobs `todo`. Prints each change of state and keeps index.html up to date.

    `todo`: a dict from jobs to the hashes of their input files. `jobs`: all jobs on the page index.html, finished ones
    too. `config`: the options of the command.
    """
    states = {job.name: "waiting" for job in todo}
    starts: dict[str, tuple[int, int]] = {}  #: iteration and number of tries at the last start of each fit
    with progress(None, "fits", total=len(todo), leave=True) as bar:

        def report() -> None:
            changed = False
            for job in todo:
                record = job.record
                if record.state != states[job.name]:
                    changed, states[job.name] = True, record.state
                    bar.write(f"{job.name}: {record.state}{': ' * bool(record.message)}{record.message}")
                    bar.update(record.state in ("failed", "done"))
                if record.state == "running":
                    start = record.iteration, record.tries
                    if starts.setdefault(job.name, start) != start:
                        starts[job.name] = start
                        bar.write(f"{job.name}: died; continues at or shortly before iteration {record.iteration}")
            running = [f"{job.name} {job.progress}" for job in todo if states[job.name] == "running"]
            bar.set_postfix_str("; ".join(running))
            if changed:
                with contextlib.suppress(InputError):  # a disk that is full for a while ends no fit
                    write_page(jobs, config.out, running=True)

        cpus = config.cpus or max(1, cores() // config.workers)
        resources = Resources(config.workers, cpus, config.gpus, config.memory, config.address)
        fit_all(todo, resources, config.retries, report)


def write_page(jobs: Sequence[Job], out: Path, running: bool) -> None:
    """Write index.html, a table of all jobs and their states, into the folder `out`.

    `running`: True while fits are running. The page then reloads itself in the browser.
    """
    entries = []
    for job in jobs:
        record = job.record
        text = record.message or (job.progress if record.state == "running" else "")
        entries.append(Entry(job.name, record.state, text, job.folder, job.output))
    write_index(out, entries, running)


if __name__ == "__main__":
    command.run("mi_ring.batch", main)
