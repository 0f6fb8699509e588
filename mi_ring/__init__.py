"""From photographs to a watertight mesh with a spatially varying material, inside Mitsuba 3.

`import mi_ring` registers the plugins `photograph`, `shapenet`, `cooktorrance` and `photometric` for the current
variant of Mitsuba and for every one switched to later, and the emitter `flash` through which other integrators see a
photograph's light. It selects `llvm_ad_rgb` if no variant is selected yet.
"""

import importlib
import os
import sys

from mi_ring import llvm

# Torch's workers would spin after each operation and steal the cores from Dr.Jit. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
llvm.prepare()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

llvm.check()
dr.set_thread_count(max(2, dr.thread_count()))  # on one thread Mitsuba waits forever when it reads or writes an EXR

PLUGINS = ("mi_ring.photograph", "mi_ring.bsdf", "mi_ring.mesh", "mi_ring.integrator")


def _register(old: str | None, new: str) -> None:
    """Plugin classes belong to one variant: define them anew in each."""
    for name in PLUGINS:
        if name in sys.modules:
            importlib.reload(sys.modules[name])
        else:
            importlib.import_module(name)


mi.detail.add_variant_callback(_register)
if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")
else:
    _register(None, mi.variant())
