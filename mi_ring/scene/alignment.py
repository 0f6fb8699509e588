"""Arrays for Dr.Jit whose memory begins where vectors of the processor do, so that its kernels are used again."""

from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

ALIGNMENT = 64  #: of Dr.Jit's own arrays, and of PyTorch's [bytes]

Array = TypeVar("Array", mi.Float, mi.UInt32)


def to_flat(kind: type[Array], array: np.ndarray) -> Array:
    """Copy an array to a flat Dr.Jit array of `kind`: `mi.Float` or `mi.UInt32`. Returns the array.

    Dr.Jit would share NumPy's memory, which begins anywhere. It compiles a kernel for each combination of aligned and
    unaligned arrays, which takes seconds, and looks for it in its cache in vain.
    """
    values = np.asarray(array, np.uint32 if kind is mi.UInt32 else np.float32).ravel()
    room = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    aligned = room[start : start + values.nbytes].view(values.dtype)
    aligned[:] = values
    return kind(aligned) if len(values) else dr.zeros(kind, 0)
