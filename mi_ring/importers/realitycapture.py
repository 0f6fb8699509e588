"""Importer of the cameras of RealityCapture and RealityScan: XMP sidecars, or a table."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, opencv_lens, pose_of
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import by_key, image_size, list_images, load_lines, load_xml, matrix

XCR = "{http://www.capturingreality.com/ns/xcr/1.1#}"
POSE = ("x", "y", "alt", "heading", "pitch", "roll")  #: columns of a table [scene units, degrees]
TERMS = ("k1", "k2", "k3", "k4", "t1", "t2")  #: coefficients of the distortion
NUMBERS = {*POSE, "f", "px", "py", *TERMS}  #: columns that hold numbers
DEGREES = ("lat", "latitude", "lon", "long", "lng", "longitude")  #: columns of geographic coordinates
METRIC = ("are latitudes and longitudes [degrees]; export the cameras in a local metric system, such as "
          "local:1 - Euclidean")  # fmt: skip
DECIMAL = re.compile(r"[-+\d]+,\d*([eE][-+]?\d+)?")  #: a number with a comma
#: Distortion models, and the number of coefficients that each uses.
BROWN = {"perspective": 0, "none": 0, "brown3": 3, "brown4": 4, "brown3t2": 6, "brown4t2": 6}


@dataclass(frozen=True)
class RealityCapture(Photogrammetry):
    """RealityCapture, RealityScan: XMP sidecars or the CSV table. The light is fixed to the camera.

    SRC is the folder of the sidecars, or the file of the export "Internal/External camera parameters". The distortion
    model must be one of the Brown models.
    """

    fields = Fields(
        used={
            "xcr:Rotation xcr:Position": "pose, world-to-camera, and place",
            "xcr:FocalLength35mm xcr:PrincipalPointU xcr:PrincipalPointV": "intrinsics",
            "xcr:DistortionModel xcr:DistortionCoeficients": "distortion by the Brown models",
            "name": "CSV: the photograph", "x y alt heading pitch roll": "CSV: pose",
            "f px py k1 k2 k3 t1 t2": "CSV: lens",
        },
        refused={
            "xcr:Skew xcr:AspectRatio": "pixels that are no squares", "k4": "a fourth radial term",
            "xcr:DistortionModel=division": "division models",
        },
        harmless={
            "xcr:PosePrior xcr:CalibrationPrior": "how far RealityCapture may change them",
            "xcr:CalibrationGroup xcr:DistortionGroup xcr:Rig xcr:RigInstance xcr:RigPoseIndex": "groups of cameras",
            "xcr:InTexturing xcr:InMeshing xcr:InColoring xcr:ComponentId xcr:Version": "settings",
            "xcr:Coordinates xcr:latitude xcr:longitude xcr:altitude": "where the frame is on the earth",
        },
    )  # fmt: skip

    def posed(self) -> Iterator[Frame]:
        if self.src.suffix.lower() == ".xmp":
            raise InputError(f"{self.src}: SRC: is the sidecar of one photograph; give its folder")
        return self.from_sidecars() if self.src.is_dir() else self.from_csv()

    def from_sidecars(self) -> Iterator[Frame]:
        """Yield the photographs that have a sidecar with a pose. For x.jpg, it is the file x.xmp in the folder SRC."""
        if not (sidecars := sidecars_in(self.src)):
            raise InputError(f"{self.src}: SRC: no XMP sidecars in this folder; give another, or the CSV file of "
                             "internal and external camera parameters")  # fmt: skip
        images = self.photographs
        if images is None:
            images = list_images(self.images or (self.src if list_images(self.src) else self.folder))
        self.without_pose.update(image.name for image in images if image.stem not in sidecars)
        posed = by_key([image for image in images if image.stem in sidecars], lambda image: image.stem)
        said: dict[str, None] = {}
        for name, image in posed.items():
            fields = xmp_fields(load_xml(sidecars[name]))
            said.update((f"xcr:{name}", None) for name in fields)
            if "Rotation" in fields and "Position" in fields:
                yield sidecar_frame(image, fields, str(sidecars[name]))
            else:
                self.without_pose.add(image.name)
        if self.photographs is None:
            lost = sorted(sidecars.keys() - posed.keys())
            self.without_photograph.extend(name for name in lost if "Rotation" in xmp_fields(load_xml(sidecars[name])))
        self.tell_unused(self.src, said)

    def from_csv(self) -> Iterator[Frame]:
        """Yield the photographs that the CSV file SRC lists. Raises InputError if it is invalid."""
        columns, rows = read_csv(self.src)
        if "x" not in columns and (degrees := [name for name in columns if name in DEGREES]):
            raise InputError(f"{self.src}: column {degrees[0]}: {METRIC}")
        if missing := [name for name in ("name", *POSE, "f") if name not in columns]:
            raise InputError(f"{self.src}: column {missing[0]}: is missing; must be the table of internal and external "
                             "camera parameters")  # fmt: skip
        self.tell_unused(self.src, columns)
        cameras = []
        for line, row in enumerate(rows, 1):
            what = f"{self.src}: camera {line}"
            if len(row) != len(columns):
                raise InputError(f"{what}: has {len(row)} columns; must have {len(columns)}")
            cells = dict(zip(columns, row))
            numbers = {name: float(matrix(cells[name], (), f"{what}: {name}")) for name in columns if name in NUMBERS}
            cameras.append((what, cells["name"], numbers))
        if in_degrees(np.array([[numbers["x"], numbers["y"]] for _, _, numbers in cameras]).reshape(-1, 2)):
            raise InputError(f"{self.src}: columns x, y: {METRIC}")
        for what, said, numbers in cameras:
            if (image := self.photograph(said, what)) is None:
                continue
            # At zero angles the camera looks down and its top points to y. The heading is clockwise, as on a compass.
            angles = [-numbers["heading"], numbers["pitch"], numbers["roll"]]
            R = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
            pose = pose_of(R, np.array([numbers[name] for name in POSE[:3]])) @ OPENGL
            terms, centre = ([numbers.get(name, 0.0) for name in names] for names in (TERMS, ("px", "py")))
            lens = film_lens(image, numbers["f"], centre, terms, what)
            yield Frame(image, lens, pose, said=said)


def in_degrees(places: np.ndarray) -> bool:
    """Return whether places (N, 2) are latitudes and longitudes [degrees].

    0.00001 degrees are a metre: all cameras have almost the same numbers.
    """
    largest = np.abs(places).max(initial=0)
    return bool(len(places) > 1 and largest <= 180 and 0 < np.ptp(places, 0).max() < min(0.05, 1e-3 * largest))


def sidecars_in(folder: Path) -> dict[str, Path]:
    """List the XMP sidecars in a folder by the photograph's name without suffix. Hidden files are left out."""
    return {path.stem: path for path in sorted(folder.glob("[!.]*")) if path.suffix.lower() == ".xmp"}


