"""Reads the headers of image files, without the pixels: format, size, bit depth, EXIF data and colour space."""

import contextlib
import io
import itertools
import math
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import tifffile
from PIL import ExifTags, Image, UnidentifiedImageError

from mi_ring.colour_profiles import (
    ADOBE_RGB,
    PRIMARIES,
    WHITE,
    Statement,
    as_stated,
    coded_statement,
    primaries_profile,
)
from mi_ring.foreign import require_plausible_size
from mi_ring.system.optional import need

TIFF, HEIF = (".tif", ".tiff"), (".heic", ".heif")
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
#: Suffixes of image files that are read, in lower case, by their kind.
BY_KIND = {
    "JPEG": (".jpg", ".jpeg"), "PNG": (".png",), "TIFF": TIFF, "WebP": (".webp",), "AVIF": (".avif",),
    "BMP": (".bmp",), "HEIF": HEIF, "OpenEXR": (".exr",), "raw": RAW,
}  # fmt: skip
SUFFIXES = tuple(itertools.chain(*BY_KIND.values()))
KINDS = "JPEG, PNG, TIFF, OpenEXR, WebP, AVIF, HEIC, BMP or raw"  #: for messages
FORMATS = "JPEG", "MPO", "PNG", "WEBP", "HEIF", "AVIF", "BMP", "TIFF"  #: formats in which Pillow may open a file
PNG_DEPTH = 24  #: where a PNG file says the number of its bits
COLOUR_BOX = b"colrnclx"  #: of HEIF and AVIF, followed by the codes of primaries and transfer curve
BOXES = 2**16  #: bytes at the beginning of a HEIF or AVIF file that hold its boxes

# Photographs of phones exceed Pillow's limit. `require_plausible_size` checks the size instead.
Image.MAX_IMAGE_PIXELS = None


class BoundedFile(io.BufferedReader):
    """A binary file whose `read` never allocates more memory than the rest of the file needs.

    This is for damaged headers, after which a reader may request any number of bytes.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


@contextlib.contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Context manager that opens an image file with Pillow, without reading its pixels. Not for OpenEXR and raw files.

    Raises ValueError if the file is no image, is CMYK or declares an implausible size. Raises InputError for a HEIF
    file if the package pillow_heif is not installed. A damaged file raises errors of other types.
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
            if image.mode in ("CMYK", "YCCK"):
                raise ValueError("its colours are those of inks, CMYK; save it as RGB")
            bands = 4 if image.has_transparency_data else len(image.getbands())  # palettes become RGBA
            require_plausible_size(path, 2 * bands * math.prod(image.size))
            yield image


def exif_of(path: Path) -> Image.Exif:
    """Read the EXIF data of an image file. The result is empty if the file has none.

    Raises ValueError if the file is no image or is CMYK. A damaged file raises errors of other types.
    """
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
    """Read (width, height) [px] of the stored pixels from the header of an image file. EXIF orientation is not applied.

    Raises ValueError for a file that mi_ring cannot use: for example CMYK, several pictures, or a part of a picture.
    Raises InputError if a package for the format is not installed. A damaged file raises errors of other types.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return exr_size(path)[:2]
    if suffix in TIFF:  # Pillow would rotate it by its orientation; `read_image` does not
        with tifffile.TiffFile(path) as file:
            page = tiff_page(file)
            return page.imagewidth, page.imagelength
    if suffix in RAW:
        with need("rawpy", f"{path}").imread(str(path)) as raw:
            return raw.sizes.iwidth, raw.sizes.iheight
    with open_image(path) as image:
        return image.size


def require_whole(path: Path) -> None:
    """Raise ValueError if a JPEG file is cut off before the end of its pixels. Other files are not tested.

    The pixels are not decoded.
    """
    if path.suffix.lower() not in BY_KIND["JPEG"]:
        return
    content, place = path.read_bytes(), 2
    while content[place : place + 1] == b"\xff" and content[place + 1 : place + 2] not in (b"\xff", b"\xda"):
        place += 2 + int.from_bytes(content[place + 2 : place + 4], "big")  # to the first scan: previews end, too
    if content.startswith(b"\xff\xd8") and b"\xff\xd9" not in content[place:]:
        raise ValueError("is cut off in its pixels; copy it again")


