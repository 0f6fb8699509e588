"""Finds the LLVM library that Dr.Jit compiles with. Run as a script, it downloads one.

Dr.Jit takes the first LLVM that it finds, at import. LLVM 15 and 16 load without an error, but abort the process at the
first kernel; Debian 12 installs LLVM 14. So `prepare` chooses an LLVM before Dr.Jit does, and `missing` reports what is
wrong with it.

`python mi_ring/system/llvm.py` (part of `make setup`) makes an LLVM available. If the machine has no usable one, it
unpacks Debian or Ubuntu packages beside the Python environment. It needs no root rights, does not change the system,
and imports only the standard library.
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
DEBIAN_VERSIONS = (19, 18, 17, *range(20, 30))  # of packages of Debian and Ubuntu, the best tested first

# Full names: libLLVMSPIRVLib.so.19.1 and libLLVM-18-rust-*.so are other libraries. The last pattern is Homebrew's.
_NAME = re.compile(
    r".*/(?:libLLVM-(\d+)[\d.]*\.so[\d.]*|libLLVM\.so\.(\d+)[\d.]*"
    r"|llvm[@\d]*/(\d+)[^/]*/lib/libLLVM\.dylib)"
)

_too_late = False  # Dr.Jit was imported before `prepare`


def prepare() -> None:
    """Choose the LLVM library for Dr.Jit. Sets the environment variable `DRJIT_LIBLLVM_PATH`.

    Call it before Dr.Jit is imported; later, it does nothing. A value that the user has set is kept. If no library is
    usable, the variable stays unset.
    """
    global _too_late
    _too_late = "drjit" in sys.modules
    if _too_late:
        return
    preload(PRIVATE)
    if not os.environ.get(VARIABLE) and (path := find()):
        os.environ[VARIABLE] = path


def missing() -> str | None:
    """Return what Mitsuba's variants `llvm_*` lack on this machine, with advice; None if they can run.

    Call it after `prepare`.
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
        found += f" ({VARIABLE}={chosen}{', which does not exist' * (os.sep in chosen and not os.path.exists(chosen))})"
    elif known:
        found += f" (on this machine: {', '.join(path for _, path in known)})"

    usable = [path for major, path in known if major >= OLDEST]
    if usable and _too_late:
        remedy = (f"Dr.Jit was imported before mi_ring could choose {usable[0]}: "
                  "restart Python and import mi_ring before mitsuba.")  # fmt: skip
    elif usable and chosen and os.path.realpath(chosen) not in usable:
        remedy = f"Unset {VARIABLE}: mi_ring then takes {usable[0]}."
    else:
        remedy = cure("libllvm19", f", or set {VARIABLE} to the path of a newer libLLVM") + " Then restart Python."
    return (
        f"mi_ring needs LLVM {OLDEST} or newer, but Dr.Jit {found}. LLVM 15 and 16 are refused because "
        f"they abort the whole process at the first kernel; Dr.Jit itself refuses older ones. {remedy}"
    )


def cure(package: str, more: str = "") -> str:
    """Return a sentence that tells the user how to install a library on this machine.

    `package`: name of its Debian package. `more`: another remedy, appended to the sentence, for example ", or set …".
    """
    installers = {"darwin": "brew install llvm", "win32": "winget install LLVM.LLVM"}
    if sys.platform in installers:
        return f"Run `{installers[sys.platform]}`{more}."
    script = f"{sys.executable} {os.path.abspath(__file__)}"
    return f"Run `{script}` (part of `make setup`; needs no root), or `apt install {package}` as root{more}."


