"""Errors for invalid input, and checks that raise them."""

import math
import os
from pathlib import Path
from typing import Any


class InputError(ValueError):
    """Error for input that the user can correct. Commands print its message and exit with status 2.

    The message is one line. It says the file, the field, what was found, and what to do.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class SceneError(ValueError):
    """Error for a Mitsuba scene that cannot be rendered. The message names the object in the scene and the problem."""


def is_file(path: Path) -> bool:
    """Test whether a file exists. Returns False for a name that is too long; `Path.is_file` would raise an error."""
    return os.path.isfile(path)


def require_file(path: Path, wanted: str, field: str = "") -> None:
    """Raise InputError if the file `path` does not exist. The message contains `field` and ends with "give `wanted`".

    `field`: option or field that names the file. `wanted`: description of the file that is needed.
    """
    if not is_file(path):
        what = "is a folder" if os.path.isdir(path) else "no such file"
        raise InputError(f"{path}: {field}{': ' if field else ''}{what}; give {wanted}")


def require_range(options: Any, name: str, low: float, high: float = math.inf) -> None:
    """Raise InputError if an option is less than `low` or greater than `high`. An option that is None is allowed.

    `options`: the dataclass of the options. `name`: the field of the option.
    """
    value = getattr(options, name)
    if value is not None and not low <= value <= high:
        limits = f"{low} to {high}" if high < math.inf else f"at least {low}"
        raise InputError(f"--{name.replace('_', '-')}: is {value}, must be {limits}")
