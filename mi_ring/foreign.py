"""Helps to read files of other programs: a damaged file raises InputError and cannot exhaust the memory."""

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

#: A file may declare a content of `SMALL` bytes, or of `EXPANSION` times its size if that is more. PNG and zip compress
#: at most 1032 times; a much larger ratio is an attack on the memory.
SMALL, EXPANSION = 2**28, 2**12

READ_SECONDS, READ_SPEED = 30.0, 2e6  #: time limit of a native reader: a constant [s], plus size / speed [B/s]
#: First lines of the script of a child process: limit its memory, if the system can.
LIMIT_MEMORY = """
import sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_DATA, 2 * (int(sys.argv[2]),))
except (ImportError, OSError, ValueError):
    pass
"""


@contextlib.contextmanager
def reading(where: Path | str, what: str) -> Iterator[None]:
    """Context manager that turns every error in its block into an InputError of one line.

    The message says that `where`, a file, cannot be read as `what`, the expected content. An InputError stays as it is.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # readers raise errors of all kinds for damaged files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{where}: cannot be read as {what} ({reason})") from error


def require_plausible_size(path: Path, size: int) -> None:
    """Raise ValueError if a file declares a content so large that reading it could exhaust the memory.

    `size`: number of bytes of the content, as the file declares it. Up to 256 MiB are allowed, and more for large
    files: up to 4096 times the size of the file on disk.
    """
    if size > max(SMALL, EXPANSION * path.stat().st_size):
        raise ValueError(f"declares {size:,} bytes, in a file of {path.stat().st_size:,}")


def require_readable(read: str, path: Path, size: int, what: str) -> None:
    """Raise InputError if a native library fails, crashes, hangs or exhausts the memory when it reads the file `path`.

    The library is tried in a child process, because Ctrl-C does not stop native code that hangs. `read`: Python code
    that reads the file; the path is in sys.argv[1]. `size`: number of bytes to read. `what`: the expected content.
    """
    try:
        trial = [sys.executable, "-c", LIMIT_MEMORY + read, str(path), str(2**31 + 40 * size)]
        done = subprocess.run(trial, capture_output=True, text=True, timeout=READ_SECONDS + size / READ_SPEED)
        trouble = done.stderr.strip().splitlines()[-1:] or [f"its reader ended with status {done.returncode}"]
    except subprocess.TimeoutExpired as late:
        raise InputError(f"{path}: not {what}, or damaged (not read in {late.timeout:.0f} s)") from late
    if done.returncode:
        raise InputError(f"{path}: not {what}, or damaged ({trouble[0]})")


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """Read a .npz file. Returns a dict from names to arrays. Raises InputError if the file cannot be read."""
    with reading(path, "arrays of NumPy's, .npz"), zipfile.ZipFile(path) as archive:
        require_plausible_size(path, sum(member.file_size for member in archive.infolist()))
        return {name.removesuffix(".npy"): parse_npy(archive.read(name)) for name in archive.namelist()}


def load_npy(path: Path) -> np.ndarray:
    """Read the array of a .npy file. Raises InputError if the file cannot be read."""
    with reading(path, "an array of NumPy's, .npy"):
        return parse_npy(path.read_bytes())


def parse_npy(content: bytes) -> np.ndarray:
    """Convert `content`, the bytes of a .npy file, to its array. Raises ValueError if the content is damaged."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in headers:
        raise ValueError(f"is of version {version[0]}.{version[1]}")
    shape, _, kind = headers[version](stream)
    if math.prod(shape) * kind.itemsize > len(content):  # checked before numpy allocates it
        raise ValueError(f"declares an array of shape {shape}, and is shorter")
    array = np.load(io.BytesIO(content))
    if kind.kind == "U" and array.nbytes:
        codes = np.frombuffer(array.tobytes(), np.dtype("u4").newbyteorder(array.dtype.byteorder))
        if codes.max() > sys.maxunicode:  # Python would fail at each access
            raise ValueError("has invalid characters")
    return array
