"""Bring photographs in from other tools: `python -m mi_ring.convert FORMAT SRC SCENE.xml`."""

import contextlib
import os
import shutil
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Union

import numpy as np
import scipy.ndimage
import tyro
from tqdm import tqdm

from mi_ring import command
from mi_ring.errors import InputError
from mi_ring.formats import FORMATS, Frame, camera_of, image_size, read
from mi_ring.results import replace, write_image

MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  #: axes of a Mitsuba camera, x left, y up, z forward, in OpenCV's

DESCRIPTION = """Write a scene file for photographs in the format of another tool.

Lens distortion is undone; units and frame stay as they are. mi_ring.convert FORMAT --help tells more."""

Formats = Union[tuple(Annotated[source, tyro.conf.subcommand(name)] for name, source in FORMATS.items())]  # noqa: UP007


def check(frames: Sequence[Frame], source: Path) -> None:
    """Raise InputError for invalid cameras, lights and names, and for files of another size than their camera's."""
    if not frames:
        raise InputError(f"{source}: SRC: found no photographs")
    for frame in frames:
        what = f"{frame.image}: camera"
        command.require_utf8(str(frame.image))
        rotation = frame.pose[:3, :3]
        if not np.allclose(frame.pose[3], [0, 0, 0, 1], atol=1e-6):
            raise InputError(f"{what}: the last row of its pose is {frame.pose[3]}, must be 0 0 0 1; is it transposed?")
        if not np.isfinite(frame.pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise InputError(f"{what}: its pose is no rotation and translation")
        if np.linalg.det(rotation) < 0:
            raise InputError(f"{what}: its rotation is left-handed, a mirror; check the order and signs of its axes")
        if not np.isfinite(frame.camera.params).all() or min(focal(frame)) <= 0:
            raise InputError(f"{what}: its parameters are {frame.camera.params_to_string()}; must be finite, with "
                             "focal lengths above 0")  # fmt: skip
        if frame.light and not (np.isfinite([frame.light.vector, frame.light.rgb]).all() and min(frame.light.rgb) >= 0):
            raise InputError(f"{frame.image}: light: is {frame.light.rgb} at {frame.light.vector}; "
                             "must be finite and not negative")  # fmt: skip
        for file, kind in ((None if frame.pixels is not None else frame.image, "photograph"), (frame.mask, "mask")):
            if file and (size := image_size(file)) != frame.size:
                raise InputError("{}: {}: is {} x {} pixels, its camera {} x {}".format(file, kind, *size, *frame.size))


def focal(frame: Frame) -> tuple[float, float]:
    """Focal lengths [px]."""
    return frame.camera.focal_length_x, frame.camera.focal_length_y


def principal_point(frame: Frame) -> tuple[float, float]:
    """[px]"""
    return frame.camera.principal_point_x, frame.camera.principal_point_y


def is_pinhole(frame: Frame) -> bool:
    """Is the camera a pinhole? Asked of its corners, for a fisheye without coefficients is none."""
    fx, fy = focal(frame)
    rays = np.array([[x, y, 1.0] for x in (-0.3, 0.2) for y in (-0.1, 0.4)])
    straight = rays[:, :2] * [fx, fy] + principal_point(frame)
    return np.allclose(frame.camera.img_from_cam(rays), straight, atol=1e-6)


@lru_cache(maxsize=1)
def distorted(model: str, size: tuple[int, int], params: tuple[float, ...], pinhole: tuple[float, ...]) -> np.ndarray:
    """Where in the photograph (2, H, W) [px] each pixel of the undistorted one is, row and column."""
    fx, fy, cx, cy = pinhole
    x, y = (np.arange(size[0]) + 0.5 - cx) / fx, (np.arange(size[1]) + 0.5 - cy) / fy
    rays = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones(size[::-1])], -1).reshape(-1, 3)
    pixels = camera_of(model, size, params).img_from_cam(rays).reshape(*size[::-1], 2) - 0.5
    return pixels[..., ::-1].transpose(2, 0, 1)


