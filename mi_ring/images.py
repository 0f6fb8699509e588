"""Images as arrays: sRGB, box filter, Gaussian blur, and image files of any bit depth."""

import contextlib
import io
import itertools
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import mitsuba as mi
import numpy as np
import tifffile
import torch
from PIL import ExifTags, Image, UnidentifiedImageError
from torch import Tensor
from torch.nn import functional as F

from mi_ring.colour_profiles import Statement, as_stated, primaries_profile
from mi_ring.foreign import require_plausible_size
from mi_ring.system.files import write_file
from mi_ring.system.machine import exr_threads
from mi_ring.system.optional import need

#: Suffixes of image files that are read, in lower case: common formats, formats whose package may be missing, others.
PLAIN, HEIF = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".avif", ".bmp"), (".heic", ".heif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
SUFFIXES = (*PLAIN, *HEIF, *RAW, ".exr")
TIFF = (".tif", ".tiff")
KINDS = "JPEG, PNG, TIFF, OpenEXR, WebP, AVIF, HEIC, BMP or raw"  #: for messages
FORMATS = "JPEG", "MPO", "PNG", "WEBP", "HEIF", "AVIF", "BMP", "TIFF"  #: formats in which Pillow may open a file
PNG_DEPTH = 24  #: where a PNG file says the number of its bits
EXR_CHUNK = 256  #: rows of the largest chunk of an OpenEXR file; its reader allocates one for an image of one row, too

# Photographs of phones exceed Pillow's limit. `require_plausible_size` checks the size instead.
Image.MAX_IMAGE_PIXELS = None

Pictures = TypeVar("Pictures", np.ndarray, Tensor)


def srgb_to_linear(v: np.ndarray) -> np.ndarray:
    """Convert sRGB values to linear ones (IEC 61966-2-1), as float32."""
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(v: np.ndarray) -> np.ndarray:
    """Convert linear values, clipped to [0, 1], to sRGB values."""
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055)


def contrasted(linear: Pictures, contrast: Any) -> Pictures:
    """Apply an S-curve, like that of film, to linear values. Values of 1 and above do not change.

    It maps an sRGB value v to vᶜ / (vᶜ + (1 − v)ᶜ), where c is `contrast`. The inverse is the curve with 1 / c.
    """
    where: Any = torch.where if isinstance(linear, Tensor) else np.where
    x = linear.clip(1e-6, 1 - 1e-6)  # so that the powers have finite derivatives
    v = where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    a, b = v**contrast, (1 - v) ** contrast
    v = a / (a + b)
    y = where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return where(linear < 1, y * where(linear < x, linear / x, 1.0), linear)  # linear below 1e-6


def to_bytes(encoded: np.ndarray) -> np.ndarray:
    """Convert values, clipped to [0, 1], to uint8 from 0 to 255."""
    return (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)


def box_filter(image: Tensor, scale: int) -> Tensor:
    """Average blocks of `scale` × `scale` pixels: (H, W, C) → (H // scale, W // scale, C)."""
    if scale == 1:
        return image
    return F.avg_pool2d(image.permute(2, 0, 1), scale).permute(1, 2, 0)


class BoundedFile(io.BufferedReader):
    """A file whose `read` allocates at most the bytes that are left, even if a damaged header requests more."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


@contextlib.contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image file by Pillow, in a context manager.

    Raises ValueError if it is no image or declares an implausible size, InputError if it is HEIF and pillow_heif is not
    installed, and other errors if it is damaged.
    """
    if path.suffix.lower() in HEIF:
        need("pillow_heif", f"{path}").register_heif_opener()
    Image.init()
    formats = [name for name in FORMATS if name in Image.OPEN]  # HEIF and AVIF may be missing
    with BoundedFile(io.FileIO(path)) as file:
        try:
            image = Image.open(file, formats=formats)
        except UnidentifiedImageError as error:  # its message does not name the file
            raise ValueError(f"its content is none of {KINDS}; save it as one of them") from error
        with image:
            require_plausible_size(path, 2 * len(image.getbands()) * math.prod(image.size))
            yield image


