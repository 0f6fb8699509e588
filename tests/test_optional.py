"""Packages that cannot be installed everywhere: without them there is one clear line, and what does without goes on."""

import subprocess
import sys

import pytest
from conftest import missing_package

from mi_ring.errors import InputError
from mi_ring.system import optional

CODE = """
import sys
sys.modules.update(dict.fromkeys({missing!r}.split()))  # as if they were not installed
import mi_ring
from mi_ring import {command}
{command}.main(sys.argv[1:])
"""


def without(missing, command, *arguments, cwd):
    code = CODE.format(missing=missing, command=command)
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, cwd=cwd)
    return done.returncode, done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""


QUICK = ["--iterations", 1, "--levels", 2, "--widths", 28, "--shares", 1, "--subdivisions", 2]


@pytest.mark.parametrize("domain", ["sphere", "auto"])
def test_a_fit_from_a_sphere_needs_none_of_them(small_capture, tmp_path, domain):
    arguments = [small_capture, "--out", tmp_path / "run", "--domain", domain, *QUICK]
    status, complaint = without("gpytoolbox xatlas pycolmap", "fit", *arguments, cwd=tmp_path)
    assert status == 0, complaint
    assert (tmp_path / "run/report.html").is_file() and (tmp_path / "run/mesh.ply").is_file()


@pytest.mark.parametrize(("package", "command", "arguments"), [
    ("gpytoolbox", "fit", ["{capture}", "--domain", "hull", *QUICK]),
    ("xatlas", "export", ["{run}", "pot.glb"]),
    ("pycolmap", "convert", ["colmap", "{colmap}", "scan.xml"]),
])  # fmt: skip
def test_what_needs_one_says_so(package, command, arguments, small_capture, finished, tmp_path):
    model = tmp_path / "model"
    model.mkdir()
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").write_text("")
    names = {"capture": small_capture, "colmap": model, "run": finished}
    arguments = [a.format(**names) if isinstance(a, str) else a for a in arguments]
    status, complaint = without(package, command, *arguments, cwd=tmp_path)
    assert status == 1 and "InputError" in complaint
    assert f"needs the package {package}, which is not installed; try `pip install {package}`" in complaint


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
