"""What formats of photogrammetry have in common: ordinary photographs, taken with a light beside the camera."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from PIL import ExifTags

from mi_ring.errors import InputError
from mi_ring.images import open_image
from mi_ring.importers.frames import Frame, Source, called
from mi_ring.importers.reading import SUFFIXES, first_file, pictures, read_as

EXPOSURE = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)


@dataclass(frozen=True)
class Photogrammetry(Source):
    """Photographs with poses from photogrammetry; formats say where from in `posed`."""

    images: Path | None = None
    """Folder of the photographs. Without it: the nearest `images` beside or above SRC, else the folder of SRC."""
    masks: Path | None = None
    """Folder of masks: photo.jpg has the mask photo.jpg.png, as in COLMAP, or photo.png."""
    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the light relative to the camera: right, down and forward [scene units]."""
    exif: bool = True
    """Bring the photographs to one brightness by exposure time, ISO and aperture of their EXIF data."""

    def posed(self) -> Iterator[tuple[str, Frame]]:
        """Photographs that have a pose, each with its name, by which its mask is called."""
        raise NotImplementedError

    @property
    def folder(self) -> Path:
        """Of the photographs, unless the format knows better."""
        own = self.src if self.src.is_dir() else self.src.parent
        beside = (own / "images", own.parent / "images")
        return self.images or next((folder for folder in beside if folder.is_dir()), own)

    @cached_property
    def pictures(self) -> list[Path]:
        """The image files of `folder`."""
        return pictures(self.folder)

    def photograph(self, name: str, what: str) -> Path | None:
        """The photograph of this name, whatever its suffix and that of the name are; None if it is not meant.

        Raises InputError if `folder` has none.
        """
        if self.photographs is not None:
            return called(name, self.photographs)
        if file := called(name, self.pictures):
            return file
        name = PureWindowsPath(name).name[:99]
        raise InputError(f"{what}: no photograph {name!r} with any of {' '.join(SUFFIXES)} in {self.folder}; give "
                         "--images")  # fmt: skip

    def frames(self) -> Iterator[Frame]:
        frames = []
        for name, frame in self.posed():
            if self.masks:
                names = (f"{name}.png", str(Path(name).with_suffix(".png")))
                frame.mask = first_file([self.masks / n for n in names], "mask")
            frames.append(frame)
        exposures = [exif_exposure(frame.image) for frame in frames] if self.exif else []
        known = np.array([exposure for exposure in exposures if exposure is not None])
        scale = np.ones(len(frames))
        if len(known) and len(known) == len(frames):
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
    exposure = exposure_of(exif)
    if exposure is not None and not 0 < exposure < math.inf:
        values = ", ".join(str(exif[tag]) for tag in EXPOSURE)
        raise InputError(f"{path}: EXIF: exposure time, ISO and aperture are {values}; must be positive numbers, or "
                         "give --no-exif if all photographs have the same exposure")  # fmt: skip
    return exposure


def exposure_of(exif: Mapping[int, Any]) -> float | None:
    """The same of the part of EXIF data that is about it; None if there is nothing, NaN if it is no number."""
    values: list[Any] = [exif.get(tag) for tag in EXPOSURE]
    if not all(values):
        return None
    try:
        seconds, iso, f_number = (float(v[0] if isinstance(v, tuple) else v) for v in values)
        return seconds * iso / f_number**2
    except (TypeError, ValueError, ArithmeticError):
        return math.nan


def read_exif(path: Path) -> dict[int, Any]:
    """The part of the EXIF data that is about the exposure."""
    with open_image(path) as image:
        return image.getexif().get_ifd(ExifTags.IFD.Exif)
