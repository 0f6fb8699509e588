"""The rooms of the package: who may import whom is what each room's `__init__` says."""

import ast
import functools
import graphlib
import re
import sys
from pathlib import Path

import mi_ring

PACKAGE = Path(mi_ring.__file__).parent
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
ROOMS = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
COMMANDS = [m for m in MODULES if "/" not in m and "command.run(" in (PACKAGE / m).read_text("utf-8")]
EVERYWHERE = {"errors", "version"}  #: what every room may import
LONGEST = 350  #: lines of a module; one that is longer says why
#: Names of parameters that stand for types of ours.
OURS = {
    "calibration", "camera", "capture", "config", "fit", "it", "light", "lighting", "model", "photographs", "problem",
    "renderer", "result", "ring", "rig", "schedule", "sensor", "shape", "shot", "surface",
}  # fmt: skip
#: Parameters of these names that are of no type of ours: those of a module or room, with the reason.
OTHERS = {
    "plugins": "Mitsuba calls the methods; its types depend on the variant",
    "photogrammetry": "models and cameras are pycolmap's, which may be missing",
    "metrics/path_tracing.py": "a sensor is Mitsuba's, in a scene of its own",
    "output/camera_paths.py": "a sensor is Mitsuba's, in a scene of its own",
    "capture/arrays.py": "cameras and lights are what a user gives, of any type",
    "scene": "shapes, sensors and emitters are Mitsuba's",
    "rendering": "shapes and sensors are Mitsuba's",
}


@functools.cache
def tree(module: str) -> ast.Module:
    return ast.parse((PACKAGE / module).read_text("utf-8"))


def imported(module: str) -> set[str]:
    """What a module imports, inside functions and for type checkers, too, with full names."""
    found = set()
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide which room is meant"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("need", "LazyPackage"):  # may be missing
            found |= {name.value for name in node.args[:1] if isinstance(name, ast.Constant)}
    return found


def imports(module: str) -> set[str]:
    """Top-level names of the other packages that a module imports, and of ours `mi_ring.<room or module>`."""
    return {".".join(name.split(".")[: 2 if name.startswith("mi_ring.") else 1]) for name in imported(module)}


def files_imported(module: str) -> set[str]:
    """The files of the package that a module imports."""
    parts = [name.removeprefix("mi_ring.").split(".") for name in imported(module) if name.startswith("mi_ring.")]
    paths = {"/".join(part[:n]) for part in parts for n in (1, 2)}  # the last part may be a name in a file
    return {file for path in paths for file in (f"{path}.py", f"{path}/__init__.py") if file in MODULES} - {module}


def room_of(module: str) -> str | None:
    return module.split("/")[0] if "/" in module else None


def may_import(room: str) -> set[str]:
    """What the docstring of a room says that it may import."""
    rule = re.search(r"^May import: ((?:.|\n)*?)\.$", docstring(room), re.M)
    return set(re.split(r"[,;\s]+", rule[1]))


def docstring(room: str) -> str:
    return ast.get_docstring(tree(f"{room}/__init__.py"))


def test_a_room_says_in_one_sentence_what_it_is():
    first = {room: docstring(room).split("\n\n")[0] for room in ROOMS}
    assert not {room: text for room, text in first.items() if not text.endswith(".") or ". " in text}


def test_modules_import_what_their_room_may():
    wrong = {}
    for module in filter(room_of, MODULES):
        allowed = may_import(room_of(module)) | EVERYWHERE | {room_of(module)}
        wrong[module] = imports(module) - {f"mi_ring.{a}" for a in allowed} - allowed - sys.stdlib_module_names
    assert not {module: names for module, names in wrong.items() if names}


def test_rooms_form_no_circle():
    """They can be put in an order in which each imports only those before it."""
    above = {room: may_import(room) & set(ROOMS) for room in ROOMS}
    while above:
        free = [room for room, wanted in above.items() if not wanted & above.keys()]
        assert free, f"these import each other: {above}"
        for room in free:
            del above[room]


