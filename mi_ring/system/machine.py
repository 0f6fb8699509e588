"""What a fit computes with: Mitsuba's variant, cores, threads, precision, memory."""

import contextlib
import ctypes
import gc
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
EXR_THREADS = 2  #: with fewer threads, Mitsuba waits forever when it reads or writes an EXR
_exr_lock = threading.Lock()  # for changes of the number of threads by `exr_threads`
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of mallopt(3)
LARGE_ARRAY = 2**25  #: bytes from which freed arrays go back to the system; the most that mallopt allows


def device() -> torch.device:
    """Return the device on which the current variant of Mitsuba computes: the CPU or the current CUDA device."""
    return torch.device("cuda" if str(mi.variant()).startswith("cuda") else "cpu")


def has_fast_bfloat16(device: torch.device) -> bool:
    """Return True if matrix products are faster in bfloat16 than in float32. Most processors only emulate bfloat16.

    The features of the processor decide this. Nothing is measured, so that a fit can be repeated exactly.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # The user can switch features off in PyTorch and in oneDNN.
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "DEFAULT").upper()
    if not torch.backends.cpu.get_cpu_capability().startswith("AVX512"):
        return False
    if torch.cpu._is_amx_tile_supported() and torch.cpu._init_amx():  # the system must grant the AMX registers
        return limit == "DEFAULT" or "AMX" in limit
    # With AVX512-BF16 alone, products are twice as fast as in float32 on AMD's Zen 4, but half as fast on Intel's.
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # since PyTorch 2.10
    amd = "AMD" in capabilities.get("cpu_name", "")
    return amd and torch.cpu._is_avx512_bf16_supported() and any(s in limit for s in ("DEFAULT", "BF16", "AMX"))


def autocast(precision: str, device: torch.device) -> Callable[[], contextlib.AbstractContextManager]:
    """Return a function that makes a context manager in which torch computes matrix products in this precision.

    `precision`: "float32", "bfloat16", or "auto" for the faster one of both on `device`. The function takes no
    arguments.
    """
    if precision == "bfloat16" or (precision == "auto" and has_fast_bfloat16(device)):
        return lambda: torch.autocast(device.type, torch.bfloat16)
    return contextlib.nullcontext


def set_variant(variant: str) -> str:
    """Switch Mitsuba to a variant. Returns the name of the variant that is then set.

    If there is no usable GPU, a variant `cuda_*` is replaced by `llvm_ad_rgb`, and a message is printed. Raises
    InputError if the variant needs LLVM and LLVM is missing.
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
        print(f"--variant {variant}: no usable GPU ({reason}); using llvm_ad_rgb on the processor")
        variant = "llvm_ad_rgb"
    if variant.startswith("llvm") and (problem := llvm.missing()):
        raise InputError(problem)
    mi.set_variant(variant)
    return variant


def cores() -> int:
    """Return the number of processor cores that this process may use, by its CPU affinity and container quota."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux
    count = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, math.ceil(min(count, cpu_quota(Path("/sys/fs/cgroup")))))


def in_threads(function: Callable[..., Result], *things: Iterable, most: int | None = None) -> Iterator[Result]:
    """Call `function` on the elements of iterables like `map`, but in threads. Yields the results in input order.

    `things`: an iterable for each argument. `most`: largest number of threads; None: one per core. This is faster only
    if `function` releases Python's global interpreter lock.
    """
    with ThreadPoolExecutor(min(cores(), most or cores())) as pool:
        yield from pool.map(function, *things)


def pipelined(
    first: Callable[[Thing], Part], second: Callable[[Thing, Part], Result], things: Iterable[Thing]
) -> Iterator[Result]:
    """Yield `second(thing, first(thing))` for each of `things`, in the same order.

    While `second` runs in another thread, `first` already works on the next thing. But if Dr.Jit has only one thread,
    both run one after the other, because reading an EXR file in `second` must not change that number while `first`
    renders.
    """
    if dr.thread_count() < EXR_THREADS:
        for thing in things:
            yield second(thing, first(thing))
        return
    with ThreadPoolExecutor(1) as pool:
        pending = None
        for thing in things:
            part = first(thing)
            if pending:
                yield pending.result()
            pending = pool.submit(second, thing, part)
        if pending:
            yield pending.result()


def interruptible(call: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Call `call` with these arguments in another thread, and return its result. So Ctrl-C stops the wait at once."""
    future = ThreadPoolExecutor(1).submit(call, *arguments, **options)
    while not wait([future], 0.1).done:
        pass
    return future.result()


