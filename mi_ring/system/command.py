"""What all commands share: arguments from a dataclass, one line for a user's mistake."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import tyro

from mi_ring.errors import InputError
from mi_ring.system import llvm

LONGEST = 800  #: message, in characters


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

    Of the advice, which options are spelled alike is kept. Where the output is not UTF-8 the box has no sides.
    """
    lines = [line.strip() for line in box.splitlines() if line.strip()]
    if any(line.startswith("│") for line in lines):
        lines = [line.strip("│ ") for line in lines if line.startswith("│")]
    else:
        lines = lines[2:]  # after the title and its rule
    parts: list[list[str]] = [[]]
    for line in lines:
        if set(line) in ({"─"}, {"-"}):
            parts.append([])
        else:
            parts[-1].append(line)
    alike = [line for part in parts[1:] if part[:1] == ["Perhaps you meant:"] for line in part if line.startswith("--")]
    complaint = " ".join(parts[0]) or " ".join(box.split())
    if complaint.startswith("Missing from "):  # then come names and help of all that is
        names = re.findall(r"(?:: |\(required\) )(--\S+|[A-Z]{2}\S*)(?= )", complaint)
        if names:
            return f"{' and '.join(names)}: {'is' if len(names) == 1 else 'are'} missing; --help tells more"
    union = re.match(r"Error parsing (\S+): no type matching (.*) could be instantiated from \[(.*?)\]", complaint)
    if union:  # of kinds of values; why each is not meant is of no interest
        kinds = re.sub("[{}]", "", union[2].replace("{None}|", "")).replace(",", "|")
        complaint = "{}: is {}; must be {}".format(union[1], union[3].replace("'", ""), kinds)
    choice = re.match(r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*)\)", complaint)
    if choice:
        complaint = f"{choice[2]}: is {choice[1]}; must be one of {choice[3]}".replace("'", "")
    count = re.match(r"Missing value for argument '(--\S+)'\. Expected (\d+) values", complaint)
    if count:
        complaint = f"{count[1]}: " + ("has no value" if count[2] == "1" else f"must be {count[2]} values")
    for kind, error in (
        ("whole number", r"invalid literal for int\(\) .*"),
        ("number", "could not convert string to float"),
    ):
        complaint = re.sub(rf"^Error parsing (\S+): {error}: '(.*)'", rf"\1: is \2; must be a {kind}", complaint)
    complaint = re.sub(r"^Error parsing \w+: (?=--)", "", complaint)  # by the dataclass itself
    return f"{complaint}; perhaps you meant {', '.join(alike)}" if alike else complaint


def scene_name(scene: Path) -> str:
    """The name of a scene: that of the file, or of its folder where the file is just called scene.xml."""
    return scene.stem if scene.stem != "scene" else scene.resolve().parent.name


def one_line(message: str) -> str:
    """A message without the line breaks that a name in it may have, and without the middle of what it echoes."""
    words = " ".join(message.split())
    return words if len(words) <= LONGEST else f"{words[: LONGEST // 2]} … {words[-LONGEST // 2 :]}"


@contextlib.contextmanager
def going_on() -> Iterator[None]:
    """For work that goes on where it was interrupted: says so if it is."""
    try:
        yield
    except KeyboardInterrupt:
        sys.stdout.flush()
        print("interrupted; the same command goes on", file=sys.stderr, flush=True)
        raise


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
    except KeyboardInterrupt:
        sys.exit(130)
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
