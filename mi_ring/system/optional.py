"""Packages that are not available for every machine. They are imported when they are needed."""

import contextlib
import importlib.util
import signal
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from mi_ring.errors import InputError


def installed(package: str) -> bool:
    """Whether this package can be imported."""
    return importlib.util.find_spec(package) is not None


def need(package: str, what: str, distribution: str | None = None) -> ModuleType:
    """Import a package. If it is not installed, raises InputError, which begins with its use, `what`.

    `distribution`: its name for pip, if that differs.
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
    """A context manager that restores the handler of SIGTERM, which some libraries replace."""
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
