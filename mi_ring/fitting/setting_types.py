"""Converts values of settings, from JSON and from callers, to the types of the fields of `Config`, and back to text."""

import contextlib
from itertools import repeat
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin


def of_type(kind: Any, value: Any) -> Any:
    """Convert a `value`, from JSON or from a caller, to the type `kind` of a setting.

    Raises ValueError if this is impossible.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        for one in inner:
            with contextlib.suppress(ValueError):
                return of_type(one, value)
    elif origin is tuple and isinstance(value, list | tuple):
        kinds = repeat(inner[0], len(value)) if inner[-1] is ... else inner
        return tuple(of_type(one, item) for one, item in zip(kinds, value, strict=True))
    elif origin is dict and isinstance(value, dict):
        return {name: of_type(inner[1], item) for name, item in value.items()}
    elif kind is Path and isinstance(value, str | Path):
        return Path(value)
    elif kind in (int, float) and isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool):
        return kind(value)  # also of a number of numpy, which JSON cannot hold
    elif kind is bool and not isinstance(value, str) and value in (True, False):
        return bool(value)
    elif type(value) is kind or (origin is Literal and value in inner):
        return value
    raise ValueError(value)


def as_typed(value: Any) -> str:
    """Format the value of a setting, for messages, as the user types it on the command line."""
    if isinstance(value, dict):
        value = [word for item in value.items() for word in item]
    if isinstance(value, (tuple, list)):
        return " ".join(map(as_typed, value)) or "empty"
    return str(value)
