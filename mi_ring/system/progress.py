"""Progress bars, and output that tolerates a closed terminal or pipe."""

import contextlib
import errno
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

from tqdm import tqdm

Progress = Callable[..., Iterable]  #: the type of `progress`, and of substitutes that show nothing
DELAY, LOG_INTERVAL = 2.0, 30.0  #: seconds before the first line in a log, and between two lines
KNOWN = 0.1  #: share of the work, or of a part, whose time tells how long the rest will take
SMALL = 0.05  #: a part with less of the work than this does not tell how long the rest will take
WITHIN_STEPS = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}"  #: a bar without a time of its own


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
        if Steps.current and values["prefix"].startswith("step "):
            share = min(1.0, values["n"] / values["total"]) if values["total"] else 0.0
            if left := Steps.current.left(share):  # None: unknown; 0: done
                values["prefix"] = f"{values['prefix'].removesuffix(': ')}, all done in {rounded_time(left)}"
        return values


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


class Part(NamedTuple):
    """A part of a step of a command: one progress bar, and how long it is likely to take."""

    name: str  #: what the name of the progress bar begins with
    seconds: float  #: that it is likely to take; only the ratios of parts matter


class Steps:
    """The steps of a command, as a context manager. In it, progress bars show the step and the time that is left.

    Each step is a sequence of parts, in their order. Parts may be left out.
    """

    current: ClassVar["Steps | None"] = None  #: those of the command that runs

    def __init__(self, *steps: Sequence[Part]) -> None:
        self.count = len(steps)
        self.parts = [(number, part) for number, step in enumerate(steps, 1) for part in step]
        self.place, self.started = -1, time.monotonic()
        self.done = self.before = 0.0  # of the finished parts: expected seconds, true seconds

    def __enter__(self) -> "Steps":
        Steps.current = self
        return self

    def __exit__(self, *error: object) -> None:
        Steps.current = None

    def named(self, what: str) -> str:
        """Return the text for a progress bar: its name `what` with the number of its step.

        If no part that is left has this name, returns `what` unchanged.
        """
        ahead = range(max(0, self.place), len(self.parts))
        found = next((k for k in ahead if what.startswith(self.parts[k][1].name)), None)
        if found is None:
            return what
        if found != self.place:
            if self.place >= 0:
                self.done += self.parts[self.place][1].seconds
            self.place, self.before = found, time.monotonic() - self.started
        return f"step {self.parts[found][0]}/{self.count}, {what}"

    def left(self, share: float) -> float | None:
        """Estimate the seconds that all steps still need together. Returns None if too little is done to tell.

        `share`: how much of the present part is done, 0 to 1. At its beginning, the time of the part is expected from
        the parts before; the more of it is done, the more its own speed counts.
        """
        here = self.parts[max(0, self.place)][1].seconds
        ahead = sum(part.seconds for _, part in self.parts[self.place + 1 :])
        work = self.done + here + ahead
        passed = time.monotonic() - self.started - self.before  # in this part
        if self.done > KNOWN * work:
            total = passed + (1 - share) * here * self.before / self.done
        elif share >= KNOWN and here > SMALL * work:
            total = passed / share
        else:
            return None
        return (1 - share) * total + ahead * (self.before + total) / (self.done + here)


def progress(
    things: Iterable | None, what: str = "", total: float | None = None, leave: bool = False, **options: Any
) -> tqdm:
    """Return an iterator over `things` that shows a progress bar; for None, call its `update` yourself.

    `what`: name of the bar. `total`: number of things, if `len` cannot tell it. `leave`: the bar stays when it is
    finished. `options`: other options of tqdm. If standard error is not a terminal, it writes a line every 30 seconds,
    and none if the work takes less than two seconds.
    """
    kind = Bar
    if Steps.current:
        what, options = Steps.current.named(what), {"bar_format": WITHIN_STEPS} | options
    if not getattr(sys.stderr, "isatty", bool)():
        kind = LogBar
        # At position 0, tqdm would end with a carriage return.
        options |= {"delay": DELAY, "ascii": " #", "position": 1} | ({} if sys.stderr else {"disable": True})
    columns, rows = shutil.get_terminal_size()  # 80 x 24 if a terminal says 0 x 0, at which tqdm shows nothing
    return kind(things, what, total, leave=leave, ncols=columns, nrows=rows, **options)
