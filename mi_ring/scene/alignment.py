"""Makes arrays for Dr.Jit that are aligned as its own arrays are. Then it finds compiled kernels in its cache."""

from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

ALIGNMENT = 64  #: of Dr.Jit's own arrays, and of PyTorch's [bytes]

Array = TypeVar("Array", mi.Float, mi.UInt32)


def to_flat(kind: type[Array], array: np.ndarray) -> Array:
    """Copy an array to a flat, aligned Dr.Jit array of `kind`: `mi.Float` or `mi.UInt32`.

    Without the copy, Dr.Jit would share NumPy's memory, which is aligned by chance. Dr.Jit compiles a kernel for each
    combination of aligned and unaligned arrays. This takes seconds, and each process would have other combinations.
    """
    values = np.asarray(array, np.uint32 if kind is mi.UInt32 else np.float32).ravel()
    memory = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    aligned = memory[start : start + values.nbytes].view(values.dtype)
    aligned[:] = values
    return kind(aligned) if len(values) else dr.zeros(kind, 0)


def to_vectors(array: np.ndarray) -> mi.Vector3f:
    """Copy vectors (N, 3) to aligned Dr.Jit arrays of x, y and z."""
    return mi.Vector3f(*(to_flat(mi.Float, part) for part in array.T))
