"""Importer of Record3D's exports."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, pose_of, rotation_of
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import by_key, list_images, load_json, matrix, require_object


@dataclass(frozen=True)
class Record3D(Photogrammetry):
    """Record3D: metadata.json beside a folder rgb. The light is fixed to the camera.

    SRC is metadata.json or its folder. The file of a photograph is named by its number, for example rgb/7.jpg. Pose
    number 7 in metadata.json belongs to it. A pose is a quaternion x y z w and a position, camera-to-world. The
    camera looks along its -z axis, and its y axis points up. The lens is perFrameIntrinsicCoeffs (fx, fy, cx, cy),
    or else K (by columns).
    """

    fields = Fields(
        used={"K perFrameIntrinsicCoeffs w h": "lenses", "poses": "camera-to-world"},
        harmless={
            "dw dh depthScale": "depth maps", "fps frameTimestamps cameraType": "of the recording",
            "initPose": "the poses are not relative to it",
        },
    )  # fmt: skip

    names = ("metadata.json",)

    @property
    def folder(self) -> Path:
        return self.images or self.beside / "rgb"

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        given = require_object(load_json(path), str(path))
        poses, size = given.get("poses"), matrix([given.get("w"), given.get("h")], (2,), f"{path}: w, h")
        if not isinstance(poses, list) or not poses:
            raise InputError(f"{path}: poses: found none; must be a list of 7 numbers for each photograph")
        lenses = given.get("perFrameIntrinsicCoeffs") or []
        if lenses:
            lenses = matrix(lenses, (len(poses), 4), f"{path}: perFrameIntrinsicCoeffs")
        else:
            K = matrix(given.get("K"), (9,), f"{path}: K").reshape(3, 3).T
            if K[2, :2].any() or K[0, 1] or K[1, 0]:
                raise InputError(f"{path}: K: is {K.T.ravel()}; must be fx 0 0 0 fy 0 cx cy 1, by columns")
            lenses = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (len(poses), 1))
        files = [file for file in list_images(self.folder) if file.stem.isdecimal()]
        names = {number: file.name for number, file in by_key(files, lambda file: int(file.stem)).items()}
        for k, (own, params) in enumerate(zip(poses, lenses)):
            what = f"{path}: poses[{k}]"
            numbers = matrix(own, (7,), what)
            pose = pose_of(rotation_of(numbers[:4], f"{what}: its quaternion"), numbers[4:])
            if image := self.photograph(name := names.get(k, f"{k}.jpg"), what):
                yield Frame(image, Lens("PINHOLE", (size[0], size[1]), tuple(params)), pose @ OPENGL, said=name)
        self.tell_unused(path, given)
