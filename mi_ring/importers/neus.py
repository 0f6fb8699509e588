"""Importer of the file cameras_sphere.npz of IDR, NeuS and WildLight."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.foreign import load_npy, load_npz
from mi_ring.importers.camera_models import decompose_projection, pinhole_lens
from mi_ring.importers.frames import Frame, Source
from mi_ring.importers.photograph_files import MASKS
from mi_ring.importers.reading import entry, first_file, has_alpha, image_size, matrix, numbered_images


@dataclass(frozen=True)
class Neus(Source):
    """IDR, NeuS, WildLight: cameras_sphere.npz or cameras.npz, folders image and mask. The light is at the camera.

    SRC is the folder. Without a folder of masks, alpha channels are the masks. WildLight's light_energy_* become light
    intensities. WildLight's photographs without flash are left out.
    """

    fields = Fields(
        used={
            "world_mat_*": "projection matrices", "scale_mat_*": "the unit of light_energy_*",
            "light_energy_*": "WildLight: intensity of the flash", "max_intensity": "WildLight: where pixels clip",
        },
        harmless={
            "world_mat_inv_* scale_mat_inv_*": "inverses of other fields",
            "camera_mat_* camera_mat_inv_*": "parts of world_mat_*",
        },
    )  # fmt: skip

    def frames(self) -> Iterator[Frame]:
        path = first_file([self.src / "cameras_sphere.npz", self.src / "cameras.npz"], "SRC")
        cameras = load_npz(path)
        self.tell_unused(path, cameras)
        numbers = sorted(int(key[10:]) for key in cameras if re.fullmatch(r"world_mat_\d+", key))
        place = next(
            (own for name in ("image", "images", "rgb") if (own := self.src / name).is_dir()), self.src / "image"
        )
        images, array = numbered_images(place), self.src / "images.npy"
        if array.is_file():
            stack = load_npy(array)
            if stack.ndim != 4 or stack.shape[3] != 3 or len(stack) != len(numbers) or stack.dtype.kind not in "fiu":
                raise InputError(f"{array}: is of shape {stack.shape}, must be ({len(numbers)}, H, W, 3) numbers: "
                                 f"one photograph for each world_mat in {path.name}")  # fmt: skip
            images = dict.fromkeys(numbers, array)
        elif not images:
            raise InputError(f"{self.src}: image: no photographs in this folder, and no images.npy")
        energies = any(key.startswith("light_energy_") for key in cameras)
        if not set(images) <= set(numbers):  # the names are not the cameras' numbers: match them by order
            if len(images) != len(numbers):
                raise InputError(f"{path}: world_mat: there are {len(numbers)}, but {len(images)} photographs in "
                                 f"{place}; must be as many")  # fmt: skip
            images = dict(zip(numbers, [images[n] for n in sorted(images)]))
        self.without_photograph.extend(f"world_mat_{k}" for k in numbers if k not in images)
        masks = self.masks(images)
        for k, image in images.items():
            pixels = stack[numbers.index(k)].astype(np.float32) if image == array else None
            size = image_size(image) if pixels is None else pixels.shape[1::-1]
            what = f"{path}: world_mat_{k}"
            K, pose = decompose_projection(entry(cameras, f"world_mat_{k}", (4, 4), path)[:3], what)
            frame = Frame(image, pinhole_lens(K, size, 0.5, what), pose, masks.get(k), name=f"{k:03}", pixels=pixels)
            if not masks and pixels is None and has_alpha(image):
                frame.mask = image
            if energies:
                energy = np.ravel(cameras.get(f"light_energy_{k}", 0.0))
                energy = matrix(np.repeat(energy, 3) if len(energy) == 1 else energy, (3,), f"{path}: light_energy_{k}")
                if not energy.any():
                    continue
                unit = entry(cameras, f"scale_mat_{k}", (4, 4), path)[0, 0]  # energies refer to the unit sphere
                frame.light = frame.at_camera(energy * unit**2)
                frame.encoding = "linear"
                if "max_intensity" in cameras:
                    frame.saturation = float(matrix(np.squeeze(cameras["max_intensity"]), (), f"{path}: max_intensity"))
                    if frame.saturation <= 0:
                        raise InputError(f"{path}: max_intensity: is {frame.saturation}; must be positive")
            yield frame

    def masks(self, images: dict[int, Path]) -> dict[int, Path]:
        """Find the masks of photographs. Returns paths by the photograph's number; empty if there are no masks.

        `images`: the photographs by number. Masks have the names of the photographs, or other names in the same order.
        Raises InputError if only some photographs have a mask.
        """
        folder = next((place for name in MASKS if (place := self.src / name).is_dir()), self.src / "mask")
        files = numbered_images(folder)
        by_name = {file.stem: file for file in files.values()}
        found = {k: by_name[image.stem] for k, image in images.items() if image.stem in by_name}
        if len(found) < len(images) == len(files) and (not found or files.keys() == images.keys()):
            found = dict(zip(sorted(images), [files[n] for n in sorted(files)]))
        if files and (missing := sorted(images.keys() - found)):
            name = images[missing[0]].name
            raise InputError(f"{folder}: no mask of photograph {missing[0]}, {name}; give all or none")
        return found