def undistort(pixels: np.ndarray, frame: Frame) -> np.ndarray:
    """Resample an image (H, W, C) as a camera without distortion would have taken it: same size and focal lengths."""
    camera = frame.camera
    places = distorted(camera.model_name, frame.size, tuple(camera.params), (*focal(frame), *principal_point(frame)))
    channels = [
        scipy.ndimage.map_coordinates(pixels[..., c].astype(np.float32), places, order=1)
        for c in range(pixels.shape[2])
    ]
    result = np.stack(channels, -1)
    return result if pixels.dtype == np.float32 else (result + 0.5).astype(pixels.dtype)


class Writer:
    """Files of a scene: gathered in a folder of their own, moved to their places when all are there."""

    def __init__(self, scene: Path):
        self.scene = scene
        #: What belongs to x/pot.xml is in x/pot/, what belongs to x/scene.xml is in x/.
        self.folder = scene.parent if scene.stem == "scene" else scene.with_suffix("")
        self.made = [folder for folder in (scene.parent, *scene.parent.parents) if not folder.exists()]
        scene.parent.mkdir(parents=True, exist_ok=True)
        self.staging = Path(tempfile.mkdtemp(prefix=f".{scene.stem}.", dir=scene.parent))
        self.files: list[Path] = []
        self.masks: dict = {}  # where masks are, by file and camera

    def write(self, file: str, write) -> Path:
        """Have `write(path)` write a file and return where it is going to be."""
        path = self.staging / file
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        self.files.append(Path(file))
        return self.folder / file

    def image(self, file: str, pixels: np.ndarray) -> Path:
        """Write an image: PNG if it has integers, else EXR."""
        suffix = ".exr" if pixels.dtype == np.float32 else ".png"
        return self.write(file + suffix, lambda path: write_image(pixels, path))

    def relative(self, path: Path) -> str:
        """As the scene names it."""
        return Path(os.path.relpath(path, self.scene.parent)).as_posix()

    def finish(self, xml: bytes) -> None:
        """Move everything to its place. Raises InputError if there are other files, which may be the sources."""
        for file in self.files:
            if (self.folder / file).exists():
                raise InputError(f"{self.folder / file}: exists already; give SCENE.xml another name or folder")
        for file in self.files:
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self.staging / file, self.folder / file)
        replace(self.scene, xml)

    def close(self) -> None:
        """Remove what has not been moved, and folders that were made for nothing."""
        shutil.rmtree(self.staging, ignore_errors=True)
        for folder in self.made:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def place(writer: Writer, frame: Frame, name: str, copy: bool, encoding: str | None) -> tuple[str, str | None]:
    """Where the photograph and the mask of a frame are, as the scene names them; written anew where they must be."""
    straight = is_pinhole(frame)

    def photograph() -> np.ndarray | None:
        """Its pixels, if they are no file that will do: photographs of 8 bits are sRGB."""
        if frame.pixels is not None or encoding != "linear":
            return frame.pixels
        pixels = read(frame.image)
        return pixels * np.uint16(257) if pixels.dtype == np.uint8 else None

    def placed(folder: str, path: Path, pixels: np.ndarray | None, fill: bool = False) -> Path:
        if pixels is None and straight and not fill:
            if not copy:
                return path
            return writer.write(f"{folder}/{name}{path.suffix}", lambda file: shutil.copyfile(path, file))
        pixels = read(path) if pixels is None else pixels
        if fill:
            pixels = 255 * scipy.ndimage.binary_fill_holes(pixels[..., 0] > 127)[..., None].astype(np.uint8)
        return writer.image(f"{folder}/{name}", pixels if straight else undistort(pixels, frame))

    image = placed("images", frame.image, photograph())
    if frame.mask is None or frame.mask == frame.image:
        return writer.relative(image), frame.mask and writer.relative(image)
    key = (frame.mask, frame.camera.params_to_string())  # photographs may share a mask
    if key not in writer.masks:
        writer.masks[key] = placed("masks", frame.mask, None, frame.fill_mask)
    return writer.relative(image), writer.relative(writer.masks[key])


