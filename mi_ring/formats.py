"""Other people's capture formats, as options of `mi_ring.convert` and as readers: each gives frames.

Conventions of the sources are undone here: a frame has its camera in OpenCV's axes, x right, y down, z forward, and its
pixels' centres at (0.5, 0.5), (1.5, 0.5), …
"""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import mitsuba as mi
import numpy as np
import pycolmap
import scipy.io
import scipy.linalg
from PIL import ExifTags, Image
from tyro.conf import Positional, arg

from mi_ring.capture import read_file
from mi_ring.errors import InputError

SUFFIXES = (".png", ".exr", ".tif", ".tiff", ".jpg", ".jpeg")  #: of photographs
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  #: axes of an OpenGL camera, x right, y up, z back, in OpenCV's


class Light(NamedTuple):
    """Of one photograph, in the world."""

    kind: Literal["point", "directional"]
    vector: np.ndarray  #: (3,) position, or direction in which the light travels
    rgb: np.ndarray  #: (3,) intensity or irradiance


@dataclass
class Frame:
    """A photograph, its camera and its light."""

    image: Path
    camera: pycolmap.Camera  #: size, focal lengths, principal point, distortion [px]
    pose: np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes
    mask: Path | None = None  #: of the same size; `image` itself if its alpha channel is meant
    light: Light | None = None  #: None: a point light of intensity 1 at the camera
    saturation: float | None = None  #: encoded value at which pixels are clipped, if not full scale
    encoding: str | None = None  #: "srgb" or "linear", if it is not what the type of file implies
    name: str = ""  #: in the scene; that of the file, without suffix, if empty
    pixels: np.ndarray | None = None  #: of an image that is no file yet, (H, W, 3) float32
    fill_mask: bool = False  #: fill the holes in the mask

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]"""
        return self.camera.width, self.camera.height

    def at_camera(self, rgb, offset=(0, 0, 0)) -> Light:
        """A point light beside this frame's camera, `offset` in the camera's axes [scene units]."""
        return Light("point", self.pose[:3, :3] @ np.array(offset, float) + self.pose[:3, 3], np.array(rgb, float))


@dataclass(frozen=True)
class Source:
    """What all formats have in common."""

    src: Positional[Annotated[Path, arg(metavar="SRC")]]
    """Where the data is."""
    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Scene file to write. What belongs to it and is no file yet goes into a folder of its name."""
    copy: bool = False
    """Copy the photographs beside the scene file instead of referring to where they are."""
    encoding: Literal["auto", "srgb", "linear"] = "auto"
    """Of the photographs. auto: as the format says, else 8-bit files are sRGB and others linear. Linear ones of 8 bits
    are written anew with 16."""


