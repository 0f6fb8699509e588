"""Packages that cannot be installed everywhere: without them there is one clear line, and what does without goes on."""

import re
import subprocess
import sys

import pytest
from conftest import missing_package

from mi_ring import convert, export, fit
from mi_ring.errors import InputError
from mi_ring.system import optional

QUICK = ["--iterations", "1", "--levels", "2", "--widths", "28", "--shares", "1", "--subdivisions", "2",
         "--refine", "none", "--no-indirect"]  # fmt: skip
CODE = """
import sys
sys.modules.update(dict.fromkeys("gpytoolbox xatlas pycolmap".split()))  # as if they were not installed
from mi_ring import convert, export, fit
for domain in ("sphere", "auto"):
    fit.main([*sys.argv[1:], "--out", domain, "--domain", domain])
"""


def test_a_fit_from_a_sphere_needs_none_of_them(small_capture, tmp_path):
    """Nor does it need one to import the commands that do."""
    command = [sys.executable, "-c", CODE, small_capture, *QUICK]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for domain in ("sphere", "auto"):
        assert (tmp_path / domain / "report.html").is_file() and (tmp_path / domain / "mesh.ply").is_file()


@pytest.mark.parametrize(("package", "command", "arguments"), [
    ("gpytoolbox", fit, ["{capture}", "--domain", "hull", *QUICK]),
    ("xatlas", export, ["{run}", "pot.glb"]),
    ("pycolmap", convert, ["colmap", "{colmap}", "scan.xml"]),
])  # fmt: skip
def test_what_needs_one_says_so(package, command, arguments, small_capture, finished, tmp_path, monkeypatch):
    model = tmp_path / "model"
    model.mkdir()
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").write_text("")
    names = {"capture": small_capture, "colmap": model, "run": finished}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    needs = f"needs the package {package}, which is not installed; try `pip install {package}`"
    with pytest.raises(InputError, match=re.escape(needs)):
        command.main([argument.format(**names) for argument in arguments])


def test_tests_are_skipped_for_packages_that_are_not_there_and_for_nothing_else(monkeypatch):
    with pytest.raises(InputError) as there:
        monkeypatch.setattr(optional.importlib, "import_module", fails_for("xatlas"))
        optional.need("xatlas", "textures")
    said = str(there.value)
    assert missing_package(there.value) is None or not optional.installed("xatlas")
    monkeypatch.setattr(optional.importlib.util, "find_spec", lambda name: None)
    assert missing_package(there.value) == "xatlas"
    assert missing_package(AssertionError(said)) is missing_package(InputError(said)) is None
    assert missing_package(ModuleNotFoundError("of ours", name="mi_ring.outlines")) is None


def fails_for(package):
    def import_module(name):
        raise ModuleNotFoundError(f"No module named '{name}'", name=package)

    return import_module
