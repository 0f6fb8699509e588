"""The package as others get it: wheel and sdist, and the program in an environment of its own."""

import json
import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

import mi_ring
from mi_ring.__main__ import COMMANDS
from mi_ring.system import llvm

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of the wheel and the sdist."""
    for package in ("build", "hatchling", "hatch_fancy_pypi_readme"):
        pytest.importorskip(package, reason="needs the optional dependencies 'test'")
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT], check=True, capture_output=True
    )
    return folder


def test_the_wheel_holds_what_runs_and_nothing_else(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert f"-{mi_ring.__version__}-" in wheel.name
    ours = {path.relative_to(ROOT).as_posix() for path in (ROOT / "mi_ring").rglob("*.py")}
    data = {
        "mi_ring/py.typed", "mi_ring/output/index.html.jinja", "mi_ring/output/report.html.jinja",
        "mi_ring/output/viewer/viewer.min.js",
    }  # fmt: skip
    assert {name for name in names if ".dist-info/" not in name} == ours | data


def test_the_sdist_can_be_built_from(built, tmp_path):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (folder,) = tmp_path.iterdir()
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--wheel", folder], check=True, capture_output=True
    )
    (wheel,) = (folder / "dist").glob("*.whl")
    (first,) = built.glob("*.whl")
    assert zipfile.ZipFile(wheel).namelist() == zipfile.ZipFile(first).namelist()


def test_links_of_the_readme_work_on_the_package_index(built):
    (wheel,) = built.glob("*.whl")
    archive = zipfile.ZipFile(wheel)
    metadata = archive.read(next(n for n in archive.namelist() if n.endswith("METADATA"))).decode()
    readme = metadata.split("\n\n", 1)[1]
    links = re.findall(r"\]\((.*?)\)", readme)
    assert len(links) == len(re.findall(r"\]\((.*?)\)", (ROOT / "README.md").read_text("utf-8"))) > 3
    assert [link for link in links if not link.startswith("https://")] == []
    source = re.search(r"Project-URL: Source, (.*)", metadata)[1]
    for link in links:
        if link.startswith(f"{source}/blob/main/"):
            assert (ROOT / link.removeprefix(f"{source}/blob/main/").split("#")[0]).exists(), link


def test_help_is_quick_for_it_imports_neither_torch_nor_scipy():
    code = (
        "import sys; sys.argv = ['mi-ring', '--help']\n"
        "from mi_ring.__main__ import main\n"
        "try: main()\nexcept SystemExit as stop: assert not stop.code\n"
        "assert not {'torch', 'scipy', 'trimesh', 'matplotlib'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(f"mi-ring {command} " in done.stdout or f"mi-ring {command}\n" in done.stdout for command in COMMANDS)


def test_a_fit_begins_without_what_it_needs_at_its_end():
    code = "import sys; import mi_ring.fitting.fit; assert not {'matplotlib', 'scipy.stats'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_program_tells_its_version():
    done = subprocess.run([sys.executable, "-m", "mi_ring", "--version"], capture_output=True, text=True)
    assert done.stdout == f"{mi_ring.__version__}\n"


def without_llvm(*arguments):
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": "/nowhere/libLLVM.so"}
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment)
    return done.returncode, done.stdout, done.stderr.strip().splitlines()


def test_without_llvm_the_doctor_says_what_to_do():
    status, said, _ = without_llvm("-m", "mi_ring.doctor")
    assert status == 1 and "MISSING  LLVM" in said and said.endswith("A fit cannot run: LLVM missing\n")
    assert without_llvm("-m", "mi_ring", "--help")[0] == 0
    assert subprocess.run([sys.executable, "-m", "mi_ring.doctor"], capture_output=True).returncode == 0


#: Runs commands one after the other, and tells the status with which each would end the process.
IN_TURN = """
import json, runpy, sys
for name, *arguments in json.loads(sys.argv[1]):
    sys.argv[1:] = arguments
    try:
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        print(f"status {stop.code}", file=sys.stderr)
"""


def test_without_llvm_a_command_ends_with_one_line(tmp_path):
    more = {"render": ["a.xml", "b"], "export": ["a.ply"], "evaluate": ["--mesh", "a.ply"]}
    scene, names = tmp_path / "scene.xml", ["fit", "check", "render", "export", "evaluate", "validate"]
    scene.write_text("<scene version='3.0.0'/>")
    (tmp_path / "in_turn.py").write_text(IN_TURN)
    calls = [[f"mi_ring.{name}", str(scene), *more.get(name, [])] for name in names]
    *said, end = "\n".join(without_llvm(tmp_path / "in_turn.py", json.dumps(calls))[2]).split("status 2")
    assert not end and len(said) == len(names)
    for name, complaint in zip(names, said):
        assert complaint.strip().splitlines()[-1].startswith(f"mi_ring.{name}: mi_ring needs LLVM 17 or newer")
        assert "Traceback" not in complaint


#: Makes Python believe that this is a slim container, where Dr.Jit and Mitsuba are installed and cannot be loaded.
SLIM = """
import ctypes, importlib.machinery, sys

class Library(ctypes.CDLL):
    def __init__(self, name, *more, **options):
        if "libatomic" in str(name):
            raise OSError(name)
        super().__init__(name, *more, **options)

