"""Importer of OpenSfM's reconstructions. OpenDroneMap writes this format, too."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, camera_to_world, opencv_lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, load_json, matrix, require_object

#: The coefficients of each projection type that is supported. Of others, "dual" and "fisheye62" are lenses of their
#: own, and "spherical" is a panorama.
TERMS = {
    "perspective": ("k1", "k2"), "simple_radial": ("k1",), "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3", "p1", "p2"), "fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4"),
}  # fmt: skip


@dataclass(frozen=True)
class OpenSfm(Photogrammetry):
    """OpenSfM, OpenDroneMap: reconstruction.json. The light is fixed to the camera.

    SRC is the file, or a folder with reconstruction.json or opensfm/reconstruction.json. If the file has several
    reconstructions, the one with the most photographs is used.
    """

    fields = Fields(
        used={
            "cameras shots": "hold the others", "shots/rotation shots/translation shots/camera": "pose",
            "cameras/projection_type cameras/width cameras/height": "kind of lens, and size",
            "cameras/focal cameras/focal_x cameras/focal_y cameras/c_x cameras/c_y": "intrinsics",
            "cameras/k[1-4] cameras/p[12]": "distortion, of the kinds of lens that have it",
        },
        refused={"cameras/projection_type=*": "panoramas, and lenses of their own: dual, fisheye62"},
        harmless={
            "points biases reference_lla reference main_shots pano_shots": "points, and what poses contain already",
            "rig_cameras rig_instances": "poses of photographs contain those of rigs",
            "cameras/*_prior": "what the program began with",
            "shots/orientation shots/capture_time shots/gps_* shots/compass shots/accelerometer shots/opk": "sensors",
            "shots/skey shots/scale shots/covariance shots/merge_cc shots/vertices shots/faces shots/is_interpolated":
                "of the program",
        },
    )  # fmt: skip

    names = "reconstruction.json", "opensfm/reconstruction.json"

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        models = load_json(path)
        if not isinstance(models, list) or not models:
            raise InputError(f"{path}: SRC: must be a list of reconstructions, as OpenSfM writes it")
        models = [require_object(own, f"{path}: [{k}]") for k, own in enumerate(models)]
        shots = [require_object(own.get("shots"), f"{path}: [{k}].shots") for k, own in enumerate(models)]
        best = self.largest(shots, "reconstructions")
        cameras = require_object(models[best].get("cameras"), f"{path}: [{best}].cameras")
        said = [*models[best]]
        for name, shot in sorted(shots[best].items()):
            what = f"{path}: shots {name[:99]!r}"
            turn = matrix(require_object(shot, what).get("rotation"), (3,), f"{what}.rotation")
            shift = matrix(shot.get("translation"), (3,), f"{what}.translation")
            said += [f"shots/{key}" for key in shot]
            if image := self.photograph(name, what):
                camera = require_object(cameras.get(str(shot.get("camera"))), f"{what}.camera")
                lens = opensfm_lens(camera, image, f"{path}: cameras {str(shot['camera'])[:99]!r}")
                kind = str(camera.get("projection_type", "perspective"))
                terms = {term for own in TERMS.values() for term in own}.difference(TERMS[kind])  # of other kinds
                said += [f"cameras/{kind}/{key}" if key in terms else f"cameras/{key}" for key in camera]
                yield Frame(image, lens, camera_to_world(Rotation.from_rotvec(turn).as_matrix(), shift), said=name)
        self.tell_unused(path, said)


def opensfm_lens(given: dict[str, Any], image: Path, what: str) -> Lens:
    """Make the lens of an OpenSfM camera. `given`: the JSON object of the camera.

    `image`: a photograph that it took, for the size. OpenSfM divides lengths by the longer side of the photograph, and
    measures positions from its centre. Raises InputError if a field is invalid. The message begins with `what`.
    """

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
