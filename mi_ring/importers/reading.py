"""Readers of files of other tools. Each raises InputError if the file is missing, damaged or of another kind."""

import json
import os
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
import scipy.io
from PIL import ExifTags

from mi_ring import image_headers, images
from mi_ring.colour_profiles import Statement
from mi_ring.errors import InputError, is_file
from mi_ring.foreign import reading, require_readable
from mi_ring.scene.shot import Encoding

Content = TypeVar("Content")
Key = TypeVar("Key")


def read_as(path: Path, what: str, read: Callable[[Path], Content]) -> Content:
    """Call `read(path)`, and return its result. Any failure becomes an InputError.

    `what`: kind of file, for the message, for example "image".
    """
    with reading(path, what):
        return read(existing(path, what))


def has_byte_order_mark(path: Path) -> bool:
    """Return True if a file begins with a byte order mark of UTF-8."""
    with path.open("rb") as file:
        return file.read(len(BOM_UTF8)) == BOM_UTF8


def pixels_of(path: Path, heed: bool = False) -> np.ndarray:
    """Read the pixels (H, W, C) of an image file, uint8, uint16 or float32.

    `heed`: True: convert them by the colour space that the file declares, to sRGB for uint8 and to linear values for
    other types. False: return them as stored. Raises InputError if the file is damaged.
    """
    return read_as(path, "image", lambda file: images.read_image(file, heed))


def saturations_of(files: Mapping[Path, Encoding]) -> tuple[dict[Path, float], str]:
    """Find photographs that have values of only 10, 12 or 14 bits in files of 16 bits. Raw files are none.

    `files`: encodings by image file. Returns (saturations, note): by file the encoded value (1 = full scale) from which
    its pixels are clipped, and a sentence for the user. Both are empty if the files use all bits. Raises InputError if
    the values are not linear: their curve is for 16 bits.
    """
    stored = [path for path in files if path.suffix.lower() not in image_headers.RAW and bits_of(path) == 16]
    largest = images.largest_value(pixels_of(path) for path in stored)
    full = next((full for full in (1023, 4095) if 0 < largest <= full), largest)
    if not (bits := images.LOW_BITS.get(full)):
        return {}, ""
    for path in stored:
        declared = files[path] == "auto" and image_headers.statement_of(path) != Statement()
        if declared or files[path] == "srgb":
            raise InputError(f"{path}: has values of {bits} bits, at most {largest}, but colours that need 16 bits; "
                             f"multiply the values by {65536 // (full + 1)}")  # fmt: skip
    note = f"No value of {len(stored)} photographs of 16 bits is above {largest}: taken for {bits} bits, over-exposed"
    return dict.fromkeys(stored, (full - 0.5) / 65535), f"{note} at {full}"


def bits_of(path: Path) -> int:
    """Return the bits per channel of an image file: 8, 16, or 32 for floats."""
    return read_as(path, "image", image_headers.bits_of)


def image_size(path: Path) -> tuple[int, int]:
    """Return the (width, height) of an image file [px]. Reads no pixels."""
    return read_as(path, "image", image_headers.image_size)


def orientation_of(path: Path) -> int:
    """Return the EXIF orientation of an image file, 1 to 8: how its pixels must be turned after reading.

    1 means that they are not turned. It is returned without EXIF data, and for raw and HEIC files.
    """
    if path.suffix.lower() in (*image_headers.HEIF, *image_headers.RAW):  # HEIF's reader has turned them already
        return 1
    value = read_as(path, "image", image_headers.exif_of).get(ExifTags.Base.Orientation)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def has_alpha(path: Path) -> bool:
    """Return True if an image file has an alpha channel with at least one pixel that is not opaque."""
    if not read_as(path, "image", image_headers.has_alpha_channel):
        return False
    pixels = pixels_of(path)
    full = 1.0 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max
    return pixels.shape[2] in (2, 4) and bool((pixels[..., -1] < full).any())


def existing(path: Path, field: str) -> Path:
    """Return `path` if it is a file, otherwise raise InputError. `field`: what the file is, for the message."""
    if not is_file(path):
        raise InputError(f"{path}: {field}: no such file")
    return path


def first_file(candidates: list[Path], field: str) -> Path:
    """Return the first candidate that is an existing file. Raises InputError if there is none.

    `field`: the beginning of the message.
    """
    if file := next(filter(is_file, candidates), None):
        return file
    raise InputError(f"{field}: found neither {' nor '.join(map(str, candidates))}")


def list_images(folder: Path) -> list[Path]:
    """List the image files in a folder, sorted by name. Hidden files are left out.

    A raw or HEIC file is left out if the same photograph is beside it in another format.
    """
    return without_raw_twins(path for path in folder.glob("[!.]*") if is_image(path))


def images_below(folder: Path) -> list[Path]:
    """List the image files in a folder and all its subfolders, sorted by path. Hidden ones are left out.

    A raw or HEIC file is left out if the same photograph is beside it in another format.
    """
    found = []
    for place, inner, files in os.walk(folder):
        inner[:] = [name for name in inner if not name.startswith(".")]
        found += [Path(place, name) for name in files if not name.startswith(".")]
    return without_raw_twins(filter(is_image, found))


