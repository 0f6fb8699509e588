"""All formats by the names that `mi_ring.convert` uses, and functions that recognise the format of a file."""

from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from mi_ring.errors import InputError
from mi_ring.importers.bundler import FIRST_LINE, Bundler
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.importers.frames import Source
from mi_ring.importers.gltf_cameras import GltfCameras, has_cameras
from mi_ring.importers.iron import Iron
from mi_ring.importers.llff import Llff
from mi_ring.importers.metashape import Metashape, chunks_of
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.neus import Neus
from mi_ring.importers.opensfm import OpenSfm
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.polycam import Polycam
from mi_ring.importers.reading import list_images, load_json, load_xml
from mi_ring.importers.realitycapture import POSE, RealityCapture, read_csv, sidecars_in, xmp_fields
from mi_ring.importers.record3d import Record3D
from mi_ring.importers.sdfstudio import SdfStudio
from mi_ring.importers.sfmdata import SfmData
from mi_ring.importers.transforms import Transforms
from mi_ring.importers.visualsfm import VisualSfm

FORMATS: dict[str, type[Source]] = {
    "diligent-mv": DiligentMV, "transforms": Transforms, "colmap": Colmap, "neus": Neus, "iron": Iron,
    "metashape": Metashape, "realitycapture": RealityCapture, "sfmdata": SfmData, "llff": Llff,
    "middlebury": Middlebury, "bundler": Bundler, "visualsfm": VisualSfm,
    "opensfm": OpenSfm, "polycam": Polycam, "record3d": Record3D, "sdfstudio": SdfStudio, "gltf": GltfCameras,
}  # fmt: skip


class Sign(NamedTuple):
    """A sign by which camera files of a format are recognised."""

    format: str  #: its name
    what: str  #: for the user
    files: tuple[str, ...]  #: patterns of the files in a folder that may be SRC; empty: the folder itself may be
    check: Callable[[Path], Any]  #: is this file, or folder, of the format?


