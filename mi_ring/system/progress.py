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
KNOWN = 0.1  #: share of the work of all steps whose time tells how long the rest will take
BEGUN = 0.05  #: share of a bar that tells how long the rest of it will take


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


class Bar(tqdm):
    """A progress bar that also says how long all steps of the command will still take, if it has `Steps`."""

    @property
    def format_dict(self) -> dict[str, Any]:
        """The values that tqdm writes. Their prefix has the time that all steps still need."""
        values = super().format_dict
        if Steps.current and (left := Steps.current.left(self.seconds_left(values))) is not None:
            values["prefix"] = f"{values['prefix'].removesuffix(': ')}, all done in {rounded_time(left)}"
        return values

    @staticmethod
    def seconds_left(values: dict[str, Any]) -> float | None:
        """Estimate the seconds that the bar itself still needs, from tqdm's `values`. None: too early to tell."""
        n, total, elapsed = values["n"], values["total"], values["elapsed"]
        return elapsed * (total - n) / n if total and n >= BEGUN * total and elapsed >= DELAY else None


def rounded_time(seconds: float) -> str:
    """Write a time as whole minutes, or, below 90 seconds, as whole tens of seconds."""
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{10 * max(1, round(seconds / 10))} s"


class LogBar(Bar):
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
        self.before = 0.0  # seconds that the steps before the present one took

    def __enter__(self) -> "Steps":
        Steps.current = self
        return self

    def __exit__(self, *error: object) -> None:
        Steps.current = None

    def named(self, what: str) -> str:
        """Return the text for a progress bar: its name `what` with the number of its step.

        If no step that is left has a bar of this name, returns `what` unchanged.
        """
        ahead = range(self.number, len(self.steps))
        found = next((n for n in ahead if what.startswith(self.steps[n].bars)), None)
        if found is None:
            return what
        if found > self.number:
            self.number, self.before = found, time.monotonic() - self.started
        return f"step {found + 1}/{len(self.steps)}, {what}"

    def left(self, bar_left: float | None) -> float | None:
        """Estimate the seconds that all steps still need together. Returns None if too little is done to tell.

        `bar_left`: seconds that the present bar still needs; None: unknown.
        """
        done = sum(step.seconds for step in self.steps[: self.number])
        here, total = self.steps[self.number].seconds, sum(step.seconds for step in self.steps)
        elapsed = time.monotonic() - self.started
        slowness = []  # seconds here for each second that was measured
        if done > KNOWN * total:
            slowness.append(self.before / done)
        if bar_left is not None and done + here > KNOWN * total:
            slowness.append((elapsed + bar_left) / (done + here))
        return max(max(slowness) * total - elapsed, bar_left or 0.0) if slowness else None


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Return an iterator over `things` that shows a progress bar; for None, call its `update` yourself.

    `what`: name of the bar. `total`: number of things, if `len` cannot tell it. `leave`: the bar stays when it is
    finished. `options`: other options of tqdm. If standard error is not a terminal, it writes a line every 30 seconds,
    and none if the work takes less than two seconds.
    """
    kind, what = Bar, Steps.current.named(what) if Steps.current else what
    if not getattr(sys.stderr, "isatty", bool)():
        kind = LogBar
        # At position 0, tqdm would end with a carriage return.
        options |= {"delay": DELAY, "ascii": " #", "position": 1} | ({} if sys.stderr else {"disable": True})
    columns, rows = shutil.get_terminal_size()  # 80 x 24 if a terminal says 0 x 0, at which tqdm shows nothing
    return kind(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
