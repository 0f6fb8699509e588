"""Reads what is asked of foreign files; anything else is one clear error."""

import json
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
import scipy.io

from mi_ring import images
from mi_ring.errors import InputError, is_file
from mi_ring.foreign import reading, require_readable

SUFFIXES = (".png", ".exr", ".tif", ".tiff", ".jpg", ".jpeg")  #: of photographs
Content = TypeVar("Content")


def pixels_of(path: Path) -> np.ndarray:
    """Pixels (H, W, C) of an image file. Raises InputError if it cannot be read."""
    return read_as(path, "image", images.read_image)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] of an image file. Raises InputError if it cannot be read."""
    return read_as(path, "image", images.image_size)


def has_alpha(path: Path) -> bool:
    """Does an image file have an alpha channel?"""
    if path.suffix.lower() == ".exr":
        return pixels_of(path).shape[2] in (2, 4)

    def alpha(file: Path) -> bool:
        with images.open_image(file) as image:
            return image.mode in ("LA", "RGBA")

    return read_as(path, "image", alpha)


def existing(path: Path, field: str) -> Path:
    """A file that must be there."""
    if not is_file(path):
        raise InputError(f"{path}: {field}: no such file")
    return path


def first_file(candidates: list[Path], field: str) -> Path:
    """The first of these files that there is."""
    for path in candidates:
        if is_file(path):
            return path
    raise InputError(f"{field}: found neither {' nor '.join(map(str, candidates))}")


def with_suffix(path: Path, field: str) -> Path:
    """An image file whose name may lack its suffix."""
    if is_file(path):
        return path
    for suffix in SUFFIXES if path.name else ():
        if is_file(file := path.with_name(path.name + suffix)):
            return file
    raise InputError(f"{field}: no such file: {path}, nor with any of {' '.join(SUFFIXES)}")


def pictures(folder: Path) -> list[Path]:
    """The image files of a folder, by name."""
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES and is_file(path))


def numbered(folder: Path) -> dict[int, Path]:
    """Images of a folder by the numbers that they are called, or by their order if some are called otherwise."""
    files = pictures(folder)
    if all(path.stem.isdigit() for path in files):
        return {int(path.stem): path for path in files}
    return dict(enumerate(files))


def chosen(wanted: Collection[int], there_are: Collection[int], option: str, where: Path) -> list[int]:
    """Those wanted, or all. Raises InputError if one does not exist."""
    for number in wanted:
        if number not in there_are:
            raise InputError(f"{option}: {number}: not in {where}, which has {min(there_are)} to {max(there_are)}")
    return sorted(wanted or there_are)


def matrix(values: object, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Finite numbers of this shape. Raises InputError for anything else."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != shape or (array.ndim == 0 and np.isnan(array)):
        shown = "missing" if values is None else f"of shape {array.shape}" if array.size > 1 else str(values)[:60]
        shown = " ".join(shown.split())
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
        raise InputError(f"{what}: is {shown}; must be {wanted}")
    if not np.isfinite(array).all():
        raise InputError(f"{what}: has NaN or infinite numbers")
    return array


def entry(arrays: Mapping[str, object], key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """An array of a .mat or .npz file."""
    return matrix(arrays.get(key), shape, f"{path}: {key}")


def read_as(path: Path, what: str, read: Callable[[Path], Content]) -> Content:
    """`read(path)`. Raises InputError if there is no such file or if it is not what it should be."""
    with reading(path, what):
        return read(existing(path, what))


def load_mat(path: Path) -> dict:
    """The variables of a MATLAB file, of some of which its reader crashes."""
    size = existing(path, "MATLAB file").stat().st_size
    require_readable("import scipy.io; scipy.io.loadmat(sys.argv[1])", path, size, "a MATLAB file")
    return read_as(path, "MATLAB file", scipy.io.loadmat)


def load_json(path: Path) -> Any:
    """What a JSON file holds."""
    return read_as(path, "JSON", lambda file: json.loads(file.read_bytes()))


def load_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file."""
    return read_as(path, "XML", lambda file: ElementTree.fromstring(file.read_bytes()))


def load_lines(path: Path) -> list[str]:
    """The lines of a text file that are not empty."""
    text = read_as(path, "text", lambda file: file.read_bytes().decode("utf-8-sig"))
    return [line for line in text.splitlines() if line.strip()]


def load_table(path: Path, columns: int) -> np.ndarray:
    """A text file of so many numbers a line."""
    text = read_as(path, "table of numbers", lambda file: file.read_text("utf-8"))
    if not text.strip():
        raise InputError(f"{path}: is empty; must have {columns} numbers a line")
    table = read_as(path, "table of numbers", lambda _: np.loadtxt(text.splitlines(), ndmin=2))
    return matrix(table, (len(table), columns), str(path))