def json_object(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file. Returns an empty dict if that is no object."""
    return top if isinstance(top := load_json(path), dict) else {}


def has_files(*names: str) -> Callable[[Path], bool]:
    """Make a test of a folder. It returns True if the folder contains at least one of the files `names`."""
    return lambda path: any((path / name).is_file() for name in names)


def has_sidecars(folder: Path) -> bool:
    """Return True if a folder contains an XMP sidecar with a camera pose."""
    return any(
        accepts(lambda path: "Rotation" in xmp_fields(load_xml(path)), file) for file in sidecars_in(folder).values()
    )


def has_keyframes(folder: Path) -> bool:
    """Return True if a folder, or its subfolder keyframes, contains Polycam's cameras."""
    cameras = (next(place.glob("*cameras/[!.]*.json"), None) for place in (folder, folder / "keyframes"))
    return any("t_00" in json_object(path) for path in cameras if path)


def begins(path: Path, word: bytes) -> bool:
    """Return True if a file begins with the bytes `word`, or with a byte order mark of UTF-8 and `word`."""
    with path.open("rb") as file:
        return file.read(len(BOM_UTF8) + len(word)).removeprefix(BOM_UTF8).startswith(word)


#: In the order in which `detect` takes them.
SIGNS = (
    Sign("colmap", "a model of COLMAP", (), Colmap.model),
    Sign("transforms", "transforms.json", Transforms.names,
         lambda path: path.name in Transforms.names or (path.name not in SdfStudio.names
                                                        and json_object(path).get("frames"))),
    Sign("sdfstudio", "meta_data.json of SDFStudio", SdfStudio.names,
         lambda path: path.name in SdfStudio.names and json_object(path).get("frames")),
    Sign("metashape", "*.xml of Metashape", ("*.xml",), lambda path: chunks_of(load_xml(path))),
    Sign("realitycapture", "*.xmp or *.csv of RealityCapture", (), has_sidecars),
    Sign("realitycapture", "", ("*.csv",), lambda path: {"name", *POSE[2:], "f"} <= {*read_csv(path)[0]}),
    Sign("llff", "poses_bounds.npy", (), has_files("poses_bounds.npy")),
    Sign("middlebury", "*_par.txt", ("*_par.txt",), lambda path: path.name.endswith("_par.txt")),
    Sign("sfmdata", "*.sfm or sfm_data.json", ("cameras.sfm", "sfm.json", "sfm_data.json", "*.sfm"),
         lambda path: (top := json_object(path)).get("views") and (top.get("poses") or top.get("extrinsics"))),
    Sign("bundler", "bundle.out", (*Bundler.names, "*.bundle.out", "bundle.rd.out"),
         lambda path: begins(path, FIRST_LINE.encode())),
    Sign("visualsfm", "*.nvm", ("*.nvm",), lambda path: begins(path, b"NVM_V3")),
    Sign("opensfm", "reconstruction.json", OpenSfm.names,
         lambda path: isinstance(top := load_json(path), list) and isinstance(top[0], dict) and "shots" in top[0]),
    Sign("polycam", "keyframes of Polycam", (), has_keyframes),
    Sign("record3d", "metadata.json of Record3D", Record3D.names,
         lambda path: path.name in Record3D.names and json_object(path).get("poses")),
    Sign("gltf", "*.glb or *.gltf with cameras", ("*.glb", "*.gltf"), has_cameras),
    Sign("neus", "cameras_sphere.npz", (), has_files("cameras_sphere.npz", "cameras.npz")),
    Sign("iron", "cam_dict_norm.json", (), has_files(*Iron.names)),
    Sign("diligent-mv", "Calib_Results.mat", (), has_files("Calib_Results.mat")),
)  # fmt: skip


def signs_in(place: Path) -> Iterator[tuple[str, Path]]:
    """Yield (format name, SRC path) for each camera file that is recognised. `place`: a folder, or one file."""
    for sign in SIGNS:
        if not place.is_dir():
            paths = [place] if place.suffix.lower() in {Path(name).suffix for name in sign.files} else []
        else:
            paths = [place]
            if sign.files:
                paths = [*dict.fromkeys(path for name in sign.files for path in sorted(place.glob(name)))]
        yield from ((sign.format, path) for path in paths if accepts(sign.check, path))


def detect(folder: Path) -> Source | None:
    """Find camera files in a folder of photographs, or if there are none, in its parent folder.

    Returns an importer for them, or None. If several formats match, the first of `SIGNS` is used; if several files
    match, the first by name. Formats that need special photographs are ignored. The importer looks for photographs in
    `folder` if that contains images, except for transforms.json, which itself says where they are.
    """
    images = folder if list_images(folder) else None
    for place in (folder, folder.absolute().parent):
        for name, path in signs_in(place):
            importer = FORMATS[name]
            if importer is Transforms:
                return Transforms(path, place / "scene.xml")
            if issubclass(importer, Photogrammetry):
                return importer(path, place / "scene.xml", images=images)
    return None


def guess(src: Path) -> tuple[str, Path]:
    """Recognise the format of `src`, a file or folder. Returns (format name, path to give as SRC).

    Raises InputError if no format is recognised, or if several files or formats match.
    """
    found = [*dict.fromkeys(signs_in(src))]
    if len(found) == 1:
        return found[0]
    if found:
        choices = ", ".join(f"{name} {path}" for name, path in found[:5])
        raise InputError(f"{src}: SRC: may be of {len(found)} kinds; give one of these instead: {choices}")
    looked = ", ".join(sign.what for sign in SIGNS if sign.what)
    raise InputError(f"{src}: SRC: found no cameras; looked for {looked}; name the format before SRC if there are some")


def accepts(check: Callable[[Path], Any], path: Path) -> bool:
    """Return True if `check(path)` is true; False if it is false or if the file cannot be read."""
    try:
        return bool(check(path))
    except (InputError, OSError, LookupError):
        return False
