"""The cache folder: files that can be made again, and that are removed when there are too many."""

import contextlib
import os
import shutil
from pathlib import Path

import platformdirs

from mi_ring.errors import InputError
from mi_ring.system.files import write_file

VARIABLE = "MI_RING_CACHE"  #: environment variable with another folder
LIMIT = 8 * 2**30  #: bytes of all files; the ones that were not used for the longest time are removed first
PRUNED = 0.8  #: share of the limit that is left after files were removed


def cache_folder() -> Path:
    """The folder that `MI_RING_CACHE` names, else mi_ring's folder in the user's cache."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else Path(platformdirs.user_cache_dir("mi_ring", appauthor=False))


def cached(key: str) -> Path | None:
    """The file with this key; None if there is none. It counts as used now."""
    path = place_of(key)
    try:
        os.utime(path)
    except OSError:
        return None
    return path


def store(key: str, content: bytes | memoryview) -> Path | None:
    """Write a file with this key; None if it cannot be written."""
    path = place_of(key)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content)
    except (InputError, OSError):
        return None
    return path


def place_of(key: str) -> Path:
    """Where the file with this key is, if it is there."""
    return cache_folder() / key[:2] / key


def files() -> list[tuple[float, int, Path]]:
    """List the files of the cache: when each was last used [s], its size in bytes, and its path."""
    found = []
    for path in cache_folder().glob("??/*"):
        with contextlib.suppress(OSError):  # another process has removed it
            status = path.stat()
            found.append((status.st_mtime, status.st_size, path))
    return found


def size() -> int:
    """The number of bytes of all files in the cache."""
    return sum(bytes_ for _, bytes_, _ in files())


def prune(limit: int = LIMIT) -> None:
    """If all files together have more than `limit` bytes, remove those that were not used for the longest time."""
    several = sorted(files())
    total = sum(bytes_ for _, bytes_, _ in several)
    if total <= limit:
        return
    for _, bytes_, path in several:
        if total <= PRUNED * limit:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            total -= bytes_


def empty() -> None:
    """Remove all files of the cache."""
    for folder in cache_folder().glob("??"):
        shutil.rmtree(folder, ignore_errors=True)
