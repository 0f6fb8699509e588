"""RealityCapture's and RealityScan's cameras: XMP sidecars, or a table."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens, brown, inverse
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, load_lines, load_xml, matrix, pictures

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
POSE = ("x", "y", "alt", "heading", "pitch", "roll")  #: columns of a table [scene units, degrees]
TERMS = ("k1", "k2", "k3", "k4", "t1", "t2")  #: of the distortion
NUMBERS = {*POSE, "f", "px", "py", *TERMS}  #: columns that are numbers
BROWN = {"perspective": 0, "none": 0, "brown3": 3, "brown4": 4, "brown3t2": 6, "brown4t2": 6}  #: how many of them count


@dataclass(frozen=True)
class RealityCapture(Photogrammetry):
    """RealityCapture, RealityScan: XMP sidecars or the CSV table. The light is beside the camera.

    SRC is the folder of the sidecars, or the file of the export "Internal/External camera parameters". The lens must
    have one of the Brown models.
    """

    def posed(self) -> Iterator[tuple[str, Frame]]:
        if self.src.is_dir():
            yield from self.of_sidecars()
        else:
            yield from self.of_table()

    def of_sidecars(self) -> Iterator[tuple[str, Frame]]:
        """Photographs with x.xmp for x.jpg."""
        if not any(self.src.glob("*.xmp")):
            raise InputError(f"{self.src}: SRC: no XMP sidecars in this folder; give another, or the CSV file of "
                             "internal and external camera parameters")  # fmt: skip
        images = pictures(self.images or (self.src if pictures(self.src) else self.folder))
        for image in images if self.photographs is None else self.photographs:
            path = self.src / f"{image.stem}.xmp"
            fields = xmp_fields(load_xml(path)) if path.is_file() else {}
            if "Rotation" not in fields or "Position" not in fields:
                self.left_out.add(image.name)
                continue
            yield image.name, sidecar_frame(image, fields, str(path))

    def of_table(self) -> Iterator[tuple[str, Frame]]:
        """Photographs of the lines of a CSV file."""
        columns, rows = table(self.src)
        missing = [name for name in ("name", *POSE, "f") if name not in columns]
        if missing:
            raise InputError(f"{self.src}: column {missing[0]}: is missing; must be the table of internal and external "
                             "camera parameters")  # fmt: skip
        seen = set()
        for line, row in enumerate(rows, 1):
            what = f"{self.src}: camera {line}"
            if len(row) != len(columns):
                raise InputError(f"{what}: has {len(row)} columns; must have {len(columns)}")
            given = dict(zip(columns, row))
            numbers = {name: float(matrix(given[name], (), f"{what}: {name}")) for name in columns if name in NUMBERS}
            if (image := self.photograph(given["name"], what)) is None:
                continue
            seen.add(image)
            pose = np.eye(4)
            # At zero the camera looks down, the upper side to y. The heading is clockwise, as a compass's.
            turns = [-numbers["heading"], numbers["pitch"], numbers["roll"]]
            pose[:3, :3] = Rotation.from_euler("ZXY", turns, degrees=True).as_matrix() @ OPENGL[:3, :3]
            pose[:3, 3] = [numbers[name] for name in POSE[:3]]
            terms = np.array([numbers.get(name, 0.0) for name in TERMS])
            centre = [numbers.get(name, 0.0) for name in ("px", "py")]
            yield image.name, Frame(image, lens(image, numbers["f"], centre, terms, what), pose)
        self.left_out.update(image.name for image in self.pictures if image not in seen)


def sidecar_frame(image: Path, fields: dict[str, str], what: str) -> Frame:
    """A photograph by the fields of its sidecar."""

    def numbers(name: str, count: int, default: str | None = None) -> np.ndarray:
        text = fields.get(name, default)
        return matrix(None if text is None else text.split(), (count,), f"{what}: xcr:{name}")

    R, place = numbers("Rotation", 9).reshape(3, 3), numbers("Position", 3)
    for name, usual in (("Skew", "0"), ("AspectRatio", "1")):
        if abs((value := numbers(name, 1, usual)[0]) - float(usual)) > 1e-6:
            raise InputError(f"{what}: xcr:{name}: is {value:g}; must be {usual}")
    centre = [numbers(name, 1, "0")[0] for name in ("PrincipalPointU", "PrincipalPointV")]
    model = fields.get("DistortionModel", "perspective")
    if model not in BROWN:
        raise InputError(f"{what}: xcr:DistortionModel: is {model!r}; must be one of {', '.join(BROWN)}")
    terms = np.zeros(6)
    if count := BROWN[model]:
        given = fields.get("DistortionCoeficients", "0 0 0 0 0 0").split()
        short = count == len(given) == 3
        terms[:count] = matrix(given, (3 if short else 6,), f"{what}: xcr:DistortionCoeficients")[:count]
    return Frame(image, lens(image, numbers("FocalLength35mm", 1)[0], centre, terms, what), inverse(R, -R @ place))


def xmp_fields(root: ElementTree.Element) -> dict[str, str]:
    """What an XMP file says in RealityCapture's namespace, as attributes or as elements."""
    found: dict[str, str] = {}
    for element in root.iter():
        found |= {name: value for name, value in element.attrib.items() if name.startswith(XCR)}
        if element.tag.startswith(XCR):
            found[element.tag] = element.text or ""
    return {name.removeprefix(XCR): value for name, value in found.items()}


def table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Names of the columns and rows of a CSV file, whose first line may count the cameras."""
    lines = [line for line in load_lines(path) if not line.startswith("#cameras")]
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines)]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a table ({error})") from error
    return [name.lstrip("#").lower() for name in rows[0]] if rows else [], rows[1:]


def lens(image: Path, focal: float, centre: list[float], terms: np.ndarray, what: str) -> Lens:
    """Of a focal length for film of 36 mm and a principal point from the middle, in units of the longer side."""
    size = image_size(image)
    longer = max(size)
    k1, k2, k3, k4, t1, t2 = map(float, terms)
    if k4:
        raise InputError(f"{what}: k4: is {k4}; must be 0; align with the distortion model Brown3 or Brown3 with "
                         "tangential2")  # fmt: skip
    intrinsics = (*[focal * longer / 36] * 2, *(side / 2 + longer * u for side, u in zip(size, centre)))
    return brown(size, intrinsics, (k1, k2, k3), (t2, t1))  # t1 and t2 are those of OpenCV swapped
