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
    """A context manager in which output that cannot be written is dropped, as after `| head` or in a closed terminal.

    It replaces `sys.stdout` and `sys.stderr`.
    """
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
    """A text stream that ignores errors of writing. If its reader is gone (`head`), it drops all further text."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write text, and ignore an OSError. Returns the length of the text in both cases."""
        self.attempt(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream, and ignore an OSError."""
        self.attempt(self.stream.flush)

    def attempt(self, operation: Callable[..., object], *arguments: Any) -> None:
        """Call `operation` with `arguments`, and ignore an OSError. If the reader is gone, drop all further text."""
        try:
            operation(*arguments)
        except OSError as error:
            if error.errno in (errno.EPIPE, errno.EIO):
                self.discard()

    def discard(self) -> None:
        """Redirect the stream to the null device: the text that is still in its buffer, and all text that follows.

        Otherwise, writing the buffered text would fail again when the process exits.
        """
        with contextlib.suppress(OSError), open(os.devnull, "w") as null:
            os.dup2(null.fileno(), self.stream.fileno())


class LogBar(tqdm):
    """A progress bar for a log file. It writes a line every `LOG_INTERVAL` seconds, and one at the end."""

    written, line = -math.inf, ""  #: when the last line was written [s], and its text

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Write a line if the last one is at least `LOG_INTERVAL` seconds old. tqdm calls this method."""
        if msg is None and time.monotonic() - self.written >= LOG_INTERVAL:
            self.write_line()

    def write_line(self) -> None:
        """Write the progress as a line, unless the line is the same as the last one."""
        if (line := str(self).strip()) != self.line:
            self.fp.write(f"{line}\n")
            self.fp.flush()
            self.written, self.line = time.monotonic(), line

    def clear(self, *arguments: Any, **options: Any) -> None:
        """Do nothing. tqdm calls this method to erase a bar, but a log is not erased."""

    def close(self) -> None:
        """Close the bar. If it has written lines, write a last one."""
        if not self.disable and self.line:
            self.write_line()
        super().close()


class Step(NamedTuple):
    """A step of a command: the progress bars that belong to it, and how long it is likely to take."""

    bars: tuple[str, ...]  #: what the names of its progress bars begin with
    seconds: float  #: that it is likely to take; only the ratios of steps matter


class Steps:
    """The steps of a command, as a context manager. In it, progress bars show the step and the time that is left."""

    current: ClassVar["Steps | None"] = None  #: those of the command that runs

    def __init__(self, *steps: Step) -> None:
        self.steps, self.number, self.started = steps, 0, time.monotonic()

    def __enter__(self) -> "Steps":
        Steps.current = self
        return self

    def __exit__(self, *error: object) -> None:
        Steps.current = None

    def named(self, what: str) -> str:
        """Return the text for a progress bar: its name `what` with the number of its step and the time still needed.

        The time is that of all steps that are left. If no step that is left has a bar of this name, returns `what`
        unchanged.
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
    """Return an iterator over `things` that shows a progress bar; for None, call its `update` yourself.

    `what`: name of the bar. `total`: number of things, if `len` cannot tell it. `leave`: the bar stays when it is
    finished. `options`: other options of tqdm. If standard error is not a terminal, it writes a line every 30 seconds,
    and none if the work takes less than two seconds.
    """
    kind, what = tqdm, Steps.current.named(what) if Steps.current else what
    if not getattr(sys.stderr, "isatty", bool)():
        kind = LogBar
        # At position 0, tqdm would end with a carriage return.
        options |= {"delay": DELAY, "ascii": " #", "position": 1} | ({} if sys.stderr else {"disable": True})
    columns, rows = shutil.get_terminal_size()  # 80 x 24 if a terminal says 0 x 0, at which tqdm shows nothing
    return kind(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
