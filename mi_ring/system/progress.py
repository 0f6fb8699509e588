"""Progress bars, and output that tolerates a closed terminal or pipe."""

import contextlib
import errno
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, NamedTuple

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: the type of `progress`, and of substitutes that show nothing
DELAY, LOG_INTERVAL = 2.0, 30.0  #: seconds before the first line in a log, and between two lines


@contextlib.contextmanager
def tolerating_closed_output() -> Iterator[None]:
    """A context manager that drops output that cannot be written, such as after `| head` or in a closed terminal."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and TolerantStream(stream) for stream in before)  # None: there is no console
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TolerantStream):
                try:
                    stream.stream.flush()
                except OSError:
                    stream.discard()
        sys.stdout, sys.stderr = before


class TolerantStream:
    """A text stream that drops text that cannot be written. Once its reader is gone, it drops all text."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write text if this is possible. Returns the length of the text in any case."""
        self.attempt(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream if this is possible."""
        self.attempt(self.stream.flush)

    def attempt(self, operation: Callable[..., object], *arguments: Any) -> None:
        """Call an operation of the stream, and ignore its OSError."""
        try:
            operation(*arguments)
        except OSError as error:
            if error.errno in (errno.EPIPE, errno.EIO):
                self.discard()

    def discard(self) -> None:
        """Send the buffered text, and all text that follows, to the null device.

        Otherwise, writing the buffered text would fail again at exit.
        """
        with contextlib.suppress(OSError), open(os.devnull, "w") as null:
            os.dup2(null.fileno(), self.stream.fileno())


class LogBar(tqdm):
    """A progress bar for a log. It writes a line every `LOG_INTERVAL` seconds, and one at the end."""

    written, line = -math.inf, ""  #: when the last line was written [s], and its text

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Write a line if `LOG_INTERVAL` is over. tqdm calls this method."""
        if msg is None and time.monotonic() - self.written >= LOG_INTERVAL:
            self.write_line()

    def write_line(self) -> None:
        """Write the progress as a line. If the last line is the same, nothing is written."""
        if (line := str(self).strip()) != self.line:
            self.fp.write(f"{line}\n")
            self.fp.flush()
            self.written, self.line = time.monotonic(), line

    def clear(self, *arguments: Any, **options: Any) -> None:
        """Do nothing. tqdm calls this method to erase a bar, but a log is not erased."""

    def close(self) -> None:
        """Write a last line, if lines were written before."""
        if not self.disable and self.line:
            self.write_line()
        super().close()


class Step(NamedTuple):
    """A step of a command, for progress bars: the names of its bars, and how long it takes."""

    bars: tuple[str, ...]  #: what the names of its progress bars begin with
    seconds: float  #: that it is likely to take; only the ratios of steps matter


class Steps:
    """The steps of a command, as a context manager. Progress bars then show the step and the time that is left."""

    current: ClassVar["Steps | None"] = None  #: those of the command that runs

    def __init__(self, *steps: Step) -> None:
        self.steps, self.number, self.started = steps, 0, time.monotonic()

    def __enter__(self) -> "Steps":
        Steps.current = self
        return self

    def __exit__(self, *error: object) -> None:
        Steps.current = None

    def named(self, what: str) -> str:
        """Return the name for a progress bar, with its step and the time that all steps still need.

        If the bar belongs to no step, or to a step that is over, its name does not change. `what`: the bar's name.
        """
        ahead = range(self.number, len(self.steps))
        found = next((n for n in ahead if what.startswith(self.steps[n].bars)), None)
        if found is None:
            return what
        self.number = found
        name = f"step {found + 1}/{len(self.steps)}, {what}"
        done, left = (sum(step.seconds for step in part) for part in (self.steps[:found], self.steps[found:]))
        if not done or (elapsed := time.monotonic() - self.started) < DELAY:
            return name  # nothing is known yet of this machine's speed
        return f"{name}, all steps {tqdm.format_interval(elapsed / done * left)} more"


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Iterate over `things`, and show the progress. `what`: name of the bar. `options`: those of tqdm.

    In a terminal, it is a bar. In a log, it is a line every 30 seconds. Work of less than two seconds gets no line.
    """
    kind, what = tqdm, Steps.current.named(what) if Steps.current else what
    if not getattr(sys.stderr, "isatty", bool)():
        kind = LogBar
        # At position 0, tqdm would end with a carriage return.
        options |= {"delay": DELAY, "ascii": " #", "position": 1} | ({} if sys.stderr else {"disable": True})
    columns, rows = shutil.get_terminal_size()  # 80 x 24 if a terminal says 0 x 0, at which tqdm shows nothing
    return kind(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
