"""Runs one fit in a process of its own. If this process dies, it is started again from the last checkpoint."""

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

from mi_ring.collection.jobs import Job, Record, modified

USER_ERROR = 2  #: exit status of a fit with wrong input; a retry would fail too
DIE_WITH_PARENT = 1  #: PR_SET_PDEATHSIG of prctl(2)


def fit_to_the_end(
    job: Job, fingerprint: str, retries: int, extra: tuple[str, ...] = (), on_line: Callable[[str], None] | None = None
) -> Record:
    """Fit a scene in a process of its own, or continue its fit. Returns a record whose state is "done" or "failed".

    If the process dies, it is started again. After `retries` restarts without progress, the fit has failed.
    `fingerprint`: hash of the job's input. `extra`: further command-line options, which do not change the result.
    `on_line` is called with each printed line. If the calling process is killed, call the function again to continue.
    """
    record = job.record
    if record.fingerprint != fingerprint:  # the fit itself moves the results of the other fit aside
        record = Record(fingerprint=fingerprint, since=time.time(), done=record.done, written=record.written)
    if record.state in ("failed", "done"):  # of an earlier batch: count from 0
        record = replace(record, tries=0)
    complaint = record.message
    while True:
        iteration = job.iteration(record.since)
        tries = 1 if iteration > record.iteration else record.tries + 1
        if tries > retries + 1:
            return job.save(replace(record, state="failed", message=complaint or "was killed repeatedly"))
        record = job.save(replace(record, state="running", message="", tries=tries, iteration=iteration))
        resume = ["--resume"] if job.has_checkpoint(record.since) else []
        command = [sys.executable, "-m", "mi_ring.fit", str(job.scene), "--out", str(job.folder), *extra, *job.options]
        status, complaint = run([*command, *resume], job, on_line)
        if status == 0 and (ring := modified(job.folder / "ring.pt")):
            iteration = job.iteration(record.since)
            return job.save(replace(record, state="done", iteration=iteration, done=fingerprint, written=ring))
        if status == USER_ERROR and resume:  # checkpoints are damaged or of another version: start from iteration 0
            record = replace(record, since=time.time(), iteration=-1)
        elif status in (0, USER_ERROR):  # status 0 without results: the options asked for none
            return job.save(replace(record, state="failed", message=complaint))


def run(command: list[str], job: Job, on_line: Callable[[str], None] | None = None) -> tuple[int, str]:
    """Run a fit in a child process, and append its output to the file `job.output`.

    `command`: the command line. `on_line` is called with each printed line. Returns (exit status, last line of the
    output, or the reason why the fit ended). If this process ends, the fit ends, too.
    """
    cwd = job.cwd if job.cwd.is_dir() else None  # a worker on another machine may lack this folder
    options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    options |= {"encoding": "utf-8", "errors": "replace", **die_with_parent()}
    last = ""
    with job.output.open("ab", buffering=0) as output:
        output.write(b"\n$ " + " ".join(command).encode(errors="replace") + b"\n")
        with subprocess.Popen(command, cwd=cwd, **options) as process:
            try:
                for line in process.stdout or ():  # a carriage return of a progress bar ends a line, too
                    with contextlib.suppress(OSError):  # a disk that is full for a while ends no fit
                        output.write(line.encode())
                    if line.strip():
                        last = line.strip()
                        if on_line:
                            on_line(last)
                status = process.wait()
            finally:
                process.kill()
    if status < 0:
        return status, f"was ended by {signal.Signals(-status).name}"
    return status, re.sub(r"^mi_ring\.fit: ", "", last) or f"ended with status {status}"


def die_with_parent() -> dict[str, Any]:
    """Return arguments of `subprocess.Popen` with which the kernel kills the child process when this process ends.

    Only Linux can do this. On other systems, the result is empty.
    """
    if not sys.platform.startswith("linux"):
        return {}
    prctl: Callable[..., int] = ctypes.CDLL(None).prctl
    return {"preexec_fn": lambda: prctl(DIE_WITH_PARENT, signal.SIGKILL)}
