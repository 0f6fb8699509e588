"""The program `mi-ring`: `mi-ring fit …` does the same as `python -m mi_ring.fit …`."""

import ast
import difflib
import importlib
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.system import llvm
from mi_ring.system.command import run
from mi_ring.version import __version__

#: Modules of the package. The first line of each docstring says what the command does and how to call it.
COMMANDS = (
    "example", "synthesize", "board", "photos", "convert", "join", "check", "fit", "batch", "render", "export",
    "evaluate", "paper", "validate", "doctor",
)  # fmt: skip


def summary(name: str) -> tuple[str, str]:
    """Read (usage, description) of the command `name` from the docstring of its module, without an import."""
    source = Path(__file__).with_name(f"{name}.py").read_text("utf-8")
    sentence, _, call = (ast.get_docstring(ast.parse(source)) or "").split("\n")[0].partition("`python -m mi_ring.")
    return f"mi-ring {call.partition('`')[0] or name}", sentence.rstrip(" :.")


def overview() -> str:
    """Return the help text of `mi-ring`: two lines for each command."""
    lines = [f"  {usage}\n      {sentence}" for usage, sentence in map(summary, COMMANDS)]
    return "\n".join([
        "usage: mi-ring COMMAND …", "", *lines, "",
        "mi-ring COMMAND --help tells more; `python -m mi_ring.COMMAND …` is the same.",
        "mi-ring COMMAND … --traceback shows where an error comes from; mi-ring --version the version.",
    ])  # fmt: skip


def run_command(name: str, arguments: Sequence[str]) -> int | None:
    """Import the command `name` and run it with `arguments`, the words after its name.

    Returns its exit status; None stands for 0. Raises InputError if Mitsuba cannot be imported. Only `doctor` works
    without Mitsuba.
    """
    if name != "doctor" and not llvm.has_atomic():
        raise InputError(str(llvm.missing()))
    return importlib.import_module(f"mi_ring.{name}").main(arguments)


def main() -> None:
    """Run the command that the first argument of the program names, and end the process with its exit status."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in ("-h", "--help", "--help-all", "--version"):
        run("mi-ring", lambda _: print(__version__ if name == "--version" else overview()), [])
    if name not in COMMANDS:
        alike = "".join(f"; perhaps you meant {other}" for other in difflib.get_close_matches(name, COMMANDS, 1))
        what = f": is {name}{alike}; must be one of {', '.join(COMMANDS)}" if name else " is missing"
        print(f"mi-ring: COMMAND{what}; mi-ring --help tells more", file=sys.stderr)
        sys.exit(2)
    run(f"mi-ring {name}", partial(run_command, name), sys.argv[2:])


if __name__ == "__main__":
    main()
