"""The errors for bad input, and checks that raise them."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

LARGEST = 1e18  #: number whose square is finite in float32


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


def require_numbers(value: ArrayLike, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert a value to a float32 array of this shape.

    Raises InputError, which begins with `what`, if that is impossible.
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
