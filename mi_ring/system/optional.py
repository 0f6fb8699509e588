"""Packages that cannot be installed on every machine: they are imported when they are needed."""

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from mi_ring.errors import InputError


def installed(package: str) -> bool:
    """Can this package be imported?"""
    return importlib.util.find_spec(package) is not None


def need(package: str, what: str, distribution: str | None = None) -> ModuleType:
    """Import a package. Raises InputError, which begins with `what`, its use, if it is not installed.

    `distribution`: the name to install it by, if that differs.
    """
    try:
        with keeping_handlers():  # pycolmap installs its own
            return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise InputError(f"{what}: needs the package {package}, which is not installed; try `pip install "
                         f"{distribution or package}` (for some systems, Linux on ARM for one, there is none "
                         "ready-made)") from error  # fmt: skip


@contextlib.contextmanager
def keeping_handlers() -> Iterator[None]:
    """Restore the handler of SIGTERM afterwards: some libraries replace it."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


class LazyPackage:
    """A package that `need` imports when it is first used."""

    def __init__(self, package: str, what: str) -> None:
        self.package, self.what = package, what

    def __getattr__(self, name: str) -> Any:
        return getattr(need(self.package, self.what), name)