def test_files_form_no_circle():
    """Nor with imports inside functions and for type checkers."""
    graph = {module: files_imported(module) for module in MODULES}
    assert "fitting/iteration.py" in graph["fitting/terms.py"] and "plugins/__init__.py" in graph["__init__.py"]
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which lists the files


def untyped(function: ast.FunctionDef) -> set[str]:
    """Parameters of our types that are not annotated, or as Any or object."""
    arguments = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
    told = {a.arg: ast.unparse(a.annotation) if a.annotation else "Any" for a in arguments}
    vague = r"(Sequence\[|list\[)?(Any|object)\]?( \| None)?"
    return {name for name, type_ in told.items() if name in OURS and re.fullmatch(vague, type_)}


def test_what_is_of_a_type_of_ours_says_so():
    """So that the type checker sees what one room asks of another."""
    wrong = {}
    for module in [m for m in MODULES if not {m, room_of(m)} & OTHERS.keys()]:
        functions = [node for node in ast.walk(tree(module)) if isinstance(node, ast.FunctionDef)]
        wrong |= {f"{module}: {function.name}": names for function in functions if (names := untyped(function))}
    assert not wrong


def test_what_the_rules_are_for():
    """The rules, which anybody can loosen in a docstring, hold what the rooms are for."""
    assert may_import("nets") == {"torch"}
    assert not may_import("geometry") & {"mitsuba", "drjit"}
    for room in ("plugins", "rendering", "capture", "importers", "metrics", "output"):
        assert "fitting" not in may_import(room)
    assert not {m for m in MODULES if room_of(m) == "plugins"} & {m for m in MODULES if "mi_ring.nets" in imports(m)}


def test_commands_are_imported_by_nobody():
    commands = {f"mi_ring.{Path(command).stem}" for command in COMMANDS} - {f"mi_ring.{room}" for room in ROOMS}
    assert not {module: names for module in MODULES if (names := imports(module) & commands)}


def test_the_bridge_is_the_only_seam_between_torch_and_dr_jit():
    both = {m for m in MODULES if room_of(m) and {"torch", "drjit"} <= imports(m)}
    assert both == {"rendering/bridge.py", "system/machine.py"}  # which sets the number of threads of both


def test_one_module_knows_of_other_processes():
    """And few know of it: the problem has them, the sampler shares out, the session writes, the command joins them."""
    assert {m for m in MODULES if "torch.distributed" in (PACKAGE / m).read_text("utf-8")} == {"fitting/processes.py"}
    knowing = {m for m in MODULES if "fitting/processes.py" in files_imported(m)}
    assert knowing == {"fitting/problem.py", "fitting/sampler.py", "fitting/session.py", "fit.py"}


def test_the_loop_of_a_fit_is_short():
    assert (PACKAGE / "fitting/fit.py").read_text("utf-8").count("\n") < 200


def test_terms_and_solvers_see_an_iteration_and_no_fit():
    """Nobody imports the fit but who runs one."""
    running = {"fitting/light_selection.py", "fitting/budget.py", "fitting/checkpoint.py", "fitting/session.py"}
    running |= {"__init__.py", "fit.py", "experiments/engine.py", "photogrammetry/shading_trial.py"}
    assert {m for m in MODULES if "fitting/fit.py" in files_imported(m)} == running


def test_long_modules_give_a_reason():
    long = [m for m in MODULES if (PACKAGE / m).read_text("utf-8").count("\n") > LONGEST]
    assert not [m for m in long if "This module is long because" not in ast.get_docstring(tree(m))]


def test_top_level_modules_know_their_names():
    assert len(COMMANDS) >= 7 and "fit.py" in COMMANDS


def test_no_test_module_imports_another():
    """What several need is in conftest or in helpers."""
    found = {path.name: re.findall(r"^\s*(?:from|import) (test_\w+)", path.read_text("utf-8"), re.M)
             for path in Path(__file__).parent.rglob("*.py")}  # fmt: skip
    assert len(found) > 60 and not any(found.values())
