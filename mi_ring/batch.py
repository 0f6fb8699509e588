"""Reconstruct many objects, on one machine or many: `python -m mi_ring.batch SCENES… --workers N -- FIT OPTIONS`."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.capture.loading import require_capture
from mi_ring.collection.cluster import Resources, fit_all
from mi_ring.collection.jobs import Job, jobs_of
from mi_ring.errors import InputError
from mi_ring.fit_config import parse_options
from mi_ring.output.index import Entry, write_index
from mi_ring.system import command
from mi_ring.system.files import locked
from mi_ring.system.machine import cores, set_variant
from mi_ring.system.optional import need
from mi_ring.system.progress import outliving_readers, progress

OWN = "--out", "--resume", "--threads"  #: options of fits that a batch gives them itself


@dataclass(frozen=True)
class BatchConfig:
    """Reconstruct many objects, several at a time, on this machine or on a Ray cluster.

    Options after -- are options of mi_ring.fit and hold for all fits. A fit whose process or machine dies continues
    from its last checkpoint. A fit whose input is wrong fails, and the others continue. The same command again does
    what is unfinished; finished fits are left out unless their files or options have changed. The exit status is 1 if a
    fit is not done.
    """

    scenes: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE.xml")]]
    """Mitsuba XML files, each with the photographs of one object."""
    out: Path = Path("out")
    """Folder for all results. Each scene gets a folder of its name, and index.html shows them all.
    batch/ keeps what each fit has printed. On a cluster, scenes and this folder have the same path on all machines."""
    workers: int = 1
    """Number of fits that run at the same time."""
    cpus: int = 0
    """Processor cores for each fit. 0: the cores of this machine, shared among --workers."""
    gpus: float = 0
    """GPUs for each fit. 0.5 lets two fits share one.
    Give --variant cuda_ad_rgb after -- as well."""
    memory: float = 0
    """Memory that a fit needs [GiB]. A machine gets no more fits than it has memory for.
    0: no limit."""
    retries: int = 3
    """How many times in a row a fit may die without progress before it counts as failed."""
    address: str | None = None
    """Address of a Ray cluster, for example auto or 10.0.0.1:6379. Without it: this machine alone."""

    def __post_init__(self) -> None:
        for name, least in (("workers", 1), ("cpus", 0), ("gpus", 0), ("memory", 0), ("retries", 0)):
            if not least <= getattr(self, name) < 10**6:
                raise InputError(f"--{name}: is {getattr(self, name)}, must be {least} or more")
        if not self.scenes:
            raise InputError("SCENE.xml: is missing; name one or more")

    @property
    def resources(self) -> Resources:
        """What each fit is given."""
        cpus = self.cpus or max(1, cores() // self.workers)
        return Resources(self.workers, cpus, self.gpus, self.memory, self.address)


def main(arguments: Sequence[str]) -> int:
    """The command. Returns its exit status: 1 if a fit is not done."""
    own, options = list(arguments), []
    if "--" in own:
        own, options = own[: own.index("--")], own[own.index("--") + 1 :]
    try:
        config = command.parse(BatchConfig, own, "mi_ring.batch")
    except InputError as error:
        if str(error).startswith("Unrecognized") and "--" not in arguments:
            raise InputError(f"{error}; options of fits come after --, as in -- --preset fast") from None
        raise
    if wrong := [option for option in options if option.split("=")[0] in OWN]:
        raise InputError(f"{wrong[0]}: is what the batch itself gives each fit; leave it out")
    jobs = jobs_of(config.scenes, config.out, options)
    try:
        fit = parse_options([str(jobs[0].scene), *options])  # what is wrong with them is wrong for all
    except InputError as error:
        raise InputError(f"options of fits, after --: {error}") from None
    need("ray", "mi-ring batch")
    set_variant("llvm_ad_rgb")
    with locked(config.out / "batch"), outliving_readers(), command.going_on():
        todo = waiting(jobs, fit.masks)
        show(jobs, config.out, True)
        with noting_the_end(todo, jobs, config.out):
            if todo:
                follow(todo, jobs, config)
        return finish(jobs, config.out)


def waiting(jobs: Sequence[Job], masks: str) -> dict[Job, str]:
    """What is to be fitted, with fingerprints: what is not done already, nor wrong. What is in the records, too."""
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
            except (InputError, OSError) as error:  # now, rather than at night when its turn comes
                state, message = "failed", command.one_line(str(error))
                print(f"{job.name}: failed: {message}", flush=True)
        job.note(replace(job.record, state=state, message=message, tries=0))
    if done:
        print(f"{done} of {len(jobs)} are done already")
    return todo


@contextlib.contextmanager
def noting_the_end(todo: Iterable[Job], jobs: Sequence[Job], out: Path) -> Iterator[None]:
    """Within it whatever ends all fits early is in their records and in index.html, too, if a full disk lets it."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(InputError):
            for job in todo:
                if job.record.state == "running":
                    job.note(replace(job.record, state="interrupted"))
            show(jobs, out, False)
        raise


def follow(todo: Mapping[Job, str], jobs: Sequence[Job], config: BatchConfig) -> None:
    """Fit them, and say what goes on."""
    before = {job.name: "waiting" for job in todo}
    begun: dict[str, tuple[int, int]] = {}  #: by the iteration and the tries since
    with progress(None, "fits", total=len(todo), leave=True) as bar:

        def look() -> None:
            changed = False
            for job in todo:
                record = job.record
                if record.state != before[job.name]:
                    changed, before[job.name] = True, record.state
                    bar.write(f"{job.name}: {record.state}{': ' * bool(record.message)}{record.message}")
                    bar.update(record.state in ("failed", "done"))
                if record.state == "running":
                    last = record.iteration, record.tries
                    if begun.setdefault(job.name, last) != last:
                        begun[job.name] = last
                        bar.write(f"{job.name}: has died, goes on from iteration {record.iteration} or a little before")
            now = [f"{job.name} {job.progress}" for job in todo if before[job.name] == "running"]
            bar.set_postfix_str("; ".join(now))
            if changed:
                with contextlib.suppress(InputError):  # a disk that is full for a while ends no fit
                    show(jobs, config.out, True)

        fit_all(todo, config.resources, config.retries, look)


def show(jobs: Sequence[Job], out: Path, running: bool) -> None:
    """Write index.html."""
    entries = []
    for job in jobs:
        record = job.record
        text = record.message or (job.progress if record.state == "running" else "")
        entries.append(Entry(job.name, record.state, text, job.folder, job.output))
    write_index(out, entries, running)


def finish(jobs: Sequence[Job], out: Path) -> int:
    """Say what became of each. Returns the exit status."""
    show(jobs, out, False)
    left = [job.name for job in jobs if job.record.state != "done"]
    print(f"{len(jobs) - len(left)} of {len(jobs)} done{', not ' * bool(left)}{', '.join(left)}: {out}/index.html")
    return int(bool(left))


if __name__ == "__main__":
    command.run("mi_ring.batch", main)
