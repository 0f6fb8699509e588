"""A dataset of DiLiGenT: photographs of an object by one camera under many lights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_ring.capture.emitter_elements import Element
from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.collection.jobs import modified
from mi_ring.errors import InputError, require_file
from mi_ring.experiments.datasets import CachedDataset
from mi_ring.foreign import load_npz
from mi_ring.geometry.camera import Camera
from mi_ring.images import write_image
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Shot
from mi_ring.system.files import write_file

DISTANCE = 1500.0  #: assumed, from the camera to the object [mm]; one camera does not determine it
TO_MITSUBA = np.array([-1.0, 1.0, -1.0])  #: factors that convert axes x right, y up, z back to Mitsuba's camera axes
DIMENSIONS = {"mask": 2, "pixels_uint16": 3, "light_dir": 2, "light_int": 2, "normal_gt": 3, "K": 2}  #: of the arrays
MANUAL = "docs/how-to/paper.md"  #: describes these arrays


@dataclass(frozen=True)
class SingleView(CachedDataset):
    """DiLiGenT's photographs of an object by one real camera under 96 lights, in an .npz file.

    The file has these arrays: `mask` (H, W), `pixels_uint16` (lights, pixels of the mask, 3), `light_dir` (lights, 3; x
    right, y up, z to the viewer), `light_int` (lights, 3), `normal_gt` (H, W, 3; same axes, 0 where unknown) and `K`
    (3, 3), the camera's intrinsics.
    """

    file: Path

    def read(self) -> dict[str, np.ndarray]:
        """Read the .npz file. Returns a dict from names to arrays.

        Raises InputError if an array is missing or has another shape or type than it should have.
        """
        require_file(self.file, "an .npz of DiLiGenT's photographs from one side")
        arrays = load_npz(self.file)
        for name, dimensions in DIMENSIONS.items():
            if name not in arrays or arrays[name].ndim != dimensions:
                raise InputError(f"{self.file}: has no array {name} of {dimensions} dimensions; see {MANUAL}")
        if (kind := arrays["pixels_uint16"].dtype) != np.uint16:
            raise InputError(f"{self.file}: pixels_uint16: is of {kind}, must be of uint16, linear; see {MANUAL}")
        mask, lights = arrays["mask"], len(arrays["pixels_uint16"])
        shapes = {"pixels_uint16": (lights, int((mask > 0).sum()), 3), "light_dir": (lights, 3),
                  "light_int": (lights, 3), "normal_gt": (*mask.shape, 3), "K": (3, 3)}  # fmt: skip
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise InputError(f"{self.file}: {name}: is of shape {arrays[name].shape}, must be {shape} by mask and "
                                 f"number of photographs; see {MANUAL}")  # fmt: skip
        return arrays

    @property
    def truth_files(self) -> list[Path]:
        return [self.file]

    def origin(self) -> dict[str, Any]:
        return {"file": str(self.file.resolve()), "written": modified(self.file)}

    def write(self, folder: Path) -> None:
        """Write a scene of 16-bit photographs to `folder`.

        The camera is at the origin, looks along z, and is 1.5 m from the object.
        """
        data = self.read()
        mask, K = data["mask"] > 0, data["K"]
        height, width = mask.shape
        focal, centre = np.array([K[0, 0], K[1, 1]]), np.array([K[0, 2], K[1, 2]])
        camera = Camera(np.eye(4), focal, centre + 0.5, (width, height))
        (folder / "images").mkdir(parents=True)
        write_image(mask[..., None].astype(np.uint8) * 255, folder / "mask.png")
        elements: list[Element] = []
        lights = zip(data["pixels_uint16"], data["light_dir"], data["light_int"], strict=True)
        for k, (pixels, to_light, rgb) in enumerate(lights):
            image = np.zeros((height, width, 3), np.uint16)
            image[mask] = pixels
            file = f"images/{k:03}.png"
            write_image(image, folder / file)
            light = Light("directional", -TO_MITSUBA * to_light, np.asarray(rgb, float))
            files = Files(Path(file), Path("mask.png"))
            elements.append(photograph_element(Shot(f"{k:03}", camera, light, files=files)))
        middle = DISTANCE * np.append((centre - np.argwhere(mask).mean(0)[::-1]) / focal, 1)
        radius = np.sqrt(mask.sum() / np.pi) * DISTANCE / focal[0]
        write_file(folder / "scene.xml", scene_bytes(scene_element(elements, middle, radius)))
