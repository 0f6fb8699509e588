"""Files that are there whole or not at all."""

import contextlib
import errno
import hashlib
import io
import json
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import torch

from mi_ring.errors import InputError

SEAL = b"blake2b "  #: begins the comment at the end of an archive that says what its bytes are
DIGEST = 32  #: hexadecimal digits of it
END, COMMENT = b"PK\x05\x06", 20  #: of a zip file: its last record begins so, and there has the length of a comment


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


def write_file(path: Path, content: bytes | memoryview | str, durable: bool = False, keep: Path | None = None) -> None:
    """Write a file so that it is there whole or not at all. Raises InputError if it cannot be written.

    `durable`: even after a power cut, which takes a while. `keep`: what was there before goes there.
    """
    partial = partial_path(path)
    with writing(path):
        try:
            with partial.open("wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            if keep:
                with contextlib.suppress(FileNotFoundError):
                    os.replace(path, keep)
            os.replace(partial, path)
            if durable:
                sync_folder(path.parent)
        finally:
            partial.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Have its names outlive a power cut, where the system can: not on Windows, nor on all that is mounted."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def write_state(state: dict, path: Path, keep: Path | None = None) -> None:
    """`torch.save`, whole or not at all, and sealed: `read_state` notices each bit that is not as it was.

    `keep`: what was there before goes there.
    """
    buffer = io.BytesIO()
    torch.save(state | {"sealed": True}, buffer)
    seal(buffer)
    write_file(path, buffer.getbuffer(), durable=True, keep=keep)


def seal(archive: io.BytesIO) -> None:
    """Give a zip file the digest of all that comes before as its comment."""
    end = archive.seek(-COMMENT - 2, os.SEEK_END)
    assert archive.read(len(END)) == END, "has a comment already"
    archive.seek(end + COMMENT)
    archive.write((len(SEAL) + DIGEST).to_bytes(2, "little"))
    archive.write(SEAL + fingerprint(archive.getbuffer()))


def is_sealed(archive: bytes) -> bool:
    """Is it a zip file as `seal` left it, every bit of it?"""
    body = memoryview(archive)[: max(0, len(archive) - len(SEAL) - DIGEST)]
    return archive[len(body) :] == SEAL + fingerprint(body)


def fingerprint(content: bytes | memoryview) -> bytes:
    """Of some bytes, in hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=DIGEST // 2).hexdigest().encode()


def read_json(path: Path) -> Any:
    """What a JSON file of ours holds; None if there is no such file, or if it is damaged."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def quoted(content: bytes) -> list[str]:
    """The words in quotes of an XML file, some of which are names of files."""
    words = re.findall(rb"\"([^\"<>\0\n]{1,500})\"|'([^'<>\0\n]{1,500})'", content)
    return [(double or single).decode(errors="replace") for double, single in words]


@contextlib.contextmanager
def in_turn(folder: Path) -> Iterator[None]:
    """Make a folder after another process that does so has done it; says so if there is one.

    The lock is beside the folder and stays there: of one that is removed, who waits for it would hold another.
    """
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder.with_name(f".{folder.name}.lock"))
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            print(f"waiting for {folder}, which another process makes", flush=True)
            lock.acquire()
    try:
        yield
    finally:
        lock.release()


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


@contextlib.contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary folder beside `folder`. At the end it is renamed to `folder`, which must then be missing or empty.

    After an error nothing is left of it. Raises InputError if something in it cannot be written.
    """
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        growing = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            yield growing
            growing.chmod(0o755)
            with contextlib.suppress(FileNotFoundError):
                folder.rmdir()
            os.replace(growing, folder)
        finally:
            shutil.rmtree(growing, ignore_errors=True)
