"""Runs many fits at a time with Ray, on this machine or on a cluster."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from mi_ring.collection.fits import fit_to_the_end
from mi_ring.collection.jobs import Job
from mi_ring.errors import InputError
from mi_ring.system.optional import keeping_handlers, need

OBJECT_STORE = 80 * 2**20  #: size of Ray's object store [bytes], about the minimum: fits share no data
POLL = 1.0  #: interval between checks of the fits [s]


@dataclass(frozen=True)
class Resources:
    """The resources of each fit, and how many fits run at a time."""

    workers: int
    cpus: int  #: cores and threads of each fit
    gpus: float
    memory: float  #: of each fit [GiB]; 0: no limit
    address: str | None  #: of a running cluster; None: start Ray here and stop it after the batch


@contextlib.contextmanager
def ray_cluster(resources: Resources) -> Iterator[Any]:
    """Context manager that starts Ray, or connects to a running cluster. Yields the module `ray`.

    At the end, Ray is stopped or disconnected. Raises InputError if Ray cannot be started or reached, or if no machine
    has the resources that one fit needs.
    """
    ray = need("ray", "mi-ring batch")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    options: dict[str, Any] = {"address": resources.address, "log_to_driver": False, "logging_level": "ERROR"}
    if resources.address is None:
        options |= {"address": "local", "num_cpus": resources.workers * resources.cpus, "include_dashboard": False,
                    "object_store_memory": OBJECT_STORE}  # fmt: skip
    try:
        with keeping_handlers():
            ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        where = f"--address: {resources.address}" if resources.address else "mi-ring batch"
        raise InputError(f"{where}: Ray cannot be reached or started ({error}); see `ray status`") from error
    try:
        needed = {"CPU": resources.cpus, "GPU": resources.gpus, "memory": resources.memory * 2**30}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(all(node.get(name, 0) >= amount for name, amount in needed.items()) for node in nodes):
            most = {name: max((node.get(name, 0) for node in nodes), default=0) for name in needed}
            raise InputError(f"--cpus, --gpus, --memory: no machine has enough for a fit: at most {most['CPU']:g} "
                             f"processor cores, {most['GPU']:g} GPUs, {most['memory'] / 2**30:.3g} GiB")  # fmt: skip
        yield ray
    finally:
        ray.shutdown()


def fit_all(jobs: Mapping[Job, str], resources: Resources, retries: int, on_poll: Callable[[], None]) -> None:
    """Fit all jobs with Ray, several at a time. Returns when all have ended. Their saved records say how they ended.

    `jobs`: a dict from each job to the hash of its input. `retries`: how often a fit whose process has died is
    restarted without progress. `on_poll` is called about once a second. If a worker dies, Ray replaces it, and its fit
    continues from the last checkpoint.
    """
    with ray_cluster(resources) as ray:
        fit = ray.remote(fit_to_the_end).options(
            num_cpus=resources.cpus, num_gpus=resources.gpus, memory=resources.memory * 2**30 or None, max_retries=-1
        )
        waiting, running = list(jobs), dict[Any, Job]()
        while waiting or running:
            while waiting and len(running) < resources.workers:
                job = waiting.pop(0)
                running[fit.remote(job, jobs[job], retries, ("--threads", str(resources.cpus)))] = job
            done, _ = ray.wait(list(running), timeout=POLL)
            for reference in done:
                job = running.pop(reference)
                try:
                    ray.get(reference)
                except (ray.exceptions.RayError, OSError, InputError) as error:  # the worker failed, not the fit
                    message = str(error).strip().splitlines()[-1:] or [type(error).__name__]
                    with contextlib.suppress(InputError):
                        job.save(replace(job.record, state="failed", message=message[0]))
            on_poll()
