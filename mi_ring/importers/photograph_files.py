"""Finds the files of photographs and masks by the paths that other tools have written."""

import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import unquote

from mi_ring.errors import InputError

#: What follows the last dot of a name and is a suffix. "IMG.1" and "IMG.2" differ in more than their suffix.
SUFFIX = re.compile(r"\.[a-z][a-z0-9]{1,4}$")
MASKS = ("masks", "mask", "segmentation", "segmentations")  #: folders of masks, in lower case
#: Folders, in lower case, whose images are no photographs, unless a path names them.
ASIDE = {*MASKS, "depth", "depths", "normal", "normals", "valid", "sparse"}


def parts_of(path: str) -> list[str]:
    """Split a path of any operating system into its folders and its file name, all in lower case.

    A drive letter, `.` and `..` are left out.
    """
    parts = re.split(r"[/\\]+", unicodedata.normalize("NFC", path).casefold())
    return [part for part in parts if part not in ("", ".", "..") and not re.fullmatch("[a-z]:", part)]


def name_of(path: str) -> str:
    """Return the file name in a path of any operating system."""
    return re.split(r"[/\\]+", path)[-1]


def stem_of(name: str) -> str:
    """Return a file name without its suffix. `name` must be in lower case."""
    return SUFFIX.sub("", name)


class PhotographFiles:
    """Index of image files. It finds the file for a path that another tool has written, perhaps on another computer.

    Path and file may differ in case, suffix, drive, leading folders and percent encoding (`a%20b.jpg`). If several
    files have the name of the path, the one whose folders match best is found. `root`: folder that contains all
    `files`.
    """

    def __init__(self, files: Iterable[Path], root: Path, affix: re.Pattern[str] | None = None) -> None:
        """`affix`: what names without suffix may have more than those that are looked for, as in photo_mask.png."""
        self.files, self.root = list(files), root
        self.folders = {file: parts_of(file.parent.as_posix()) for file in self.files}
        self.below = len(parts_of(root.as_posix()))  #: number of folders that all files share
        self.by_name: dict[str, list[Path]] = defaultdict(list)
        for file in self.files:
            name = parts_of(file.name)[0]
            for key in {name, stem := stem_of(name), affix.sub("", stem) if affix else stem}:
                self.by_name[key].append(file)

    @property
    def ordinary(self) -> list[Path]:
        """All files except those in folders such as masks or depth, whose images are no photographs."""
        return [file for file in self.files if not ASIDE.intersection(self.folders[file][self.below :])]

    def find(self, path: str) -> tuple[Path | None, bool]:
        """Find the file for a path. Returns (file or None, True if its folders below `root` match those of the path).

        Raises InputError if several files match equally well.
        """
        if not (parts := parts_of(path)):
            return None, False
        *folders, name = parts
        candidates = dict.fromkeys([*self.by_name.get(name, ()), *self.by_name.get(stem_of(name), ())])
        if self.root != Path() and (own := self.root / path) in candidates:
            return own, True
        aside = ASIDE - {*folders}
        ranks: dict[Path, tuple] = {}
        for file in candidates:
            own_folders = self.folders[file]
            if aside.intersection(own_folders[self.below :]):
                continue
            agree = next((k for k, (a, b) in enumerate(zip(reversed(own_folders), reversed(folders))) if a != b),
                         min(len(own_folders), len(folders)))  # fmt: skip
            more = max(0, len(own_folders) - self.below - agree)  # folders below the root that the path does not say
            own_name = parts_of(file.name)[0]
            unlike = [file.name != name_of(path), own_name != name, stem_of(own_name) != name]
            ranks[file] = (bool(more and len(folders) > agree), -agree, more, [*unlike[:2], all(unlike[1:])])
        if not ranks:
            plain = unquote(path)  # of addresses, in which %20 stands for a space
            return self.find(plain) if plain != path else (None, False)
        best = min(ranks.values())
        found = [file for file, rank in ranks.items() if rank == best]
        contrary = best[0]
        if contrary and len({file.parent for file in ranks}) > 1:  # of several folders, none is the one that is said
            return None, False
        if len(found) > 1:
            raise InputError(f"{path!r} may be {' or '.join(map(str, found[:3]))}; keep one, or give --images, the "
                             "folder that the paths begin in")  # fmt: skip
        return found[0], not contrary


def refuse_twins(
    claims: Iterable[tuple[Path, str, bool]],
    what: str = "photograph of two cameras",
    advice: str = "give --images, the folder that the paths of the cameras begin in",
) -> set[str]:
    """Decide which path gets a file if several paths match the same file. Returns the set of paths that get none.

    `claims`: tuples (file, path, True if the folders of both match). The path whose folders match gets the file. Raises
    InputError if this is not exactly one path. `what`: what the file would be, for the message. `advice`: its end.
    """
    by_file: dict[Path, list[tuple[str, bool]]] = defaultdict(list)
    for file, path, agrees in claims:
        by_file[file].append((path, agrees))
    lost = set()
    for file, paths in by_file.items():
        if len(paths) < 2:
            continue
        first = [path for path, agrees in paths if agrees] or [path for path, _ in paths]
        if len(first) > 1:
            if first[0] == first[1]:
                raise InputError(f"{file}: would be the {what}: {first[0]!r} is named twice; remove one")
            raise InputError(f"{file}: would be the {what}, {first[0]!r} and {first[1]!r}; {advice}")
        lost |= {path for path, _ in paths} - {*first}
    return lost
