"""How far something is."""

import io
import shutil
import sys
from collections.abc import Callable, Iterable
from typing import Any

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: what `progress` is; another shows nothing
QUIET = 30.0  #: seconds between two lines where there is no terminal


class Lines(io.TextIOBase):
    """Standard error where it is a file: each state of a bar is a line of its own."""

    def write(self, text: str) -> int:
        """Write it, if there is anything to be seen in it."""
        if sys.stderr and (line := text.strip()):
            sys.stderr.write(f"{line}\n")
        return len(text)

    def flush(self) -> None:
        """Flush standard error."""
        if sys.stderr:
            sys.stderr.flush()


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Iterates over things and shows how far it is, while it is at work; `options` are those of tqdm.

    In a terminal it is a bar; else a line is written twice a minute, and none of what takes less.
    """
    if not getattr(sys.stderr, "isatty", bool)():
        options |= {"file": Lines(), "mininterval": QUIET, "maxinterval": QUIET, "delay": QUIET, "ascii": " #",
                    "position": 0}  # fmt: skip
    columns, rows = shutil.get_terminal_size()  # 80 x 24 where a terminal says 0 x 0: tqdm would show nothing
    return tqdm(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
