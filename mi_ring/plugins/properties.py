"""Reading the properties of plugins: files, numbers, vectors."""

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np


def beside_scene(name: str) -> Path:
    """The path of a file that a scene names: relative to the scene's folder, or without one to the working folder."""
    return Path(str(mi.file_resolver()[0])) / name


LARGEST = 1e18  #: number whose square is finite in float32


def number(props, name: str, default: float | None = None, positive: bool = False) -> float:
    """Read a number from a plugin's properties. Its square must be finite, and if `positive` its inverse, too.

    Raises ValueError if the property is anything else. `default`: the value if it is missing.
    """
    value = props.get(name, default)
    least = 1 / LARGEST if positive else -LARGEST
    if isinstance(value, int | float) and least <= value <= LARGEST:
        return float(value)
    wanted = f"a positive number, {1 / LARGEST:g} to {LARGEST:g}" if positive else "a number"
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {value}, must be {wanted}')


def vector(props, name: str, kind: str) -> np.ndarray | None:
    """Read a <point> or <vector> (`kind`) from a plugin's properties: (3,), or None. Otherwise raises ValueError."""
    if name not in props:
        return None
    found = np.array(props[name]).ravel()
    if found.shape == (3,) and found.dtype.kind == "f" and np.isfinite(found).all():
        return found
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {props[name]}, must be a <{kind}>')


def number_list(props, name: str, counts: Sequence[int]) -> list[float]:
    """Read a text of numbers, as many as one of `counts`, from a plugin's properties. Otherwise raises ValueError."""
    text = str(props.get(name, ""))
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) in counts and (np.abs(values) <= LARGEST).all():
        return values
    wanted = " or ".join(map(str, counts))
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is "{text[:60]}", must be {wanted} numbers')
