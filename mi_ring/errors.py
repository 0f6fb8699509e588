"""The one error that a user can cause, and the commonest cause of it."""

import os
from pathlib import Path


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line, whatever it echoes: the file, the field, what was found, and what to do. Commands print it
    and exit with status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class SceneError(ValueError):
    """What a scene asks for cannot be rendered. The message says which object and what is wrong with it."""


def is_file(path: Path) -> bool:
    """Is there such a file? There is none of a name that cannot be."""
    try:
        return path.is_file()
    except OSError:
        return False


def require_file(path: Path, wanted: str, field: str = "") -> None:
    """Raise InputError, which says what is `wanted` and in which `field`, if the path is not that of a file."""
    if not is_file(path):
        what = "is a folder" if os.path.isdir(path) else "no such file"
        raise InputError(f"{path}: {field}{': ' if field else ''}{what}; give {wanted}")
