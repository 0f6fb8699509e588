"""meta_data.json of SDFStudio."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import pinhole_lens
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, load_json, matrix, require_object


@dataclass(frozen=True)
class SdfStudio(Photogrammetry):
    """SDFStudio: meta_data.json. The light is fixed to the camera.

    SRC is the file or its folder. The cameras have OpenCV's axes. Meshes stay in the frame of the cameras: worldtogt,
    which maps them to the frame of the true mesh, is not applied.
    """

    fields = Fields(
        used={
            "frames": "holds the others", "frames/rgb_path": "the photograph", "frames/foreground_mask": "the mask",
            "frames/camtoworld": "pose, camera-to-world", "frames/intrinsics": "focal lengths and principal point",
            "height width": "size of the photographs",
        },
        refused={"camera_model=*": "lenses other than OPENCV without distortion"},
        told={"worldtogt": "the frame of the true mesh; the cameras keep theirs"},
        harmless={
            "camera_model": "refused unless OPENCV", "scene_box/*": "the scene's place in a box",
            "has_* pairs": "which other maps there are",
            "frames/mono_* frames/sensor_depth_path frames/sfm_sparse_points_view": "other maps",
        },
    )  # fmt: skip

    names = ("meta_data.json",)

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        top = require_object(load_json(path), str(path))
        frames = top.get("frames")
        if not isinstance(frames, list) or not frames:
            raise InputError(f"{path}: frames: found none; must be a list of photographs")
        if (model := top.get("camera_model", "OPENCV")) != "OPENCV":
            raise InputError(f"{path}: camera_model: is {str(model)[:60]!r}; must be OPENCV")
        size: Any = None
        if "width" in top and "height" in top:
            size = matrix([top["width"], top["height"]], (2,), f"{path}: width, height")
        said = [key for key in top if key != "worldtogt" or not np.array_equal(top[key], np.eye(4))]
        for number, own in enumerate(frames):
            what = f"{path}: frames[{number}]"
            name = require_object(own, what).get("rgb_path")
            if not isinstance(name, str):
                raise InputError(f"{what}.rgb_path: missing; must be the name of an image file")
            if (image := self.photograph(name, f"{what}.rgb_path", relative=True)) is None:
                continue
            said += [f"frames/{key}" for key in own]
            rows = own.get("intrinsics")
            K = matrix(rows, (4, 4) if isinstance(rows, list) and len(rows) == 4 else (3, 3), f"{what}.intrinsics")
            lens = pinhole_lens(K[:3, :3], image_size(image) if size is None else size, 0.0, f"{what}.intrinsics")
            frame = Frame(image, lens, matrix(own.get("camtoworld"), (4, 4), f"{what}.camtoworld"), said=name)
            if (mask := own.get("foreground_mask")) is not None:
                frame.mask = self.mask_at(str(mask), image, f"{what}.foreground_mask")
            yield frame
        self.tell_unused(path, said)
