"""Finds the LLVM library that Dr.Jit compiles with; as a script, downloads one.

Dr.Jit chooses its library once, while it is imported, and takes what it meets first. LLVM 15 and 16 look fine and then
abort the whole process at the first kernel; Debian 12 installs 14. So `mi_ring` chooses before Dr.Jit does (`prepare`)
and says what is wrong with the result (`missing`).

`python mi_ring/system/llvm.py` (part of `make setup`) makes sure that there is something to choose: where the machine
has no usable LLVM, it unpacks Debian or Ubuntu packages beside the Python environment, without root and without
installing them. It needs nothing but Python.
"""

import ctypes
import glob
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

OLDEST = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"
PRIVATE = Path(sys.prefix) / "llvm"  # the copy that belongs to this environment

# The versions that Debian and Ubuntu carry, the best tested first.
DEBIAN_VERSIONS = (19, 18, 17, *range(20, 30))

# Full names only: libLLVMSPIRVLib.so.19.1 and the libLLVM-18-rust-*.so of a compiler are other libraries.
_NAME = re.compile(
    r".*/(?:libLLVM-(\d+)[\d.]*\.so[\d.]*|libLLVM\.so\.(\d+)[\d.]*"
    r"|llvm[@\d]*/(\d+)[^/]*/lib/libLLVM\.dylib)"
)  # Homebrew

_too_late = False  # Dr.Jit was there before us


def prepare() -> None:
    """Choose Dr.Jit's LLVM through the environment variable `DRJIT_LIBLLVM_PATH`; call it before Dr.Jit is imported.

    A value that the user has set stays. Without a usable library nothing is set, and `missing` says what came of it.
    """
    global _too_late
    _too_late = "drjit" in sys.modules
    if _too_late:
        return
    preload(PRIVATE)
    if not os.environ.get(VARIABLE) and (path := find()):
        os.environ[VARIABLE] = path


def missing() -> str | None:
    """What the variants `llvm_*` of Mitsuba lack here and what to do about it; None if they lack nothing.

    Call it after `prepare`. Where libatomic is missing Dr.Jit cannot even be imported.
    """
    if not has_atomic():
        return f"Dr.Jit needs libatomic.so.1, which this machine lacks. {cure('libatomic1')}"
    import drjit.detail

    version = drjit.detail.llvm_version()  # (-1, -1, -1): none
    if version[0] >= OLDEST:
        return None

    chosen, known = os.environ.get(VARIABLE), libraries()
    found = f"loaded LLVM {'.'.join(map(str, version))}" if version[0] > 0 else "found none that it can use"
    if chosen:
        missing = os.sep in chosen and not os.path.exists(chosen)
        found += f" ({VARIABLE}={chosen}{', which does not exist' if missing else ''})"
    elif known:
        found += f" (on this machine: {', '.join(path for _, path in known)})"

    usable = [path for major, path in known if major >= OLDEST]
    if usable and _too_late:
        remedy = (
            f"Dr.Jit was imported before mi_ring could choose {usable[0]}: "
            "restart Python and import mi_ring before mitsuba."
        )
    elif usable and chosen and os.path.realpath(chosen) not in usable:
        remedy = f"Unset {VARIABLE}: mi_ring then takes {usable[0]}."
    else:
        remedy = cure("libllvm19", f", or set {VARIABLE} to the path of a newer libLLVM") + " Then restart Python."
    return (
        f"mi_ring needs LLVM {OLDEST} or newer, but Dr.Jit {found}. LLVM 15 and 16 are refused because "
        f"they abort the whole process at the first kernel; Dr.Jit itself refuses older ones. {remedy}"
    )


def cure(package: str, more: str = "") -> str:
    """How to get a Debian package's library on this machine."""
    advice = {
        "darwin": "Run `brew install llvm`",
        "win32": "Run `winget install LLVM.LLVM`",
    }
    if sys.platform in advice:
        return f"{advice[sys.platform]}{more}."
    script = f"{sys.executable} {os.path.abspath(__file__)}"
    return f"Run `{script}` (part of `make setup`; needs no root), or `apt install {package}` as root{more}."


def libraries(folders: list[str] | None = None) -> list[tuple[int, str]]:
    """List the LLVM libraries in `folders` as (major version, path), in order of preference.

    Without `folders`: the system's, newest first, then the private copy. The version is read from the file name, since
    loading two LLVMs into one process is asking for trouble.
    """
    if folders is None:
        return libraries(_system_folders()) + libraries([f"{glob.escape(str(PRIVATE))}/**"])
    found = set()
    for folder in folders:
        for path in glob.glob(f"{folder}/libLLVM*", recursive=True):
            if match := _NAME.fullmatch(path):
                found.add((int(next(filter(None, match.groups()))), os.path.realpath(path)))
    return sorted(found, reverse=True)


def _system_folders() -> list[str]:
    """Folders (glob patterns) in which systems keep libLLVM."""
    arch = sysconfig.get_config_var("MULTIARCH") or f"{platform.machine()}-linux-gnu"
    folders = [
        f"/usr/lib/{arch}",
        "/usr/lib/llvm-*/lib",
        "/usr/lib64",
        "/usr/lib64/llvm*/lib",
        "/usr/lib",
        "/usr/local/lib",
        "/opt/homebrew/Cellar/llvm*/*/lib",
        "/usr/local/Cellar/llvm*/*/lib",
        f"{glob.escape(sys.prefix)}/lib",
    ]
    if ldconfig := shutil.which("ldconfig", path="/sbin:/usr/sbin"):  # not in every user's PATH
        cache = subprocess.run([ldconfig, "-p"], check=False, capture_output=True, text=True).stdout
        folders += {os.path.dirname(path) for path in re.findall(r"=> (/.*/libLLVM[^/]*)$", cache, re.MULTILINE)}
    return folders


