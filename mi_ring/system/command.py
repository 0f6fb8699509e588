"""What all commands share: parsing of arguments, user errors in one line, signals, exit status."""

import ast
import contextlib
import difflib
import errno
import io
import itertools
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import tyro

from mi_ring.errors import InputError
from mi_ring.system import llvm

MAX_MESSAGE = 800  #: characters of an error message
#: Signals that end a command: Ctrl-C; `kill` and schedulers; a terminal that closes (not on Windows).
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
FULL = errno.ENOSPC, errno.EDQUOT, errno.EFBIG  #: of a full disk, a quota, and `ulimit -f`
CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")  #: characters that XML cannot express
REPEATED = 5.0  #: a second SIGTERM or SIGHUP within this time is a copy of the first [s]


def parse(
    config_type: Any, arguments: Sequence[str], program: str, default: Any = tyro.MISSING_NONPROP,
    description: str | None = None, needs_llvm: bool = True,
) -> Any:  # fmt: skip
    """Parse the arguments of a command. Returns an instance of the dataclass `config_type`.

    `program`: name of the command in the help. `default`: an instance whose values replace the defaults of the
    dataclass. `description`: first text of the help; None: the docstring of the dataclass. With --help or --help-all,
    the help is printed and the process ends. Raises InputError for wrong arguments. With `needs_llvm`, also raises
    InputError if LLVM is missing.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:  # set by the import of mi_ring
        signal.signal(signal.SIGINT, receive)  # from here on, there may be partial files to remove
    for word in (*arguments, os.getcwd()):
        require_expressible_name(word)
    words, box = ["--help" if word == "--help-all" else word for word in arguments], io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            config = tyro.cli(config_type, args=words, prog=program, default=default, description=description)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(complaint_in(box.getvalue())) from None
    if needs_llvm and (problem := llvm.missing()):
        raise InputError(problem)
    return config


def require_expressible_name(name: str) -> None:
    """Raise InputError if a file name is not UTF-8, or if it has a character that XML cannot express.

    The file system itself allows any bytes.
    """
    printable = CONTROL.sub("\ufffd", os.fsencode(name).decode(errors="replace"))
    if printable != name:
        raise InputError(f"{printable}: this name is not UTF-8, or has control characters, which XML and Mitsuba do "
                         "not allow; rename it")  # fmt: skip


def complaint_in(box: str) -> str:
    """Return the error message in a box that tyro has printed, as one line. `box`: all lines of the box.

    Options of similar spelling are added to the message, and what the help of the option says about its values.
    """
    if "│" in box:
        lines = [line.strip("│") for line in box.splitlines() if line.startswith("│")]
    else:
        lines = [line for line in box.splitlines() if line.strip()][2:]  # after the title and its rule
    groups = itertools.groupby(lines, lambda line: set(line.strip()) in ({"─"}, {"-"}))
    parts = [list(group) for is_rule, group in groups if not is_rule] or [[]]
    if parts[0] and parts[0][0].strip().startswith("Missing from "):  # names are indented, and help texts further
        indents = [len(line) - len(line.lstrip()) for line in parts[0][1:]]
        names = [line.split()[0] for line, indent in zip(parts[0][1:], indents) if indent == min(indents)]
        return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} missing; --help tells more"
    parts = [[line.strip() for line in part if line.strip()] for part in parts]
    advice = {part[0]: part[1:] for part in parts[1:] if part}
    complaint = plain(" ".join(parts[0]) or " ".join(box.split()), " ".join(advice.get("Argument helptext:", [])))
    alike = [line for line in advice.get("Perhaps you meant:", []) if line.startswith("--")]
    return f"{complaint}; perhaps you meant {', '.join(alike)}" if alike else complaint


def plain(complaint: str, help_text: str) -> str:
    """Rewrite an error message of tyro in our form: option, value found, values allowed. Returns a line.

    `help_text`: tyro's help of the option, which may list the allowed values; empty if there is none.
    """
    if wrong := re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*)\)", complaint):
        choices = wrong[3].replace("'", "").split(", ")
        alike = difflib.get_close_matches(wrong[1], choices)
        meant = f"; perhaps you meant {', '.join(alike)}" if alike else ""
        return f"{name_in_help(wrong[2])}: is {wrong[1]}; must be one of {', '.join(choices)}{meant}"
    if wrong := re.match(r"Missing value for argument '(\S+)'\. Expected (\d+) values", complaint):
        has_none = ": has no value" if wrong[1].startswith("--") else " is missing; --help tells more"
        return name_in_help(wrong[1]) + (has_none if wrong[2] == "1" else f": must be {wrong[2]} values")
    union = r"Error parsing (\S+): no type matching (.*) could be instantiated from \[(.*?)\]"
    if wrong := re.match(union, complaint):  # tyro's reasons for each type are left out
        kinds = re.sub("[{}]", "", wrong[2].replace("{None}|", "")).replace(",", "|")
        return "{}: is {}; must be {}".format(wrong[1], wrong[3].replace("'", ""), kinds)
    unread = r"Error parsing (--\S+): (?:Could not find valid parse|Failed to parse)[^\[]*(\[.*\])?"
    if wrong := re.match(unread, complaint):
        found = ""
        with contextlib.suppress(SyntaxError, ValueError):  # the box may have wrapped the words
            found = " ".join(ast.literal_eval(wrong[2] or "[]"))
        shown = re.match(r"--\S+ \[(.*?\.\.\.\])\]", help_text)
        return f"{wrong[1]}: {f'is {found}, ' * bool(found)}must be {shown[1] if shown else 'as --help says'}"
    errors = {"whole number": r"invalid literal for int\(\) .*", "number": "could not convert string to float"}
    for kind, error in errors.items():
        complaint = re.sub(rf"^Error parsing (\S+): {error}: '(.*)'", rf"\1: is \2; must be a {kind}", complaint)
    return re.sub(r"^Error parsing \w+Config: ", "", complaint)  # errors that the dataclass itself raises


def name_in_help(name: str) -> str:
    """Return the name of an argument as the help shows it: options (--name) unchanged, other names in capitals."""
    return name if name.startswith("--") else name.upper()


def scene_name(scene: Path) -> str:
    """Return a name for a scene: its file name without suffix; for a file scene.xml, the name of its folder."""
    return scene.stem if scene.stem != "scene" else scene.resolve().parent.name


def one_line(message: str) -> str:
    """Return a message without line breaks. If it is longer than `MAX_MESSAGE` characters, its middle is left out."""
    words = " ".join(message.split())
    return words if len(words) <= MAX_MESSAGE else f"{words[: MAX_MESSAGE // 2]} … {words[-MAX_MESSAGE // 2 :]}"


class Interrupted(KeyboardInterrupt):
    """Raised when a signal asks the process to stop, such as SIGTERM. Its argument is the number of the signal."""


def exit_status(stop: KeyboardInterrupt) -> int:
    """Return the exit status of an interrupted command: 128 + the number of the signal."""
    return 128 + (stop.args[0] if isinstance(stop, Interrupted) else signal.SIGINT)


_received: list[tuple[int, float]] = []  #: signals that `receive` has handled: number, time of arrival [s]


def receive(number: int, frame: object) -> None:
    """Handle a signal: raise Interrupted, and record the signal."""
    before, now = _received[-1][1] if _received else -math.inf, time.monotonic()
    _received.append((number, now))
    # Shells, schedulers and the kernel may send a signal several times. Each Ctrl-C is meant.
    if number == signal.SIGINT or now - before > REPEATED:
        raise Interrupted(number)


def interrupted() -> bool:
    """Return True if a stop signal has arrived, and `receive` has handled it.

    Ask it after an exception: native code may have turned the interruption into another error.
    """
    return bool(_received)


@contextlib.contextmanager
def resumable() -> Iterator[None]:
    """A context manager for work that the same command can continue. A stop signal makes it print this advice.

    It then raises Interrupted, even if a library has turned the interruption into another error. In a thread other than
    the main thread, it handles no signals.
    """

    handled = []
    if threading.current_thread() is threading.main_thread():
        handled = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]  # nohup ignores SIGHUP
    before = {number: signal.signal(number, receive) for number in handled}
    try:
        yield
    except (KeyboardInterrupt, Exception) as stop:
        if not (_received or isinstance(stop, KeyboardInterrupt)):
            raise
        with contextlib.suppress(OSError):  # the terminal may be closed
            sys.stdout.flush()
            print("interrupted; to continue, give the same command again", file=sys.stderr, flush=True)
        raise Interrupted(_received[0][0] if _received else signal.SIGINT) from stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _received.clear()


def make_callable(module: str, function: Callable) -> None:
    """Let a module be called like `function`. So `mi_ring.evaluate(…)` works, although `evaluate` is a module.

    `module`: full name of an imported module.
    """

    class CallableModule(ModuleType):
        __call__ = staticmethod(function)

    sys.modules[module].__class__ = CallableModule


def run(program: str, main: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit the process. The exit status is what `main` returns, 0 for None.

    `program`: name of the command, for messages. `main`: takes the list of arguments. `arguments`: None: those of the
    process. A user error is printed as one line on standard error, with exit status 2. If `--traceback` is among the
    arguments, the error is raised instead.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    traceback = "--traceback" in arguments
    arguments = [argument for argument in arguments if argument != "--traceback"]
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed, as by `>&-`: a file of ours must not take its place
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))
    try:
        try:
            status: Any = main(arguments) or 0
        except SystemExit as stop:  # after --help
            status = stop.code
        sys.stdout.flush()  # so that a broken pipe is noticed here
        sys.exit(status)
    except KeyboardInterrupt as stop:
        sys.exit(exit_status(stop))
    except BrokenPipeError:  # `mi-ring … | head` has stopped reading
        finish_output()
        sys.exit(141)
    except Exception as error:
        if _received:  # Mitsuba and others make errors of their own of a Ctrl-C
            sys.exit(128 + _received[0][0])
        message = str(error)
        if isinstance(error, OSError) and error.strerror and (error.filename or error.errno in FULL):
            # A user error: no permission, a removed folder, a full disk. Other OSErrors are bugs.
            message = f"{error.filename or 'standard output, or a file'}: {error.strerror}"
        elif not isinstance(error, InputError):
            raise
        if traceback:
            raise
        finish_output()
        print(f"{program}: {one_line(message)}", file=sys.stderr)
        sys.exit(2)


def finish_output() -> None:
    """Write the buffered standard output. If that fails, drop it; otherwise, it would fail again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
