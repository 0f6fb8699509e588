"""Files of others: read, or refused in one line whatever is in them, and with memory that their size bounds."""

import contextlib
import io
import math
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError

#: Bytes that what is in a file may take in memory, and times the file's size: a PNG or a zip file may be 1032 times as
#: small, what is much smaller than that and not small is made to fill memories.
ROOM, EXPANSION = 2**28, 2**12


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