def sensor(frame: Frame, name: str, image: str, mask: str | None, encoding: str | None) -> ElementTree.Element:
    """A `photograph`."""
    element = ElementTree.Element("sensor", type="photograph", id=name)

    def add(tag, name, value, parent=element):
        ElementTree.SubElement(parent, tag, name=name, value=value if isinstance(value, str) else numbers(value))

    add("string", "filename", image)
    if mask:
        add("string", "mask", mask)
    for field, value in zip(("fx", "fy", "cx", "cy"), (*focal(frame), *principal_point(frame))):
        add("float", field, value)
    ElementTree.SubElement(
        ElementTree.SubElement(element, "transform", name="to_world"), "matrix", value=numbers(frame.pose @ MITSUBA)
    )
    if encoding:
        add("string", "encoding", encoding)
    if frame.saturation is not None:
        add("float", "saturation", frame.saturation)
    film = ElementTree.SubElement(element, "film", type="hdrfilm")
    for field, value in zip(("width", "height"), frame.size):
        add("integer", field, str(value), film)
    if frame.light:
        kind, vector, rgb = frame.light
        emitter = ElementTree.SubElement(element, "emitter", type=kind)
        names = ("position", "intensity") if kind == "point" else ("direction", "irradiance")
        x, y, z = (numbers(v) for v in vector)
        ElementTree.SubElement(emitter, "point" if kind == "point" else "vector", name=names[0], x=x, y=y, z=z)
        add("rgb", names[1], rgb, emitter)
    return element


def numbers(values) -> str:
    """As XML has them."""
    return " ".join(f"{v:.9g}" for v in np.ravel(values))


def main(arguments: Sequence[str]) -> None:
    """The command."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in FORMATS:
        raise InputError(f"FORMAT: is {arguments[0]}; must be one of {', '.join(FORMATS)}")
    source = command.parse(Formats, arguments, "mi_ring.convert", description=DESCRIPTION)
    frames = list(source.frames())
    check(frames, source.src)
    names = [frame.name or frame.image.stem for frame in frames]
    if len({*names, "object"}) <= len(names):
        names = [f"{k:0{len(str(len(frames)))}}_{name}" for k, name in enumerate(names)]
    root = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(root, "integrator", type="photometric")
    shape = ElementTree.SubElement(root, "shape", type="shapenet", id="object")
    ElementTree.SubElement(shape, "bsdf", type="cooktorrance")
    if source.scene.suffix != ".xml" or source.scene.exists():
        what = "exists already; give another name" if source.scene.exists() else "must end in .xml"
        raise InputError(f"{source.scene}: SCENE.xml: {what}")
    try:
        writer = Writer(source.scene)
        try:
            for frame, name in zip(tqdm(frames, unit="photograph", disable=None, leave=False), names):
                encoding = source.encoding if source.encoding != "auto" else frame.encoding
                root.append(sensor(frame, name, *place(writer, frame, name, source.copy, encoding), encoding))
            if truth := getattr(source, "truth", None):
                writer.write("truth/mesh.ply", lambda file: shutil.copyfile(truth, file))
            ElementTree.indent(root)
            writer.finish(ElementTree.tostring(root, "utf-8"))
        finally:
            writer.close()
    except OSError as error:
        raise InputError(f"{source.scene}: cannot be written ({error.strerror or error})") from error
    masked = sum(frame.mask is not None for frame in frames)
    print(f"{len(frames)} photographs, {masked} with masks, of {len({f.pose.tobytes() for f in frames})} cameras: "
          f"{source.scene}\nNow: python -m mi_ring.fit {source.scene}")  # fmt: skip


if __name__ == "__main__":
    command.run("mi_ring.convert", main)
