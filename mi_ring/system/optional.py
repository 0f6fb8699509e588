"""Imports packages that are not available for every machine. They are imported only when they are needed."""

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from mi_ring.errors import InputError


def installed(package: str) -> bool:
    """Return whether this package can be imported."""
    return importlib.util.find_spec(package) is not None


def need(package: str, what: str, distribution: str | None = None) -> ModuleType:
    """Import a package, and return it. Raises InputError if it is not installed.

    The message begins with `what`, which says what needs the package. `distribution`: the name for pip, if it differs.
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
    """Stands for a package. When it is first used, `need` imports the package."""

    def __init__(self, package: str, what: str) -> None:
        self.package, self.what = package, what

    def __getattr__(self, name: str) -> Any:
        return getattr(need(self.package, self.what), name)
