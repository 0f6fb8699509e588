"""Which GPU is a process's own, said before anything looks for one."""

import os
import sys
from pathlib import Path

OWN = "MI_RING_OWN_GPU"  #: 1 in the environment of a process that shares its GPU with no other of the same fit


def choose_gpu() -> None:
    """Have each of several fits that `torchrun` has started on this machine see one GPU alone, in turn.

    It is not for other programs that import mi_ring: what they do with their GPUs is their business.
    """
    if not any(word in ("mi_ring", "mi_ring.fit") or Path(word).stem == "mi-ring" for word in sys.orig_argv):
        return
    here, rank = int(os.environ.get("LOCAL_WORLD_SIZE", 1)), int(os.environ.get("LOCAL_RANK", 0))
    if here == 1 or OWN in os.environ:
        return
    told = os.environ.get("CUDA_VISIBLE_DEVICES")
    there = [str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]  # none without a driver
    gpus = there if told is None else [name for name in told.split(",") if name]
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[rank % len(gpus)]
        os.environ[OWN] = str(int(len(gpus) >= here))
