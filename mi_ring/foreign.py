"""Files of others: read, or refused in one line whatever is in them, and with memory that their size bounds."""

import contextlib
import io
import math
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError

#: Bytes that what is in a file may take in memory, and times the file's size: a PNG or a zip file may be 1032 times as
#: small, what is much smaller than that and not small is made to fill memories.
ROOM, EXPANSION = 2**28, 2**12

PATIENCE, SPEED = 30.0, 2e6  #: seconds, and bytes in each further second, that a native reader may take
#: Begins what runs in a process of its own: its memory is bounded where the system can do that.
BOUNDED = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_DATA, 2 * (int(sys.argv[2]),))
except (ImportError, OSError, ValueError):
    pass
"""


@contextlib.contextmanager
def reading(where: Path | str, what: str) -> Iterator[None]:
    """Turns all that a reader of files raises into an InputError: `where` the file, `what` it should have been."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # readers raise what they like for files that are damaged, or meant to
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{where}: cannot be read as {what} ({reason})") from error


def require_room(path: Path, size: int) -> None:
    """Raise ValueError if what a file declares to hold takes more bytes than one of its size can mean."""
    if size > max(ROOM, EXPANSION * path.stat().st_size):
        raise ValueError(f"declares {size:,} bytes, in a file of {path.stat().st_size:,}")


def require_survival(read: str, path: Path, size: int, what: str) -> None:
    """Raise InputError for files that a native reader crashes of, is busy with for ever or takes all memory for.

    `read`: it in Python, with the path as sys.argv[1]; `size`: bytes of the files. Nothing ends such readers, not even
    Ctrl-C; so another process tries first.
    """
    try:
        trial = [sys.executable, "-c", BOUNDED + read, str(path), str(2**31 + 40 * size)]
        done = subprocess.run(trial, capture_output=True, text=True, timeout=PATIENCE + size / SPEED)
        trouble = done.stderr.strip().splitlines()[-1:] or [f"its reader ended with status {done.returncode}"]
    except subprocess.TimeoutExpired as late:
        raise InputError(f"{path}: not {what}, or damaged (not read in {late.timeout:.0f} s)") from late
    if done.returncode:
        raise InputError(f"{path}: not {what}, or damaged ({trouble[0]})")


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a .npz file. Raises InputError if it is none."""
    with reading(path, "arrays of NumPy's, .npz"), zipfile.ZipFile(path) as archive:
        require_room(path, sum(member.file_size for member in archive.infolist()))
        return {name.removesuffix(".npy"): array_of(archive.read(name)) for name in archive.namelist()}


def load_npy(path: Path) -> np.ndarray:
    """The array of a .npy file. Raises InputError if it is none."""
    with reading(path, "an array of NumPy's, .npy"):
        return array_of(path.read_bytes())


def array_of(content: bytes) -> np.ndarray:
    """The array in the content of a .npy file. Raises ValueError if that lacks some of it, or is none."""
    shape: tuple[int, ...] = ()
    stream, kind = io.BytesIO(content), np.dtype(float)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, kind = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, kind = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"is of version {version[0]}.{version[1]}")
    if math.prod(shape) * kind.itemsize > len(content):  # before as much is allocated
        raise ValueError(f"declares an array of shape {shape}, and is shorter")
    array = np.load(io.BytesIO(content))
    if kind.kind == "U" and array.nbytes:
        codes = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(array.dtype.byteorder))
        if codes.max() > sys.maxunicode:  # which Python stumbles over whenever it looks at one
            raise ValueError("has characters that are none")
    return array
