"""COLMAP's sparse models, text or binary."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from mi_ring.errors import InputError
from mi_ring.importers.cameras import Lens
from mi_ring.importers.frames import Frame, Source
from mi_ring.importers.reading import existing, first_file, read_as
from mi_ring.system.optional import need


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
        pycolmap = need("pycolmap", f"{model}")
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
            name = Path(image.name).with_suffix("").as_posix().replace("/", "_")
            own = reconstruction.cameras[image.camera_id]
            lens = Lens(own.model_name, (own.width, own.height), own.params)
            frame = Frame(path, lens, pose, name=name)
            if self.masks:
                names = (f"{image.name}.png", str(Path(image.name).with_suffix(".png")))
                frame.mask = first_file([self.masks / n for n in names], "mask")
            frames.append(frame)
        exposures = [exif_exposure(frame.image) for frame in frames] if self.exif else []
        known = np.array([exposure for exposure in exposures if exposure is not None])
        scale = np.ones(len(frames))
        if len(known) == len(frames):
            scale = known / np.median(known)
        elif len(known):
            k = exposures.index(None)
            raise InputError(f"{frames[k].image}: EXIF: no exposure time, ISO or aperture, but other photographs have "
                             "them; add them, or give --no-exif if all have the same exposure")  # fmt: skip
        for frame, exposure in zip(frames, scale):
            if exposure != 1 or any(self.flash_offset):
                frame.light = frame.at_camera(np.full(3, exposure), self.flash_offset)
            yield frame


def exif_exposure(path: Path) -> float | None:
    """Exposure time · ISO / aperture², to which radiance as recorded is proportional; None if EXIF lacks one."""
    if path.suffix.lower() == ".exr":
        return None
    exif = read_as(path, "image", read_exif)
    tags = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
    values: list[Any] = [exif.get(tag) for tag in tags]
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


def read_exif(path: Path) -> dict[int, Any]:
    """The part of the EXIF data that is about the exposure."""
    with Image.open(path) as image:
        return image.getexif().get_ifd(ExifTags.IFD.Exif)
