"""What all commands share: arguments from a dataclass, one line for a user's mistake."""

import ast
import contextlib
import difflib
import io
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import tyro

from mi_ring.errors import InputError
from mi_ring.system import llvm

LONGEST = 800  #: message, in characters
#: Signals that end a command: Ctrl-C, `kill` and schedulers, a terminal that is closed (not on Windows).
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
REPEATS = 5.0  #: seconds within which a signal that comes again is the same one


def parse(
    config_type: Any, arguments: Sequence[str], program: str, default: Any = tyro.MISSING_NONPROP,
    description: str | None = None, needs_llvm: bool = True,
) -> Any:  # fmt: skip
    """Fill a dataclass from the command line. Raises InputError, one line, for what cannot be understood.

    The help begins with `description`, by default the docstring of the dataclass. If the command `needs_llvm` and there
    is none, that is an InputError, too; its help needs none.
    """
    for word in (*arguments, os.getcwd()):
        require_utf8(word)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            config = tyro.cli(config_type, args=list(arguments), prog=program, default=default, description=description)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(complaint_in(box.getvalue())) from None
    if needs_llvm and (problem := llvm.missing()):
        raise InputError(problem)
    return config


def require_utf8(name: str) -> None:
    """Raise InputError for a file's name that is not UTF-8: it may be any bytes."""
    shown = os.fsencode(name).decode(errors="replace")
    if shown != name:
        raise InputError(f"{shown}: this name is not UTF-8, which Mitsuba and XML need; rename it")


def complaint_in(box: str) -> str:
    """The complaint, in one line, of the box that tyro draws: a title, the complaint, rules and advice between them.

    Of the advice, which options are spelled alike is kept, and what an option takes. Where the output is not UTF-8 the
    box has no sides.
    """
    if "│" in box:
        lines = [line.strip("│") for line in box.splitlines() if line.startswith("│")]
    else:
        lines = [line for line in box.splitlines() if line.strip()][2:]  # after the title and its rule
    parts: list[list[str]] = [[]]
    for line in lines:
        if set(line.strip()) in ({"─"}, {"-"}):
            parts.append([])
        else:
            parts[-1].append(line)
    if names := missing_in(parts[0]):
        return f"{' and '.join(names)}: {'is' if len(names) == 1 else 'are'} missing; --help tells more"
    parts = [[line.strip() for line in part if line.strip()] for part in parts]
    advice = {part[0]: part[1:] for part in parts[1:] if part}
    complaint = plain(" ".join(parts[0]) or " ".join(box.split()), " ".join(advice.get("Argument helptext:", [])))
    alike = [line for line in advice.get("Perhaps you meant:", []) if line.startswith("--")]
    return f"{complaint}; perhaps you meant {', '.join(alike)}" if alike else complaint


def missing_in(lines: Sequence[str]) -> list[str]:
    """The names of what is missing, where tyro says so: they are those lines that are indented, and their help more."""
    if not (lines and lines[0].strip().startswith("Missing from ")):
        return []
    indents = [len(line) - len(line.lstrip()) for line in lines]
    return [line.split()[0] for line, n in zip(lines[1:], indents[1:], strict=True) if n == min(indents[1:])]


def plain(complaint: str, help_text: str) -> str:
    """A complaint of tyro's as ours are: what, what was found, what must be. `help_text`: the option's."""
    if wrong := re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*)\)", complaint):
        choices = wrong[3].replace("'", "").split(", ")
        alike = difflib.get_close_matches(wrong[1], choices)
        meant = f"; perhaps you meant {', '.join(alike)}" if alike else ""
        return f"{as_shown(wrong[2])}: is {wrong[1]}; must be one of {', '.join(choices)}{meant}"
    if wrong := re.match(r"Missing value for argument '(\S+)'\. Expected (\d+) values", complaint):
        has_none = "has no value" if wrong[1].startswith("--") else "is missing; --help tells more"
        return f"{as_shown(wrong[1])}: {has_none if wrong[2] == '1' else f'must be {wrong[2]} values'}"
    union = r"Error parsing (\S+): no type matching (.*) could be instantiated from \[(.*?)\]"
    if wrong := re.match(union, complaint):  # why each kind of value is not meant is of no interest
        kinds = re.sub("[{}]", "", wrong[2].replace("{None}|", "")).replace(",", "|")
        return "{}: is {}; must be {}".format(wrong[1], wrong[3].replace("'", ""), kinds)
    unread = r"Error parsing (--\S+): (?:Could not find valid parse|Failed to parse)[^\[]*(\[.*\])?"
    if wrong := re.match(unread, complaint):
        found = ""
        with contextlib.suppress(SyntaxError, ValueError):  # of words that the box has broken
            found = " ".join(ast.literal_eval(wrong[2] or "[]"))
        shown = re.match(r"--\S+ \[(.*?\.\.\.\])\]", help_text)
        return f"{wrong[1]}: {f'is {found}, ' * bool(found)}must be {shown[1] if shown else 'as --help says'}"
    for kind, error in (
        ("whole number", r"invalid literal for int\(\) .*"),
        ("number", "could not convert string to float"),
    ):
        complaint = re.sub(rf"^Error parsing (\S+): {error}: '(.*)'", rf"\1: is \2; must be a {kind}", complaint)
    return re.sub(r"^Error parsing \w+Config: ", "", complaint)  # by the dataclass itself


