"""Images as arrays: encoding as sRGB, filters, and functions that read and write image files of any bit depth."""

import contextlib
import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import tifffile
import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional as F

from mi_ring.colour_profiles import as_stated
from mi_ring.errors import LARGEST, InputError
from mi_ring.foreign import require_plausible_size
from mi_ring.image_headers import (
    RAW,
    TIFF,
    bits_of,
    exr_picture,
    exr_size,
    open_image,
    statement_of,
    tiff_channels,
    tiff_page,
)
from mi_ring.system.files import write_file
from mi_ring.system.machine import exr_threads
from mi_ring.system.optional import need

#: Full scale and bits of cameras whose values may be stored in the low bits of 16.
LOW_BITS = {1023: 10, 4095: 12, 16383: 14}
MAX_LABELS = 32  #: largest number of values in a mask of labels; more are a picture
ROWS = 256  #: of a strip: large pictures are converted strip by strip, to save memory
EXR_CHUNK = 256  #: rows of the largest chunk of an OpenEXR file; its reader allocates one for an image of one row, too


def linear_to_srgb(v: np.ndarray) -> np.ndarray:
    """Clip linear values of any shape to [0, 1] and encode them as sRGB values in [0, 1]."""
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1 / 2.4) - 0.055)


def to_bytes(encoded: np.ndarray) -> np.ndarray:
    """Convert values from [0, 1] to uint8 values from 0 to 255. Values outside of [0, 1] are clipped."""
    return (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)


def box_filter(image: Tensor, scale: int) -> Tensor:
    """Average blocks of `scale` × `scale` pixels: (H, W, C) → (H // scale, W // scale, C).

    Incomplete blocks are left out.
    """
    if scale == 1:
        return image
    return F.avg_pool2d(image.permute(2, 0, 1), scale).permute(1, 2, 0)


