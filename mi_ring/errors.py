"""The errors for bad input, and checks that raise them."""

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
    """Whether a file exists. False for a name that is too long, for which `Path.is_file` raises an error."""
    return os.path.isfile(path)


def require_file(path: Path, wanted: str, field: str = "") -> None:
    """Raise InputError if a file does not exist. The message names the `field` and says which file is `wanted`."""
    if not is_file(path):
        what = "is a folder" if os.path.isdir(path) else "no such file"
        raise InputError(f"{path}: {field}{': ' if field else ''}{what}; give {wanted}")


def require_range(options: Any, name: str, low: float, high: float = math.inf) -> None:
    """Raise InputError unless the option of this name is in [low, high] or None."""
    value = getattr(options, name)
    if value is not None and not low <= value <= high:
        limits = f"{low} to {high}" if high < math.inf else f"at least {low}"
        raise InputError(f"--{name.replace('_', '-')}: is {value}, must be {limits}")
