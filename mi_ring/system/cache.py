"""The cache folder. Its files can be computed again. When they get too large, those not used for long are removed."""

import contextlib
import os
import re
from pathlib import Path

import platformdirs

from mi_ring.errors import InputError

VARIABLE = "MI_RING_CACHE"  #: environment variable with another folder
OWN = "photographs"  #: the folder in it for our files: reduced photographs, and surfaces of their masks
NAME = re.compile(r"[0-9a-f]{32}|\.[0-9a-f]{32}\..*\.partial")  #: of our files, finished or not
LIMIT = 8 * 2**30  #: largest size of all files [bytes]
PRUNED = 0.8  #: share of the limit that is left after files were removed


def cache_folder() -> Path:
    """Return the folder that contains the cached files.

    It lies in the folder that the environment variable `MI_RING_CACHE` names, or else in the user's cache folder.
    """
    named = os.environ.get(VARIABLE)
    return (Path(named) if named else Path(platformdirs.user_cache_dir("mi_ring", appauthor=False))) / OWN


def cached(key: str) -> Path | None:
    """Return the path of the cached file with this key; None if there is none. Sets its modification time to now.

    `key`: 32 hexadecimal digits, the name of the file.
    """
    path = cache_folder() / key
    with contextlib.suppress(OSError):  # in a folder that is only read
        os.utime(path)
    return path if os.path.isfile(path) else None  # False, too, in a folder that must not be read


def store(key: str, content: bytes | memoryview) -> bool:
    """Write a file into the cache. Returns True if it was written, False if that failed.

    `key`: 32 hexadecimal digits, the name of the file.
    """
    from mi_ring.system.files import write_file  # which needs torch; the rest of this module does not

    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        write_file(cache_folder() / key, content)
    except (InputError, OSError):
        return False
    return True


def files() -> list[tuple[float, int, Path]]:
    """List all files in the cache. Returns (time of the last use [s], size [bytes], path) for each."""
    found = []
    with contextlib.suppress(OSError):  # there is no folder yet
        for path in cache_folder().iterdir():
            with contextlib.suppress(OSError):  # another process has removed it
                if NAME.fullmatch(path.name):
                    found.append((path.stat().st_mtime, path.stat().st_size, path))
    return found


def size() -> int:
    """Return the total size of all files in the cache [bytes]."""
    return sum(own for _, own, _ in files())


def prune(limit: int = LIMIT) -> None:
    """If the cache is larger than `limit` [bytes], remove the files that were not used for the longest time.

    Afterwards it has at most 80 % of `limit`.
    """
    several = sorted(files())
    total = sum(own for _, own, _ in several)
    least = total if total <= limit else PRUNED * limit
    for _, own, path in several:
        if total <= least:
            break
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)  # another process or thread may remove files at the same time
            total -= own


def empty() -> None:
    """Remove all files from the cache."""
    for _, _, path in files():
        with contextlib.suppress(OSError):
            path.unlink()