def is_image(path: Path) -> bool:
    """Return True if a path is an existing file with the suffix of an image format."""
    return path.suffix.lower() in image_headers.SUFFIXES and is_file(path)


def without_raw_twins(paths: Iterable[Path]) -> list[Path]:
    """Return the paths sorted, without a raw or HEIC file if the same name is in the list with another suffix."""
    found = sorted(paths)
    twins = image_headers.RAW + image_headers.HEIF
    others = {path.with_suffix("") for path in found if path.suffix.lower() not in twins}
    return [p for p in found if p.with_suffix("") not in others or p.suffix.lower() not in twins]


def numbered_images(folder: Path) -> dict[int, Path]:
    """Return the image files in a folder by number.

    If all file names are numbers, these are the keys. Otherwise the keys are 0, 1, … in the order of the names. Raises
    InputError if two names are the same number.
    """
    files = list_images(folder)
    return by_key(files, lambda f: int(f.stem)) if all(f.stem.isdigit() for f in files) else dict(enumerate(files))


def by_key(files: Iterable[Path], key: Callable[[Path], Key]) -> dict[Key, Path]:
    """Return the files in a dictionary with `key(file)` as key. Raises InputError if two files have the same key."""
    found: dict[Key, Path] = {}
    for file in files:
        if (other := found.setdefault(key(file), file)) != file:
            raise InputError(f"{file}: may be the same photograph as {other.name}; keep one of them")
    return found


def chosen(wanted: Collection[int], available: Collection[int], option: str, where: Path) -> list[int]:
    """Return the `wanted` numbers, sorted; if there are none, all `available` numbers.

    Raises InputError if a wanted number is not available. `option`: name of the option, for the message. `where`: path
    that has the available ones, for the message.
    """
    for number in wanted:
        if number not in available:
            raise InputError(f"{option}: {number}: is not in {where}, which has {min(available)} to {max(available)}")
    return sorted(wanted or available)


def matrix(values: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert values from a file to an array of floats of this `shape`; () for a single number.

    Raises InputError if `values` are not finite numbers of this shape. The message begins with `what`.
    """
    try:
        array = np.array(values, float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != shape or (array.ndim == 0 and np.isnan(array)):
        found = "missing" if values is None else f"of shape {array.shape}" if array.size > 1 else str(values)[:60]
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape not in ((), (1,)) else "a number"
        raise InputError(f"{what}: is {' '.join(found.split())}; must be {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{what}: has NaN or infinite numbers")
    return array


def entry(arrays: Mapping[str, object], key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """Return `arrays[key]` as an array of floats of this `shape`. `arrays`: content of a .mat or .npz file.

    `path`: the file, for the message. Raises InputError if the array is missing or has another shape.
    """
    return matrix(arrays.get(key), shape, f"{path}: {key}")


def load_mat(path: Path) -> dict:
    """Read a MATLAB file. Returns its variables by name.

    A child process reads the file first, because damaged files crash scipy's reader.
    """
    size = existing(path, "MATLAB file").stat().st_size
    require_readable("import scipy.io; scipy.io.loadmat(sys.argv[1])", path, size, "a MATLAB file")
    return read_as(path, "MATLAB file", scipy.io.loadmat)


def load_json(path: Path) -> Any:
    """Read a JSON file and return its value. Raises InputError if that fails, or if an object has a key twice."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(found := dict(pairs)) < len(pairs):
            key, _ = Counter(key for key, _ in pairs).most_common(1)[0]
            raise ValueError(f"an object has the key {key[:60]!r} twice")
        return found

    return read_as(path, "JSON", lambda file: json.loads(file.read_bytes(), object_pairs_hook=unique))


def require_object(value: Any, what: str) -> dict:
    """Return `value` if it is a JSON object (dict), otherwise raise InputError. The message begins with `what`."""
    if not isinstance(value, dict):
        raise InputError(f"{what}: is {'missing' if value is None else 'no object'}")
    return value


def load_xml(path: Path) -> ElementTree.Element:
    """Read an XML file and return its root element. Raises InputError if that fails."""
    return read_as(path, "XML", lambda file: ElementTree.fromstring(file.read_bytes()))


def load_lines(path: Path, others: bool = False) -> list[str]:
    """Read the lines of a text file in UTF-8, without empty lines.

    `others`: True: also accept UTF-16 and the Windows code page 1252.
    """

    def decoded(file: Path) -> str:
        content = file.read_bytes()
        if others and content[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return content.decode("utf-16")
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError:
            if not others:
                raise
            return content.decode("cp1252")

    text = read_as(path, "text", decoded)
    return [line for line in text.splitlines() if line.strip()]


def load_table(path: Path, columns: int) -> np.ndarray:
    """Read a text file with `columns` numbers in each line. Returns an array (n, `columns`)."""
    text = read_as(path, "table of numbers", lambda file: file.read_text("utf-8"))
    if not text.strip():
        raise InputError(f"{path}: is empty; must have {columns} numbers a line")
    table = read_as(path, "table of numbers", lambda _: np.loadtxt(text.splitlines(), ndmin=2))
    return matrix(table, (len(table), columns), str(path))
