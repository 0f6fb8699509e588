"""The photographs in a folder: their pixels, orientation and EXIF data."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.foreign import reading
from mi_ring.image_headers import HEIF, KINDS, RAW, SUFFIXES, encoding_of, exif_of, open_image
from mi_ring.images import linear_to_srgb, mask_values, orientation_axes, oriented, read_image
from mi_ring.importers.named_photographs import MASK_AFFIX
from mi_ring.importers.photogrammetry import exposures_of
from mi_ring.importers.reading import image_size, read_as, saturations_of
from mi_ring.scene.shot import Encoding
from mi_ring.system import command
from mi_ring.system.optional import need

TRANSPARENT = (".png", ".tif", ".tiff", ".webp", ".avif", ".exr")  #: suffixes of files that may have an alpha channel
FLIPS = {0: 1, 3: 3, 5: 8, 6: 6}  #: LibRaw's numbers of orientations, and EXIF's
MIN_PHOTOGRAPHS = 8
DECODED = 2  #: photographs that are decoded at a time: each may take 500 MB


@dataclass(frozen=True)
class Picture:
    """A photograph in a file. Its pixels and EXIF data are read when they are used."""

    path: Path
    upright: bool = True  #: turn the pixels by the EXIF orientation; cameras of other tools need them as stored
    saturation: float = 1.0  #: encoded value (1 = full scale) from which a pixel is clipped

    @property
    def name(self) -> str:
        """Name of the file without suffix."""
        return self.path.stem

    @property
    def suffix(self) -> str:
        """Suffix of the file in lower case."""
        return self.path.suffix.lower()

    @cached_property
    def pixels(self) -> np.ndarray:
        """Pixels (H, W, 3 or 4) uint8 or uint16. They are turned upright if `upright` is set. See also `encoding`.

        Floats become uint16: 1 is full scale, and larger values are clipped. Raises InputError if the file cannot be
        read.
        """
        return oriented(self.stored(), self.orientation)

    def stored(self) -> np.ndarray:
        """Read the pixels (H, W, C) uint8 or uint16 as the file stores them, not turned upright. C is at least 3.

        Raises InputError if the file cannot be read.
        """
        pixels = read_as(self.path, "photograph", partial(read_image, heed=True))
        if pixels.dtype == np.float32:
            pixels = (pixels.clip(0, 1) * 65535 + 0.5).astype(np.uint16)
        count = pixels.shape[2]
        return pixels[:, :, [0, 0, 0, *range(1, count)]] if count < 3 else pixels  # grey, with alpha or without

    @property
    def mask_pixels(self) -> np.ndarray:
        """The file, read as a mask (H, W) uint8. It is turned in the same way as `pixels`."""
        return oriented(mask_values(read_as(self.path, "mask", read_image), f"{self.path}: mask"), self.orientation)

    def decode(self, read: Callable[[Any], Any]) -> Any:
        """Open a raw or HEIF file, and return the result of `read(opened)`.

        `read`: takes LibRaw's object for a raw file, otherwise Pillow's image. Raises InputError if the file cannot be
        read.
        """
        raw = self.suffix in RAW
        with (
            reading(self.path, f"{'raw' if raw else 'HEIF'} photograph"),
            need("rawpy", f"{self.path}").imread(str(self.path)) if raw else open_image(self.path) as file,
        ):
            return read(file)

    @cached_property
    def camera_orientation(self) -> int:
        """How the camera was held, as an EXIF orientation: 1 (upright) to 8."""
        if self.suffix in HEIF:
            return self.decode(lambda image: image.info.get("original_orientation") or 1)
        if self.suffix in RAW:
            return FLIPS.get(self.decode(lambda raw: raw.sizes.flip), 1)
        value = self.exif.get(ExifTags.Base.Orientation)
        return value if isinstance(value, int) and 1 <= value <= 8 else 1

    @property
    def orientation(self) -> int:
        """EXIF orientation by which the stored pixels must be turned; 1 (not at all) if `upright` is False.

        It is also 1 for HEIF, because its reader has turned the pixels already.
        """
        return self.camera_orientation if self.upright and self.suffix not in HEIF else 1

    @property
    def axes(self) -> np.ndarray:
        """Rotation (3, 3) from the axes of the sensor to the axes of `pixels`; both are x right, y down, z forward."""
        return orientation_axes(self.camera_orientation if self.upright or self.suffix in HEIF else 1)

    @cached_property
    def exif(self) -> Image.Exif:
        """EXIF data of the file; empty if there are none, or if they cannot be read."""
        try:
            return exif_of(self.path)
        except Exception:  # damaged data raise many kinds; Pillow does not know all raw formats
            return Image.Exif()

    def exif_field(self, tag: int) -> Any:
        """Return a value of the Exif section of the EXIF data; None if it is missing. `tag`: number of the tag."""
        return self.exif.get_ifd(ExifTags.IFD.Exif).get(tag)

    @property
    def raw(self) -> bool:
        """True for a raw file: its pixels are linear, with an arbitrary scale."""
        return self.suffix in RAW

    @cached_property
    def encoding(self) -> Encoding:
        """Encoding of `pixels`: "linear" or "srgb". If the file does not declare it, 8 bits are sRGB, others linear."""
        return read_as(self.path, "photograph", encoding_of)

    @cached_property
    def size(self) -> tuple[int, int]:
        """(width, height) of `pixels` [px]. It is read without the pixels."""
        size = image_size(self.path)
        return size[::-1] if self.orientation > 4 else size

    def grey(self, longest: int) -> np.ndarray:
        """Return a reduced grey image (h, w) uint8, in which features are searched.

        `longest`: largest length of the longer side [px]. Pixels are means of square blocks.
        """
        rgb = self.srgb()
        scale = -(-max(rgb.shape[:2]) // longest)
        height, width = (n // scale * scale for n in rgb.shape[:2])
        return np.array(Image.fromarray(rgb[:height, :width]).convert("L").reduce(scale))

    def srgb(self) -> np.ndarray:
        """Return the photograph as 8-bit sRGB, (H, W, 3) uint8, in which `white` is white."""
        rgb = self.pixels[:, :, :3]
        if rgb.dtype == np.uint8:
            return rgb
        value = np.arange(2**16, dtype=np.float32) / 65535
        lookup = linear_to_srgb(value / self.white) if self.encoding == "linear" else value
        return (lookup * 255 + 0.5).astype(np.uint8)[rgb]

    @cached_property
    def white(self) -> float:
        """The linear value of `pixels` that is shown as white (1 = full scale).

        For a raw file, it is near the brightest pixel, because its scale is arbitrary. For others, it is `saturation`.
        """
        if not self.raw:
            return self.saturation
        return max(float(np.quantile(self.pixels[::8, ::8, :3], 0.995)) / 65535, 1e-3)

    def to_linear(self, pixels: np.ndarray) -> np.ndarray:
        """Convert pixels, encoded as those of this photograph, to linear radiance. 1.0 is full scale.

        `pixels`: a part of the array `pixels` without alpha, of any shape. Returns float32 of the same shape.
        """
        value = np.arange(np.iinfo(pixels.dtype).max + 1, dtype=np.float32) / np.iinfo(pixels.dtype).max
        return (value if self.encoding == "linear" else srgb_to_linear(value))[pixels]

    def mask(self, source: str | Path) -> np.ndarray | None:
        """Return the user's mask (H, W) uint8, 255 on the object; None if this photograph has none.

        `source`: "alpha": the mask is the alpha channel. "rembg": the package rembg makes it. Otherwise, `source` is a
        folder of mask files. Raises InputError if the mask cannot be read, or if its size is not that of the
        photograph.
        """
        if source == "rembg":
            return np.array(rembg()(Image.fromarray(self.srgb())))
        if source == "alpha":
            if self.pixels.shape[2] != 4:
                return None
            mask = self.pixels[:, :, 3]
        elif file := self.mask_file(Path(source)):
            mask = Picture(file, self.upright).mask_pixels
            if mask.shape[::-1] != self.size:
                sizes = *mask.shape[::-1], *self.size
                raise InputError("{}: is {} x {} pixels, but its photograph {} x {}".format(file, *sizes))
        else:
            return None
        return (mask // (np.iinfo(mask.dtype).max // 255)).astype(np.uint8)

    def mask_file(self, folder: Path) -> Path | None:
        """Return the path of this photograph's mask file in `folder`; None if there is no such file.

        For photo.jpg, it is photo.jpg.png, photo.png, photo_mask.png or mask_photo.png, or one of these in another
        image format.
        """
        suffixes = [own for suffix in (".png", *SUFFIXES) for own in (suffix, suffix.upper())]
        names = self.path.name, self.name, f"{self.name}_mask", f"mask_{self.name}"
        files = (folder / f"{name}{suffix}" for name in names for suffix in suffixes)
        return next((file for file in files if file.is_file()), None)

    def close(self) -> None:
        """Drop the cached pixels to free memory. The next use reads them again."""
        self.__dict__.pop("pixels", None)


@cache
def rembg() -> Callable[[Image.Image], Image.Image]:
    """Load the network of the package rembg. Returns a function from an image to its mask.

    Raises InputError if rembg is not installed.
    """
    package = need("rembg", "--masks rembg")
    return partial(package.remove, session=package.new_session(), only_mask=True)


def turn_with_cameras(pictures: Sequence[Picture], vector: np.ndarray) -> dict[str, np.ndarray]:
    """Convert a vector that is fixed to the camera to the pixel axes of each photograph. Returns vectors by name.

    The camera may have been held in several orientations. `vector` (3,), or (3, n) for n vectors: in the axes (x right,
    y down, z forward) of a photograph with the most frequent orientation, shown upright.
    """
    usual, _ = Counter(picture.camera_orientation for picture in pictures).most_common(1)[0]
    return {p.name: p.axes @ orientation_axes(usual).T @ vector for p in pictures}


def up_directions(pictures: Sequence[Picture]) -> dict[str, np.ndarray]:
    """Return the up direction (3,) of each photograph in its pixel axes (x right, y down, z forward), by name.

    It is the direction that points up when the photograph is shown upright.
    """
    return {p.name: p.axes @ orientation_axes(p.camera_orientation).T @ [0, -1, 0] for p in pictures}


def find_pictures(folder: Path, upright: bool = True) -> list[Picture]:
    """List the photographs in a folder, sorted by name.

    Of a raw file and a JPEG of the same name, only the raw file is listed. `upright`: turn pixels by the EXIF
    orientation. Raises InputError if the folder is missing, if a file name cannot be used, if there are too few
    photographs, or if two of them are the same.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: FOLDER: {'is a file' if folder.exists() else 'no such folder'}; give the folder "
                         "of the photographs")  # fmt: skip
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        kind = path.suffix.lower()
        if kind not in SUFFIXES or path.name.startswith(".") or not path.is_file():
            continue
        command.require_expressible_name(str(path))
        if "$" in path.name:
            raise InputError(f"{path}: FOLDER: has a $ in its name, which scene files take for a parameter; rename it")
        if path.stem in found and not {kind, found[path.stem].suffix.lower()} & {*RAW, *HEIF}:
            raise InputError(f"{path}: FOLDER: has the name of {found[path.stem].name}; keep one of them, or move "
                             "masks to a folder of their own, and give it by --masks")  # fmt: skip
        if path.stem not in found or kind in RAW:  # a raw file is linear: prefer it to a JPEG of the same name
            found[path.stem] = path
    if mask := next((name for name in found if MASK_AFFIX.search(name) and MASK_AFFIX.sub("", name) in found), None):
        raise InputError(f"{found[mask]}: FOLDER: looks like the mask of {found[MASK_AFFIX.sub('', mask)].name}; move "
                         "masks to a folder of their own, and give it by --masks")  # fmt: skip
    if len(found) < MIN_PHOTOGRAPHS:
        kinds = Counter(path.suffix.lower() for path in folder.iterdir() if path.suffix and path.is_file())
        others = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(4) if kind not in SUFFIXES)
        others = f", and files that are not read: {others}" if others else ""
        raise InputError(f"{folder}: FOLDER: has {len(found)} photographs ({KINDS}){others}; at least "
                         f"{MIN_PHOTOGRAPHS} are needed, better 40, from all around")  # fmt: skip
    if "object" in found:
        raise InputError(f'{found["object"]}: FOLDER: "object" is a name that scenes need for the surface; rename it')
    sizes = Counter(path.stat().st_size for path in found.values())
    copies = defaultdict(list)
    for path in found.values():
        if sizes[path.stat().st_size] > 1:
            copies[hashlib.sha256(path.read_bytes()).digest()].append(path.name)
    if names := next((names for names in copies.values() if len(names) > 1), None):
        raise InputError(f"{folder}: FOLDER: {', '.join(names)} are the same photograph; keep one of them")
    return [Picture(path, upright) for path in found.values()]


