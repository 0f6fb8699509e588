"""What photogrammetry formats have in common: ordinary photographs, taken with a light beside the camera."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags

from mi_ring.errors import InputError
from mi_ring.images import exif_of
from mi_ring.importers.frames import Frame
from mi_ring.importers.named_photographs import NamedPhotographs
from mi_ring.importers.reading import read_as

EXPOSURE = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)


@dataclass(frozen=True)
class Photogrammetry(NamedPhotographs):
    """Base of the photogrammetry formats. Each format implements `posed`."""

    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the light relative to the camera: right, down and forward [scene units]."""
    exif: bool = True
    """Take different exposures into account, by exposure time, ISO and aperture in EXIF data."""

    def frames(self) -> Iterator[Frame]:
        frames = list(super().frames())
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
    """`exposure_of` an image file. Raises InputError if it is not positive."""
    exif = read_as(path, "image", exif_of).get_ifd(ExifTags.IFD.Exif)
    exposure = exposure_of(exif)
    if exposure is not None and not 0 < exposure < math.inf:
        values = ", ".join(str(exif[tag]) for tag in EXPOSURE)
        raise InputError(f"{path}: EXIF: exposure time, ISO and aperture are {values}; must be positive numbers, or "
                         "give --no-exif if all photographs have the same exposure")  # fmt: skip
    return exposure


def exposure_of(exif: Mapping[int, Any]) -> float | None:
    """Exposure time · ISO / aperture² of EXIF data; None if a value is missing, NaN if one is no number."""
    values: list[Any] = [exif.get(tag) for tag in EXPOSURE]
    if not all(values):
        return None
    try:
        seconds, iso, f_number = (float(v[0] if isinstance(v, tuple) else v) for v in values)
        return seconds * iso / f_number**2
    except (TypeError, ValueError, ArithmeticError):
        return math.nan