def libraries(folders: list[str] | None = None) -> list[tuple[int, str]]:
    """List the LLVM libraries in `folders` (glob patterns) as (major version, path), the newest first. Loads no file.

    None: the folders of the system, and after their libraries those of our private copy. Versions come from file names.
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
        f"/usr/lib/{arch}", "/usr/lib/llvm-*/lib", "/usr/lib64", "/usr/lib64/llvm*/lib", "/usr/lib", "/usr/local/lib",
        "/opt/homebrew/Cellar/llvm*/*/lib", "/usr/local/Cellar/llvm*/*/lib", f"{glob.escape(sys.prefix)}/lib",
    ]  # fmt: skip
    if ldconfig := shutil.which("ldconfig", path="/sbin:/usr/sbin"):  # not in every user's PATH
        cache = subprocess.run([ldconfig, "-p"], check=False, capture_output=True, text=True).stdout
        folders += {os.path.dirname(path) for path in re.findall(r"=> (/.*/libLLVM[^/]*)$", cache, re.MULTILINE)}
    return folders


def find(folders: list[str] | None = None) -> str | None:
    """Return the path of the newest LLVM library that Dr.Jit can use, or None. Loads the library.

    `folders`: glob patterns of folders to search; None: those of the system first, then our private copy.
    """
    if sys.platform == "win32" and folders is None:  # file names there do not contain the version
        places = shutil.which("LLVM-C.dll"), r"C:\Program Files\LLVM\bin\LLVM-C.dll"
        return next((path for path in places if path and os.path.exists(path)), None)
    return next((path for major, path in libraries(folders) if major >= OLDEST and loads(path)), None)


def loads(path: str | Path) -> bool:
    """Load a shared library into this process. Returns False if this fails, e.g. for another architecture."""
    try:
        ctypes.CDLL(str(path))
        return True
    except OSError:
        return False


def has_atomic() -> bool:
    """Return True if Dr.Jit finds libatomic, which it needs on Linux. Small containers do not have it."""
    return sys.platform != "linux" or loads("libatomic.so.1")


def preload(folder: Path) -> None:
    """Load the shared libraries in `folder` and its subfolders into this process, except LLVM.

    The dynamic loader does not search this folder. But a library that needs them then finds them, as they are loaded.
    """
    waiting = [path for path in folder.rglob("*.so*") if path.is_file() and not path.name.startswith("libLLVM")]
    while waiting != (left := [path for path in waiting if not loads(path)]):
        waiting = left


def install(target: Path = PRIVATE) -> str:
    """Download LLVM and libatomic if this machine lacks them. Returns a text for the user that says where LLVM is.

    They are unpacked into the folder `target`. Raises RuntimeError if this fails.
    """
    preload(target)
    path, packages = os.environ.get(VARIABLE) or find(), []
    if not (path and has_atomic()):
        wanted = [["libatomic1"]]  # always asked for: apt leaves out what the machine has
        if not (os.environ.get(VARIABLE) or find(_system_folders())):
            wanted = [["libatomic1", f"libllvm{major}"] for major in DEBIAN_VERSIONS]
        packages = unpack(wanted, target)
        preload(target)
        path = os.environ.get(VARIABLE) or find()
        if not (path and has_atomic()):
            raise RuntimeError(f"{' '.join(packages)} in {target} cannot be loaded")
    return f"LLVM: {path}" + (f" (unpacked in {target}: {' '.join(packages)})" if packages else "")


def unpack(alternatives: list[list[str]], target: Path) -> list[str]:
    """Download Debian or Ubuntu packages, and unpack them into the folder `target`. Returns their names.

    `alternatives`: lists of package names; the first list that the archive has is used, with its dependencies, without
    packages that are installed already. `target` is replaced; after an error, it is as before or missing, never
    incomplete. Needs no root rights, because apt's lists and cache are in a temporary folder. Raises RuntimeError if
    there is no apt or if apt fails.
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
        # Sandbox user root: apt's own sandbox user cannot write here.
        apt = [
            "apt-get", "-qq", f"-oDir::State={folder}/state", "-oDir::State::status=/var/lib/dpkg/status",
            f"-oDir::Cache={folder}/cache", "-oAPT::Sandbox::User=root", "-oAcquire::Languages=none",
        ]  # fmt: skip
        # An unreachable third-party source fails here, without harm. Without the archive, the next step fails.
        subprocess.run([*apt, "update"], check=False)
        for wanted in alternatives:
            plan = subprocess.run(
                [*apt, "install", "-s", "--no-install-recommends", *wanted], check=False, capture_output=True, text=True
            )
            # "Inst name (version ...)" is a new package. "Inst name [old] (version ...)" would shadow an installed one.
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
    """Run the script: without arguments, make LLVM available; with FOLDER PACKAGE..., unpack packages into a folder."""
    try:
        if arguments:
            unpack([arguments[1:]], Path(arguments[0]))
        else:
            print(install())
    except (RuntimeError, OSError) as error:
        sys.exit(f"{os.path.basename(__file__)}: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])
