"""Files that are there whole or not at all."""

import contextlib
import errno
import io
import os
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

import filelock
import torch

from mi_ring.errors import InputError


@contextlib.contextmanager
def writing(what: Path | str) -> Iterator[None]:
    """Turns what the system has against writing a file, a full disk for instance, into an InputError."""
    try:
        yield
    except OSError as error:
        advice = "make room" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose another place"
        raise InputError(f"{what}: cannot be written ({error.strerror}); {advice}") from error


def require_place(path: Path, field: str = "") -> None:
    """Make the folder of a file that is to come after long work. Raises InputError if nothing can be written there."""
    with writing(f"{path}: {field}" if field else path):
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()


def relative_to(folder: Path, path: Path) -> str:
    """A path as files in a folder name it, with forward slashes; absolute where it is on another drive (Windows)."""
    with contextlib.suppress(ValueError):
        path = Path(os.path.relpath(path, folder))
    return path.as_posix()


def partial_path(path: Path) -> Path:
    """Where a file grows until it is whole: beside it, under a name that no other process has."""
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")


def write_file(path: Path, content: bytes | str) -> None:
    """Write a file so that it is there whole or not at all. Raises InputError if it cannot be written."""
    partial = partial_path(path)
    with writing(path):
        try:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


def write_state(state: dict, path: Path) -> None:
    """`torch.save`, whole or not at all."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_file(path, buffer.getvalue())


@contextlib.contextmanager
def locked(folder: Path, field: str = "--out") -> Iterator[None]:
    """Keep other processes from writing into a folder. Raises InputError if one does already.

    The lock is beside the folder, which may be moved meanwhile, and goes with the process.
    """
    place = folder.resolve()
    file = place.with_name(f".{place.name}.lock")
    if place.is_file():
        raise InputError(f"{folder}: {field}: is a file; give a folder, which is made if it is not there")
    require_place(place, field)  # else filelock tells of another process
    with writing(f"{folder}: {field}"):
        lock = filelock.FileLock(file, timeout=0)
        try:
            lock.acquire()
        except filelock.Timeout:
            raise InputError(
                f"{folder}: {field}: another process is writing there; wait for it, or give another folder"
            ) from None
    try:
        yield
    finally:
        if os.name == "posix":  # elsewhere a file that is open cannot be removed, and filelock removes it itself
            file.unlink(missing_ok=True)
        lock.release()
