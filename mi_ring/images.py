"""Pictures as arrays: sRGB, box filter, Gaussian blur, files with all their bits."""

import contextlib
import io
import itertools
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import imageio.v3 as imageio
import mitsuba as mi
import numpy as np
import tifffile
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor
from torch.nn import functional as F

from mi_ring.foreign import require_room
from mi_ring.system.files import write_file
from mi_ring.system.machine import exr_threads

#: Suffixes of photographs, lower case: those that everybody reads, and those that take packages of their own.
PLAIN, HEIF = (".jpg", ".jpeg", ".png", ".tif", ".tiff"), (".heic", ".heif")
FORMATS = "JPEG", "MPO", "PNG", "TIFF", "WEBP", "HEIF", "AVIF", "BMP"  #: that Pillow may take an image file for
EXR_CHUNK = 256  #: rows of an OpenEXR file's largest chunks: its reader holds some, however low the picture is
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")

# Photographs of phones have more pixels than what Pillow takes for an attack; `require_room` goes by the file's size.
Image.MAX_IMAGE_PIXELS = None


def srgb_to_linear(v: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, on numpy arrays."""
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(v: np.ndarray) -> np.ndarray:
    """The inverse of `srgb_to_linear`, clipped to [0, 1]."""
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055)


Pictures = TypeVar("Pictures", np.ndarray, Tensor)


def contrasted(linear: Pictures, contrast: Any) -> Pictures:
    """Linear values whose sRGB encoding v has become vᶜ / (vᶜ + (1 − v)ᶜ), c = `contrast`; from 1 on as they are.

    An S-curve as of film: steeper in the middle, and flat at both ends. `1 / contrast` undoes it.
    """
    where: Any = torch.where if isinstance(linear, Tensor) else np.where
    x = linear.clip(1e-6, 1 - 1e-6)  # where powers have slopes
    v = where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    a, b = v**contrast, (1 - v) ** contrast
    v = a / (a + b)
    y = where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return where(linear < 1, y * where(linear < x, linear / x, 1.0), linear)  # straight below


def to_bytes(encoded: np.ndarray) -> np.ndarray:
    """[0, 1] to uint8."""
    return (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)


def box_filter(image: Tensor, scale: int) -> Tensor:
    """(H, W, C) → (H // scale, W // scale, C), the mean over blocks."""
    if scale == 1:
        return image
    return F.avg_pool2d(image.permute(2, 0, 1), scale).permute(1, 2, 0)


class Bounded(io.BufferedReader):
    """A file of which nobody reads more bytes at once than it has: else as many are allocated as are asked for."""

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """An image file by Pillow, which may read more than the header to answer any question.

    Raises ValueError if it declares to be larger than such a file can be, what its reader likes if it is none.
    """
    Image.init()
    formats = [name for name in FORMATS if name in Image.OPEN]  # HEIF if its opener is there
    with Bounded(io.FileIO(path)) as file:
        try:
            image = Image.open(file, formats=formats)
        except UnidentifiedImageError as error:  # which names the object, not the file
            raise ValueError("its content is that of no image") from error
        with image:
            require_room(path, 2 * len(image.getbands()) * math.prod(image.size))
            yield image


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] that an image file declares. Raises as `opened` does."""
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return exr_size(path)[:2]
    if suffix in (".tif", ".tiff"):  # which Pillow turns by their orientation, `read_image` does not
        with tifffile.TiffFile(path) as file:
            return file.pages.first.imagewidth, file.pages.first.imagelength
    with opened(path) as image:
        return image.size


def exr_size(path: Path) -> tuple[int, int, int]:
    """Width, height [px] and number of channels that the header of an OpenEXR file declares.

    By "OpenEXR File Layout": attributes are their name and their type, which end in 0, their size and their value.
    """
    found: dict[bytes, bytes] = {}
    with path.open("rb") as file:

        def word() -> bytes:
            letters = iter(lambda: file.read(1) or b"\0", b"\0")
            return b"".join(itertools.islice(letters, 256))  # the format's longest

        if file.read(8)[:4] != b"\x76\x2f\x31\x01":
            raise ValueError("no OpenEXR file")
        while len(found) < 2 and (name := word()):
            word()
            (size,) = struct.unpack("<I", file.read(4))
            if name in (b"channels", b"dataWindow"):
                found[name] = file.read(min(size, 2**16))
            else:
                file.seek(size, os.SEEK_CUR)
    left, top, right, bottom = struct.unpack("<4i", found[b"dataWindow"])
    channels, place = 0, 0
    while found[b"channels"][place]:  # a name, then 16 bytes
        channels, place = channels + 1, found[b"channels"].index(b"\0", place) + 17
    if min(right - left, bottom - top, channels - 1) < 0:
        raise ValueError("declares no pixels")
    return right - left + 1, bottom - top + 1, channels


def read_image(path: Path) -> np.ndarray:
    """Pixels (H, W, C) of an image file as they are: uint8, uint16, else float32.

    Raises ValueError for inks and, before it is allocated, for what declares to be larger than such a file can be; what
    its reader likes for what is damaged.
    """
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):  # which Mitsuba does not read
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            if page.photometric == tifffile.PHOTOMETRIC.SEPARATED:
                raise ValueError("its colours are those of inks, CMYK; save it as RGB")
            require_room(path, math.prod(page.shape) * page.dtype.itemsize)
            if sum(page.databytecounts) > path.stat().st_size:
                raise ValueError(f"declares {sum(page.databytecounts):,} bytes, and is shorter")
            if math.prod(page.chunked) > path.stat().st_size:  # each of which would be asked for
                raise ValueError(f"declares {math.prod(page.chunked):,} strips or tiles, and is shorter")
        pixels = np.array(imageio.imread(path, page=0))
    elif suffix == ".exr":
        width, height, channels = exr_size(path)
        require_room(path, 4 * width * max(height, EXR_CHUNK) * channels)
        with exr_threads():
            pixels = np.array(mi.Bitmap(str(path)), copy=True)
    elif suffix in (".jpg", ".jpeg"):  # Mitsuba reads those that end too early, grey from there on
        with opened(path) as image:
            pixels = np.array(image if image.mode == "L" else image.convert("RGB"))
    else:
        with opened(path):  # others read PNGs of 16 bits as 8, silently
            pixels = np.array(mi.Bitmap(str(path)), copy=True)
    if pixels.dtype not in (np.uint8, np.uint16):
        pixels = pixels.astype(np.float32)
    return pixels if pixels.ndim == 3 else pixels[:, :, None]


def blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur by `sigma` > 0 [px] of (..., H, W) images, zero outside."""
    radius = int(3 * sigma + 0.5)
    total = sum(math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1))

    def kernel(n: int) -> Tensor:  # as a matrix: two products are ten times faster than two convolutions
        distance = (torch.arange(n)[:, None] - torch.arange(n)).to(images)
        return torch.where(distance.abs() <= radius, torch.exp(-0.5 * (distance / sigma) ** 2) / total, 0)

    return kernel(images.shape[-2]) @ images @ kernel(images.shape[-1])


def write_image(pixels: np.ndarray, path: Path) -> None:
    """An image (H, W, C) as PNG, JPEG or EXR, by the file's name, whole or not at all."""
    formats = mi.Bitmap.FileFormat
    kind = {".png": formats.PNG, ".exr": formats.OpenEXR}.get(path.suffix.lower(), formats.JPEG)
    stream = mi.MemoryStream()
    with exr_threads() if kind == formats.OpenEXR else contextlib.nullcontext():
        mi.Bitmap(np.ascontiguousarray(pixels)).write(stream, kind)
    write_file(path, stream.raw_buffer())
