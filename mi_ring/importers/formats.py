"""The table of all formats, by the names that `mi_ring.convert` knows them by."""

from pathlib import Path

from mi_ring.errors import InputError
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.importers.frames import Source
from mi_ring.importers.iron import Iron
from mi_ring.importers.llff import Llff
from mi_ring.importers.metashape import Metashape, chunk_of
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.neus import Neus
from mi_ring.importers.reading import load_json, load_xml, pictures
from mi_ring.importers.realitycapture import POSE, RealityCapture, table, xmp_fields
from mi_ring.importers.sfmdata import SfmData
from mi_ring.importers.transforms import Transforms

FORMATS = {
    "diligent-mv": DiligentMV, "transforms": Transforms, "colmap": Colmap, "neus": Neus, "iron": Iron,
    "metashape": Metashape, "realitycapture": RealityCapture, "sfmdata": SfmData, "llff": Llff,
    "middlebury": Middlebury,
}  # fmt: skip


def detect(folder: Path) -> Source | None:
    """The importer of the cameras that lie in a folder of photographs or else in the folder above it, if there are any.

    Of several the first counts: COLMAP's model (also in sparse/0, sparse), transforms.json, Metashape's XML,
    RealityCapture's sidecars, its table, poses_bounds.npy, Middlebury's `*_par.txt`, then cameras.sfm, sfm.json,
    sfm_data.json and other `*.sfm` with poses; of several files of one kind the first by name. Photographs are those of
    `folder` if it has any, but transforms.json names its own. The importer's `scene` is no file yet.
    """
    images = folder if pictures(folder) else None
    places = (folder, folder.absolute().parent)
    return next((source for place in places if (source := found_in(place, images))), None)


def found_in(place: Path, images: Path | None) -> Source | None:
    """As `detect`, of cameras in one place."""
    scene = place / "scene.xml"
    if Colmap.model(place):
        return Colmap(place, scene, images=images)
    if (place / "transforms.json").is_file():
        return Transforms(place / "transforms.json", scene)
    for path in sorted(place.glob("*.xml")):
        if is_metashape(path):
            return Metashape(path, scene, images=images)
    if any(map(has_pose, sorted(place.glob("*.xmp")))):
        return RealityCapture(place, scene, images=images)
    for path in sorted(place.glob("*.csv")):
        if is_table(path):
            return RealityCapture(path, scene, images=images)
    if (place / "poses_bounds.npy").is_file():
        return Llff(place, scene, images=images)
    for path in sorted(place.glob("*_par.txt")):
        return Middlebury(path, scene, images=images)
    first = [place / name for name in ("cameras.sfm", "sfm.json", "sfm_data.json")]
    for path in (*first, *sorted(place.glob("*.sfm"))):
        if has_poses(path):
            return SfmData(path, scene, images=images)
    return None


def is_metashape(path: Path) -> bool:
    """Is an XML file one of Metashape's?"""
    try:
        return chunk_of(load_xml(path)) is not None
    except InputError:
        return False


def has_pose(path: Path) -> bool:
    """Is an XMP file a sidecar of RealityCapture's with a pose?"""
    try:
        return "Rotation" in xmp_fields(load_xml(path))
    except InputError:
        return False


def is_table(path: Path) -> bool:
    """Is a CSV file RealityCapture's table of cameras?"""
    try:
        return {"name", *POSE, "f"} <= {*table(path)[0]}
    except InputError:
        return False


def has_poses(path: Path) -> bool:
    """Is a JSON file a scene of Meshroom's or OpenMVG's with poses?"""
    try:
        top = load_json(path)
    except InputError:
        return False
    return isinstance(top, dict) and bool(top.get("poses") or top.get("extrinsics"))
