"""Arrays in the cache folder: keys of results, and results that are computed only once."""

import contextlib
import hashlib
import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mi_ring.system import cache

FORMAT = "2"  #: change it if the content of cached files changes; files of another format are not used


def key_of(*parts: Any) -> str:
    """Return the key of a result that is computed from `parts`: 32 hexadecimal digits, a hash of `parts`.

    Of arrays, shape, type and content count; of all other parts, what `repr` returns.
    """
    found = hashlib.blake2b(FORMAT.encode(), digest_size=16)
    for part in parts:
        array = isinstance(part, np.ndarray)
        found.update(repr((part.shape, part.dtype.str) if array else part).encode() + b"\0")
        if array:
            found.update(np.ascontiguousarray(part).data)
    return found.hexdigest()


def archived(arrays: Mapping[str, np.ndarray]) -> memoryview:
    """Return the bytes of a .npz file of arrays by name."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # mypy takes the arrays for options
    return buffer.getbuffer()


def remembered(key: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Read arrays by name from the cached file with this key. If it is missing or damaged, compute and store them.

    `key`: of `key_of`. `make`: function that computes the arrays.
    """
    with contextlib.suppress(Exception):  # another process has removed it, or it is damaged in any way
        if path := cache.cached(key):
            with np.load(path) as stored:  # of a .npz file, checksums are verified
                return dict(stored)
    arrays = make()
    cache.store(key, archived(arrays))
    cache.prune()
    return arrays