def read_image(path: Path, heed: bool = False) -> np.ndarray:
    """Read the pixels (H, W, C) of an image file: uint8, uint16 or float32. Raw files become linear uint16.

    `heed`: True applies the colour space that the file declares. The result is then sRGB if it is uint8, otherwise
    linear with sRGB's primaries. False returns the pixels as they are stored.

    Raises ValueError for CMYK, for integers of more than 16 bits, for floats that are NaN, infinite or above 1e18, for
    files of several pictures and for an implausible size. The size is checked before memory is allocated. Damaged files
    raise errors of other types.
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
            if bits_of(path) == 16:  # Pillow reduces 16 bits to 8; Mitsuba does not
                pixels = np.array(mi.Bitmap(str(path)), copy=True)
            elif image.has_transparency_data:  # of palettes, too
                pixels = decoded_in_strips(image if image.mode == "LA" else image.convert("RGBA"))
            else:
                if image.mode not in ("L", "RGB"):
                    image = image.convert("L" if image.mode == "1" else "RGB")
                pixels = decoded_in_strips(image)
    pixels = pixels if pixels.ndim == 3 else pixels[:, :, None]
    if pixels.dtype == np.float32 and not (np.abs(pixels) <= LARGEST).all():
        raise ValueError(f"contains pixels that are NaN, infinite or above {LARGEST:g}")
    return as_stated(pixels, statement_of(path)) if heed else pixels


def decoded_in_strips(image: Image.Image) -> np.ndarray:
    """Return the pixels (H, W, C) uint8 of an image. In strips, because Pillow would hold two more copies of them."""
    width, height = image.size
    pixels = np.empty((height, width, len(image.getbands())), np.uint8)
    for top in range(0, height, ROWS):
        strip = image.crop((0, top, width, min(top + ROWS, height)))
        pixels[top : top + ROWS] = np.asarray(strip).reshape(strip.height, width, -1)
    return pixels


def largest_value(pictures: Iterable[np.ndarray]) -> int:
    """Return the largest colour value of pictures (H, W, C) uint16; 0 without pictures.

    It tells whether they use all 16 bits: see `LOW_BITS`. Once a value needs more than 14 bits, no more pictures are
    taken from the iterator.
    """
    largest = 0
    for pixels in pictures:
        largest = max(largest, int(pixels[..., : 3 if pixels.shape[2] > 2 else 1].max()))
        if largest >= 2**14:
            break
    return largest


def read_tiff(path: Path) -> np.ndarray:
    """Read the pixels (H, W, C) of the first page of a TIFF file; (H, W) if there is one channel.

    They are uint8, uint16 or float32. Raises ValueError for CMYK, for integers of more than 16 bits, for files of
    several pictures and for an implausible size.
    """
    kinds = tifffile.PHOTOMETRIC
    with tifffile.TiffFile(path) as file:
        page = tiff_page(file)
        require_plausible_size(path, page.nbytes)
        for count, what in ((sum(page.databytecounts), "bytes"), (math.prod(page.chunked), "strips or tiles")):
            if count > path.stat().st_size:  # the reader would request each of them
                raise ValueError(f"declares {count:,} {what}, but is shorter")
        pixels = page.asarray()
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
            pixels = np.moveaxis(pixels, 0, -1)
        if pixels.ndim == 3:
            pixels = pixels[..., : tiff_channels(page)]
        if page.photometric == kinds.PALETTE:
            return (np.asarray(page.colormap)[:, pixels].transpose(1, 2, 0) >> 8).astype(np.uint8)
        if pixels.dtype == bool:
            pixels = pixels.astype(np.uint8) * np.uint8(255)
        elif pixels.dtype.kind == "u" and (bits := page.bitspersample) not in (8, 16):  # stored in the low bits
            values = np.arange(2**bits) * (np.iinfo(pixels.dtype).max / (2**bits - 1)) + 0.5
            pixels = values.astype(pixels.dtype)[pixels]
        if page.photometric == kinds.MINISWHITE:
            pixels = np.iinfo(pixels.dtype).max - pixels if pixels.dtype.kind == "u" else 1 - pixels
        if page.extrasamples[:1] == (tifffile.EXTRASAMPLE.ASSOCALPHA,) and pixels.dtype.kind == "u":
            full, alpha = np.iinfo(pixels.dtype).max, pixels[..., -1:].astype(np.float32)
            colours = (pixels[..., :-1] * (full / np.maximum(alpha, 1)) + 0.5).clip(0, full).astype(pixels.dtype)
            pixels = np.concatenate([colours, pixels[..., -1:]], -1)
    return pixels.astype(np.float32, copy=False) if pixels.dtype.kind == "f" else pixels


def read_exr(path: Path) -> np.ndarray:
    """Read the picture in an OpenEXR file: (H, W, C) float32. The channels are R, G, B, A, or Y, A, or the only one.

    Raises ValueError if no channels form a picture, if the file has several parts or layers or only a part of the
    picture, and for an implausible size.
    """
    width, height, channels = exr_size(path)
    require_plausible_size(path, 4 * width * max(height, EXR_CHUNK) * channels)
    with exr_threads():
        bitmap = mi.Bitmap(str(path))
    names = [field.name for field in bitmap.struct_()]  # type: ignore[attr-defined]
    pixels = np.asarray(bitmap).reshape(height, width, len(names))
    # This copies once: the bitmap's memory ends with the bitmap.
    return pixels[..., [names.index(name) for name in exr_picture(names)]].astype(np.float32, copy=False)


def read_raw(path: Path) -> np.ndarray:
    """Develop a raw file to linear radiance (H, W, 3) uint16, with sRGB's primaries and the camera's white balance.

    Raises InputError if the package rawpy is not installed, ValueError for an implausible size.
    """
    with need("rawpy", f"{path}").imread(str(path)) as raw:
        require_plausible_size(path, 6 * raw.sizes.raw_width * raw.sizes.raw_height)
        return raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, user_flip=0)


def mask_values(pixels: np.ndarray, what: str) -> np.ndarray:
    """Convert the pixels (H, W, C) of a mask file to the mask (H, W) uint8, from 0 (background) to 255 (object).

    The mask is the alpha channel if it is not constant. Otherwise it is the colour channel that varies most, because
    the object may have any colour. If all values above 0 are equal, such as the label 1, they become 255.

    Raises InputError if the values seem to be several labels: floats above 1, or a few values that are all dark. The
    message begins with `what`.
    """
    count = pixels.shape[2]
    extent = np.ptp(pixels, (0, 1))
    has_alpha = count in (2, 4) and extent[-1] > 0
    channel = pixels[..., -1 if has_alpha else extent[: 3 if count > 2 else 1].argmax()]
    shown = channel[channel > 0]
    if 0 < shown.size < channel.size and shown.min() == shown.max():
        return np.where(channel > 0, np.uint8(255), np.uint8(0))
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(pixels.dtype, 1)
    largest = shown.max(initial=0)
    if largest > full or (0 < largest < full / 2 and len(np.unique(shown)) <= MAX_LABELS):
        labels = np.unique(channel)
        listed = ", ".join(f"{label:g}" for label in labels[:6]) + ", …" * (len(labels) > 6)
        raise InputError(f"{what}: has the values {listed}; save the object as {full}, and all else as 0")
    return (channel.astype(np.float32) * (255 / full)).round().astype(np.uint8)


def orientation_axes(orientation: int) -> np.ndarray:
    """Return the matrix (3, 3) that turns directions from the stored image to the upright image.

    `orientation`: the EXIF orientation, 1 to 8. In both images, the axes are x right, y down, z forward.
    """
    column, row = [(1, 1), (-1, 1), (-1, -1), (1, -1)][(orientation - 1) % 4]
    return np.diag([column, row, 1.0]) @ np.eye(3)[[1, 0, 2] if orientation > 4 else [0, 1, 2]]


def oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate or mirror pixels (H, W, …) so that the image is upright. `orientation`: the EXIF orientation, 1 to 8."""
    column, row = orientation_axes(orientation)[:2, :2].sum(1).astype(int)
    return np.ascontiguousarray((pixels.swapaxes(0, 1) if orientation > 4 else pixels)[::row, ::column])


