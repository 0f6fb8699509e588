"""The errors for bad input, and the most frequent cause: a file that does not exist."""

import os
from pathlib import Path


class InputError(ValueError):
    """The user's input cannot be used.

    The message is one line: the file, the field, what was found, and what to do. Commands print it and exit with
    status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class SceneError(ValueError):
    """A scene cannot be rendered. The message names the object and the problem."""


def is_file(path: Path) -> bool:
    """Is there such a file? Unlike `Path.is_file`, this is False for a name that is too long."""
    return os.path.isfile(path)


def require_file(path: Path, wanted: str, field: str = "") -> None:
    """Raise InputError if there is no such file; the message says which file is `wanted` and names the `field`."""
    if not is_file(path):
        what = "is a folder" if os.path.isdir(path) else "no such file"
        raise InputError(f"{path}: {field}{': ' if field else ''}{what}; give {wanted}")
