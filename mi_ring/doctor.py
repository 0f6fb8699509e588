"""Say what this machine lacks for mi_ring, and how to get it: `python -m mi_ring.doctor`."""

import importlib.metadata
import importlib.util
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mi_ring.system import cache, command, llvm
from mi_ring.version import __version__

#: Packages that are not available for every machine, and what needs them.
OPTIONAL = {
    "gpytoolbox": "starts from the visual hull or a mesh, and mi_ring.evaluate",
    "pycolmap": "mi_ring.photos, COLMAP's models, and lens distortion in mi_ring.convert",
    "rawpy": "raw photographs in mi_ring.photos",
    "ray": "mi_ring.batch",
    "xatlas": "GLB and OBJ, and the object in the report",
}


@dataclass(frozen=True)
class DoctorConfig:
    """Say what mi_ring lacks on this machine and how to get it. The exit status is 1 if a fit cannot run."""

    empty_cache: bool = False
    """Remove the reduced photographs and surfaces that fits and checks keep in the cache folder, to free disk space.
    Your photographs stay. The next fit of a capture makes these files again and takes longer."""


class Finding(NamedTuple):
    """One line of the output of mi-ring doctor: (mark, what was examined, text).

    The mark is "ok", "MISSING" if a fit cannot run without it, or "absent" if only another feature needs it.
    """

    mark: str  #: ok; MISSING: a fit cannot run; absent: something else cannot run
    what: str
    text: str


def findings() -> Iterator[Finding]:
    """Yield a finding for each package and library. It says the version, or how to install what is missing.

    Findings about the cache folder, the processor and the GPU follow.
    """
    yield Finding("ok", "mi_ring", __version__)
    yield Finding("ok", "Python", f"{platform.python_version()} on {platform.platform()}")
    for package in ("torch", "drjit", "mitsuba"):
        found = importlib.util.find_spec(package)
        text = importlib.metadata.version(package) if found else f"pip install {package}"
        yield Finding("ok" if found else "MISSING", package, text)
    problem = llvm.missing()
    if not llvm.has_atomic():
        yield Finding("MISSING", "libatomic", str(problem))
        problem = None if llvm.find() else f"mi_ring needs version {llvm.OLDEST} or newer. {llvm.cure('libllvm19')}"
    yield Finding("MISSING" if problem else "ok", "LLVM", problem or "found; for the variant llvm_ad_rgb")
    for package, use in OPTIONAL.items():
        if importlib.util.find_spec(package):
            yield Finding("ok", package, importlib.metadata.version(package))
        else:
            yield Finding("absent", package, f"for {use}: pip install {package} (not available for all systems)")
    if llvm.has_atomic() and importlib.util.find_spec("torch"):  # otherwise Dr.Jit or torch cannot be imported
        yield from computing()


def computing() -> Iterator[Finding]:
    """Yield findings about the cache folder, the processor and the GPU."""
    import drjit as dr
    import torch

    from mi_ring.system.machine import cores, has_fast_bfloat16

    used = f"{cache.size() / 2**20:.0f} MiB, of at most {cache.LIMIT / 2**30:.0f} GiB, in {cache.cache_folder()}"
    yield Finding("ok", "cache", f"{used}; to empty it: mi-ring doctor --empty-cache")
    precision = "bfloat16" if has_fast_bfloat16(torch.device("cpu")) else "float32"
    yield Finding("ok", "processor", f"{cores()} cores; the networks compute in {precision}")
    if torch.cuda.is_available() and dr.has_backend(dr.JitBackend.CUDA):
        yield Finding("ok", "GPU", f"{torch.cuda.get_device_name()}: --variant cuda_ad_rgb")
    else:
        yield Finding("absent", "GPU", "for --variant cuda_ad_rgb: needs an NVIDIA GPU and a PyTorch built for CUDA")


def main(arguments: Sequence[str]) -> int:
    """Run the command with these arguments of the command line.

    Returns its exit status: 1 if a fit cannot run, otherwise 0.
    """
    if command.parse(DoctorConfig, arguments, "mi_ring.doctor", needs_llvm=False).empty_cache:
        before = cache.size()
        cache.empty()
        left = cache.size()
        print(f"Removed {(before - left) / 2**20:.0f} MiB from the cache folder")
        if left:
            print(f"{left / 2**20:.1f} MiB could not be removed: {cache.cache_folder()}")
    found = list(findings())
    for mark, what, text in found:
        print(f"{mark:8} {what:11} {text}")
    missing = [what for mark, what, _ in found if mark == "MISSING"]
    print(f"A fit cannot run: {', '.join(missing)} missing" if missing else "A fit can run.")
    return int(bool(missing))


if __name__ == "__main__":
    command.run("mi_ring.doctor", main, sys.argv[1:])
