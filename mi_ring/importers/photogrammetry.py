"""Base class of importers from photogrammetry: ordinary photographs with a light that is fixed to the camera."""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags

from mi_ring.errors import InputError
from mi_ring.image_headers import exif_of
from mi_ring.importers.frames import Frame
from mi_ring.importers.named_photographs import NamedPhotographs
from mi_ring.importers.reading import read_as

EXPOSURE = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
#: By tag of a value: the tag of its logarithm to base 2 (APEX), and the factor to multiply this with. Some files have
#: only the logarithm.
LOGARITHMS: dict[int, tuple[int, float]] = {
    ExifTags.Base.ExposureTime: (ExifTags.Base.ShutterSpeedValue, -1.0),
    ExifTags.Base.FNumber: (ExifTags.Base.ApertureValue, 0.5),
}


@dataclass(frozen=True)
class Photogrammetry(NamedPhotographs):
    """Base class of importers from photogrammetry. Subclasses implement `posed`.

    The light is fixed to the camera. Its intensity follows the exposure of each photograph.
    """

    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the light relative to the lens: right, down and forward [scene units]. 0 0 0: at the lens.
    0.1 -0.2 0: 0.1 to the right of the lens and 0.2 above it."""
    exif: bool = True
    """Correct for different exposures of the photographs, by exposure time, ISO and aperture in their EXIF data.
    Give --no-exif if these data are wrong or if the brightness of the photographs has been edited."""

    def frames(self) -> Iterator[Frame]:
        frames = list(super().frames())
        exposures = self.exposures(frames)
        for frame, exposure in zip(frames, exposures):
            if exposure != 1 or any(self.flash_offset):
                frame.light = frame.at_camera(np.full(3, exposure), self.flash_offset)
            yield frame

    def exposures(self, frames: Sequence[Frame]) -> np.ndarray:
        """Return the relative exposures (N,) of the frames: exposures from EXIF data, divided by their median.

        All are 1 with --no-exif, or if no photograph has an exposure in its EXIF data. Raises InputError if only some
        photographs have one.
        """
        ones = np.ones(len(frames))
        if not self.exif:
            return ones
        known = exposures_of([exif_values(frame.image) for frame in frames])
        if not known or np.isnan(known).all():
            return ones
        if np.isnan(known).any():
            path = frames[int(np.isnan(known).argmax())].image
            own = exif_values(path)
            values = ", ".join(str(own.get(tag, "missing")) for tag in EXPOSURE)
            raise InputError(f"{path}: EXIF: exposure time, ISO and aperture are {values}; other photographs have "
                             "more; add them, or give --no-exif if all have the same exposure")  # fmt: skip
        return np.divide(known, np.median(known))


def exif_values(path: Path) -> dict[int, Any]:
    """Read exposure time [s], ISO, aperture and logarithms of these from an image file. Returns values by EXIF tag.

    Values that the file lacks are left out.
    """
    exif = read_as(path, "image", exif_of).get_ifd(ExifTags.IFD.Exif)
    return {tag: exif[tag] for tag in (*EXPOSURE, *(tag for tag, _ in LOGARITHMS.values())) if tag in exif}


def exposures_of(photographs: Sequence[Mapping[int, Any]]) -> list[float]:
    """Return the exposure of each photograph: exposure time [s] · ISO / aperture². NaN if it is unknown.

    `photographs`: EXIF values by EXIF tag, for each photograph. A value that all photographs lack, for example the
    aperture of an old lens, is taken as 1.
    """
    values = np.array([[exposure_value(exif, tag) for tag in EXPOSURE] for exif in photographs]).reshape(-1, 3)
    unknown = np.isnan(values).all(0)
    if unknown.all():
        return [math.nan] * len(values)
    seconds, iso, f_number = np.where(unknown, 1.0, values).T
    with np.errstate(all="ignore"):
        exposures = seconds * iso / f_number**2
    return np.where(np.isfinite(exposures) & (exposures > 0), exposures, math.nan).tolist()


def exposure_value(exif: Mapping[int, Any], tag: int) -> float:
    """Return exposure time [s], ISO or aperture by its EXIF tag; NaN if it is unknown.

    `exif`: EXIF values by tag. If time or aperture is missing or invalid, it is computed from its logarithm.
    """
    value = positive(exif.get(tag))
    if math.isnan(value) and tag in LOGARITHMS:
        logarithm, factor = LOGARITHMS[tag]
        with contextlib.suppress(KeyError, TypeError, ValueError, ArithmeticError):
            value = positive(2.0 ** (factor * float(exif[logarithm])))
    return value


def positive(value: Any) -> float:
    """Convert an EXIF value to a float. Returns NaN if it is not a positive finite number."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ArithmeticError, IndexError):
        return math.nan
    return number if 0 < number < math.inf else math.nan