def sidecar_frame(image: Path, fields: dict[str, str], what: str) -> Frame:
    """Make the frame of the photograph `image` from its XMP sidecar.

    `fields`: texts in the sidecar by RealityCapture's names. Raises InputError if one is invalid. The message begins
    with `what`.
    """

    def numbers(name: str, count: int, default: str | None = None) -> np.ndarray:
        text = fields.get(name, default)
        return matrix(None if text is None else text.split(), (count,), f"{what}: xcr:{name}")

    R, position = numbers("Rotation", 9).reshape(3, 3), numbers("Position", 3)
    for name, usual in (("Skew", "0"), ("AspectRatio", "1")):
        if abs((value := numbers(name, 1, usual)[0]) - float(usual)) > 1e-6:
            raise InputError(f"{what}: xcr:{name}: is {value:g}; must be {usual}")
    centre = [numbers(name, 1, "0")[0] for name in ("PrincipalPointU", "PrincipalPointV")]
    model = fields.get("DistortionModel", "perspective")
    if model not in BROWN:
        raise InputError(f"{what}: xcr:DistortionModel: is {model!r}; must be one of {', '.join(BROWN)}")
    terms = np.zeros(6)
    if count := BROWN[model]:
        texts = fields.get("DistortionCoeficients", "0 0 0 0 0 0").split()
        length = 3 if count == len(texts) == 3 else 6
        terms[:count] = matrix(texts, (length,), f"{what}: xcr:DistortionCoeficients")[:count]
    lens = film_lens(image, numbers("FocalLength35mm", 1)[0], centre, terms.tolist(), what)
    return Frame(image, lens, pose_of(R.T, position), said=image.name)


def xmp_fields(root: ElementTree.Element) -> dict[str, str]:
    """Return the texts of RealityCapture's attributes and elements in an XMP file, by their names without prefix."""
    found: dict[str, str] = {}
    for element in root.iter():
        found |= {name: value for name, value in element.attrib.items() if name.startswith(XCR)}
        if element.tag.startswith(XCR):
            found[element.tag] = element.text or ""
    return {name.removeprefix(XCR): value for name, value in found.items()}


def read_csv(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read a table of cameras from a CSV file. Returns (column names in lower case, rows of cells).

    Lines that begin with #cameras or sep= are skipped. It also accepts what spreadsheet programs write: semicolons or
    tabs, decimal commas, other encodings than UTF-8.
    """
    lines = [line for line in load_lines(path, others=True) if not line.startswith(("#cameras", "sep="))]
    separator = max(",;\t", key=lines[0].count) if lines else ","
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=separator)]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as a table ({error})") from error
    if separator != ",":
        rows = [[cell.replace(",", ".") if DECIMAL.fullmatch(cell) else cell for cell in row] for row in rows]
    return [name.lstrip("#").lower() for name in rows[0]] if rows else [], rows[1:]


def film_lens(image: Path, focal: float, centre: list[float], terms: list[float], what: str) -> Lens:
    """Make the lens of the photograph `image` from its 35 mm equivalent focal length [mm].

    `focal`: this length. `centre`: principal point relative to the centre of the photograph, divided by its longer
    side. `terms`: distortion coefficients k1, k2, k3, k4, t1, t2. Raises InputError if k4 is not 0. The message begins
    with `what`.
    """
    size = image_size(image)
    longer = max(size)
    k1, k2, k3, k4, t1, t2 = terms
    if k4:
        raise InputError(f"{what}: k4: is {k4}; must be 0; align with the distortion model Brown3 or Brown3 with "
                         "tangential2")  # fmt: skip
    intrinsics = (*[focal * longer / 36] * 2, *(side / 2 + longer * u for side, u in zip(size, centre)))
    return opencv_lens(size, intrinsics, (k1, k2, k3), (t2, t1))  # OpenCV's p1 and p2 are swapped