@dataclass(frozen=True)
class DiligentMV(Source):
    """DiLiGenT-MV: an object on a turntable, 20 views under 96 distant lights each.

    SRC is an object's folder, such as mvpmsData/bearPNG, with Calib_Results.mat, view_01, view_02, …
    """

    views: tuple[int, ...] = ()
    """Views to take, from 1. Default: all."""
    lights: tuple[int, ...] = ()
    """Lights to take, from 1. Default: all."""
    fill_holes: bool = False
    """Fill holes in the masks. Those of the bear are faults of the masks; those of pot and cow are in the object."""

    def frames(self) -> Iterator[Frame]:
        calibration = load_mat(self.src / "Calib_Results.mat")
        numbers = {int(f.name[5:]): f for f in self.src.glob("view_*") if f.name[5:].isdigit()}
        if not numbers:
            raise InputError(f"{self.src}: SRC: no folders view_01, view_02, …; give the folder of one object")
        K = entry(calibration, "KK", (3, 3), self.src / "Calib_Results.mat")
        for view in chosen(self.views, numbers, "--views", self.src):
            folder = numbers[view]
            R = entry(calibration, f"Rc_{view}", (3, 3), self.src / "Calib_Results.mat")
            t = entry(calibration, f"Tc_{view}", (3, 1), self.src / "Calib_Results.mat")
            pose = inverse(R, t[:, 0])
            mask = existing(folder / "mask.png", "mask")
            camera = pinhole(K, image_size(mask), 0.5, f"{self.src / 'Calib_Results.mat'}: KK")
            directions = load_table(folder / "light_directions.txt", 3)
            intensities = load_table(folder / "light_intensities.txt", 3)
            if len(directions) != len(intensities):
                raise InputError(f"{folder / 'light_intensities.txt'}: has {len(intensities)} lines, "
                                 f"light_directions.txt {len(directions)}; must be as many")  # fmt: skip
            for light in chosen(self.lights, range(1, len(directions) + 1), "--lights", folder):
                to_light = pose[:3, :3] @ OPENGL[:3, :3] @ directions[light - 1]
                yield Frame(
                    existing(folder / f"{light:03}.png", "photograph"), camera, pose, mask,
                    Light("directional", -to_light, intensities[light - 1]), name=f"{view:02}_{light:03}",
                    fill_mask=self.fill_holes,
                )  # fmt: skip

    @property
    def truth(self) -> Path | None:
        """The true mesh, where there is one."""
        mesh = self.src / "mesh_Gt.ply"
        return mesh if mesh.is_file() else None


@dataclass(frozen=True)
class Transforms(Source):
    """transforms.json of NeRF, instant-ngp, nerfstudio; the frames' pl_pos and pl_intensity are their lights.

    SRC is the file, or a folder with transforms.json or transforms_train.json.
    """

    def frames(self) -> Iterator[Frame]:
        path = self.src
        if path.is_dir():
            path = first_file([path / "transforms.json", path / "transforms_train.json"], "SRC")
        top = load_json(path)
        frames = top.get("frames") if isinstance(top, dict) else None
        if not isinstance(frames, list) or not frames:
            raise InputError(f"{path}: frames: found none; must be a list of photographs")
        for number, own in enumerate(frames):
            where = f"frames[{number}]"
            if not isinstance(own, dict):
                raise InputError(f"{path}: {where}: is no object")
            name = own.get("file_path", own.get("img_path"))
            if not isinstance(name, str):
                raise InputError(f"{path}: {where}.file_path: missing; must be the name of an image file")
            image = with_suffix(path.parent / name, f"{path}: {where}.file_path")
            pose = matrix(own.get("transform_matrix"), (4, 4), f"{path}: {where}.transform_matrix") @ OPENGL
            camera = transforms_camera({**top, **own}, image, f"{path}: {where}")
            mask = own.get("mask_path")
            frame = Frame(image, camera, pose)
            if mask is not None:
                frame.mask = existing(path.parent / str(mask), f"{where}.mask_path")
            elif has_alpha(image):
                frame.mask = image
            intensity = np.ones(3)
            if own.get("pl_intensity") is not None:
                rgb = own["pl_intensity"]
                rgb = [rgb] * 3 if isinstance(rgb, int | float) else rgb
                intensity = matrix(rgb, (3,), f"{path}: {where}.pl_intensity")
                frame.light = frame.at_camera(intensity)
            if own.get("pl_pos") is not None:
                position = matrix(own["pl_pos"], (3,), f"{path}: {where}.pl_pos")
                frame.light = Light("point", position, intensity)
            yield frame


