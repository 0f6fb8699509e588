"""Importer of Middlebury's multi-view stereo data."""

from collections.abc import Iterator
from dataclasses import dataclass

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import camera_to_world, pinhole_lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, load_lines, matrix


@dataclass(frozen=True)
class Middlebury(Photogrammetry):
    """Middlebury's multi-view stereo: NAME_par.txt beside its photographs. The light is fixed to the camera.

    SRC is NAME_par.txt or its folder.
    """

    fields = Fields(used={
        "imgname": "the photograph", "k11 k12 k13 k21 k22 k23 k31 k32 k33": "calibration matrix, without skew",
        "r11 r12 r13 r21 r22 r23 r31 r32 r33 t1 t2 t3": "pose, world-to-camera",
    })  # fmt: skip

    def posed(self) -> Iterator[Frame]:
        files = sorted(self.src.glob("*_par.txt")) if self.src.is_dir() else [self.src]
        if len(files) != 1:
            raise InputError(f"{self.src}: SRC: has {len(files)} files *_par.txt; must have one, or give the file")
        path, (count, *lines) = files[0], load_lines(files[0]) or [""]
        if count.strip() != str(len(lines)):
            raise InputError(f"{path}: line 1: is {count[:40]!r}; must be the number of cameras, of which "
                             f"{len(lines)} follow")  # fmt: skip
        for line in lines:
            name, *numbers = line.split()
            what = f"{path}: {name}"
            values = matrix(numbers, (21,), f"{what}: K, R, t")
            K, R, t = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
            if image := self.photograph(name, what):
                lens = pinhole_lens(K, image_size(image), 0.5, what)  # pixels as in OpenCV
                yield Frame(image, lens, camera_to_world(R, t), said=name)
