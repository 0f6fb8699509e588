"""The scripts in benchmarks/: they import what there is, say what they measure, and the documentation uses them."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*/*.md")]


def test_they_import_what_there_is():
    code = "import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name)"
    command = [sys.executable, "-c", code, *(script.stem for script in SCRIPTS)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT / "benchmarks")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_each_says_how_it_is_called_and_what_it_prints(script):
    about = ast.get_docstring(ast.parse(script.read_text("utf-8")))
    if script.stem == "phone_stage":  # the stage of phone.py, no script
        return
    assert f"    python benchmarks/{script.name}" in about
    assert re.search(r"\b(prints?|writes)\b", about, re.I)


def test_the_documentation_names_those_that_there_are():
    named = set().union(*(re.findall(r"benchmarks/(\w+\.py)", page.read_text("utf-8")) for page in PAGES))
    assert named == {script.name for script in SCRIPTS} - {"phone_stage.py"}
