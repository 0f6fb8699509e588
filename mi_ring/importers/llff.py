"""Importer of the file poses_bounds.npy of LLFF and NeRF."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.foreign import load_npy
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import existing, image_size, list_images, matrix


@dataclass(frozen=True)
class Llff(Photogrammetry):
    """LLFF, NeRF: poses_bounds.npy beside folders images, images_4, … The light is fixed to the camera.

    SRC is the folder of poses_bounds.npy. The photographs are in its folder images. If this has none, they are in
    images_4 or the like. The order of the photographs by name must be the order of the poses.
    """

    fields = Fields(
        used={"rotation translation": "poses, camera-to-world; axes down, right, back", "height width focal": "lenses"},
        harmless={"near far": "the range of depth"},
    )

    def posed(self) -> Iterator[Frame]:
        path = existing(self.src / "poses_bounds.npy", "SRC")
        array = load_npy(path)
        if array.ndim != 2 or array.shape[1] != 17:
            raise InputError(f"{path}: is of shape {array.shape}; must be N x 17 numbers")
        poses = matrix(array, array.shape, str(path))[:, :15].reshape(-1, 3, 5)
        reduced = sorted(self.src.glob("images_*"), key=lambda f: (len(f.name), f.name))  # images_4 before images_16
        folders = [self.src / "images", *reduced, self.src]
        folder = self.images or next((f for f in folders if list_images(f)), folders[0])
        images = list_images(folder)
        if len(images) != len(poses):
            raise InputError(f"{folder}: has {len(images)} photographs, {path.name} {len(poses)} poses; must be as "
                             "many, or give --images")  # fmt: skip
        for k, (image, own) in enumerate(zip(images, poses)):
            pose = np.eye(4)
            pose[:3] = own[:, [1, 0, 2, 3]] * [1, 1, -1, 1]  # LLFF's axes are down, right, back
            height, width, focal = own[:, 4]
            size = image_size(image)
            if min(own[:, 4]) <= 0 or abs(size[0] / width * height - size[1]) > 2:  # reduced sizes are rounded
                raise InputError(f"{image}: is {size[0]} x {size[1]} pixels, not proportional to the {width:g} x "
                                 f"{height:g} of pose {k} in {path.name}")  # fmt: skip
            params = (focal * size[0] / width, focal * size[1] / height, size[0] / 2, size[1] / 2)
            yield Frame(image, Lens("PINHOLE", size, params), pose, said=image.name)