class Broken:
    def find_spec(self, name, path=None, target=None):
        return importlib.machinery.ModuleSpec(name, self) if name in ("drjit", "mitsuba") else None
    def create_module(self, spec):
        return None
    def exec_module(self, module):
        raise ImportError("libatomic.so.1: cannot open shared object file")

ctypes.CDLL = Library
sys.meta_path.insert(0, Broken())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux needs libatomic")
def test_without_libatomic_there_is_one_line_too(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(SLIM)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}

    def run(*arguments):
        call = [sys.executable, "-W", "ignore", "-m", *arguments]
        done = subprocess.run(call, capture_output=True, text=True, env=environment, cwd=tmp_path)
        return done.returncode, done.stdout, done.stderr.splitlines()

    for call in (["mi_ring.fit"], ["mi_ring", "fit"]):
        status, _, complaint = run(*call, "scene.xml")
        assert (status, len(complaint)) == (2, 1) and "Dr.Jit needs libatomic.so.1" in complaint[0]
    for call in (["mi_ring.doctor"], ["mi_ring", "doctor"]):
        status, said, complaint = run(*call)
        assert (status, complaint) == (1, []) and said.endswith("A fit cannot run: libatomic missing\n")


@pytest.fixture(scope="module", params=["whl", "tar.gz"])
def program(request, built, tmp_path_factory):
    """Runs `mi-ring` as installed in an environment of its own; what it depends on is the parent's. And its folder."""
    if os.name != "posix":
        pytest.skip("the folders of environments are those of POSIX systems")
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder / "env", with_pip=False)
    (site,) = (folder / "env").glob("lib/python*/site-packages")
    # Appended this way, not as a folder of packages: that would bring the parent's editable installation along.
    (site / "parent.pth").write_text(f"import sys; sys.path.append({sysconfig.get_paths()['purelib']!r})\n")
    python, (package,) = folder / "env/bin/python", built.glob(f"*.{request.param}")
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "-q"]
    options = ["--no-deps", "--no-build-isolation", "--ignore-installed"]
    subprocess.run([*pip, *options, package], check=True, capture_output=True, cwd=folder)
    environment = {name: os.environ[name] for name in ("PATH", llvm.VARIABLE) if name in os.environ}
    environment["HOME"] = str(folder)

    def run(*call):
        done = subprocess.run([folder / "env/bin" / call[0], *call[1:]], capture_output=True, text=True, cwd=folder,
                              env=environment)  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert run("python", "-c", "import mi_ring; print(mi_ring.__file__)").startswith(str(site))
    return run, folder


def test_the_program_runs_without_a_checkout(program):
    run, _ = program
    assert "mi-ring fit SCENE.xml" in run("mi-ring", "--help")
    assert run("mi-ring", "doctor").endswith("A fit can run.\n")


@pytest.mark.skipif("MI_RING_WHEEL_TEST" not in os.environ, reason="takes minutes; MI_RING_WHEEL_TEST=1 runs it")
def test_example_and_fit_without_a_checkout(program):
    """`pip install mi-ring && mi-ring example pot && mi-ring fit pot/scene.xml`."""
    run, folder = program
    assert "Now: mi-ring fit pot/scene.xml" in run("mi-ring", "example", "pot")
    assert "No problems found." in run("mi-ring", "check", "pot/scene.xml")
    run("mi-ring", "fit", "pot/scene.xml", "--iterations", "4", "--levels", "2", "--widths", "48", "--shares", "1",
        "--subdivisions", "2")  # fmt: skip
    assert mi_ring.__version__ in (folder / "out/pot/report.html").read_text("utf-8")


def test_the_example_is_as_its_scene_file_says(tmp_path, monkeypatch):
    from mi_ring import example
    from mi_ring.synthesis import example_pot as making

    monkeypatch.setattr(making, "VIEWS", 3)
    monkeypatch.setattr(example, "write_example", lambda folder: making.write_example(folder, spp=4))
    example.main([str(tmp_path / "pot")])
    assert sorted(path.name for path in (tmp_path / "pot").iterdir()) == ["images", "masks", "scene.xml", "truth"]
    truth = trimesh.load(tmp_path / "pot/truth/mesh.ply")
    assert truth.is_watertight and truth.volume > 0
    capture = mi_ring.load_capture(tmp_path / "pot/scene.xml")
    assert len(capture) == 3
    for image, mask, sensor in zip(
        capture.images, capture.masks, ElementTree.parse(tmp_path / "pot/scene.xml").iter("sensor")
    ):
        to_world = np.array(sensor.find("transform/matrix").get("value").split(), float).reshape(4, 4)
        x, y, z = np.linalg.solve(to_world, np.c_[truth.vertices, np.ones(len(truth.vertices))].T)[:3]
        seen = making.SIZE / 2 - making.FOCAL * np.stack([x, y]) / z
        rows, columns = np.nonzero(mask)
        assert np.allclose(seen.min(1), [columns.min(), rows.min()], atol=1.5)
        assert np.allclose(seen.max(1), [columns.max() + 1, rows.max() + 1], atol=1.5)
        assert image[mask == 0].mean() < 2 < 60 < image[mask > 0].mean()


def test_the_example_replaces_nothing(tmp_path, monkeypatch):
    from mi_ring import example

    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    for place in (".", "..", "file"):
        with pytest.raises(mi_ring.InputError, match="DIR: is there already"):
            example.main([place])
