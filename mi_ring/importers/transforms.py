"""Importer of the file transforms.json of NeRF, instant-ngp and nerfstudio."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, opencv_lens, pinhole_lens
from mi_ring.importers.frames import OPENGL, Frame, Light
from mi_ring.importers.named_photographs import NamedPhotographs
from mi_ring.importers.reading import image_size, images_below, load_json, matrix

#: Fields that give focal lengths, by kind. If a frame has fields of one kind, those of the whole file of other kinds do
#: not apply to it.
FOCAL = (
    {"fl_x", "fl_y"}, {"camera_angle_x", "camera_angle_y", "x_fov", "y_fov"}, {"camera_intrinsics"},
    {"intrinsic_matrix"},
)  # fmt: skip


@dataclass(frozen=True)
class Transforms(NamedPhotographs):
    """transforms.json of NeRF, instant-ngp, nerfstudio. The fields pl_pos and pl_intensity of a frame give its light.

    SRC is the file, or a folder with transforms.json or transforms_train.json.
    """

    fields = Fields(
        used={
            "file_path img_path": "the photograph",
            "transform_matrix": "the pose, camera-to-world",
            "from_na": "NeuS2: the axes of the camera are OpenCV's",
            "mask_path": "the mask",
            "pl_pos pl_intensity": "position and intensity of the light",
            "w h": "size of the photograph; without it, that of the file",
            "fl_x fl_y cx cy": "focal lengths and principal point",
            "camera_angle_x camera_angle_y x_fov y_fov": "fields of view [rad; degrees]",
            "camera_intrinsics intrinsic_matrix": "focal lengths and principal point",
            "camera_model is_fisheye": "the kind of lens",
            "k1 k2 k3 k4 p1 p2": "distortion",
        },
        refused={
            "distortion_params p3 p4 k5 k6 s1 s2 s3 s4": "such lenses; undistort the photographs first",
            "ftheta_* lens_mode latlong equirectangular orthographic": "such lenses; undistort the photographs first",
            "rolling_shutter transform_matrix_start transform_matrix_end": "a camera that moved during the exposure",
            "from_mitsuba": "such axes of the camera",
            "fix_premult": "colours that are divided by alpha",
        },
        told={"fisheye_crop_radius": "a mask of the lens", "is_hdr driver_parameters": "other light or colours"},
        harmless={
            "aabb_scale aabb render_aabb render_aabb_to_local scale offset scene_scale": "the scene's place in a box",
            "applied_transform applied_scale": "what was done to the poses already",
            "orientation_override auto_scale_poses_override": "what would be done to the poses",
            "depth_path depth_file_path normal_path normal_file_path semantics_path": "other maps",
            "enable_depth_* integer_depth_scale depth_unit_scale_factor enable_ray_loading": "other maps",
            "n_frames n_extra_learnable_dims envmap_resolution wants_importance_sampling": "settings of a method",
            "train_filenames val_filenames test_filenames": "lists of photographs; all are used",
            "rotation time timestamp sharpness blur_score": "of the animation that made the photograph, or its quality",
            "colmap_im_id colmap_id camera_label ply_file_path": "names of other files and in them",
            "up white_transparent black_transparent mask_color": "how to show the scene",
            "frames": "holds the others",
        },
    )

    names = "transforms.json", "transforms_train.json"

    @property
    def folder(self) -> Path:
        return self.images or (self.beside if images_below(self.beside) else super().folder)

    def posed(self) -> Iterator[Frame]:
        path = self.cameras
        top = load_json(path)
        frames = top.get("frames") if isinstance(top, dict) else None
        if not isinstance(frames, list) or not frames:
            raise InputError(f"{path}: frames: found none; must be a list of photographs")
        if others := [file.name for file in sorted(path.parent.glob("transforms*.json")) if file.name != path.name]:
            self.notes.append(f"{path.parent}: not used: {', '.join(others[:9])}; convert each to a scene of its own")
        said: dict[str, None] = {}
        for number, own in enumerate(frames):
            where = f"frames[{number}]"
            if not isinstance(own, dict):
                raise InputError(f"{path}: {where}: is no object")
            name = own.get("file_path", own.get("img_path"))
            if not isinstance(name, str):
                raise InputError(f"{path}: {where}.file_path: missing; must be the name of an image file")
            if (image := self.photograph(name, f"{path}: {where}.file_path", relative=True)) is None:
                continue
            given = set().union(*(kind for kind in FOCAL if kind & own.keys()))
            replaced = set().union(*FOCAL) - given if given else set()
            fields = {key: value for key, value in top.items() if key not in {"frames", *replaced}} | own
            pose = matrix(own.get("transform_matrix"), (4, 4), f"{path}: {where}.transform_matrix")
            if not fields.get("from_na"):  # NeuS2's sign of OpenCV's axes
                pose = pose @ OPENGL
            said.update(dict.fromkeys(fields))
            camera = transforms_camera(fields, image, f"{path}: {where}")
            mask = fields.get("mask_path")
            frame = Frame(image, camera, pose, said=name)
            if mask is not None:
                frame.mask = self.mask_at(str(mask), image, f"{path}: {where}.mask_path")
            intensity = np.ones(3)
            if (rgb := fields.get("pl_intensity")) is not None:
                rgb = [rgb] * 3 if isinstance(rgb, int | float) else rgb
                intensity = matrix(rgb, (3,), f"{path}: {where}.pl_intensity")
                frame.light = frame.at_camera(intensity)
            if (position := fields.get("pl_pos")) is not None:
                frame.light = Light("point", matrix(position, (3,), f"{path}: {where}.pl_pos"), intensity)
            yield frame
        self.tell_unused(path, said)


def transforms_camera(given: dict, image: Path, where: str) -> Lens:
    """Make the lens of a frame in transforms.json. `image`: its photograph, for the size if the file lacks it.

    `given`: the fields of the frame, and of the whole file where the frame lacks them. Raises InputError if a field is
    invalid or not supported. The message begins with `where`.
    """

    def number(*names: str, default: float | None = None) -> float:
        value = next((given[name] for name in names if given.get(name) is not None), default)
        return float(matrix(value, (), f"{where}.{names[0]}"))

    def angle(name: str) -> float:
        if not 0 < (value := number(name)) < math.pi:
            raise InputError(f"{where}.{name}: is {value}; must be between 0 and pi")
        return value

    said = any(given.get(name) is not None for name in ("w", "h"))
    size: Any = (number("w"), number("h")) if said else image_size(image)  # Lens truncates
    width, height = size
    for name in given:
        kind, why = Transforms.fields.kind_of(name)
        if kind == "refused" and any(np.ravel(given[name] or 0).tolist()):
            raise InputError(f"{where}.{name}: is {str(given[name])[:60]}, which is not supported: {why}")
    for name, fov in (("camera_angle_x", "x_fov"), ("camera_angle_y", "y_fov")):
        if fov in given:  # instant-ngp's, in degrees
            given = {name: math.radians(number(fov))} | given
    fx: float | None = None
    fy: float | None = None
    if (rows := given.get("intrinsic_matrix")) is not None:  # NeuS2's
        what = f"{where}.intrinsic_matrix"
        K = matrix(rows, (4, 4) if isinstance(rows, list) and len(rows) == 4 else (3, 3), what)
        fx, fy, cx, cy = pinhole_lens(K[:3, :3], size, 0.0, what).params
    elif given.get("camera_intrinsics") is not None:
        cx, cy, fx, fy = matrix(given["camera_intrinsics"], (4,), f"{where}.camera_intrinsics")
    else:
        if "camera_angle_y" in given:
            fx = fy = 0.5 * height / math.tan(0.5 * angle("camera_angle_y"))
        if "camera_angle_x" in given:
            fx = 0.5 * width / math.tan(0.5 * angle("camera_angle_x"))
            fy = fx if fy is None else fy
        fx = number("fl_x", default=fx)
        fy = number("fl_y", default=fy if "fl_x" not in given else fx)
        cx, cy = number("cx", default=width / 2), number("cy", default=height / 2)
    k1, k2, k3, k4, p1, p2 = (number(name, default=0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = given.get("camera_model") or "OPENCV"
    if model == "OPENCV_FISHEYE" or given.get("is_fisheye"):
        return Lens("OPENCV_FISHEYE", size, (fx, fy, cx, cy, k1, k2, k3, k4))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise InputError(f"{where}.camera_model: is {model}; must be OPENCV, OPENCV_FISHEYE or PINHOLE")
    if k4:
        raise InputError(f"{where}.k4: is {k4}; OPENCV has no such term of distortion, must be 0")
    return opencv_lens(size, (fx, fy, cx, cy), (k1, k2, k3), (p1, p2))
