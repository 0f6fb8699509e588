"""What the plugins read of their properties."""

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np


def beside_scene(name: str) -> Path:
    """A file that a scene names, relative to the scene's own folder (to the working directory outside of a file)."""
    return Path(str(mi.file_resolver()[0])) / name


LARGEST = 1e18  #: number whose square is finite in float32, in which all is computed


def number(props, name: str, default: float | None = None, positive: bool = False) -> float:
    """A property of a plugin that is a finite number, and so are its square and, if it must be positive, its inverse.

    Raises ValueError, which names it, if it is anything else.
    """
    value = props.get(name, default)
    least = 1 / LARGEST if positive else -LARGEST
    if isinstance(value, int | float) and least <= value <= LARGEST:
        return float(value)
    wanted = f"a positive number, {1 / LARGEST:g} to {LARGEST:g}" if positive else "a number"
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {value}, must be {wanted}')


def vector(props, name: str, kind: str) -> np.ndarray | None:
    """A property of a plugin that is a <point> or <vector>, `kind`, (3,); None if there is none.

    Raises ValueError, which names it, if it is anything else.
    """
    if name not in props:
        return None
    found = np.array(props[name]).ravel()
    if found.shape == (3,) and found.dtype.kind == "f" and np.isfinite(found).all():
        return found
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is {props[name]}, must be a <{kind}>')


def number_list(props, name: str, counts: Sequence[int]) -> list[float]:
    """A property of a plugin that is one of so many finite numbers. Raises ValueError, which names it, if it is not."""
    text = str(props.get(name, ""))
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) in counts and (np.abs(values) <= LARGEST).all():
        return values
    wanted = " or ".join(map(str, counts))
    raise ValueError(f'{props.plugin_name()} "{props.id()}": {name} is "{text[:60]}", must be {wanted} numbers')
