"""The errors for bad input, and the most frequent cause: a file that does not exist."""

import math
import os
from pathlib import Path
from typing import Any


class InputError(ValueError):
    """The user's input cannot be used. Commands print the message and exit with status 2.

    The message is one line: the file, the field, what was found, and what to do.
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


def require_range(options: Any, name: str, low: float, high: float = math.inf) -> None:
    """Raise InputError unless the option of this name is within these limits or None."""
    value = getattr(options, name)
    if value is not None and not low <= value <= high:
        limits = f"{low} to {high}" if high < math.inf else f"at least {low}"
        raise InputError(f"--{name.replace('_', '-')}: is {value}, must be {limits}")