def tiff_page(file: tifffile.TiffFile) -> tifffile.TiffPage:
    """Return the first page of a TIFF file, without reading its pixels.

    Raises ValueError if its colours are neither grey, RGB nor a palette, if its integers have more than 16 bits, or if
    the file contains several pictures. Smaller previews are allowed.
    """
    page, kinds = file.pages.first, tifffile.PHOTOMETRIC
    if page.photometric == kinds.SEPARATED:
        raise ValueError("its colours are those of inks, CMYK; save it as RGB")
    jpeg = page.photometric == kinds.YCBCR and "JPEG" in tifffile.COMPRESSION(page.compression).name
    if not jpeg and page.photometric not in (kinds.RGB, kinds.PALETTE, kinds.MINISBLACK, kinds.MINISWHITE):
        raise ValueError(f"its colours are {getattr(page.photometric, 'name', page.photometric)}; save it as RGB")
    if page.dtype is None or not (page.dtype.kind == "f" or (page.dtype.kind in "bu" and page.dtype.itemsize <= 2)):
        raise ValueError(f"has {page.dtype} pixels, whose full scale is unknown; save it with 8 or 16 bits, or as "
                         "floats")  # fmt: skip
    if len(file.pages) > 1 and math.prod(file.pages[1].shape) >= math.prod(page.shape):
        raise ValueError(f"has {len(file.pages)} pictures; save the photograph alone")
    return page


def tiff_channels(page: tifffile.TiffPage) -> int:
    """Return how many channels of a TIFF page form the picture: one or three for colours, plus one for alpha.

    A channel after the colours is alpha, unless the file calls it unspecified. An unspecified channel may be infrared,
    for example.
    """
    colours = 3 if page.photometric in (tifffile.PHOTOMETRIC.RGB, tifffile.PHOTOMETRIC.YCBCR) else 1
    unspecified = page.extrasamples[:1] == (tifffile.EXTRASAMPLE.UNSPECIFIED,)
    return colours + (page.samplesperpixel > colours and not unspecified)


def has_alpha_channel(path: Path) -> bool:
    """Test whether an image file has an alpha channel. Raises ValueError or another error if it cannot be opened."""
    suffix = path.suffix.lower()
    if suffix in (".jpg", ".jpeg", *RAW):
        return False
    if suffix == ".exr":
        names = exr_channels(dict(exr_attributes(path))[b"channels"])
        return any(name.rpartition(".")[2] == "A" for name in names)
    if suffix in TIFF:
        with tifffile.TiffFile(path) as file:
            return tiff_channels(file.pages.first) in (2, 4)
    with open_image(path) as image:
        return image.has_transparency_data


def statement_of(path: Path) -> Statement:
    """Read the colour space that an image file declares.

    If a file declares several, the first in this list counts: PNG chunk cICP, ICC profile, codes of HEIF and AVIF,
    other PNG chunks, Adobe RGB in EXIF data. Raises ValueError if the file cannot be used, for example for HDR colours.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        if len(found := dict(exr_attributes(path)).get(b"chromaticities", b"")) == 32:
            *primaries, x, y = struct.unpack("<8f", found)
            return Statement(primaries_profile((x, y), tuple(primaries)))
    elif suffix in TIFF:
        with tifffile.TiffFile(path) as file:
            return Statement(file.pages.first.iccprofile)
    elif suffix not in RAW:
        with open_image(path) as image:
            if image.format == "PNG" and len(codes := dict(png_chunks(path)).get(b"cICP", b"")) == 4:
                return coded_statement(codes[0], codes[1])
            if profile := image.info.get("icc_profile"):
                return Statement(profile)
            if image.format in ("HEIF", "AVIF"):
                with path.open("rb") as file:
                    codes = file.read(BOXES).partition(COLOUR_BOX)[2][:4]
                return coded_statement(*struct.unpack(">HH", codes)) if len(codes) == 4 else Statement()
            if image.format == "PNG":
                return png_statement(image.info, bits_of(path))
            exif = image.getexif()
            space = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace)
            index = exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex)
            if space == 2 or (space != 1 and index == "R03"):
                return Statement(ADOBE_RGB)
    return Statement()


def png_statement(info: dict, bits: int) -> Statement:
    """Find the colour space that the PNG chunks sRGB, gAMA and cHRM declare.

    `info`: the metadata of the file, as Pillow reads them (`Image.info`). `bits`: bits per channel.
    """
    if "srgb" in info:
        return Statement(None, 2.2)
    gamma, places = info.get("gamma"), info.get("chromaticity")
    exponent = 1 / gamma if gamma else None
    if not places or np.allclose(places, (*WHITE, *PRIMARIES), atol=2e-3):
        return Statement(None, exponent)
    curve = exponent or (2.2 if bits == 8 else 1.0)
    return Statement(primaries_profile(places[:2], places[2:], 2.2 if abs(curve - 2.2) < 0.05 else curve))


def png_chunks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield (name, content) of each chunk of a PNG file before the pixels. Content after 64 bytes is left out."""
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(8)) == 8 and head[4:] != b"IDAT":
            size = int.from_bytes(head[:4], "big")
            yield head[4:], file.read(min(size, 64))
            file.seek(max(0, size - 64) + 4, os.SEEK_CUR)


def bits_of(path: Path) -> int:
    """Return the bits per channel of an image file: 8, 16, or 32 for floats. Raises an error if the file is damaged."""
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


