"""Importer of Polycam's raw data."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import load_json, matrix, require_object

#: Fields that are used: entries of the camera-to-world matrix by row and column, and the lens [px].
USED = [*(f"t_{row}{column}" for row in range(3) for column in range(4)), "fx", "fy", "cx", "cy", "width", "height"]


@dataclass(frozen=True)
class Polycam(Photogrammetry):
    """Polycam: raw data, exported in developer mode. The light is fixed to the camera.

    SRC is the folder of the export, or its folder keyframes. If the export has corrected cameras and images, they are
    used. A camera looks along its -z axis, and its y axis points up. In the world, y points up.
    """

    fields = Fields(
        used={
            "t_[0-2][0-3]": "pose, camera-to-world", "fx fy cx cy": "lens", "width height": "size of the photograph",
        },
        harmless={"timestamp blur_score neighbors manual_keyframe center_depth angular_velocity": "its quality"},
    )  # fmt: skip

    @property
    def corrected(self) -> str:
        """Prefix of the names of folders: `corrected_` if the export has corrected cameras, otherwise empty."""
        return "corrected_" if (self.keyframes / "corrected_cameras").is_dir() else ""

    @property
    def keyframes(self) -> Path:
        """The folder that contains the folders of cameras and images."""
        return inner if (inner := self.src / "keyframes").is_dir() else self.src

    @property
    def folder(self) -> Path:
        return self.images or self.keyframes / f"{self.corrected}images"

    def posed(self) -> Iterator[Frame]:
        folder = self.keyframes / f"{self.corrected}cameras"
        files = sorted(folder.glob("[!.]*.json"))
        if not files:
            raise InputError(f"{folder}: SRC: found no *.json; must be raw data of Polycam, with a folder keyframes")
        if not self.corrected:
            self.notes.append(f"{folder}: Polycam has not corrected these cameras; they are those of the phone, which "
                              "are less exact")  # fmt: skip
        said: list[str] = []
        for path in files:
            given = require_object(load_json(path), str(path))
            if (image := self.photograph(f"{path.stem}.jpg", str(path))) is None:
                continue
            numbers = [float(matrix(given.get(name), (), f"{path}: {name}")) for name in USED]
            pose = np.vstack([np.reshape(numbers[:12], (3, 4)), [0, 0, 0, 1]])
            size: Any = numbers[16:]
            said += given
            lens = Lens("PINHOLE", size, tuple(numbers[12:16]))  # Lens truncates
            yield Frame(image, lens, pose @ OPENGL, said=f"{path.stem}.jpg")
        self.tell_unused(folder, said)