def blur(images: Tensor, sigma: float) -> Tensor:
    """Blur images (..., H, W) with a Gaussian of standard deviation `sigma` > 0 [px].

    Pixels outside of the image count as zero.
    """
    radius = int(3 * sigma + 0.5)
    total = sum(math.exp(-0.5 * (x / sigma) ** 2) for x in range(-radius, radius + 1))

    def kernel(n: int) -> Tensor:  # as a matrix, because a product takes a tenth of the time of a convolution
        distance = (torch.arange(n)[:, None] - torch.arange(n)).to(images)
        return torch.where(distance.abs() <= radius, torch.exp(-0.5 * (distance / sigma) ** 2) / total, 0)

    return kernel(images.shape[-2]) @ images @ kernel(images.shape[-1])


def write_image(pixels: np.ndarray, path: Path) -> None:
    """Write an image (H, W, C) to a file. The suffix of `path` chooses the format: .png, .exr, otherwise JPEG.

    `pixels` are written as they are: uint8 or uint16 for PNG, uint8 for JPEG, floats for OpenEXR.
    """
    formats = mi.Bitmap.FileFormat
    kind = {".png": formats.PNG, ".exr": formats.OpenEXR}.get(path.suffix.lower(), formats.JPEG)
    stream = mi.MemoryStream()
    with exr_threads() if kind == formats.OpenEXR else contextlib.nullcontext():
        mi.Bitmap(np.require(pixels, requirements=["C", "W"])).write(stream, kind)
    write_file(path, stream.raw_buffer())


def encoded_picture(picture: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    """Encode a Pillow image as the bytes of a file.

    `kind`: Pillow's name of the file format. `options`: arguments of Pillow's `Image.save`.
    """
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()
