"""Reconstructs a watertight mesh with a spatially varying material from photographs, inside Mitsuba 3.

`import mi_ring` registers its plugins (`photograph`, `shapenet`, `cooktorrance`, `photometric`, `flash` and others) for
the current variant of Mitsuba and for every variant that is selected later. If no variant is selected yet, the import
selects `llvm_ad_rgb`. Without LLVM it selects `scalar_rgb` and warns: `scalar_rgb` shows a finished fit, slowly, but
makes no fits.

The package imports each name of the Python API at its first use:

    capture = mi_ring.load_capture("pot2.xml")
    fit = mi_ring.Fit(capture, mi_ring.Config.preset("fast"))
    for it in fit: ...
    fit.save("out/pot2"); ring = mi_ring.load_fit("out/pot2")
"""

import importlib
import os
import re
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from mi_ring.system import llvm
from mi_ring.system.gpus import choose_gpu
from mi_ring.version import __version__

if TYPE_CHECKING:
    from mi_ring.capture.capture import Capture
    from mi_ring.capture.loading import load_capture
    from mi_ring.errors import InputError
    from mi_ring.fitting.config import Config
    from mi_ring.fitting.fit import Fit
    from mi_ring.fitting.iteration import Iteration
    from mi_ring.fitting.light_selection import choose_lighting
    from mi_ring.fitting.lighting import Lighting
    from mi_ring.fitting.terms import Term, default_terms
    from mi_ring.geometry.camera import Camera
    from mi_ring.metrics.evaluation import evaluate
    from mi_ring.nets.brdf_net import BRDFNet, MaterialNet
    from mi_ring.nets.mlp import plain_autograd
    from mi_ring.nets.registry import register_network
    from mi_ring.nets.shape_net import Flow, ShapeNet
    from mi_ring.objects.fitted_object import FittedObject
    from mi_ring.objects.ring_file import load_fit
    from mi_ring.output.exporting import export
    from mi_ring.scene.lights import Light
    from mi_ring.scene.shot import Response, Shot

#: The Python API: names and the modules that they are read from.
_API = {
    "InputError": "errors", "Capture": "capture.capture", "load_capture": "capture.loading", "Config": "fitting.config",
    "Fit": "fitting.fit", "Iteration": "fitting.iteration", "Term": "fitting.terms", "default_terms": "fitting.terms",
    "ShapeNet": "nets.shape_net", "Flow": "nets.shape_net", "BRDFNet": "nets.brdf_net", "MaterialNet": "nets.brdf_net",
    "register_network": "nets.registry", "plain_autograd": "nets.mlp",
    "FittedObject": "objects.fitted_object", "load_fit": "objects.ring_file",
    "Lighting": "fitting.lighting", "choose_lighting": "fitting.light_selection",
    "Camera": "geometry.camera", "Light": "scene.lights", "Response": "scene.shot", "Shot": "scene.shot",
}  # fmt: skip

__all__ = [
    "BRDFNet", "Camera", "Capture", "Config", "Fit", "FittedObject", "Flow", "InputError", "Iteration", "Light",
    "Lighting", "MaterialNet", "Response", "ShapeNet", "Shot", "Term", "__version__", "choose_lighting",
    "default_terms", "evaluate", "export", "load_capture", "load_fit", "plain_autograd", "register_network",
]  # fmt: skip

_COMMANDS = "evaluate", "export"  #: functions that share their name with the module of a command
#: Names up to version 0.2, with the present ones.
_RENAMED = {"Ring": "FittedObject", "ReflectanceMap": "MaterialNet"}


def __getattr__(name: str) -> object:
    if name in _COMMANDS:
        return importlib.import_module(f"{__name__}.{name}")
    if name in _RENAMED:
        raise AttributeError(f"mi_ring.{name} is now mi_ring.{_RENAMED[name]}")
    if name not in _API:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_API[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _command_looked_for() -> str | None:
    """Return the module of mi_ring that `python -m` is about to run, such as `mi_ring.fit`; None if there is none."""
    names = sys.orig_argv if sys.argv[:1] == ["-m"] else ()
    return next(filter(re.compile(r"mi_ring\.\w+").fullmatch, names), None)


def _prepare_mitsuba() -> None:
    """Choose LLVM, register the plugins, select a variant."""
    program = Path("".join(sys.argv[:1])).stem == "mi-ring" or (sys.argv[:1] == ["-m"] and "mi_ring" in sys.orig_argv)
    command = _command_looked_for()
    if (command or program) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Until a command reads its arguments: packages that it imports turn a KeyboardInterrupt into other errors, or
        # drop it.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Otherwise torch's idle workers spin and take the cores from Dr.Jit. Torch reads this when it is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    choose_gpu()
    llvm.prepare()
    problem = llvm.missing()
    if llvm.has_atomic():  # else Mitsuba cannot be imported
        import drjit as dr
        import mitsuba as mi

        from mi_ring import plugins

        def register(old: str | None, new: str) -> None:
            if problem and new.startswith("llvm"):
                raise ImportError(problem)
            plugins.register()

        # On one thread Mitsuba waits forever when it reads or writes an EXR.
        dr.set_thread_count(max(2, dr.thread_count()))
        mi.detail.add_variant_callback(register)
        if mi.variant() is not None:
            register(None, str(mi.variant()))
        else:
            mi.set_variant("scalar_rgb" if problem else "llvm_ad_rgb")
    elif command and command != "mi_ring.doctor":  # its module cannot be imported
        print(f"{command}: {problem}", file=sys.stderr)
        sys.exit(2)
    if problem and not command and not program:  # commands print it themselves
        warnings.warn(problem, stacklevel=3)


_prepare_mitsuba()