def focal_35mm(pictures: Sequence[Picture]) -> float | None:
    """Return the 35 mm equivalent focal length [mm] from EXIF data, of the first photograph that has one.

    None if no photograph has one.
    """
    values = (picture.exif_field(ExifTags.Base.FocalLengthIn35mmFilm) for picture in pictures)
    return next((float(value) for value in values if isinstance(value, int | float) and value > 0), None)


def without_exposure(pictures: Sequence[Picture]) -> list[str]:
    """Return the file names of photographs without an exposure in their EXIF data; empty if all lack it."""
    missing = [p.path.name for p, exposure in zip(pictures, exif_exposures(pictures)) if np.isnan(exposure)]
    return missing if len(missing) < len(pictures) else []


def exif_exposures(pictures: Sequence[Picture]) -> np.ndarray:
    """Return the exposures (N,) from EXIF data: exposure time [s] · ISO / aperture². NaN if unknown.

    A value that all photographs lack, for example the aperture of an old lens, is taken as 1.
    """
    return np.array(exposures_of([picture.exif.get_ifd(ExifTags.IFD.Exif) for picture in pictures]))


def relative_exposures(pictures: Sequence[Picture], unknown: float = 1.0) -> np.ndarray:
    """Return the exposures (N,) from EXIF data, divided by their median.

    `unknown`: value for photographs without an exposure.
    """
    exposures = exif_exposures(pictures)
    known = np.isfinite(exposures)
    return np.where(known, exposures / np.median(exposures[known]) if known.any() else 1.0, unknown)


def with_saturations(pictures: Sequence[Picture]) -> tuple[list[Picture], str]:
    """Return the photographs with their saturations, and a sentence about these for the user; empty if all are 1.

    Raises InputError if values of 10, 12 or 14 bits in a file of 16 bits are not linear.
    """
    found, note = saturations_of(dict.fromkeys((picture.path for picture in pictures), "auto"))
    return [replace(picture, saturation=found.get(picture.path, 1.0)) for picture in pictures], note


def without_flash(pictures: Sequence[Picture]) -> list[str]:
    """Return the file names of photographs whose flash did not fire, by EXIF data.

    The list is empty unless the flash fired in more than half of the photographs.
    """
    fired = [picture.exif_field(ExifTags.Base.Flash) for picture in pictures]
    off = [p.path.name for p, value in zip(pictures, fired) if isinstance(value, int) and not value & 1]
    return off if sum(isinstance(value, int) and value & 1 for value in fired) > len(pictures) / 2 else []


def camera_names(pictures: Sequence[Picture]) -> dict[str, int]:
    """Count the photographs of each camera model in the EXIF data. Returns counts by the name of the model."""
    return dict(Counter(str(m) for picture in pictures if (m := picture.exif.get(ExifTags.Base.Model))))
