"""What photogrammetry formats have in common: ordinary photographs, taken with a light beside the camera."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from PIL import ExifTags

from mi_ring.errors import InputError
from mi_ring.foreign import reading
from mi_ring.images import open_image
from mi_ring.importers.frames import Frame, Source, find_by_name
from mi_ring.importers.reading import SUFFIXES, existing, first_file, list_images

EXPOSURE = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)


@dataclass(frozen=True)
class Photogrammetry(Source):
    """The base class of formats of photogrammetry, with their options. Each format implements `posed`."""

    images: Path | None = None
    """Folder of the photographs. Without it: the nearest folder `images` beside or above SRC, or the folder of SRC."""
    masks: Path | None = None
    """Folder of masks: photo.jpg has the mask photo.jpg.png, as in COLMAP, or photo.png. Without it: no masks."""
    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the light relative to the camera: right, down and forward [scene units]. Default: at the lens."""
    exif: bool = True
    """Correct for different exposures by exposure time, ISO and aperture in EXIF data.
    Leave it out if EXIF data are wrong or the photographs have been brightened later."""

    def posed(self) -> Iterator[tuple[str, Frame]]:
        """Read the photographs that have a pose, each after the name by which its mask is found."""
        raise NotImplementedError

    @property
    def folder(self) -> Path:
        """The folder of the photographs. Formats with another rule replace this property."""
        own = self.src if self.src.is_dir() else self.src.parent
        candidates = (own / "images", own.parent / "images")
        return self.images or next((folder for folder in candidates if folder.is_dir()), own)

    @cached_property
    def image_files(self) -> list[Path]:
        """The image files in `folder`."""
        return list_images(self.folder)

    def photograph(self, name: str, what: str) -> Path | None:
        """Find the photograph of this name, with any suffix; None if it is not in `photographs`.

        Without `photographs`, raises InputError if it is not in `folder`.
        """
        if self.photographs is not None:
            return find_by_name(name, self.photographs)
        if file := find_by_name(name, self.image_files):
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
        exposures = [exif_exposure(frame.image) if self.exif else None for frame in frames]
        known = [exposure for exposure in exposures if exposure is not None]
        if known and len(known) < len(frames):
            k = exposures.index(None)
            raise InputError(f"{frames[k].image}: EXIF: no exposure time, ISO or aperture, but other photographs have "
                             "them; add them, or give --no-exif if all have the same exposure")  # fmt: skip
        for frame, exposure in zip(frames, np.divide(known, np.median(known)) if known else np.ones(len(frames))):
            if exposure != 1 or any(self.flash_offset):
                frame.light = frame.at_camera(np.full(3, exposure), self.flash_offset)
            yield frame


def exif_exposure(path: Path) -> float | None:
    """Compute `exposure_of` an image file. Raises InputError if it is not positive."""
    if path.suffix.lower() == ".exr":
        return None
    with reading(path, "image"), open_image(existing(path, "image")) as image:
        exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
    exposure = exposure_of(exif)
    if exposure is not None and not 0 < exposure < math.inf:
        values = ", ".join(str(exif[tag]) for tag in EXPOSURE)
        raise InputError(f"{path}: EXIF: exposure time, ISO and aperture are {values}; must be positive numbers, or "
                         "give --no-exif if all photographs have the same exposure")  # fmt: skip
    return exposure


def exposure_of(exif: Mapping[int, Any]) -> float | None:
    """Compute exposure time · ISO / aperture² of EXIF data; None if a value is missing, NaN if one is no number."""
    values: list[Any] = [exif.get(tag) for tag in EXPOSURE]
    if not all(values):
        return None
    try:
        seconds, iso, f_number = (float(v[0] if isinstance(v, tuple) else v) for v in values)
        return seconds * iso / f_number**2
    except (TypeError, ValueError, ArithmeticError):
        return math.nan
