"""Imports optional packages, which some machines lack. Each is imported only when it is needed."""

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from mi_ring.errors import InputError


def installed(package: str) -> bool:
    """Return True if this package is installed. Does not import it."""
    return importlib.util.find_spec(package) is not None


def need(package: str, what: str, distribution: str | None = None) -> ModuleType:
    """Import a package and return it. Raises InputError if it is not installed.

    `what`: what needs the package, the beginning of the message. `distribution`: the package's name for pip; None: the
    same name.
    """
    try:
        with keeping_handlers():  # pycolmap installs its own
            return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise InputError(f"{what}: needs the package {package}, which is not installed; try `pip install "
                         f"{distribution or package}`; it is not built for every system") from error  # fmt: skip


@contextlib.contextmanager
def keeping_handlers() -> Iterator[None]:
    """A context manager that restores the handler of SIGTERM at its end. Some libraries replace this handler."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if handler is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


class LazyPackage:
    """Stands for a package that is imported when an attribute is first read. Then raises InputError if it is missing.

    `what`: what needs the package, the beginning of the message.
    """

    def __init__(self, package: str, what: str) -> None:
        self.package, self.what = package, what

    def __getattr__(self, name: str) -> Any:
        return getattr(need(self.package, self.what), name)