def encodings(paths: Sequence[Path]) -> list[str]:
    """Count the files by the encoding of their pixels.

    Returns phrases for the user, such as "3 files of 8 bits are sRGB". The last phrase is the number of files that
    declare a colour space, if there are any.
    """
    bits = Counter(bits_of(path) for path in paths)
    said = sum(statement_of(path) != Statement() for path in paths)
    kinds = {8: "8 bits are sRGB", 16: "16 bits are linear", 32: "floats are linear"}
    found = [f"{bits[depth]} files of {what}" for depth, what in kinds.items() if bits[depth]]
    return found + ([f"except as {said} of the files say themselves"] if said else [])


def encoding_of(path: Path) -> Literal["srgb", "linear"]:
    """Return "srgb" or "linear", the encoding of a file's pixels after its declared colour space has been applied."""
    said = statement_of(path)
    sample = np.zeros((1, 1, 3), np.uint8)
    return "srgb" if bits_of(path) == 8 and as_stated(sample, said).dtype == np.uint8 else "linear"


def exr_attributes(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield (name, value) of each header attribute of an OpenEXR file, at most 64 KiB of the value.

    The format is described in "OpenEXR File Layout": an attribute consists of its name, its type, its size and its
    value; a zero byte ends the name and the type. Raises ValueError if the file is no OpenEXR file or has several
    parts.
    """
    with path.open("rb") as file:

        def text() -> bytes:
            letters = iter(lambda: file.read(1) or b"\0", b"\0")
            return b"".join(itertools.islice(letters, 256))  # the longest that the format allows

        if (head := file.read(8))[:4] != b"\x76\x2f\x31\x01":
            raise ValueError("no OpenEXR file")
        if head[5] & 0x10:
            raise ValueError("has several parts; save the one of the photograph alone")
        while name := text():
            text()
            (size,) = struct.unpack("<I", file.read(4))
            yield name, file.read(min(size, 2**16))
            file.seek(max(0, size - 2**16), os.SEEK_CUR)


def exr_channels(value: bytes) -> dict[str, int]:
    """Read the channels from `value`, the bytes of the OpenEXR attribute `channels`: pixel types by name.

    A type is 0 (integers), 1 (half floats) or 2 (floats). A zero byte and 16 more bytes follow each name.
    """
    kinds, place = {}, 0
    while value[place]:
        end = value.index(b"\0", place)
        kinds[value[place:end].decode("utf-8", "replace")] = value[end + 1]
        place = end + 17
    return kinds


def exr_picture(channels: Iterable[str]) -> list[str]:
    """Choose the channels of an OpenEXR file that form the picture: R, G, B and A; or Y and A; or the only channel.

    `channels`: all channel names. A name may begin with a layer, as in `ViewLayer.Combined.R`. Returns the chosen names
    in this order; a file may lack A. Raises ValueError if no channels form a picture, or if several layers do.
    """
    names = [*channels]
    layers = [name.removesuffix("R") for name in names if name == "R" or name.endswith(".R")]
    layers = [layer for layer in layers if {f"{layer}{c}" for c in "RGB"} <= {*names}]
    layers = [""] if "" in layers else layers
    if len(layers) > 1:
        raise ValueError(f"has the layers {', '.join(layer.rstrip('.') for layer in layers[:6])}; save the one of the "
                         "photograph alone")  # fmt: skip
    grey = "Y" in names and not ({"X", "Z"} <= {*names} or "RY" in names)  # not of colours XYZ, or Y and chroma
    wanted = [f"{layers[0]}{c}" for c in "RGBA"] if layers else ["Y", "A"] if grey else names
    if not layers and not grey and (len(names) > 1 or names[0].rpartition(".")[2] in ("Z", "depth")):
        raise ValueError(f"has channels {', '.join(names[:6])}, but no R, G, B; save the photograph alone")
    return [name for name in wanted if name in names]


def exr_size(path: Path) -> tuple[int, int, int]:
    """Read (width [px], height [px], number of channels) from the header of an OpenEXR file.

    Raises ValueError if no channels form a picture of floats, or if there are no pixels, or only a part of them.
    """
    found = dict(exr_attributes(path))
    left, top, right, bottom = data = struct.unpack("<4i", found[b"dataWindow"])
    kinds = exr_channels(found[b"channels"])
    if min(right - left, bottom - top, len(kinds) - 1) < 0:
        raise ValueError("declares no pixels")
    if integers := [name for name in exr_picture(kinds) if not kinds[name]]:
        raise ValueError(f"has integers in the channels {', '.join(integers)}; save them as floats")
    if data != (whole := struct.unpack("<4i", found.get(b"displayWindow", found[b"dataWindow"]))):
        raise ValueError(f"its data window {data} is not its display window {whole}; save the whole picture")
    return right - left + 1, bottom - top + 1, len(kinds)
