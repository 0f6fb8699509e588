"""Importer of the file cam_dict_norm.json of IRON."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import camera_to_world, pinhole_lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.named_photographs import NamedPhotographs
from mi_ring.importers.reading import image_size, load_json, matrix


@dataclass(frozen=True)
class Iron(NamedPhotographs):
    """IRON: cam_dict_norm.json beside a folder image. The light is at the camera.

    SRC is the file, or a folder with cam_dict_norm.json or train/cam_dict_norm.json.
    """

    fields = Fields(used={"K": "calibration matrix", "W2C": "pose, world-to-camera", "img_size": "of the photograph"})

    names = "cam_dict_norm.json", "train/cam_dict_norm.json"

    @property
    def folder(self) -> Path:
        return self.images or self.beside / "image"

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        cameras = load_json(path)
        if not isinstance(cameras, dict) or not all(isinstance(camera, dict) for camera in cameras.values()):
            raise InputError(f"{path}: must be an object with an object K, W2C, img_size for each photograph")
        self.tell_unused(path, (name for camera in cameras.values() for name in camera))
        for key in sorted(cameras):  # the keys end in .png, but the files may have another suffix
            if (image := self.photograph(key, f"{path}: {key}")) is None:
                continue
            K = matrix(cameras[key].get("K"), (16,), f"{path}: {key}.K").reshape(4, 4)
            to_camera = matrix(cameras[key].get("W2C"), (16,), f"{path}: {key}.W2C").reshape(4, 4)
            size = matrix(cameras[key].get("img_size", image_size(image)), (2,), f"{path}: {key}.img_size")
            pose = camera_to_world(to_camera[:3, :3], to_camera[:3, 3])
            yield Frame(image, pinhole_lens(K, size, 0.0, f"{path}: {key}.K"), pose, said=key)