def exif_of(path: Path) -> Image.Exif:
    """The EXIF data of an image file; empty if it has none. Raises the same errors as `open_image`."""
    suffix, exif = path.suffix.lower(), Image.Exif()
    if suffix in (*TIFF, *RAW):  # Pillow does not open all of their pixels
        trouble = () if suffix in TIFF else (Exception,)  # of raw files that are no TIFFs
        with contextlib.suppress(*trouble), BoundedFile(io.FileIO(path)) as file:
            if file.peek(4)[:4] not in (b"II+\0", b"MM\0+"):  # BigTIFF, which Pillow cannot read
                exif.load_from_fp(file)
                exif.get_ifd(ExifTags.IFD.Exif)  # read while the file is open
    elif suffix != ".exr":
        with open_image(path) as image:
            exif = image.getexif()
            exif.get_ifd(ExifTags.IFD.Exif)
    return exif


def image_size(path: Path) -> tuple[int, int]:
    """Read the width and height [px] that an image file declares. Raises the same errors as `open_image`."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return exr_size(path)[:2]
    if suffix in TIFF:  # Pillow would rotate it by its orientation; `read_image` does not
        with tifffile.TiffFile(path) as file:
            return file.pages.first.imagewidth, file.pages.first.imagelength
    if suffix in RAW:
        with need("rawpy", f"{path}").imread(str(path)) as raw:
            return raw.sizes.iwidth, raw.sizes.iheight
    with open_image(path) as image:
        return image.size


def statement_of(path: Path) -> Statement:
    """What an image file says about its colours. Raises the same errors as `open_image`."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        if len(found := exr_attributes(path, b"chromaticities").get(b"chromaticities", b"")) == 32:
            *primaries, x, y = struct.unpack("<8f", found)
            return Statement(primaries_profile((x, y), tuple(primaries)))
    elif suffix in TIFF:
        with tifffile.TiffFile(path) as file:
            return Statement(file.pages.first.iccprofile)
    elif suffix not in RAW:
        with open_image(path) as image:
            gamma = image.info.get("gamma")
            exponent = 2.2 if "srgb" in image.info else 1 / gamma if gamma and image.format == "PNG" else None
            return Statement(image.info.get("icc_profile") or None, exponent)
    return Statement()


def bits_of(path: Path) -> int:
    """Bits of a channel that an image file stores: 8, 16, or 32 for floats. Raises the same errors as `open_image`."""
    suffix = path.suffix.lower()
    if suffix in TIFF:
        with tifffile.TiffFile(path) as file:
            kind = file.pages.first.dtype
            return 32 if kind is None or kind.kind == "f" else 8 if kind.itemsize == 1 else 16
    if suffix in (".exr", *RAW):
        return 32 if suffix == ".exr" else 16
    with path.open("rb") as file:
        head = file.read(PNG_DEPTH + 1)
    return 16 if head.startswith(b"\x89PNG") and head[PNG_DEPTH:] == b"\x10" else 8


def encoding_of(path: Path) -> str:
    """The encoding of the pixels that `read_image` gives with `heed`: srgb or linear."""
    said = statement_of(path)
    sample = np.zeros((1, 1, 3), np.uint8)
    return "srgb" if bits_of(path) == 8 and as_stated(sample, said).dtype == np.uint8 else "linear"


def exr_attributes(path: Path, *wanted: bytes) -> dict[bytes, bytes]:
    """These attributes in the header of an OpenEXR file, by name.

    The header is a list of attributes ("OpenEXR File Layout"): name and type, which end in a zero byte, size, value.
    Raises ValueError if it is no OpenEXR file, or one of several parts.
    """
    found: dict[bytes, bytes] = {}
    with path.open("rb") as file:

        def text() -> bytes:
            letters = iter(lambda: file.read(1) or b"\0", b"\0")
            return b"".join(itertools.islice(letters, 256))  # the longest that the format allows

        if (head := file.read(8))[:4] != b"\x76\x2f\x31\x01":
            raise ValueError("no OpenEXR file")
        if head[5] & 0x10:
            raise ValueError("has several parts; save the one of the photograph alone")
        while len(found) < len(wanted) and (name := text()):
            text()
            (size,) = struct.unpack("<I", file.read(4))
            if name in wanted:
                found[name] = file.read(min(size, 2**16))
            else:
                file.seek(size, os.SEEK_CUR)
    return found