def as_shown(name: str) -> str:
    """An argument's name as the help has it."""
    return name if name.startswith("--") else name.upper()


def scene_name(scene: Path) -> str:
    """The name of a scene: that of the file, or of its folder where the file is just called scene.xml."""
    return scene.stem if scene.stem != "scene" else scene.resolve().parent.name


def one_line(message: str) -> str:
    """A message without the line breaks that a name in it may have, and without the middle of what it echoes."""
    words = " ".join(message.split())
    return words if len(words) <= LONGEST else f"{words[: LONGEST // 2]} … {words[-LONGEST // 2 :]}"


class Interrupted(KeyboardInterrupt):
    """A signal has come that ends a command, as Ctrl-C does."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def status_of(stop: KeyboardInterrupt) -> int:
    """The exit status of a command that was interrupted: 128 and the signal."""
    return 128 + getattr(stop, "number", signal.SIGINT)


COME: list[tuple[int, float]] = []  #: signals that have come within `going_on`, and when


def interrupted() -> bool:
    """Has a signal come that ends what is within `going_on`? Native code may have made an error of its own of it."""
    return bool(COME)


@contextlib.contextmanager
def going_on() -> Iterator[None]:
    """For work that goes on where it was interrupted: says so if it is, by Ctrl-C or another signal that ends it.

    Raises Interrupted for all of them, whatever a library has made of it. Signals are heard in the main thread alone.
    """

    def hear(number: int, frame: object) -> None:
        before, now = COME[-1][1] if COME else -math.inf, time.monotonic()
        COME.append((number, now))
        if number == signal.SIGINT or now - before > REPEATS:  # shells, schedulers and the kernel send others again
            raise Interrupted(number)

    heard = []
    if threading.current_thread() is threading.main_thread():
        heard = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]  # not under nohup
    before = {number: signal.signal(number, hear) for number in heard}
    try:
        yield
    except (KeyboardInterrupt, Exception) as stop:
        if not (COME or isinstance(stop, KeyboardInterrupt)):
            raise
        with contextlib.suppress(OSError):  # a terminal that is closed
            sys.stdout.flush()
            print("interrupted; the same command goes on", file=sys.stderr, flush=True)
        raise Interrupted(COME[0][0] if COME else signal.SIGINT) from stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        COME.clear()  # of what is over nothing is left to whoever asks


def run(program: str, main: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: status 2 and one line on standard error for anything the user can mend.

    With `--traceback` among the arguments the whole way to the error is shown instead.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    traceback = "--traceback" in arguments
    arguments = [argument for argument in arguments if argument != "--traceback"]
    try:
        status = main(arguments) or 0
        sys.stdout.flush()  # here, where it may fail
        sys.exit(status)
    except KeyboardInterrupt as stop:
        sys.exit(status_of(stop))
    except BrokenPipeError:  # `mi-ring … | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except (InputError, OSError) as error:
        # A file that may not be read, a folder that is gone; other errors of the system are nobody's mistake but ours.
        if traceback or (isinstance(error, OSError) and not (error.filename and error.strerror)):
            raise
        message = str(error) if isinstance(error, InputError) else f"{error.filename}: {error.strerror}"
        print(f"{program}: {one_line(message)}", file=sys.stderr)
        sys.exit(2)
