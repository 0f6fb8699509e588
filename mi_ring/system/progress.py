"""How far something is."""

import io
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: what `progress` is; another shows nothing
PATIENCE, QUIET = 2.0, 30.0  #: seconds before something is shown, and between two lines where there is no terminal


class Lines(io.TextIOBase):
    """Standard error where it is a file: a bar's state now and then, each a line of its own."""

    def __init__(self) -> None:
        self.last = -math.inf  #: when the last was written [s]

    def write(self, text: str) -> int:
        """Write it, if there is anything to be seen in it and the last was a while ago."""
        line, now = text.strip(), time.monotonic()
        if sys.stderr and line and now - self.last >= QUIET:
            sys.stderr.write(f"{line}\n")
            self.last = now
        return len(text)

    def flush(self) -> None:
        """Flush standard error."""
        if sys.stderr:
            sys.stderr.flush()


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Iterates over things and shows how far it is, while it is at work; `options` are those of tqdm.

    In a terminal it is a bar; else a line is written twice a minute, and none of what takes less than two seconds.
    """
    if not getattr(sys.stderr, "isatty", bool)():
        options |= {"file": Lines(), "delay": PATIENCE, "ascii": " #", "position": 0}
    columns, rows = shutil.get_terminal_size()  # 80 x 24 where a terminal says 0 x 0: tqdm would show nothing
    return tqdm(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
