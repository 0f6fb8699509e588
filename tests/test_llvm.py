"""Choice of the LLVM library, and the one error that replaces an aborted process."""

import os
import re
import subprocess
import sys

import pytest

from mi_ring.system import llvm

# The names that LLVM's own builds, Debian, Ubuntu and Fedora use, and two libraries that are not LLVM.
NAMES = {
    14: ["libLLVM-14.so.1"],
    15: ["libLLVM-15.so"],
    16: ["libLLVM-16.0.6.so"],
    17: ["libLLVM-17.so.1"],
    18: ["libLLVM.so.18.1"],
    19: ["libLLVM-19.so", "libLLVM.so.19.1"],
    None: ["libLLVM.so.1", "libLLVMSPIRVLib.so.20.1", "libLLVM-20-rust-1.90.0-stable.so"],
}


def put(folder, *majors):
    """Put empty library files of these versions into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for major in majors:
        for name in NAMES[major]:
            (folder / name).touch()
    return str(folder)


@pytest.fixture
def world(tmp_path, monkeypatch):
    """A machine whose libraries are the files below tmp_path; all of them load."""
    monkeypatch.setenv(llvm.VARIABLE, "")  # as good as unset
    monkeypatch.setattr(llvm, "_too_late", False)
    monkeypatch.setattr(llvm, "_system_folders", lambda: [str(tmp_path / "system")])
    monkeypatch.setattr(llvm, "PRIVATE", tmp_path / "private")
    monkeypatch.setattr(llvm, "loads", lambda path: True)
    return tmp_path


@pytest.fixture
def drjit_loaded(monkeypatch):
    """Make Dr.Jit report an LLVM version."""
    import drjit.detail

    return lambda *version: monkeypatch.setattr(drjit.detail, "llvm_version", lambda: version)


def prepared():
    """Run `prepare` as if Dr.Jit had not been imported yet; the name of the library it chose."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delitem(sys.modules, "drjit")
        llvm.prepare()
    return os.path.basename(os.environ[llvm.VARIABLE])


def test_versions_are_read_from_file_names(world):
    majors = {major for major, _ in llvm.libraries([put(world / "a", *NAMES)])}
    assert majors == {1, 14, 15, 16, 17, 18, 19}  # libLLVM.so.1 counts as version 1, which is never usable


@pytest.mark.parametrize(
    ("majors", "expected"),
    [
        ((14, 15, 16, 17, 18, 19, None), r"libLLVM(-19\.so|\.so\.19\.1)"),
        ((14, 18, 17), r"libLLVM\.so\.18\.1"),
        ((15, 17), r"libLLVM-17\.so\.1"),
    ],
)
def test_takes_the_newest(world, majors, expected):
    put(world / "system", *majors)
    assert re.fullmatch(expected, prepared())


def test_sets_nothing_without_a_usable_version(world):
    put(world / "system", 14, 15, 16, None)
    assert prepared() == ""


def test_prefers_the_system_to_the_private_copy(world):
    put(world / "private" / "usr" / "lib", 19)
    assert "19" in prepared()
    os.environ[llvm.VARIABLE] = ""
    put(world / "system", 17)
    assert prepared() == "libLLVM-17.so.1"


def test_skips_a_library_that_does_not_load(world, monkeypatch):
    put(world / "system", 17, 19)
    monkeypatch.setattr(llvm, "loads", lambda path: "19" not in os.path.basename(path))
    assert prepared() == "libLLVM-17.so.1"


def test_keeps_the_users_choice(world, monkeypatch):
    put(world / "system", 19)
    monkeypatch.setenv(llvm.VARIABLE, "/my/libLLVM.so")
    assert prepared() == "libLLVM.so"


def test_sets_nothing_after_drjit(world):
    put(world / "system", 19)
    llvm.prepare()
    assert os.environ[llvm.VARIABLE] == ""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux needs libatomic")
def test_names_a_missing_libatomic(world, monkeypatch):
    monkeypatch.setattr(llvm, "loads", lambda path: "atomic" not in str(path))
    prepared()
    assert "apt install libatomic1" in llvm.missing()


def test_preload_finds_an_order(tmp_path, monkeypatch):
    for name in "abc":
        (tmp_path / f"lib{name}.so").touch()
    (tmp_path / "libLLVM.so.19.1").touch()
    needs, loaded = {"liba.so": {"libb.so"}, "libb.so": {"libc.so"}, "libc.so": set()}, []

    def loads(path):
        if needs[path.name] <= set(loaded):
            loaded.append(path.name)
        return path.name in loaded

    monkeypatch.setattr(llvm, "loads", loads)
    llvm.preload(tmp_path)
    assert loaded == ["libc.so", "libb.so", "liba.so"]


@pytest.mark.parametrize("version", [(17, 0, 0), (19, 1, 7), (22, 1, 0)])
def test_accepts(drjit_loaded, version):
    drjit_loaded(*version)
    assert llvm.missing() is None


@pytest.mark.parametrize(
    ("version", "found"),
    [
        ((16, 0, 6), "loaded LLVM 16.0.6"),
        ((15, 0, 6), "loaded LLVM 15.0.6"),
        ((14, 0, 6), "loaded LLVM 14.0.6"),
        ((-1, -1, -1), "found none"),
    ],
)
def test_refuses(world, drjit_loaded, version, found):
    put(world / "system", 15)
    drjit_loaded(*version)
    complaint = llvm.missing()
    for part in (found, "libLLVM-15.so", "LLVM 17 or newer", "abort", "make setup", "apt install lib", llvm.VARIABLE):
        assert part in complaint


def test_refusal_asks_for_the_right_order(world, drjit_loaded, monkeypatch):
    put(world / "system", 15, 19)
    drjit_loaded(15, 0, 6)
    monkeypatch.setattr(llvm, "_too_late", True)
    assert "import mi_ring before mitsuba" in llvm.missing()


def test_refusal_of_the_users_choice(world, drjit_loaded, monkeypatch):
    put(world / "system", 19)
    drjit_loaded(15, 0, 6)
    monkeypatch.setenv(llvm.VARIABLE, put(world / "mine", 15) + "/libLLVM-15.so")
    assert f"Unset {llvm.VARIABLE}" in llvm.missing() and "does not exist" not in llvm.missing()


def test_without_llvm_other_variants_go_on_and_the_import_says_what_is_missing(tmp_path):
    missing = str(tmp_path / "libLLVM.so.19.1")
    code = "import mi_ring, mitsuba as mi; mi.set_variant('scalar_rgb'); print(mi.load_dict({'type': 'cooktorrance'}))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                             env=os.environ | {llvm.VARIABLE: missing})  # fmt: skip
    assert process.returncode == 0 and "CookTorrance" in process.stdout
    assert f"{missing}, which does not exist" in process.stderr and "mi_ring needs LLVM 17 or newer" in process.stderr


def test_a_kernel_that_older_versions_abort_on():
    """In a process of its own, which may die."""
    code = (
        "import mi_ring, mitsuba as mi, drjit as dr; mi.set_variant('llvm_ad_rgb');"
        "print(dr.minimum(mi.Float([1, 3]), 2))"
    )
    process = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert process.stdout.strip() == "[1, 2]"


def test_unpack_without_apt_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(llvm.shutil, "which", lambda name: None)
    with pytest.raises(RuntimeError, match="dnf install"):
        llvm.unpack([["libllvm19"]], tmp_path / "llvm")
    assert not list(tmp_path.iterdir())
