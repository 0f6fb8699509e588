"""The photographs of a folder: which there are, their pixels and what their EXIF data say."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from mi_ring.errors import InputError
from mi_ring.images import linear_to_srgb, read_image, srgb_to_linear
from mi_ring.importers.reading import image_size, read_as
from mi_ring.system.optional import need

PLAIN = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
HEIF = (".heic", ".heif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
FEWEST = 8  #: photographs that a reconstruction needs at least


@dataclass(frozen=True)
class Picture:
    """A photograph as it was taken. Pixels are those of the sensor: EXIF orientation is left alone."""

    path: Path

    @property
    def name(self) -> str:
        """That of the file, without suffix."""
        return self.path.stem

    @cached_property
    def pixels(self) -> np.ndarray:
        """(H, W, C) uint8 sRGB, or uint16: linear of raw files, else as the file has it.

        Raises InputError if it cannot be read.
        """
        suffix = self.path.suffix.lower()
        if suffix in RAW:
            return read_as(self.path, "raw photograph", develop)
        if suffix in HEIF:
            need("pillow_heif", f"{self.path}").register_heif_opener()
            return read_as(self.path, "HEIF photograph", lambda file: np.array(Image.open(file).convert("RGB")))
        pixels = read_as(self.path, "image", read_image)
        if pixels.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{self.path}: has {pixels.dtype} pixels; photographs must have 8 or 16 bits")
        return np.repeat(pixels[:, :, :1], 3, 2) if pixels.shape[2] < 3 else pixels

    @property
    def encoding(self) -> str:
        """`linear` or `srgb`: what the numbers mean."""
        return "linear" if self.path.suffix.lower() in RAW else "srgb"

    @cached_property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]"""
        if self.path.suffix.lower() in RAW:
            height, width = self.pixels.shape[:2]
            return width, height
        if self.path.suffix.lower() in HEIF:
            need("pillow_heif", f"{self.path}").register_heif_opener()
        return image_size(self.path)

    def grey(self, longest: int) -> np.ndarray:
        """For features: (h, w) uint8 of so many pixels at most, each the mean of as many whole ones."""
        rgb = self.srgb()
        scale = -(-max(rgb.shape[:2]) // longest)
        height, width = (n // scale * scale for n in rgb.shape[:2])
        return np.array(Image.fromarray(rgb[:height, :width]).convert("L").reduce(scale))

    def srgb(self) -> np.ndarray:
        """(H, W, 3) uint8 sRGB."""
        rgb = self.pixels[:, :, :3]
        if rgb.dtype == np.uint8:
            return rgb
        value = np.arange(2**16, dtype=np.float32) / 65535
        lookup = linear_to_srgb(value / self.white) if self.encoding == "linear" else value
        return (lookup * 255 + 0.5).astype(np.uint8)[rgb]

    @cached_property
    def white(self) -> float:
        """Of raw data, that has no brightness of its own: what is to look white, a share of full scale."""
        return max(float(np.quantile(self.pixels[::8, ::8, :3], 0.995)) / 65535, 1e-3)

    def linear(self) -> np.ndarray:
        """(H, W, 3) float32 linear radiance, 1.0 = full scale."""
        rgb = self.pixels[:, :, :3]
        value = np.arange(np.iinfo(rgb.dtype).max + 1, dtype=np.float32) / np.iinfo(rgb.dtype).max
        return (value if self.encoding == "linear" else srgb_to_linear(value))[rgb]

    def mask(self, source: str | Path) -> np.ndarray | None:
        """The object as the user brings it, (H, W) uint8, 255 the object; None if this photograph has none.

        `source`: "alpha", the channel of the photograph itself; "rembg", what that package thinks; else a folder with
        masks called like the photographs. Raises InputError if one cannot be had or is of another size.
        """
        if source == "alpha":
            alpha = self.pixels[:, :, 3] if self.pixels.shape[2] == 4 else None
            return None if alpha is None else (alpha // (np.iinfo(alpha.dtype).max // 255)).astype(np.uint8)
        if source == "rembg":
            return np.array(need("rembg", "--masks rembg").remove(Image.fromarray(self.srgb()), only_mask=True))
        names = (f"{self.path.name}.png", f"{self.name}.png")
        file = next((f for name in names if (f := Path(source) / name).is_file()), None)
        if file is None:
            return None
        mask = read_as(file, "mask", read_image)[:, :, 0]
        if mask.shape[::-1] != self.size:
            sizes = *mask.shape[::-1], *self.size
            raise InputError("{}: is {} x {} pixels, its photograph {} x {}".format(file, *sizes))
        return (mask // (np.iinfo(mask.dtype).max // 255)).astype(np.uint8)

    def close(self) -> None:
        """Let go of the pixels."""
        self.__dict__.pop("pixels", None)


def develop(path: Path) -> np.ndarray:
    """A raw photograph (H, W, 3) uint16, linear radiance in sRGB's primaries, white balance as the camera chose it."""
    rawpy = need("rawpy", f"{path}")
    with rawpy.imread(str(path)) as raw:
        return raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, user_flip=0)


def find_pictures(folder: Path) -> list[Picture]:
    """The photographs of a folder, by name. Raises InputError if there is no such folder or if they are too few."""
    if not folder.is_dir():
        raise InputError(f"{folder}: FOLDER: {'is a file' if folder.exists() else 'no such folder'}; give the folder "
                         "of the photographs")  # fmt: skip
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        kind = path.suffix.lower()
        if kind not in PLAIN + HEIF + RAW or path.name.startswith("."):
            continue
        # A camera that writes both raw and JPEG: the raw one is linear.
        if path.stem not in found or kind in RAW:
            found[path.stem] = path
    if len(found) < FEWEST:
        raise InputError(f"{folder}: FOLDER: has {len(found)} photographs ({', '.join(PLAIN + HEIF)} or raw); at least "
                         f"{FEWEST} are needed, better 40, from all around")  # fmt: skip
    return [Picture(path) for path in found.values()]


def focal_35mm(pictures: Sequence[Picture]) -> float | None:
    """The focal length by EXIF, as of a frame 36 mm wide, of the first photograph that says; None if none does."""
    for picture in pictures:
        exif = exif_of(picture.path)
        value = exif.get(ExifTags.Base.FocalLengthIn35mmFilm)
        if isinstance(value, int | float) and value > 0:
            return float(value)
    return None


def relative_exposures(pictures: Sequence[Picture]) -> np.ndarray:
    """(N,) by EXIF, 1 for the one in the middle; all 1 unless all photographs say."""
    exposures = []
    for picture in pictures:
        exif = exif_of(picture.path)
        tags = ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber
        try:
            seconds, iso, number = (float(np.ravel(exif[tag])[0]) for tag in tags)
            exposures.append(seconds * iso / number**2)
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            exposures.append(np.nan)
    found = np.array(exposures)
    return found / np.median(found) if np.isfinite(found).all() and (found > 0).all() else np.ones(len(found))


def exif_of(path: Path) -> dict:
    """EXIF data about the exposure, empty where there are none."""
    try:
        if path.suffix.lower() in HEIF:
            need("pillow_heif", f"{path}").register_heif_opener()
        with Image.open(path) as image:
            return dict(image.getexif().get_ifd(ExifTags.IFD.Exif))
    except (OSError, SyntaxError):  # damaged, or a raw format that Pillow does not know
        return {}
