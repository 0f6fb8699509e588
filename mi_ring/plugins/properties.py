"""Reads the properties of plugins: file names, numbers and vectors."""

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ring.errors import LARGEST


def beside_scene(name: str) -> Path:
    """Return the path of a file that a scene names: relative to the folder of the scene file.

    For a scene that was not read from a file, it is relative to the working directory. The file need not exist.
    """
    return Path(str(mi.file_resolver()[0])) / name


def number(props, name: str, default: float | None = None, positive: bool = False) -> float:
    """Read the property `name` of a plugin as a number. `props`: Mitsuba's properties of the plugin.

    `default`: the value if the property is missing; None: a missing property is an error. Raises ValueError if the
    property is no number, or if its absolute value exceeds 1e18, so that its square is finite in float32. If `positive`
    is True, the number must be at least 1e-18, so that 1 / number² is finite, too.
    """
    value = props.get(name, default)
    least = 1 / LARGEST if positive else -LARGEST
    if isinstance(value, int | float) and least <= value <= LARGEST:
        return float(value)
    wanted = f"a positive number, {1 / LARGEST:g} to {LARGEST:g}" if positive else "a number"
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {value}, must be {wanted}')


def vector(props, name: str, kind: str) -> np.ndarray | None:
    """Read the property `name` of a plugin as an array (3,). Returns None if the property is missing.

    `props`: Mitsuba's properties of the plugin. `kind`: "point" or "vector", used only in the error message. Raises
    ValueError if the property is not three finite numbers.
    """
    if name not in props:
        return None
    found = np.array(props[name]).ravel()
    if found.shape == (3,) and found.dtype.kind == "f" and np.isfinite(found).all():
        return found
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {props[name]}, must be a <{kind}>')


def number_list(props, name: str, counts: Sequence[int]) -> list[float]:
    """Read the property `name` of a plugin: a string of numbers, separated by spaces or commas. Returns their list.

    `props`: Mitsuba's properties of the plugin. `counts`: how many numbers are allowed, for example (1, 3). Raises
    ValueError for another count, for a word that is no number, and for a number whose absolute value exceeds 1e18.
    """
    text = str(props.get(name, ""))
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) in counts and (np.abs(values) <= LARGEST).all():
        return values
    wanted = " or ".join(map(str, counts))
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is "{text[:60]}", must be {wanted} numbers')