@dataclass(frozen=True)
class Colmap(Source):
    """COLMAP, text or binary; the light is beside the camera.

    SRC is the folder of the model (cameras, images), or one that holds it as sparse/0 or sparse.
    """

    images: Path | None = None
    """Folder of the photographs. Default: the nearest `images` beside or above the model."""
    masks: Path | None = None
    """Folder of masks, each called like its photograph with .png added, as COLMAP's are, or instead of its suffix."""
    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the light from the camera, in the camera's axes (x right, y down, z forward) [scene units]."""
    exif: bool = True
    """Bring the photographs to one scale by the exposure time, ISO and aperture in their EXIF data."""

    def frames(self) -> Iterator[Frame]:
        folders = (self.src, self.src / "sparse" / "0", self.src / "sparse")
        model = next((f for f in folders if (f / "images.bin").is_file() or (f / "images.txt").is_file()), None)
        if model is None:
            raise InputError(f"{self.src}: SRC: neither images.bin nor images.txt, nor a folder sparse/0 with them")
        try:
            pycolmap.logging.minloglevel = pycolmap.logging.FATAL  # what it has to say is in the exception
            reconstruction = pycolmap.Reconstruction(str(model))
        except Exception as error:
            raise InputError(f"{model}: not a COLMAP model ({' '.join(str(error).split())})") from error
        if not reconstruction.num_reg_images():
            raise InputError(f"{model}: images: no photograph has a pose")
        beside = [f / "images" for f in (self.src, model, model.parent, model.parent.parent)]
        images = self.images or next((f for f in beside if f.is_dir()), None)
        if images is None:
            raise InputError(f"{self.src}: --images: no folder images beside or above {model}; give it")
        found = sorted((reconstruction.images[k] for k in reconstruction.reg_image_ids()), key=lambda image: image.name)
        frames = []
        for image in found:
            path = existing(images / image.name, "photograph")
            pose = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
            name = str(Path(image.name).with_suffix("")).replace("/", "_")
            frame = Frame(path, reconstruction.cameras[image.camera_id], pose, name=name)
            if self.masks:
                names = (f"{image.name}.png", str(Path(image.name).with_suffix(".png")))
                frame.mask = first_file([self.masks / n for n in names], "mask")
            frames.append(frame)
        exposures = self.exif and [exif_exposure(frame.image) for frame in frames]
        scale = np.ones(len(frames))
        if exposures and all(exposures):
            scale = exposures / np.median(exposures)
        elif exposures and any(exposures):
            k = exposures.index(None)
            raise InputError(f"{frames[k].image}: EXIF: no exposure time, ISO or aperture, but other photographs have "
                             "them; add them, or give --no-exif if all have the same exposure")  # fmt: skip
        for frame, exposure in zip(frames, scale):
            if exposure != 1 or any(self.flash_offset):
                frame.light = frame.at_camera(np.full(3, exposure), self.flash_offset)
            yield frame


@dataclass(frozen=True)
class Neus(Source):
    """IDR, NeuS, WildLight: cameras_sphere.npz or cameras.npz with folders image and mask; light at the camera.

    SRC is the folder. WildLight's light_energy_* become intensities; photographs without flash are left out.
    """

    def frames(self) -> Iterator[Frame]:
        path = first_file([self.src / "cameras_sphere.npz", self.src / "cameras.npz"], "SRC")
        cameras = load_npz(path)
        numbers = sorted(int(key[10:]) for key in cameras if re.fullmatch(r"world_mat_\d+", key))
        pictures, array = numbered(self.src / "image"), self.src / "images.npy"
        if array.is_file():
            stack = load_npz(array)
            if stack.ndim != 4 or stack.shape[3] != 3 or len(stack) != len(numbers):
                raise InputError(f"{array}: is of shape {stack.shape}, must be ({len(numbers)}, H, W, 3): "
                                 f"one photograph for each world_mat in {path.name}")  # fmt: skip
            pictures = dict.fromkeys(numbers, array)
        elif not pictures:
            raise InputError(f"{self.src}: image: no photographs in this folder, and no images.npy")
        masks = numbered(self.src / "mask")
        energies = any(key.startswith("light_energy_") for key in cameras)
        if not set(pictures) <= set(numbers):  # names that are no numbers of cameras: by their order
            if len(pictures) != len(numbers):
                raise InputError(f"{path}: world_mat: there are {len(numbers)}, but {len(pictures)} photographs")
            pictures, masks = (dict(zip(numbers, [files[n] for n in sorted(files)])) for files in (pictures, masks))
        for k, image in pictures.items():
            pixels = stack[numbers.index(k)].astype(np.float32) if image == array else None
            size = image_size(image) if pixels is None else pixels.shape[1::-1]
            projection = entry(cameras, f"world_mat_{k}", (4, 4), path)
            K, pose = decompose(projection[:3], f"{path}: world_mat_{k}")
            camera = pinhole(K, size, 0.5, f"{path}: world_mat_{k}")
            frame = Frame(image, camera, pose, masks.get(k), name=f"{k:03}", pixels=pixels)
            if masks and not frame.mask:
                raise InputError(f"{self.src / 'mask'}: no mask for photograph {k}; give all or none")
            if energies:
                energy = np.ravel(cameras.get(f"light_energy_{k}", 0.0))
                energy = matrix(np.repeat(energy, 3) if len(energy) == 1 else energy, (3,), f"{path}: light_energy_{k}")
                if not energy.any():
                    continue
                unit = entry(cameras, f"scale_mat_{k}", (4, 4), path)[0, 0]  # energies are for the object's unit sphere
                frame.light = frame.at_camera(energy * unit**2)
                frame.encoding = "linear"
                if "max_intensity" in cameras:
                    frame.saturation = float(matrix(np.squeeze(cameras["max_intensity"]), (), f"{path}: max_intensity"))
                    if frame.saturation <= 0:
                        raise InputError(f"{path}: max_intensity: is {frame.saturation}; must be positive")
            yield frame


