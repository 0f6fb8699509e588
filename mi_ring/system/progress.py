"""How far something is."""

import contextlib
import errno
import io
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: what `progress` is; another shows nothing
PATIENCE, QUIET = 2.0, 30.0  #: seconds before something is shown, and between two lines where there is no terminal


@contextlib.contextmanager
def outliving_readers() -> Iterator[None]:
    """Within it nobody need read on what is printed: `| head`, a terminal that is closed. It is dropped then."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and Dispensable(stream) for stream in before)  # None: there is no console
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, Dispensable):
                try:
                    stream.stream.flush()
                except OSError:
                    stream.drop()
        sys.stdout, sys.stderr = before


class Dispensable:
    """A stream of text, of which what cannot be written is dropped; all from then on, if nobody is there any more."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write it, if that is possible."""
        self.attempt(lambda: self.stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush it, if that is possible."""
        self.attempt(self.stream.flush)

    def attempt(self, output: Callable[[], object]) -> None:
        """Try it."""
        try:
            output()
        except OSError as error:
            if error.errno in (errno.EPIPE, errno.EIO):
                self.drop()

    def drop(self) -> None:
        """Drop what is left to be written, which would fail again at the very end, and all that comes."""
        with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self.stream.fileno())


class Lines(io.TextIOBase):
    """Standard error where it is a file: a bar's state now and then, each a line of its own."""

    def __init__(self) -> None:
        self.last, self.shown = -math.inf, ""  #: when the last was written [s], and what it was

    def write(self, text: str) -> int:
        """Write it, if there is anything to be seen in it and the last was a while ago."""
        if text.strip() and time.monotonic() - self.last >= QUIET:
            self.put(text.strip())
        return len(text)

    def put(self, line: str) -> None:
        """Write a line, unless it is there already."""
        if sys.stderr and line != self.shown:
            sys.stderr.write(f"{line}\n")
            self.last, self.shown = time.monotonic(), line

    def flush(self) -> None:
        """Flush standard error."""
        if sys.stderr:
            sys.stderr.flush()


class LastLine(tqdm):
    """A bar that is lines, of which the last says how far it came; tqdm leaves that out, or wipes it off."""

    def __init__(self, *arguments: Any, file: Lines, **options: Any) -> None:
        self.lines = file
        super().__init__(*arguments, file=file, **options)

    def close(self) -> None:
        """Say it, if anything was said before."""
        if not self.disable and self.lines.shown:
            self.lines.put(str(self).strip())
        super().close()


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Iterates over things and shows how far it is, while it is at work; `options` are those of tqdm.

    In a terminal it is a bar; else a line is written twice a minute, and none of what takes less than two seconds.
    """
    kind = tqdm
    if not getattr(sys.stderr, "isatty", bool)():
        kind = LastLine
        options |= {"file": Lines(), "delay": PATIENCE, "ascii": " #", "position": 0}
    columns, rows = shutil.get_terminal_size()  # 80 x 24 where a terminal says 0 x 0: tqdm would show nothing
    return kind(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
