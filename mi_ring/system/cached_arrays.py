"""Arrays in the cache folder: keys of results, and results that are computed only once."""

import contextlib
import functools
import hashlib
import io
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any

import numpy as np
import torch

from mi_ring.system import cache, files

#: Change it if the content of cached files changes, or if their computation does. Files of another format are not used.
FORMAT = "5"
LIBRARIES = "numpy", "scipy", "scikit-image", "trimesh", "gpytoolbox", "torch"  #: which compute surfaces


def key_of(*parts: Any) -> str:
    """Return the key of a result that is computed from `parts`: 32 hexadecimal digits, a hash of `parts`.

    Of an array, type, shape and content count; of all other parts, what `repr` returns. Other parts, such as tuples,
    must not contain arrays.
    """
    checksum = hashlib.blake2b(FORMAT.encode(), digest_size=16)
    for part in parts:
        array = isinstance(part, np.ndarray)
        checksum.update(repr((part.shape, part.dtype.str) if array else part).encode() + b"\0")
        if array:
            checksum.update(np.ascontiguousarray(part).data)
    return checksum.hexdigest()


@functools.cache
def environment() -> tuple[str, ...]:
    """Return what may change the last digits of a computed surface: versions of libraries, and the processor's kind."""
    versions = []
    for library in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):  # gpytoolbox is optional
            versions.append(f"{library} {metadata.version(library)}")
    return *versions, torch.backends.cpu.get_cpu_capability()


def archived(key: str, arrays: Mapping[str, np.ndarray]) -> memoryview:
    """Return the bytes of a .npz file of arrays by name, and of its key, with a checksum at its end."""
    buffer = io.BytesIO()
    np.savez(buffer, key=np.array(key), **arrays)  # type: ignore[arg-type]  # mypy takes the arrays for options
    files.seal(buffer)
    return buffer.getbuffer()


def read_archive(key: str) -> Any:
    """Open the cached file with this key, made by `archived`: numpy's NpzFile.

    Raises ValueError if there is none, if it is damaged or of another key, OSError if it cannot be read.
    """
    path = cache.cached(key)
    content = path.read_bytes() if path else b""
    if not files.is_sealed(content):
        raise ValueError(f"{key}: is missing or damaged")
    stored = np.load(io.BytesIO(content))
    if stored.get("key") != key:
        raise ValueError(f"{key}: is of another key")
    return stored


def remembered(key: str, make: Callable[[], tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Read arrays from the cached file with this key. If it is missing or damaged, compute and store them.

    `key`: from `key_of`. `make`: function that computes the arrays. Call `cache.prune` afterwards.
    """
    with contextlib.suppress(OSError, ValueError), read_archive(key) as stored:
        return tuple(array for name, array in stored.items() if name != "key")
    arrays = make()
    cache.store(key, archived(key, {f"{number:03}": array for number, array in enumerate(arrays)}))
    return arrays