def find(folders: list[str] | None = None) -> str | None:
    """Return the path of the first library in `libraries(folders)` that is new enough and loads, or None."""
    if sys.platform == "win32" and folders is None:  # whose libraries do not have their version in their names
        places = shutil.which("LLVM-C.dll"), r"C:\Program Files\LLVM\bin\LLVM-C.dll"
        return next((path for path in places if path and os.path.exists(path)), None)
    return next((path for major, path in libraries(folders) if major >= OLDEST and loads(path)), None)


def loads(path: str | Path) -> bool:
    """Load a shared library and keep it; False if that fails (wrong architecture, a missing dependency)."""
    try:
        ctypes.CDLL(str(path))
        return True
    except OSError:
        return False


def has_atomic() -> bool:
    """Whether libatomic, which Dr.Jit is linked with and slim containers lack, can be loaded (only Linux needs it)."""
    return sys.platform != "linux" or loads("libatomic.so.1")


def preload(folder: Path) -> None:
    """Load what is unpacked in `folder`, LLVM itself apart, in whatever order resolves.

    The loader does not search there, but takes a library that is already loaded wherever its name is asked for.
    """
    waiting = [path for path in folder.rglob("*.so*") if path.is_file() and not path.name.startswith("libLLVM")]
    while waiting != (left := [path for path in waiting if not loads(path)]):
        waiting = left


def install(target: Path = PRIVATE) -> str:
    """Make a usable LLVM, and libatomic, available and say in one line how.

    Does nothing where the machine has both. Otherwise fills the folder `target` by `unpack`.

    Raises:
        RuntimeError: There is no usable LLVM and no way to get one here.
    """
    preload(target)
    path = os.environ.get(VARIABLE) or find()
    if path and has_atomic():
        return f"LLVM: {path}"

    wanted = [["libatomic1"]]  # asked for in any case: apt leaves out what the machine has
    if not (os.environ.get(VARIABLE) or find(_system_folders())):
        wanted = [["libatomic1", f"libllvm{major}"] for major in DEBIAN_VERSIONS]
    packages = unpack(wanted, target)

    preload(target)
    path = os.environ.get(VARIABLE) or find()
    if not (path and has_atomic()):
        raise RuntimeError(f"{' '.join(packages)} in {target} cannot be loaded")
    return f"LLVM: {path} (unpacked in {target}: {' '.join(packages)})"


def unpack(alternatives: list[list[str]], target: Path) -> list[str]:
    """Unpack Debian or Ubuntu packages into the folder `target`, replacing it, and return the packages' names.

    Works without root and leaves the system as it is: apt keeps its lists and its cache in a temporary folder.

    Args:
        alternatives: Lists of packages. The first list that the archive can serve is taken, together with the
            dependencies that this machine lacks; packages that the machine has are left out.
        target: The folder. It appears complete or not at all.

    Raises:
        RuntimeError: The system has no apt, or apt failed.
    """
    if not shutil.which("apt-get"):
        raise RuntimeError(
            f"no LLVM of version {OLDEST} or newer, and no apt-get to fetch one: install it (Fedora: "
            f"`dnf install llvm-libs libatomic`, macOS: `brew install llvm`) or set {VARIABLE}"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unpack-", dir=target.parent) as name:
        folder = Path(name).resolve()
        for part in ("state/lists/partial", "cache/archives/partial", "debs", "tree"):
            (folder / part).mkdir(parents=True)
        # Without the sandbox user: it could not write here, and apt would say so at length.
        apt = [
            "apt-get",
            "-qq",
            "-o",
            f"Dir::State={folder}/state",
            "-o",
            "Dir::State::status=/var/lib/dpkg/status",
            "-o",
            f"Dir::Cache={folder}/cache",
            "-o",
            "APT::Sandbox::User=root",
            "-o",
            "Acquire::Languages=none",
        ]
        # An unreachable third-party source fails here and does not matter; an unreachable archive fails below.
        subprocess.run([*apt, "update"], check=False)
        for wanted in alternatives:
            plan = subprocess.run(
                [*apt, "install", "-s", "--no-install-recommends", *wanted], check=False, capture_output=True, text=True
            )
            # "Inst name (version ...)" is new; "Inst name [old] (version ...)" would shadow what runs here: never that.
            if packages := re.findall(r"^Inst (\S+) \(", plan.stdout, re.MULTILINE):
                break
        else:
            reason = " ".join(plan.stderr.split())
            raise RuntimeError(f"apt has no {' '.join(alternatives[0])} to fetch, nor an alternative. {reason}")
        print(f"Downloading {' '.join(packages)}", flush=True)
        try:
            subprocess.run([*apt, "download", *packages], cwd=folder / "debs", check=True)
            for package in (folder / "debs").iterdir():
                subprocess.run(["dpkg-deb", "-x", package, folder / "tree"], check=True)
        except subprocess.CalledProcessError as error:
            raise RuntimeError(f"{error.cmd[0]} failed") from error
        shutil.rmtree(target, ignore_errors=True)
        (folder / "tree").rename(target)
    return packages


def main(arguments: list[str]) -> None:
    """`llvm.py` makes LLVM available; `llvm.py FOLDER PACKAGE...` unpacks other packages the same way."""
    try:
        if arguments:
            unpack([arguments[1:]], Path(arguments[0]))
        else:
            print(install())
    except (RuntimeError, OSError) as error:
        sys.exit(f"{os.path.basename(__file__)}: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])