@dataclass(frozen=True)
class Iron(Source):
    """IRON: cam_dict_norm.json with a folder image beside it; light at the camera.

    SRC is that folder, or one that holds it as train.
    """

    def frames(self) -> Iterator[Frame]:
        path = first_file([f / "cam_dict_norm.json" for f in (self.src, self.src / "train")], "SRC")
        cameras = load_json(path)
        if not isinstance(cameras, dict) or not all(isinstance(camera, dict) for camera in cameras.values()):
            raise InputError(f"{path}: must be an object with an object K, W2C, img_size for each photograph")
        for key in sorted(cameras):  # names end in .png, whatever the files' end is
            image = with_suffix((path.parent / "image" / key).with_suffix(""), f"{path}: {key}")
            K = matrix(cameras[key].get("K"), (16,), f"{path}: {key}.K").reshape(4, 4)
            to_camera = matrix(cameras[key].get("W2C"), (16,), f"{path}: {key}.W2C").reshape(4, 4)
            size = matrix(cameras[key].get("img_size", image_size(image)), (2,), f"{path}: {key}.img_size")
            pose = inverse(to_camera[:3, :3], to_camera[:3, 3])
            yield Frame(image, pinhole(K, size, 0.0, f"{path}: {key}.K"), pose)


FORMATS = {
    "diligent-mv": DiligentMV, "transforms": Transforms, "colmap": Colmap, "neus": Neus, "iron": Iron,
}  # fmt: skip


def pinhole(K: np.ndarray, size, shift: float, what: str) -> pycolmap.Camera:
    """Of a calibration matrix; `shift` [px] is what its principal point lacks to have pixels' centres at 0.5."""
    if not K[2, 2]:
        raise InputError(f"{what}: is no calibration matrix (K[2][2] is 0)")
    K = K / K[2, 2]
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise InputError(f"{what}: pixels are sheared (K[0][1] is {K[0, 1]:.4g}), which no photograph can be here; is "
                         "the matrix transposed?")  # fmt: skip
    return camera_of("PINHOLE", size, [K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift])


def camera_of(model: str, size, params) -> pycolmap.Camera:
    """One of COLMAP's camera models: https://colmap.github.io/cameras.html"""
    if not (np.isfinite(size).all() and min(size) >= 1):
        raise InputError(f"camera: is for photographs of {size[0]} x {size[1]} pixels; must be 1 or more")
    return pycolmap.Camera(model=model, width=int(size[0]), height=int(size[1]), params=[float(p) for p in params])


