"""One of many fits, in a process of its own that is begun again when it dies, from its last checkpoint."""

import contextlib
import ctypes
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mi_ring.collection.jobs import Job, Record, written

MISTAKE = 2  #: exit status of a fit for what the user can mend, and no second try
LOOK = 0.5  #: seconds between looks at what a fit prints
DIE_WITH_PARENT = 1  #: PR_SET_PDEATHSIG of prctl(2)


def fit_to_the_end(
    job: Job, fingerprint: str, retries: int, extra: tuple[str, ...] = (), tell: Callable[[str], None] | None = None
) -> Record:
    """Fit a scene, or go on with its fit, until it is done, has failed, or has died so often without getting further.

    `fingerprint`: the job's. `extra`: options that change nothing of the result. `tell` is given each line that
    the fit prints, while it goes on. Whoever is killed while at it may call it again.
    """
    record = job.record
    if record.fingerprint != fingerprint:  # the fit moves results of another aside, as soon as it begins
        record = Record(fingerprint=fingerprint, since=time.time(), done=record.done, written=record.written)
    if record.state in ("failed", "done"):  # before: a new batch tries anew
        record = replace(record, tries=0)
    complaint = record.message
    while True:
        iteration = job.iteration(record.since)
        tries = 1 if iteration > record.iteration else record.tries + 1
        if tries > retries + 1:
            return job.note(replace(record, state="failed", message=complaint or "was killed again and again"))
        record = job.note(replace(record, state="running", message="", tries=tries, iteration=iteration))
        resume = ["--resume"] if job.has_checkpoint(record.since) else []
        command = [sys.executable, "-m", "mi_ring.fit", str(job.scene), "--out", str(job.folder), *extra, *job.options]
        status, complaint = run([*command, *resume], job, tell)
        if status == 0 and (ring := written(job.folder / "ring.pt")):
            iteration = job.iteration(record.since)
            return job.note(replace(record, state="done", iteration=iteration, done=fingerprint, written=ring))
        if status == MISTAKE and resume:  # by another version, or both checkpoints are damaged: anew, for once
            record = replace(record, since=time.time(), iteration=-1)
            continue
        if status in (0, MISTAKE):  # without results: it was not asked for any
            return job.note(replace(record, state="failed", message=complaint))


def run(command: list[str], job: Job, tell: Callable[[str], None] | None = None) -> tuple[int, str]:
    """Run a fit, which ends with this process. Returns its exit status and the last line that it has printed."""
    with job.output.open("ab") as output:
        output.write(b"\n$ " + " ".join(command).encode(errors="replace") + b"\n")
        output.flush()
        begun, told = output.tell(), 0
        place = job.place if job.place.is_dir() else None  # a worker of a cluster is elsewhere, or has no such folder
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
        process = subprocess.Popen(command, cwd=place, **streams, **dying())
        try:
            status = None
            while status is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    status = process.wait(LOOK if tell else None)
                if tell:
                    lines = printed(job, begun, whole=status is None)
                    for line in lines[told:]:
                        tell(line)
                    told = len(lines)
        finally:
            process.kill()
            process.wait()
    if status < 0:
        return status, f"was ended by {signal.Signals(-status).name}"
    lines = printed(job, begun)
    return status, re.sub(r"^mi_ring\.fit: ", "", lines[-1]) if lines else f"ended with status {status}"


def printed(job: Job, begun: int, whole: bool = False) -> list[str]:
    """The lines of a fit's output from a byte on; `whole`: without the last if it has no end yet."""
    with job.output.open("rb") as output:
        output.seek(begun)
        lines = re.split(r"[\r\n]+", output.read().decode(errors="replace"))
    return [line.strip() for line in (lines[:-1] if whole else lines) if line.strip()]


def dying() -> dict[str, Any]:
    """Options of a process that is not to outlive this one, however this one ends: Linux can say so."""
    if not sys.platform.startswith("linux"):
        return {}
    prctl: Callable[..., int] = ctypes.CDLL(None).prctl
    return {"preexec_fn": lambda: prctl(DIE_WITH_PARENT, signal.SIGKILL)}
