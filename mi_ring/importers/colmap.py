"""Importer of COLMAP's sparse models, text or binary."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from os.path import splitext
from pathlib import Path

import numpy as np

from mi_ring.errors import InputError, is_file
from mi_ring.fields import Fields
from mi_ring.foreign import require_readable
from mi_ring.importers.camera_models import Lens, camera_to_world
from mi_ring.importers.frames import Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import has_byte_order_mark, read_as
from mi_ring.system.optional import need

NUMBER = re.compile(rb"[-+.\deE]+|nan|-?inf", re.I)
#: Python code that reads a model, for `require_readable`.
READ_MODEL = """
import pycolmap
pycolmap.logging.minloglevel = pycolmap.logging.FATAL
pycolmap.Reconstruction(sys.argv[1])
"""


@dataclass(frozen=True)
class Colmap(Photogrammetry):
    """COLMAP, text or binary, with rigs or without. The light is fixed to the camera.

    SRC is the folder of a model (files cameras and images), or a folder with models in sparse/0, sparse/1, … or sparse.
    If there are several models, the one with the most photographs is used.
    """

    fields = Fields(
        used={
            "cameras/CAMERA_ID cameras/MODEL cameras/WIDTH cameras/HEIGHT cameras/PARAMS[]": "lenses",
            "images/QW images/QX images/QY images/QZ images/TX images/TY images/TZ": "poses, world-to-camera",
            "images/CAMERA_ID images/NAME images/IMAGE_ID": "lens and photograph",
            "rigs/RIG_ID rigs/REF_SENSOR_TYPE rigs/SENSORS[] frames/FRAME_ID frames/RIG_FROM_WORLD[]":
                "cameras that are joined; pycolmap composes their poses",
        },
        refused={"cameras/MODEL=EQUIRECTANGULAR": "panoramas"},
        harmless={"images/POINTS2D[] points3D/POINT3D_ID": "points: the surface starts from masks"},
    )  # fmt: skip

    @staticmethod
    def models(src: Path) -> list[Path]:
        """List the folders of COLMAP models in or below the folder `src`, sorted; empty if there are none.

        A model is in `src` itself, in its folder sparse or in a folder inside sparse, in a folder inside colmap/sparse,
        or in a folder inside `src`. Only the models of the first of these places that has any are listed.
        """
        sparse = src / "sparse"
        places = [src], [sparse, *sparse.glob("*")], (src / "colmap/sparse").glob("*"), src.glob("*")
        return next((found for place in places if (found := sorted(filter(is_model, place)))), [])

    @classmethod
    def model(cls, src: Path) -> Path | None:
        """Return the folder of the COLMAP model in or below `src` with the most photographs; None without a model."""
        return max(cls.models(src), key=count_images, default=None)

    @property
    def folder(self) -> Path:
        places = [self.src, *(self.model(self.src) or self.src).parents[:3]]
        return self.images or next((f / "images" for f in places if (f / "images").is_dir()), self.src)

    def posed(self) -> Iterator[Frame]:
        model = self.model(self.src)
        if model is None:
            raise InputError(f"{self.src}: SRC: neither images.bin nor images.txt, nor a folder sparse/0 with them")
        require_text(model)
        siblings = [model.parent, *model.parent.iterdir()] if model == self.src else self.models(self.src)
        others = [folder for folder in sorted(siblings) if is_model(folder) and folder != model]
        if sizes := ", ".join(f"{folder} ({count_images(folder)})" for folder in others):
            self.notes.append(f"Of COLMAP's models {model} is taken, with {count_images(model)} photographs; not used: "
                              f"{sizes}")  # fmt: skip
        pycolmap = need("pycolmap", f"{model}")
        if size := sum(file.stat().st_size for file in model.glob("*.bin")):
            require_readable(READ_MODEL, model, size, "a COLMAP model")
        try:
            pycolmap.logging.minloglevel = pycolmap.logging.FATAL  # the exception repeats what it logs
            reconstruction = pycolmap.Reconstruction(str(model))
            registered = {*reconstruction.reg_image_ids()}
            names = [(image.name, k) for k, image in reconstruction.images.items()]  # fails if not UTF-8
        except Exception as error:
            raise InputError(f"{model}: not a COLMAP model ({' '.join(str(error).split())})") from error
        for rig in reconstruction.rigs.values():
            for sensor, pose in rig.non_ref_sensors.items():
                if pose and not any(pose.rotation.quat):
                    raise InputError(
                        f"{model}: rigs: the quaternion of camera {sensor.id} is 0 0 0 0; must have length 1"
                    )
        texts = {} if (model / "images.bin").is_file() else names_in(model / "images.txt")
        names = sorted((texts.get(k, name), k) for name, k in names)
        if not registered:
            raise InputError(f"{model}: images: no photograph has a pose")
        for name, k in names:
            image = reconstruction.images[k]
            if k not in registered:
                self.without_pose.add(name)
                continue
            if (path := self.photograph(name, str(model))) is None:
                continue
            try:
                world_to_camera = image.cam_from_world().matrix()  # of the frame and of the sensor in its rig
            except RuntimeError as error:
                raise InputError(f"{model}: rigs: camera {image.camera_id} of {name} has no pose in its rig; let "
                                 "COLMAP estimate it") from error  # fmt: skip
            if not np.any(image.frame.rig_from_world.rotation.quat):
                raise InputError(f"{model}: images: the quaternion of {name} is 0 0 0 0; must have length 1")
            pose = camera_to_world(world_to_camera[:, :3], world_to_camera[:, 3])
            camera = reconstruction.cameras[image.camera_id]
            lens = Lens(camera.model_name, (camera.width, camera.height), camera.params)
            yield Frame(path, lens, pose, name=Path(splitext(name)[0]).as_posix().replace("/", "_"), said=name)


def is_model(folder: Path) -> bool:
    """Return True if a folder contains a COLMAP model, that is, images.bin or images.txt."""
    return any((folder / name).is_file() for name in ("images.bin", "images.txt"))


def camera_lines(path: Path) -> Iterator[tuple[bytes, int, list[bytes] | None]]:
    """Yield (line of the camera, number of the next line, words of the next line) for each camera in images.txt.

    In this file, two lines describe a camera. The second has the image points. Its words are None if the file ends
    before it.
    """
    lines = iter(enumerate(read_as(path, "text", lambda file: file.read_bytes().splitlines()), 1))
    for number, line in lines:
        if line.strip() and not line.lstrip().startswith(b"#"):
            _, points = next(lines, (0, None))
            yield line, number + 1, None if points is None else points.split()


def names_in(path: Path) -> dict[int, str]:
    """Read the names of the photographs in images.txt, by IMAGE_ID. Names may contain spaces.

    COLMAP itself reads a name only up to its first space.
    """
    words = (line.split(maxsplit=9) for line, _, _ in camera_lines(path))
    return {int(own[0]): own[9].decode().rstrip() for own in words if len(own) == 10}


def count_images(folder: Path) -> int:
    """Read how many photographs the COLMAP model in `folder` has, from its file images.bin or images.txt."""
    binary = folder / "images.bin"
    if binary.is_file():
        with binary.open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    return sum(1 for _ in camera_lines(folder / "images.txt"))


def require_text(folder: Path) -> None:
    """Raise InputError if COLMAP would misread the text files of a model. Binary models are not checked.

    It would ignore the digits after a decimal comma. A camera in images.txt has a second line for its image points,
    which may be empty. Without this line, COLMAP would read the next camera as points and lose it.
    """
    if (folder / "images.bin").is_file():
        return
    for path in filter(is_file, (folder / name for name in ("images.txt", "cameras.txt", "rigs.txt", "frames.txt"))):
        if read_as(path, "text", has_byte_order_mark):
            raise InputError(f"{path}: begins with a byte order mark, which COLMAP does not read; save it without")
        if path.name == "images.txt":  # names of photographs may have commas; its numbers are checked below
            continue
        data = re.sub(rb"^\s*#.*", b"", read_as(path, "text", Path.read_bytes), flags=re.MULTILINE)
        if bad := re.search(rb"\S*,\S*", data):
            raise InputError(f"{path}: has {bad[0].decode(errors='replace')}; must have decimal points, not commas")
    for line, number, words in camera_lines(path := folder / "images.txt"):
        if wrong := [word for word in line.split()[:9] if not NUMBER.fullmatch(word)]:
            raise InputError(f"{path}: line {number - 1}: has {wrong[0].decode(errors='replace')}; must be a number")
        if words is None or len(words) % 3 or not all(map(NUMBER.fullmatch, words[:30])):
            raise InputError(f"{path}: line {number}: must be the points of the camera in the line before; put an "
                             "empty line after each camera")  # fmt: skip
