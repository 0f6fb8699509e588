"""Errors for invalid input, and checks that raise them."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 1e18  #: number whose square is finite in float32


class InputError(ValueError):
    """Error for input that the user can correct. Commands print its message and exit with status 2.

    The message is one line. It says the file, the field, what was found, and what to do.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.splitlines()))


class SceneError(ValueError):
    """Error for a Mitsuba scene that cannot be rendered. The message names the object in the scene and the problem."""


def is_file(path: Path) -> bool:
    """Test whether a file exists. Returns False if its name is too long for the file system."""
    return os.path.isfile(path)


def require_file(path: Path, wanted: str, field: str = "") -> None:
    """Raise InputError if `path` is not a file. The message has the form "path: field: no such file; give `wanted`".

    `field`: option or field that names the file; it is left out if it is empty. `wanted`: description of the file that
    is needed, such as "the results folder of a fit".
    """
    if not is_file(path):
        what = "is a folder" if os.path.isdir(path) else "no such file"
        raise InputError(f"{path}: {field}{': ' if field else ''}{what}; give {wanted}")


def require_range(options: Any, name: str, low: float, high: float = math.inf) -> None:
    """Raise InputError if an option is less than `low` or greater than `high`. An option that is None is allowed.

    `options`: dataclass instance with the options of a command. `name`: name of the field in it.
    """
    value = getattr(options, name)
    if value is not None and not low <= value <= high:
        limits = f"{low} to {high}" if high < math.inf else f"at least {low}"
        raise InputError(f"--{name.replace('_', '-')}: is {value}, must be {limits}")


def require_numbers(value: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert a value to a float32 array, and check that it has this shape and only finite numbers.

    Raises InputError otherwise. The message begins with `what`, the name of the value.
    """
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{what}: is {type(value).__name__}; must be numbers of shape {shape}") from None
    if array.shape != shape:
        raise InputError(f"{what}: is of shape {array.shape}; must be {shape}")
    if not (np.abs(array) <= LARGEST).all():
        raise InputError(f"{what}: must be finite, {LARGEST:g} at most")
    return array.astype(np.float32)
