"""What all commands share: arguments from a dataclass, one line for a user's mistake, the `mi-ring` entry point."""

import contextlib
import importlib
import io
import sys
from collections.abc import Callable, Sequence

import tyro

from mi_ring.errors import InputError

COMMANDS = ("fit", "render")


def parse(config_type: type, arguments: Sequence[str], program: str, default=None):
    """Fill a dataclass from the command line. Raises InputError, one line, for what cannot be understood."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(config_type, args=list(arguments), prog=program, default=default or tyro.MISSING_NONPROP)
    except SystemExit as stop:
        if not stop.code:
            raise
        # tyro draws a box: a title, the complaint, a rule, advice.
        lines = [line.strip("│╭╮╰╯ ") for line in complaint.getvalue().split("────")[0:]]
        raise InputError(" ".join(lines)) from None


def run(program: str, main: Callable[[Sequence[str]], int | None], arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: status 2 and one line on standard error for anything the user can mend."""
    try:
        sys.exit(main(sys.argv[1:] if arguments is None else arguments) or 0)
    except InputError as error:
        print(f"{program}: {error}", file=sys.stderr)
        sys.exit(2)


def main() -> None:
    """The `mi-ring` program: `mi-ring fit …` is `python -m mi_ring.fit …`."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in COMMANDS:
        help_asked = name in ("-h", "--help")
        print(f"usage: mi-ring {{{','.join(COMMANDS)}}} …; mi-ring COMMAND --help tells more",
              file=sys.stdout if help_asked else sys.stderr)  # fmt: skip
        sys.exit(0 if help_asked else 2)
    run(f"mi-ring {name}", importlib.import_module(f"mi_ring.{name}").main, sys.argv[2:])
