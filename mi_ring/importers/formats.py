"""All formats, by their names in `mi_ring.convert`, and the detection of a folder's format."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from mi_ring.errors import InputError
from mi_ring.importers.bundler import Bundler
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.diligent_mv import DiligentMV
from mi_ring.importers.frames import Source
from mi_ring.importers.gltf_cameras import GltfCameras
from mi_ring.importers.iron import Iron
from mi_ring.importers.llff import Llff
from mi_ring.importers.metashape import Metashape, find_chunk
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.neus import Neus
from mi_ring.importers.opensfm import OpenSfm
from mi_ring.importers.polycam import Polycam
from mi_ring.importers.reading import list_images, load_json, load_xml
from mi_ring.importers.realitycapture import POSE, RealityCapture, read_csv, xmp_fields
from mi_ring.importers.record3d import Record3D
from mi_ring.importers.sfmdata import SfmData
from mi_ring.importers.transforms import Transforms
from mi_ring.importers.visualsfm import VisualSfm

FORMATS = {
    "diligent-mv": DiligentMV, "transforms": Transforms, "colmap": Colmap, "neus": Neus, "iron": Iron,
    "metashape": Metashape, "realitycapture": RealityCapture, "sfmdata": SfmData, "llff": Llff,
    "middlebury": Middlebury, "bundler": Bundler, "visualsfm": VisualSfm,
    "opensfm": OpenSfm, "polycam": Polycam, "record3d": Record3D, "gltf": GltfCameras,
}  # fmt: skip


def detect(folder: Path) -> Source | None:
    """The importer of the cameras in a folder of photographs, otherwise in its parent folder; None without cameras.

    The first match is taken, in this order: COLMAP's model (also in sparse/0, sparse), transforms.json, Metashape's
    XML, RealityCapture's sidecars, its table, poses_bounds.npy, Middlebury's `*_par.txt`, cameras.sfm, sfm.json,
    sfm_data.json, other `*.sfm` with poses. Files of one kind are sorted by name. The photographs are those in `folder`
    if there are any, except that transforms.json names its own.
    """
    images = folder if list_images(folder) else None

    def has_pose(path: Path) -> bool:
        return "Rotation" in xmp_fields(load_xml(path))

    def has_poses(path: Path) -> bool:
        return isinstance(top := load_json(path), dict) and bool(top.get("poses") or top.get("extrinsics"))

    for place in (folder, folder.absolute().parent):
        scenes = [place / name for name in ("cameras.sfm", "sfm.json", "sfm_data.json")]
        candidates: list[tuple[type[Source], list[Path], Callable[[Path], Any]]] = [
            (Colmap, [place], Colmap.model),
            (Transforms, [place / "transforms.json"], Path.is_file),
            (Metashape, sorted(place.glob("*.xml")), lambda path: find_chunk(load_xml(path)) is not None),
            (RealityCapture, [place], lambda path: any(accepts(has_pose, file) for file in path.glob("*.xmp"))),
            (RealityCapture, sorted(place.glob("*.csv")), lambda path: {"name", *POSE, "f"} <= {*read_csv(path)[0]}),
            (Llff, [place], lambda path: (path / "poses_bounds.npy").is_file()),
            (Middlebury, sorted(place.glob("*_par.txt")), Path.exists),
            (SfmData, [*scenes, *sorted(place.glob("*.sfm"))], has_poses),
        ]
        for importer, paths, check in candidates:
            for path in filter(partial(accepts, check), paths):
                options: dict[str, Any] = {} if importer is Transforms else {"images": images}
                return importer(path, place / "scene.xml", **options)
    return None


def accepts(check: Callable[[Path], Any], path: Path) -> bool:
    """Does a file pass a check? It does not if reading it raises InputError."""
    try:
        return bool(check(path))
    except InputError:
        return False
