"""OpenSfM's reconstructions, which OpenDroneMap writes too."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens, camera_to_world, opencv_lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import first_file, image_size, load_json, matrix, require_object

#: The coefficients of each projection type that is supported. Of others, "dual" and "fisheye62" are lenses of their
#: own, and "spherical" is a panorama.
TERMS = {
    "perspective": ("k1", "k2"), "simple_radial": ("k1",), "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}  # fmt: skip
#: Other fields of cameras that are used. The same with `_prior` change nothing: what the program began with.
CAMERA = {"projection_type", "width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y"}
#: Fields of shots that are used, and those that change nothing: poses are in the frame of the reconstruction already.
SHOT = {"rotation", "translation", "camera"} | {
    "orientation", "capture_time", "gps_dop", "gps_position", "gps_altitude", "compass", "accelerometer", "opk",
    "skey", "scale", "covariance", "merge_cc", "vertices", "faces", "is_interpolated",
}  # fmt: skip
#: Fields of reconstructions that are used, and those that change nothing: points, and what the poses contain already.
TOP = {"cameras", "shots"} | {
    "points", "biases", "rig_cameras", "rig_instances", "reference_lla", "reference", "main_shots", "pano_shots",
}  # fmt: skip


@dataclass(frozen=True)
class OpenSfm(Photogrammetry):
    """OpenSfM, OpenDroneMap: reconstruction.json. The light is beside the camera.

    SRC is the file, or a folder with reconstruction.json or opensfm/reconstruction.json. Of several reconstructions the
    one with the most photographs is taken.
    """

    @property
    def cameras(self) -> Path:
        """The file of the cameras."""
        if not self.src.is_dir():
            return self.src
        return first_file([folder / "reconstruction.json" for folder in (self.src, self.src / "opensfm")], "SRC")

    @property
    def beside(self) -> Path:
        return self.cameras.parent

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        models = load_json(path)
        if not isinstance(models, list) or not models:
            raise InputError(f"{path}: SRC: must be a list of reconstructions, as OpenSfM writes it")
        models = [require_object(own, f"{path}: [{k}]") for k, own in enumerate(models)]
        shots = [require_object(own.get("shots"), f"{path}: [{k}].shots") for k, own in enumerate(models)]
        best = self.largest(shots, "reconstructions")
        cameras = require_object(models[best].get("cameras"), f"{path}: [{best}].cameras")
        unknown = [name for name in models[best] if name not in TOP]
        for name, shot in sorted(shots[best].items()):
            what = f"{path}: shots {name[:99]!r}"
            turn = matrix(require_object(shot, what).get("rotation"), (3,), f"{what}.rotation")
            shift = matrix(shot.get("translation"), (3,), f"{what}.translation")
            unknown += [key for key in shot if key not in SHOT]
            if image := self.photograph(name, what):
                camera = require_object(cameras.get(str(shot.get("camera"))), f"{what}.camera")
                lens = opensfm_lens(camera, image, f"{path}: cameras {str(shot['camera'])[:99]!r}")
                known = CAMERA.union(TERMS[camera.get("projection_type", "perspective")])
                unknown += [key for key in camera if key.removesuffix("_prior") not in known]
                yield Frame(image, lens, camera_to_world(Rotation.from_rotvec(turn).as_matrix(), shift), said=name)
        self.note_unknown(path, unknown)


def opensfm_lens(given: dict[str, Any], image: Path, what: str) -> Lens:
    """The lens of a camera. Lengths are relative to the longer side of the photograph, places to its middle."""

    def number(name: str, default: float | None = None) -> float:
        return float(matrix(given.get(name, default), (), f"{what}.{name}"))

    kind = str(given.get("projection_type", "perspective"))
    if kind not in TERMS:
        raise InputError(f"{what}.projection_type: is {kind[:40]!r}; must be one of {', '.join(TERMS)}")
    size: Any = (number("width"), number("height")) if given.get("width") and given.get("height") else image_size(image)
    fx, fy = (number("focal"),) * 2 if "focal" in given else (number("focal_x"), number("focal_y"))
    intrinsics = max(size) * np.array([fx, fy, number("c_x", 0), number("c_y", 0)]) + [0, 0, size[0] / 2, size[1] / 2]
    k1, k2, k3, k4, p1, p2 = (number(n, 0) if n in TERMS[kind] else 0.0 for n in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if kind.startswith("fisheye"):
        return Lens("OPENCV_FISHEYE", size, (*intrinsics, k1, k2, k3, k4))
    return opencv_lens(size, intrinsics.tolist(), (k1, k2, k3), (p1, p2))