def cpu_quota(root: Path) -> float:
    """Return how many cores the Linux control groups allow this process; infinite without a limit.

    `root`: folder of the control groups, usually /sys/fs/cgroup. Limits of parent groups count, too:
    https://docs.kernel.org/admin-guide/cgroup-v2.html
    """
    groups = [root]
    with contextlib.suppress(OSError):
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        group = root / next((line.split(":", 2)[2] for line in lines if line.startswith("0::")), "/").lstrip("/")
        groups = [folder for folder in (group, *group.parents) if folder.is_relative_to(root)]
    sources = [[group / "cpu.max"] for group in groups]  # version 2, then version 1
    sources += [[root / name / f"cpu.cfs_{x}_us" for x in ("quota", "period")] for name in ("cpu", "cpu,cpuacct")]
    limit = math.inf
    for files in sources:
        with contextlib.suppress(OSError, ValueError):  # there is no such file, or it says "max"
            time, period = map(int, " ".join(file.read_text() for file in files).split())
            limit = min(limit, time / period if time > 0 else math.inf)
    return limit


def set_threads(count: int = 0) -> None:
    """Set the number of threads of torch and Dr.Jit. 0: one for each core that this process may use."""
    torch.set_num_threads(count or cores())
    dr.set_thread_count(count or cores())


def computer() -> str:
    """Return a text for reports: the model of the processor, and the number of cores that this process may use.

    If the current variant of Mitsuba uses a GPU, the text begins with the name of the GPU.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    gpu = f"{torch.cuda.get_device_name()}, " if device().type == "cuda" else ""
    return f"{gpu}{model}, {cores()} core{'s' * (cores() > 1)}"


@contextlib.contextmanager
def threads_of(count: int = 0) -> Iterator[None]:
    """A context manager in which torch and Dr.Jit use `count` threads. 0: one for each core.

    With one thread, results can be repeated exactly. With more threads, the order of sums varies.
    """
    before = torch.get_num_threads(), dr.thread_count()
    set_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        dr.set_thread_count(before[1])


@contextlib.contextmanager
def exr_threads() -> Iterator[None]:
    """A context manager for reading or writing an EXR file: in it, Dr.Jit has at least `EXR_THREADS` threads.

    Rendering in another thread must not run at the same time.
    """
    with _exr_lock:  # another thread may have raised the number for a moment
        before = dr.thread_count()
    if before >= EXR_THREADS:
        yield
        return
    with _exr_lock:
        dr.set_thread_count(EXR_THREADS)
        try:
            yield
        finally:
            dr.set_thread_count(before)


def glibc(name: str) -> Callable[..., int]:
    """Return a function of glibc by its name. On other systems (macOS, musl, Windows), it does nothing."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, TypeError, OSError):
        return lambda *_: 0


def keep_memory() -> None:
    """Tell glibc to keep the memory of freed arrays for new ones, because new pages from the system are slow.

    Arrays of `LARGE_ARRAY` bytes or more still go back to the system.
    """
    mallopt = glibc("mallopt")
    mallopt(M_MMAP_THRESHOLD, LARGE_ARRAY)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def release_scenes() -> None:
    """Free Mitsuba's objects that nobody uses any more, but that refer to each other.

    As long as they live, Dr.Jit compiles them into the kernels of all other scenes: a second fit in one process may
    take four times as long.
    """
    gc.collect()


def release_memory() -> None:
    """Return freed memory to the system. This can be half of the memory that a fit uses."""
    dr.flush_malloc_cache()
    glibc("malloc_trim")(0)
