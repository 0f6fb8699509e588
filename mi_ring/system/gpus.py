"""Chooses the GPU of each process of a distributed fit. It must do this before anything initialises CUDA."""

import os
import sys
from pathlib import Path

OWN = "MI_RING_OWN_GPU"  #: environment variable: 1 if no other process of the same fit uses this process's GPU


def choose_gpu() -> None:
    """Let this process see only one GPU, if `torchrun` started several processes on this machine.

    The process with local rank n gets GPU n, counted again from 0 if there are fewer GPUs. Does nothing in other
    programs that import mi_ring. Sets environment variables.
    """
    if not any(word in ("mi_ring", "mi_ring.fit") or Path(word).stem == "mi-ring" for word in sys.orig_argv):
        return
    processes, rank = int(os.environ.get("LOCAL_WORLD_SIZE", 1)), int(os.environ.get("LOCAL_RANK", 0))
    if processes == 1 or OWN in os.environ:
        return
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    installed = [str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]  # none without a driver
    gpus = installed if visible is None else [name for name in visible.split(",") if name]
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[rank % len(gpus)]
        os.environ[OWN] = str(int(len(gpus) >= processes))
