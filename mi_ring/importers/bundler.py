"""Importer of Bundler's cameras. Other programs write this format, too."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import camera_to_world, opencv_lens
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import first_file, image_size, load_lines, matrix, read_as

FIRST_LINE = "# Bundle file"
LISTED = re.compile(r"\s*(.*?)(?:\s+0\s+[-+.\deE]+)?\s*$")  #: a line of list.txt: name, and 0 with a focal length
MAX_CAMERAS = 10**6


@dataclass(frozen=True)
class Bundler(Photogrammetry):
    """Bundler: bundle.out with list.txt. The light is fixed to the camera.

    SRC is the bundle file, or a folder with bundle.out or bundle/bundle.out. The photographs are listed in list.txt,
    which is beside the bundle file or one folder above. The list of pot.bundle.out is pot.list.txt. The bundle file
    does not give the size of the photographs. They must have their original size.
    """

    fields = Fields(
        used={"f k1 k2": "lens; a camera with f = 0 has no pose", "R t": "world to camera, which looks along -z, y up"},
        harmless={"points": "the surface starts from masks", "list.txt:focal": "where the program began"},
    )

    names = "bundle.out", "bundle/bundle.out"

    @property
    def listed(self) -> Path:
        """Path of the file that lists the photographs. Raises InputError if there is none."""
        path = self.cameras
        names = [path.with_name(path.name.replace("bundle", "list")).with_suffix(".txt"), path.with_name("list.txt")]
        return first_file([*dict.fromkeys([*names, path.parent.parent / "list.txt"])], f"{path}: list.txt")

    @property
    def beside(self) -> Path:
        return self.listed.parent

    def posed(self) -> Iterator[Frame]:
        path, listed = self.cameras, self.listed
        photographs = [LISTED.sub(r"\1", line) for line in load_lines(listed)]
        rows = read_cameras(path)
        if len(rows) != len(photographs):
            raise InputError(f"{listed}: names {len(photographs)} photographs, but {path.name} has {len(rows)} "
                             "cameras; give the list of this reconstruction")  # fmt: skip
        for name, ((f, k1, k2), *R, t) in zip(photographs, rows):
            if not f:
                self.without_pose.add(name)
            elif image := self.photograph(name, str(listed), relative=True):
                size = image_size(image)
                lens = opencv_lens(size, (f, f, size[0] / 2, size[1] / 2), (k1, k2, 0.0), (0.0, 0.0))
                yield Frame(image, lens, camera_to_world(np.array(R), t) @ OPENGL, said=name)


def read_cameras(path: Path) -> np.ndarray:
    """Read the cameras of a bundle file. Returns (N, 5, 3): for each camera, five rows of three numbers.

    The rows are (f [px], k1, k2), the three rows of the rotation R, and the translation t, world-to-camera. Raises
    InputError if the file is damaged.
    """

    def read(file: Path) -> tuple[list[str], list[str]]:
        with file.open(encoding="utf-8-sig") as text:
            head = list(islice(text, 2))
            return head, list(islice(text, 5 * count_in(head, path)))

    head, lines = read_as(path, "text", read)
    count = count_in(head, path)
    return matrix(" ".join(lines).split(), (15 * count,), f"{path}: its {count} cameras").reshape(-1, 5, 3)


def count_in(head: list[str], path: Path) -> int:
    """Return the number of cameras that a bundle file announces. `head`: its first two lines.

    Raises InputError if these lines are invalid. The message begins with `path`.
    """
    if not head or not head[0].startswith(FIRST_LINE):
        raise InputError(f"{path}: SRC: does not begin with {FIRST_LINE!r}; must be a file of Bundler's, bundle.out")
    word = (head[1].split() or [""])[0] if len(head) > 1 else ""
    if not word.isdecimal() or not 0 < len(word) < 8 or not 0 < int(word) <= MAX_CAMERAS:
        raise InputError(f"{path}: line 2: is {word[:40]!r}; must be the number of cameras, 1 to {MAX_CAMERAS}")
    return int(word)
