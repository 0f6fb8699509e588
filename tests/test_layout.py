"""The rooms of the package: who may import whom is what each room's `__init__` says."""

import ast
import re
import sys
from pathlib import Path

import pytest

import mi_ring

PACKAGE = Path(mi_ring.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
COMMANDS = [m for m in MODULES if "/" not in m and "command.run(" in (PACKAGE / m).read_text("utf-8")]
EVERYWHERE = {"errors", "version"}  #: what every room may import
LONGEST = 350  #: lines of a module; one that is longer says why


def imports(module: str) -> set[str]:
    """What a module imports, inside functions and for type checkers, too.

    Top-level names of other packages, and of our own modules `mi_ring.<room or module>`.
    """
    found = set()
    for node in ast.walk(ast.parse((PACKAGE / module).read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide which room is meant"
            names = [alias.name for alias in node.names]
            found |= {f"mi_ring.{name}" for name in names} if node.module == "mi_ring" else {node.module}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("need", "LazyPackage"):  # may be missing
            found |= {arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)}
    return {".".join(name.split(".")[: 2 if name.startswith("mi_ring.") else 1]) for name in found}


def room_of(module: str) -> str | None:
    return module.split("/")[0] if "/" in module else None


def may_import(room: str) -> set[str]:
    """What the docstring of a room says that it may import."""
    rule = re.search(r"^May import: ((?:.|\n)*?)\.$", docstring(room), re.M)
    return set(re.split(r"[,;\s]+", rule[1]))


def docstring(room: str) -> str:
    return ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text("utf-8")))


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_says_in_one_sentence_what_it_is(room):
    first = docstring(room).split("\n\n")[0]
    assert first.endswith(".") and first.count(". ") == 0


@pytest.mark.parametrize("module", [m for m in MODULES if room_of(m)])
def test_modules_import_what_their_room_may(module):
    room = room_of(module)
    allowed = may_import(room) | EVERYWHERE | {room}
    for name in imports(module) - {f"mi_ring.{a}" for a in allowed} - allowed - sys.stdlib_module_names:
        pytest.fail(f"mi_ring/{module} imports {name}; {room}: may import {', '.join(sorted(may_import(room)))}")


def test_rooms_form_no_circle():
    """They can be put in an order in which each imports only those before it."""
    above = {room: may_import(room) & set(ROOMS) for room in ROOMS}
    while above:
        free = [room for room, wanted in above.items() if not wanted & above.keys()]
        assert free, f"these import each other: {above}"
        for room in free:
            del above[room]


def test_what_the_rules_are_for():
    """The rules, which anybody can loosen in a docstring, hold what the rooms are for."""
    assert may_import("nets") == {"torch", "torchdiffeq"}
    assert not may_import("geometry") & {"mitsuba", "drjit"}
    for room in ("plugins", "rendering", "capture", "importers", "metrics", "output"):
        assert "fitting" not in may_import(room)
    assert not {m for m in MODULES if room_of(m) == "plugins"} & {m for m in MODULES if "mi_ring.nets" in imports(m)}


@pytest.mark.parametrize("module", MODULES)
def test_commands_are_imported_by_nobody(module):
    commands = {f"mi_ring.{Path(command).stem}" for command in COMMANDS} - {f"mi_ring.{room}" for room in ROOMS}
    assert not imports(module) & commands


def test_the_bridge_is_the_only_seam_between_torch_and_dr_jit():
    both = {m for m in MODULES if room_of(m) and {"torch", "drjit"} <= imports(m)}
    assert both == {"rendering/bridge.py", "system/machine.py"}  # which sets the number of threads of both


def test_one_module_knows_of_other_processes():
    assert {m for m in MODULES if "torch.distributed" in (PACKAGE / m).read_text("utf-8")} == {"fitting/processes.py"}


@pytest.mark.parametrize("module", MODULES)
def test_long_modules_give_a_reason(module):
    text = (PACKAGE / module).read_text("utf-8")
    assert text.count("\n") <= LONGEST or "This module is long because" in ast.get_docstring(ast.parse(text))


def test_top_level_modules_know_their_names():
    assert len(COMMANDS) >= 7 and "fit.py" in COMMANDS
