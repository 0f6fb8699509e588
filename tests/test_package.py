"""The package as others get it: wheel and sdist, and the program in an environment of its own."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

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
    data = {"mi_ring/py.typed", "mi_ring/output/report.html.jinja", "mi_ring/output/viewer/viewer.min.js"}
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


def test_the_program_tells_its_version():
    done = subprocess.run([sys.executable, "-m", "mi_ring", "--version"], capture_output=True, text=True)
    assert done.stdout == f"{mi_ring.__version__}\n"


def without_llvm(*arguments):
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": "/nowhere/libLLVM.so"}
    done = subprocess.run([sys.executable, "-m", *arguments], capture_output=True, text=True, env=environment)
    return done.returncode, done.stdout, done.stderr.strip().splitlines()


def test_without_llvm_the_doctor_says_what_to_do():
    status, said, _ = without_llvm("mi_ring.doctor")
    assert status == 1 and "MISSING  LLVM" in said and said.endswith("A fit cannot run: LLVM missing\n")
    assert without_llvm("mi_ring", "--help")[0] == 0
    assert subprocess.run([sys.executable, "-m", "mi_ring.doctor"], capture_output=True).returncode == 0


@pytest.mark.parametrize("command", ["fit", "check", "render", "export", "evaluate", "validate"])
def test_without_llvm_a_command_ends_with_one_line(command, tmp_path):
    more = {"render": ["a.xml", "b"], "export": ["a.ply"], "evaluate": ["--mesh", "a.ply"]}.get(command, [])
    scene = tmp_path / "scene.xml"
    scene.write_text("<scene version='3.0.0'/>")
    status, _, complaint = without_llvm(f"mi_ring.{command}", str(scene), *more)
    assert status == 2 and complaint[-1].startswith(f"mi_ring.{command}: mi_ring needs LLVM 17 or newer")
    assert not any("Traceback" in line for line in complaint)


@pytest.mark.parametrize("kind", ["whl", "tar.gz"])
def test_in_a_fresh_environment_without_a_checkout(kind, built, tmp_path):
    """`pip install mi-ring && mi-ring example pot && mi-ring fit pot/scene.xml`; what it needs is the parent's."""
    if os.name != "posix":
        pytest.skip("the folders of environments are those of POSIX systems")
    venv.create(tmp_path / "env", with_pip=False)
    (site,) = (tmp_path / "env").glob("lib/python*/site-packages")
    own = Path(sysconfig.get_paths()["purelib"])
    (package,) = built.glob(f"*.{kind}")
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        site,
        package,
    ]
    subprocess.run(install, check=True, capture_output=True, cwd=tmp_path)
    # What it depends on, but not the checkout, which an editable installation would bring along.
    (site / "parent.pth").write_text(f"import sys; sys.path.append({str(own)!r})\n")
    program = "import mi_ring.__main__ as m; m.main()"

    python = tmp_path / "env/bin/python"
    environment = {name: os.environ[name] for name in ("PATH", llvm.VARIABLE) if name in os.environ}
    environment["HOME"] = str(tmp_path)

    def run(*arguments):
        call = [python, "-c", program, *arguments]
        done = subprocess.run(call, capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = subprocess.run([tmp_path / "env/bin/python", "-c", "import mi_ring; print(mi_ring.__file__)"],
                           capture_output=True, text=True, cwd=tmp_path)  # fmt: skip
    assert where.stdout.startswith(str(site)), where.stderr
    assert "mi-ring fit" in run("--help")
    assert "A fit can run." in run("doctor")
    if kind == "whl":  # it takes 20 s
        assert "Now: mi-ring fit pot/scene.xml" in run("example", "pot")
        assert "Nothing to mend found." in run("check", "pot/scene.xml")
        run("fit", "pot/scene.xml", "--iterations", "3", "--levels", "2", "--widths", "48", "--shares", "1",
            "--subdivisions", "2")  # fmt: skip
        assert mi_ring.__version__ in (tmp_path / "out/pot/report.html").read_text("utf-8")
