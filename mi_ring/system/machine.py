"""The machine that a fit runs on: variant, cores, threads, precision, memory."""

import contextlib
import ctypes
import math
import os
import platform
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import torch

from mi_ring.errors import InputError
from mi_ring.system import llvm

Thing = TypeVar("Thing")
Part = TypeVar("Part")
Result = TypeVar("Result")
ENOUGH, ONE_AT_A_TIME = 2, threading.Lock()  #: threads for an EXR; who changes their number
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of mallopt(3)


def device() -> torch.device:
    """Where torch must keep its tensors: where the current variant of Mitsuba computes. Nothing is copied then."""
    return torch.device("cuda" if str(mi.variant()).startswith("cuda") else "cpu")


def has_fast_bfloat16(device: torch.device) -> bool:
    """Are matrix products faster in bfloat16 than in float32? Most processors emulate it.

    Asked of what the processor can do, not measured: a fit that is repeated must not depend on a measurement.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # PyTorch and oneDNN can be told to do without what there is.
    told = os.environ.get("ONEDNN_MAX_CPU_ISA", "DEFAULT").upper()
    if not torch.backends.cpu.get_cpu_capability().startswith("AVX512"):
        return False
    if torch.cpu._is_amx_tile_supported() and torch.cpu._init_amx():  # which asks the system for its registers
        return told == "DEFAULT" or "AMX" in told
    # By AVX512-BF16 alone products are twice as fast as in float32 on AMD's (Zen 4), half as fast on Intel's.
    told_of: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # from PyTorch 2.10 on
    amd = "AMD" in told_of.get("cpu_name", "")
    return amd and torch.cpu._is_avx512_bf16_supported() and (told == "DEFAULT" or "BF16" in told or "AMX" in told)


def autocast(precision: str, device: torch.device) -> Callable[[], contextlib.AbstractContextManager]:
    """A context in which the networks' matrix products have this precision, `auto` the faster one."""
    if precision == "bfloat16" or (precision == "auto" and has_fast_bfloat16(device)):
        return lambda: torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext


def set_variant(variant: str) -> str:
    """Switch Mitsuba to a variant and return its name: that of the processor, where there is no GPU to use.

    Raises InputError if that needs an LLVM which is not there.
    """
    reason = None
    if variant.startswith("cuda"):
        if not torch.cuda.is_available():
            reason = "PyTorch finds none" if torch.version.cuda else "this PyTorch is built without CUDA"
        elif not dr.has_backend(dr.JitBackend.CUDA):
            reason = "Dr.Jit finds none, or its driver is too old"
        else:
            mi.set_variant(variant)
            try:
                mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})  # the first scene loads OptiX
            except RuntimeError as error:
                reason = " ".join(str(error).split())
    if reason:
        print(f"--variant {variant}: no GPU to use ({reason}); going on with llvm_ad_rgb, on the processor")
        variant = "llvm_ad_rgb"
    if variant.startswith("llvm") and (problem := llvm.missing()):
        raise InputError(problem)
    mi.set_variant(variant)
    return variant


def cores() -> int:
    """Of the processor, those that this process may use: by its affinity, and by the quota of its container."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    count = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, math.ceil(min(count, quota(Path("/sys/fs/cgroup")))))


def in_threads(function: Callable[..., Result], *things: Iterable) -> Iterator[Result]:
    """`map`, each in a thread, as many at once as there are cores; for what leaves Python's lock alone."""
    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(function, *things)


def in_turn(
    first: Callable[[Thing], Part], second: Callable[[Thing, Part], Result], things: Iterable[Thing]
) -> Iterator[Result]:
    """`second(thing, first(thing))` of each; in a thread of its own, while this one has the `first` of the next.

    But for one thread, in turn indeed: `threads_for_exr` must not change their number while another renders.
    """
    if dr.thread_count() < ENOUGH:
        for thing in things:
            yield second(thing, first(thing))
        return
    with ThreadPoolExecutor(1) as pool:
        before = None
        for thing in things:
            part = first(thing)
            if before:
                yield before.result()
            before = pool.submit(second, thing, part)
        if before:
            yield before.result()


def interruptible(call: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """What a long native call returns. Ctrl-C is heard meanwhile, not only at its end: it runs in another thread."""
    future = ThreadPoolExecutor(1).submit(call, *arguments, **options)
    while not wait([future], 0.1).done:
        pass
    return future.result()


def quota(root: Path) -> float:
    """The processor time per time that control groups allow this process; infinite without a limit.

    Of groups above its own, too: https://docs.kernel.org/admin-guide/cgroup-v2.html
    """
    limit = math.inf
    with contextlib.suppress(OSError):
        groups = Path("/proc/self/cgroup").read_text().splitlines()
        own = next((line.split(":", 2)[2] for line in groups if line.startswith("0::")), "/")  # version 2
        folder = root / own.lstrip("/")
        for group in (folder, *folder.parents):
            limit = min(limit, share_of(group / "cpu.max"))
            if group == root:
                break
    for name in ("cpu", "cpu,cpuacct"):  # version 1
        with contextlib.suppress(OSError, ValueError):
            time = int((root / name / "cpu.cfs_quota_us").read_text())
            if time > 0:
                limit = min(limit, time / int((root / name / "cpu.cfs_period_us").read_text()))
    return limit


def share_of(file: Path) -> float:
    """What a `cpu.max` allows; infinite if it says so or is not there."""
    try:
        time, period = file.read_text().split()
        return math.inf if time == "max" else int(time) / int(period)
    except (OSError, ValueError):
        return math.inf


def set_threads(count: int = 0) -> None:
    """Have torch and Dr.Jit use so many threads, by default all `cores`."""
    torch.set_num_threads(count or cores())
    dr.set_thread_count(count or cores())


def processor() -> str:
    """What runs this: model of the processor and number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {cores()} core{'s' * (cores() > 1)}"


def computer() -> str:
    """What the current variant computes on: the GPU, and the processor."""
    gpu = f"{torch.cuda.get_device_name()}, " if device().type == "cuda" else ""
    return gpu + processor()


@contextlib.contextmanager
def threads_of(count: int = 0) -> Iterator[None]:
    """So many threads of torch and Dr.Jit, by default all `cores`, and those of before at the end.

    Parallel sums depend on the order in which threads finish: one thread is what determinism costs.
    """
    before = torch.get_num_threads(), dr.thread_count()
    set_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        dr.set_thread_count(before[1])


@contextlib.contextmanager
def threads_for_exr() -> Iterator[None]:
    """Threads enough for Mitsuba to read or write an EXR: on a single one it waits forever."""
    with contextlib.ExitStack() as held:
        held.enter_context(ONE_AT_A_TIME)
        before = dr.thread_count()  # of which no other thread has made more for a moment
        if before < ENOUGH:
            dr.set_thread_count(ENOUGH)
            held.callback(dr.set_thread_count, before)
        else:
            held.close()
        yield


def glibc(name: str) -> Callable[..., int]:
    """A function of glibc's; one that does nothing where there is none: macOS, musl, Windows."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, TypeError, OSError):
        return lambda *_: 0


def keep_memory() -> None:
    """Have glibc keep freed memory, for the rest of the process.

    The system takes longer to hand out and clear pages than most operations take to use them.
    """
    mallopt = glibc("mallopt")
    mallopt(M_MMAP_MAX, 0)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def release_memory() -> None:
    """Give the system back what has been freed so far, between what stays, too: up to half of what a fit holds."""
    dr.flush_malloc_cache()
    glibc("malloc_trim")(0)