def exr_size(path: Path) -> tuple[int, int, int]:
    """Width [px], height [px] and number of channels that the header of an OpenEXR file declares."""
    found = exr_attributes(path, b"channels", b"dataWindow")
    left, top, right, bottom = struct.unpack("<4i", found[b"dataWindow"])
    channels, place = 0, 0
    while found[b"channels"][place]:  # a channel is its name, a zero byte and 16 more bytes
        channels, place = channels + 1, found[b"channels"].index(b"\0", place) + 17
    if min(right - left, bottom - top, channels - 1) < 0:
        raise ValueError("declares no pixels")
    return right - left + 1, bottom - top + 1, channels


def read_image(path: Path, heed: bool = False) -> np.ndarray:
    """The pixels (H, W, C) of an image file: uint8, uint16 or float32. Raw files are developed: linear, uint16.

    `heed`: obey what the file says about its colours, so that 8 bits are sRGB and all others linear, see
    `colour_profiles.as_stated`. Without it: the pixels as they are stored.

    Raises ValueError for CMYK, for integers of more than 16 bits, for several parts and for an implausible size, before
    memory is allocated; other errors for damaged files.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF:
        pixels = read_tiff(path)
    elif suffix == ".exr":
        pixels = read_exr(path)
    elif suffix in RAW:
        pixels = read_raw(path)
    else:
        with open_image(path) as image:
            if image.mode in ("CMYK", "YCCK"):
                raise ValueError("its colours are those of inks, CMYK; save it as RGB")
            if bits_of(path) == 16:  # Pillow reduces 16 bits to 8; Mitsuba does not
                pixels = np.array(mi.Bitmap(str(path)), copy=True)
            elif image.has_transparency_data:  # of palettes, too
                pixels = np.array(image if image.mode == "LA" else image.convert("RGBA"))
            else:
                if image.mode not in ("L", "RGB"):
                    image = image.convert("L" if image.mode == "1" else "RGB")
                pixels = np.asarray(image)  # without a copy: it may be large
    pixels = pixels if pixels.ndim == 3 else pixels[:, :, None]
    return as_stated(pixels, statement_of(path)) if heed else pixels


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the first page of a TIFF file. Raises ValueError as `read_image` does."""
    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        if page.photometric == tifffile.PHOTOMETRIC.SEPARATED:
            raise ValueError("its colours are those of inks, CMYK; save it as RGB")
        if page.dtype is None or not (page.dtype.kind == "f" or (page.dtype.kind in "bu" and page.dtype.itemsize <= 2)):
            raise ValueError(f"has {page.dtype} pixels, whose full scale is unknown; save it with 8 or 16 bits, or as "
                             "floats")  # fmt: skip
        require_plausible_size(path, math.prod(page.shape) * page.dtype.itemsize)
        for count, what in ((sum(page.databytecounts), "bytes"), (math.prod(page.chunked), "strips or tiles")):
            if count > path.stat().st_size:  # the reader would request each of them
                raise ValueError(f"declares {count:,} {what}, but is shorter")
        pixels = page.asarray()
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
            pixels = np.moveaxis(pixels, 0, -1)
        if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
            return (page.colormap[:, pixels].transpose(1, 2, 0) >> 8).astype(np.uint8)
        if pixels.dtype == bool:
            pixels = pixels.astype(np.uint8) * np.uint8(255)
        elif pixels.dtype.kind == "u" and (bits := page.bitspersample) not in (8, 16):  # stored in the low bits
            full = np.iinfo(pixels.dtype).max
            pixels = (pixels.astype(np.float32) * (full / (2**bits - 1)) + 0.5).astype(pixels.dtype)
        if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            pixels = np.iinfo(pixels.dtype).max - pixels if pixels.dtype.kind == "u" else 1 - pixels
    return pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels


def read_exr(path: Path) -> np.ndarray:
    """The channels R, G, B and A of an OpenEXR file, or all if it has at most four of other names: float32."""
    width, height, channels = exr_size(path)
    require_plausible_size(path, 4 * width * max(height, EXR_CHUNK) * channels)
    with exr_threads():
        bitmap = mi.Bitmap(str(path))
    names = [field.name for field in bitmap.struct_()]  # type: ignore[attr-defined]
    pixels = np.array(bitmap, copy=True).astype(np.float32)
    if len(names) <= 4:
        return pixels
    if not {"R", "G", "B"} <= {*names}:
        raise ValueError(f"has channels {', '.join(names[:6])}, …, but no R, G, B; save the photograph alone")
    return pixels[..., [names.index(name) for name in "RGBA" if name in names]]


def read_raw(path: Path) -> np.ndarray:
    """Linear radiance in sRGB's primaries, with the camera's white balance, of a raw file: uint16."""
    with need("rawpy", f"{path}").imread(str(path)) as raw:
        require_plausible_size(path, 6 * raw.sizes.raw_width * raw.sizes.raw_height)
        return raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, user_flip=0)


def mask_values(pixels: np.ndarray) -> np.ndarray:
    """A mask (H, W) uint8 in the pixels (H, W, C) of its file: the alpha channel if that varies, else the first."""
    channel = pixels[..., 0]
    if pixels.shape[2] in (2, 4) and pixels[..., -1].min() < pixels[..., -1].max():
        channel = pixels[..., -1]
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(pixels.dtype, 1)
    return (channel.astype(np.float32) * (255 / full)).round().astype(np.uint8)


def orientation_axes(orientation: int) -> np.ndarray:
    """(3, 3) from the axes (x right, y down, z forward) of stored pixels to those after a turn by an orientation."""
    column, row = [(1, 1), (-1, 1), (-1, -1), (1, -1)][(orientation - 1) % 4]
    return np.diag([column, row, 1.0]) @ np.eye(3)[[1, 0, 2] if orientation > 4 else [0, 1, 2]]


def oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels (H, W, …) turned by an EXIF orientation."""
    column, row = orientation_axes(orientation)[:2, :2].sum(1).astype(int)
    return np.ascontiguousarray((pixels.swapaxes(0, 1) if orientation > 4 else pixels)[::row, ::column])


def blur(images: Tensor, sigma: float) -> Tensor:
    """Blur images (..., H, W) by a Gaussian of `sigma` > 0 [px]. Pixels outside count as zero."""
    radius = int(3 * sigma + 0.5)
    total = sum(math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1))

    def kernel(n: int) -> Tensor:  # as a matrix, because a product takes a tenth of the time of a convolution
        distance = (torch.arange(n)[:, None] - torch.arange(n)).to(images)
        return torch.where(distance.abs() <= radius, torch.exp(-0.5 * (distance / sigma) ** 2) / total, 0)

    return kernel(images.shape[-2]) @ images @ kernel(images.shape[-1])


def write_image(pixels: np.ndarray, path: Path) -> None:
    """Write an image (H, W, C) by `write_file`. The suffix says the format: .png, .exr, otherwise JPEG."""
    formats = mi.Bitmap.FileFormat
    kind = {".png": formats.PNG, ".exr": formats.OpenEXR}.get(path.suffix.lower(), formats.JPEG)
    stream = mi.MemoryStream()
    with exr_threads() if kind == formats.OpenEXR else contextlib.nullcontext():
        mi.Bitmap(np.require(pixels, requirements=["C", "W"])).write(stream, kind)
    write_file(path, stream.raw_buffer())


def encoded_picture(picture: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    """Encode an image as the content of a file. `kind` and `options` are those of Pillow's `save`."""
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()
