"""Packages that not every machine can install: asked for when they are needed."""

import importlib
from types import ModuleType

from mi_ring.errors import InputError


def need(package: str, what: str) -> ModuleType:
    """Import a package. Raises InputError, which says `what` it is for, if it is not installed."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise InputError(f"{what}: needs the package {package}, which is not installed; try `pip install {package}` "
                         "(for some systems, Linux on ARM for one, there is none ready-made)") from error  # fmt: skip
