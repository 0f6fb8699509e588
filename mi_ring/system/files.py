"""Writes files such that they are complete or absent. Also computes checksums and locks folders."""

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

SEAL = b"blake2b "  #: begins the comment of a zip file that holds its checksum
DIGEST = 32  #: hexadecimal digits of the checksum
END, COMMENT = b"PK\x05\x06", 20  #: of the last record of a zip file: signature, and offset of the comment's length


@contextlib.contextmanager
def writing(what: Path | str) -> Iterator[None]:
    """A context manager that turns an OSError, such as a full disk, into an InputError.

    `what`: the beginning of the message: path of the file, or path and option.
    """
    try:
        yield
    except OSError as error:
        advice = "make room" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "choose another place"
        raise InputError(f"{what}: cannot be written ({error.strerror}); {advice}") from error


def require_place(path: Path, field: str = "") -> None:
    """Create the folder of the file `path`, and check that files can be written there. Raises InputError if not.

    Call it before long work whose result goes to this file. `field`: name of the option, for the message; empty: none.
    """
    with writing(f"{path}: {field}" if field else path):
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()


def relative_to(folder: Path, path: Path) -> str:
    """Return `path` relative to `folder`, with forward slashes; unchanged if it is on another drive (Windows)."""
    with contextlib.suppress(ValueError):
        path = Path(os.path.relpath(path, folder))
    return path.as_posix()


def partial_path(path: Path) -> Path:
    """Return a new path in the folder of `path`, to write a file there first and to rename it when it is complete.

    No other process uses the returned path.
    """
    return path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")


def write_file(path: Path, content: bytes | memoryview | str, durable: bool = False, keep: Path | None = None) -> None:
    """Write a file such that it is complete or absent. Raises InputError if it cannot be written.

    `content`: a text is written as UTF-8. `durable`: the file survives a power failure; this is slower. `keep`: an
    existing file is moved to this path; None: it is replaced.
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
                with contextlib.suppress(OSError):  # on Windows, and on some file systems
                    folder = os.open(path.parent, os.O_RDONLY)
                    os.fsync(folder)
                    os.close(folder)
        finally:
            partial.unlink(missing_ok=True)


def write_state(state: dict, path: Path, keep: Path | None = None) -> None:
    """Write a dictionary by `torch.save`, with a checksum by which a reader detects damage.

    An entry "sealed": True says that there is a checksum. `keep`: an existing file is moved to this path; None: it is
    replaced. The file survives a power failure. Raises InputError if it cannot be written.
    """
    buffer = io.BytesIO()
    torch.save(state | {"sealed": True}, buffer)
    seal(buffer)
    write_file(path, buffer.getbuffer(), durable=True, keep=keep)


def seal(archive: io.BytesIO) -> None:
    """Append a checksum to a zip file, as its comment. It covers everything before it. `archive` is changed.

    `archive`: the zip file, without a comment.
    """
    end = archive.seek(-COMMENT - 2, os.SEEK_END)
    assert archive.read(len(END)) == END, "it has a comment already"
    archive.seek(end + COMMENT)
    archive.write((len(SEAL) + DIGEST).to_bytes(2, "little"))
    archive.write(SEAL + fingerprint(archive.getbuffer()))


def is_sealed(archive: bytes) -> bool:
    """Return True if a zip file ends with a checksum of ours that is right. False means no checksum, or a damaged file.

    `archive`: the bytes of the file.
    """
    body = memoryview(archive)[: max(0, len(archive) - len(SEAL) - DIGEST)]
    return archive[len(body) :] == SEAL + fingerprint(body)


def fingerprint(content: bytes | memoryview) -> bytes:
    """Return the BLAKE2b checksum of `content` as 32 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=DIGEST // 2).hexdigest().encode()


def digest(file: Path) -> str:
    """Return the BLAKE2b checksum of a file's content as 32 hexadecimal digits. Large files need little memory."""
    result = hashlib.blake2b(digest_size=16)
    with file.open("rb") as stream:
        while block := stream.read(2**20):
            result.update(block)
    return result.hexdigest()


def read_json(path: Path) -> Any:
    """Return the content of a JSON file. Returns None if the file is missing or damaged."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None


def quoted(content: bytes) -> list[str]:
    """Return all quoted strings in an XML file. Among them are the names of the files that it uses.

    `content`: the bytes of the file.
    """
    strings = re.findall(rb"\"([^\"<>\0\n]{1,500})\"|'([^'<>\0\n]{1,500})'", content)
    return [(double or single).decode(errors="replace") for double, single in strings]


@contextlib.contextmanager
def locked(folder: Path, field: str = "--out", wait: bool = False) -> Iterator[None]:
    """A context manager that locks a folder for this process. The lock ends with the context or with the process.

    If another process has locked the folder, raises InputError; with `wait`, waits for that process instead. `field`:
    name of the option that gave the folder, for messages. The lock is a file beside the folder, so the folder can be
    moved.
    """
    place = folder.resolve()
    file = place.with_name(f".{place.name}.lock")
    if place.is_file():
        raise InputError(f"{folder}: {field}: is a file; give a new or existing folder")
    require_place(place, field)  # otherwise filelock would report that another process holds the lock
    with writing(f"{folder}: {field}"):
        lock = filelock.FileLock(file)
        try:
            acquired = lock.acquire(timeout=0)
        except filelock.Timeout:
            if not wait:
                raise InputError(
                    f"{folder}: {field}: another process is writing there; wait for it, or give another folder"
                ) from None
            print(f"waiting for {folder}: another process writes it", flush=True)
            acquired = lock.acquire()
    with acquired:
        try:
            yield
        finally:
            # A waiting process has opened this file, and must not lock a removed file. Windows cannot remove an open
            # file; there, filelock removes it.
            if os.name == "posix" and not wait:
                file.unlink(missing_ok=True)


@contextlib.contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A context manager that yields a new temporary folder. At the end, it renames this folder to `folder`.

    At that time, `folder` must be missing or empty. After an error, the temporary folder is removed, and `folder` stays
    as it was. Raises InputError if something cannot be written.
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


@contextlib.contextmanager
def all_or_none(path: Path) -> Iterator[Path]:
    """A context manager for several files that belong together. Yields the path to write instead of `path`.

    The other files are written beside it. At the end, all move to the folder of `path`, `path` itself last. After an
    error before that, all that was there stays as it was. Raises InputError if something cannot be written.
    """
    with writing(path), tempfile.TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as name:
        folder = Path(name)
        try:
            yield folder / path.name
        except InputError as error:
            raise InputError(str(error).replace(str(folder), str(path.parent))) from error
        made = sorted(folder.iterdir(), key=lambda file: (file.name == path.name, file.name))
        if there := next((path.with_name(file.name) for file in made if path.with_name(file.name).is_dir()), None):
            raise InputError(f"{there}: is a folder; choose another name for {path.name}")
        for file in made:
            os.replace(file, path.with_name(file.name))
