"""Reading the properties of plugins: files, numbers, vectors."""

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ring.errors import LARGEST


def beside_scene(name: str) -> Path:
    """Resolve a file name in a scene relative to the scene's folder; without one, to the working folder."""
    return Path(str(mi.file_resolver()[0])) / name


def number(props, name: str, default: float | None = None, positive: bool = False) -> float:
    """Read a number from a plugin's properties. Its square must be finite; with `positive` its inverse, too.

    `default`: the value if the property is missing. Raises ValueError for anything else.
    """
    value = props.get(name, default)
    least = 1 / LARGEST if positive else -LARGEST
    if isinstance(value, int | float) and least <= value <= LARGEST:
        return float(value)
    wanted = f"a positive number, {1 / LARGEST:g} to {LARGEST:g}" if positive else "a number"
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {value}, must be {wanted}')


def vector(props, name: str, kind: str) -> np.ndarray | None:
    """Read the <point> or <vector> (`kind`) `name` from a plugin's properties: (3,), or None if missing.

    Raises ValueError for anything else.
    """
    if name not in props:
        return None
    found = np.array(props[name]).ravel()
    if found.shape == (3,) and found.dtype.kind == "f" and np.isfinite(found).all():
        return found
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {props[name]}, must be a <{kind}>')


def number_list(props, name: str, counts: Sequence[int]) -> list[float]:
    """Read a string of numbers from a plugin's properties. Raises ValueError unless `counts` contains their number."""
    text = str(props.get(name, ""))
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) in counts and (np.abs(values) <= LARGEST).all():
        return values
    wanted = " or ".join(map(str, counts))
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is "{text[:60]}", must be {wanted} numbers')