def transforms_camera(given: dict, image: Path, where: str) -> pycolmap.Camera:
    """The camera of one frame of transforms.json: `given` are the file's fields and above them the frame's own."""

    def number(*names, default=None):
        value = next((given[name] for name in names if given.get(name) is not None), default)
        if not isinstance(value, int | float):
            raise InputError(f"{where}.{names[0]}: is {'missing' if value is None else value}; must be a number")
        return float(value)

    def angle(name):
        if not 0 < (value := number(name)) < math.pi:
            raise InputError(f"{where}.{name}: is {value}; must be between 0 and pi")
        return value

    width, height = ("w" in given and "h" in given and (number("w"), number("h"))) or image_size(image)
    if given.get("camera_intrinsics") is not None:
        cx, cy, fx, fy = matrix(given["camera_intrinsics"], (4,), f"{where}.camera_intrinsics")
    else:
        fx = fy = None
        if "camera_angle_x" in given:
            fx = fy = 0.5 * width / math.tan(0.5 * angle("camera_angle_x"))
        if "camera_angle_y" in given:
            fy = 0.5 * height / math.tan(0.5 * angle("camera_angle_y"))
        fx = number("fl_x", default=fx)
        fy = number("fl_y", default=fy if "fl_x" not in given else fx)
        cx, cy = number("cx", default=width / 2), number("cy", default=height / 2)
    k1, k2, k3, k4, p1, p2 = (number(name, default=0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = given.get("camera_model") or "OPENCV"
    if model == "OPENCV_FISHEYE" or given.get("is_fisheye"):
        return camera_of("OPENCV_FISHEYE", (width, height), [fx, fy, cx, cy, k1, k2, k3, k4])
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise InputError(f"{where}.camera_model: is {model}; must be OPENCV, OPENCV_FISHEYE or PINHOLE")
    if k4:
        raise InputError(f"{where}.k4: is {k4}; OPENCV has no such term of distortion, must be 0")
    return camera_of("FULL_OPENCV", (width, height), [fx, fy, cx, cy, k1, k2, p1, p2, k3, 0, 0, 0])


def inverse(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Camera-to-world (4, 4) of world-to-camera x ↦ R x + t."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    return pose


def decompose(P: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Calibration matrix (3, 3) and camera-to-world (4, 4) of a projection matrix K [R | t], up to scale (3, 4)."""
    if abs(np.linalg.det(P[:, :3])) <= 1e-12 * np.linalg.norm(P[:, :3]) ** 3:
        raise InputError(f"{what}: is no projection matrix of a camera (singular)")
    K, R = scipy.linalg.rq(P[:, :3])
    signs = np.sign(np.diag(K))
    K, R = K * signs, signs[:, None] * R
    if np.linalg.det(R) < 0:  # P stands for -P as well
        R, P = -R, -P
    return K, inverse(R, np.linalg.solve(K, P[:, 3]))


def exif_exposure(path: Path) -> float | None:
    """Exposure time · ISO / aperture², to which radiance as recorded is proportional; None if EXIF lacks one."""
    if path.suffix.lower() == ".exr":
        return None
    exif = load(path, "image", read_exif)
    tags = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
    values = [exif.get(tag) for tag in tags]
    if not all(values):
        return None
    try:
        seconds, iso, f_number = (float(v[0] if isinstance(v, tuple) else v) for v in values)
        exposure = seconds * iso / f_number**2
    except (TypeError, ValueError, ZeroDivisionError):
        exposure = math.nan
    if not 0 < exposure < math.inf:
        raise InputError(f"{path}: EXIF: exposure time, ISO and aperture are {', '.join(map(str, values))}; must be "
                         "positive numbers, or give --no-exif if all photographs have the same exposure")  # fmt: skip
    return exposure


def read_exif(path: Path):
    """The part of the EXIF data that is about the exposure."""
    with Image.open(path) as image:
        return image.getexif().get_ifd(ExifTags.IFD.Exif)


def read(path: Path) -> np.ndarray:
    """Pixels (H, W, C) of an image file. Raises InputError if it cannot be read."""
    return load(path, "image", read_file)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] of an image file. Raises InputError if it cannot be read."""

    def size(file):
        if path.suffix.lower() == ".exr":
            return tuple(mi.Bitmap(str(file)).size())
        with Image.open(file) as image:
            return image.size

    return load(path, "image", size)


def has_alpha(path: Path) -> bool:
    """Does an image file have an alpha channel?"""
    if path.suffix.lower() == ".exr":
        return read(path).shape[2] in (2, 4)

    def alpha(file):
        with Image.open(file) as image:
            return image.mode in ("LA", "RGBA")

    return load(path, "image", alpha)


def existing(path: Path, field: str) -> Path:
    """A file that must be there."""
    if not path.is_file():
        raise InputError(f"{path}: {field}: no such file")
    return path


def first_file(candidates: list[Path], field: str) -> Path:
    """The first of these files that there is."""
    for path in candidates:
        if path.is_file():
            return path
    raise InputError(f"{field}: found neither {' nor '.join(map(str, candidates))}")


def with_suffix(path: Path, field: str) -> Path:
    """An image file whose name may lack its suffix."""
    if path.is_file():
        return path
    for suffix in SUFFIXES:
        if (file := path.with_name(path.name + suffix)).is_file():
            return file
    raise InputError(f"{field}: no such file: {path}, nor with any of {' '.join(SUFFIXES)}")


def numbered(folder: Path) -> dict[int, Path]:
    """Images of a folder by the numbers that they are called, or by their order if some are called otherwise."""
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES)
    if all(path.stem.isdigit() for path in files):
        return {int(path.stem): path for path in files}
    return dict(enumerate(files))


def chosen(wanted, there_are, option: str, where: Path) -> list[int]:
    """Those wanted, or all. Raises InputError if one does not exist."""
    for number in wanted:
        if number not in there_are:
            raise InputError(f"{option}: {number}: not in {where}, which has {min(there_are)} to {max(there_are)}")
    return sorted(wanted or there_are)


def matrix(values, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Finite numbers of this shape. Raises InputError for anything else."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or (array.ndim == 0 and np.isnan(array)):
        shown = "missing" if values is None else f"of shape {array.shape}" if array.size > 1 else values
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        raise InputError(f"{what}: is {shown}; must be {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{what}: has NaN or infinite numbers")
    return array


def entry(arrays, key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """An array of a .mat or .npz file."""
    return matrix(arrays.get(key), shape, f"{path}: {key}")


def load(path: Path, what: str, read):
    """`read(path)`. Raises InputError if there is no such file or if it is not what it should be."""
    try:
        return read(existing(path, what))
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: cannot be read as {what} ({' '.join(str(error).split())})") from error


def load_mat(path: Path) -> dict:
    """The variables of a MATLAB file."""
    return load(path, "MATLAB file", scipy.io.loadmat)


def load_npz(path: Path):
    """A dictionary of arrays, or the one array of a .npy file."""

    def arrays(file):
        content = np.load(file)
        return content if isinstance(content, np.ndarray) else dict(content)

    return load(path, "NumPy file", arrays)


def load_json(path: Path):
    """What a JSON file holds."""
    return load(path, "JSON", lambda file: json.loads(file.read_text()))


def load_table(path: Path, columns: int) -> np.ndarray:
    """A text file of so many numbers a line."""
    text = load(path, "table of numbers", Path.read_text)
    if not text.strip():
        raise InputError(f"{path}: is empty; must have {columns} numbers a line")
    table = load(path, "table of numbers", lambda _: np.loadtxt(text.splitlines(), ndmin=2))
    return matrix(table, (len(table), columns), str(path))
