"""The stages from photographs to a capture. Each stage saves its results, so that an interrupted run can continue."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.capture.arrays import FLATTEST
from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.formats import detect
from mi_ring.importers.frames import adapt, frames_of, require_cameras
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.photogrammetry.capture_files import OBJECT, PosedPicture, reduction
from mi_ring.photogrammetry.flash_light import FlashCalibration, ObjectSphere, calibrate_flash
from mi_ring.photogrammetry.folder import DECODED, Picture, relative_exposures, turn_with_cameras
from mi_ring.photogrammetry.marker_sheet import MarkerSheet, PaperSamples, SheetDetection, calibrate, sample_paper
from mi_ring.photogrammetry.object_masks import SegmentedObject
from mi_ring.photogrammetry.shading_trial import ASSUMED_ALBEDO
from mi_ring.photogrammetry.structure_from_motion import SparseModel, model_points, structure_from_motion
from mi_ring.photogrammetry.table_plane import Plane
from mi_ring.scene.lights import Light
from mi_ring.system.files import read_json, write_file, writing
from mi_ring.system.machine import in_threads
from mi_ring.system.optional import need
from mi_ring.system.progress import Progress

SMALLEST = 32  #: shorter side of a photograph [px]
MIN_DEGREES = 15.0  #: between the directions of two of the photographs
MIN_DETECTIONS = 3  #: photographs that must show the sheet
FORMAT = 3  #: version of the saved results; increase it when they change


def require_same_photographs(pictures: Sequence[Picture], folder: Path) -> None:
    """Raise InputError if `folder` has results of other photographs, or in another format.

    Otherwise create the folder, and record names, sizes and orientations of the photographs there.
    """
    with writing(f"{folder.parent}: DIR"):
        folder.mkdir(parents=True, exist_ok=True)
    record, first = folder / "photographs.json", folder / "sheet.json"  # without the latter there are no results
    photographs, saved = {p.path.name: [p.path.stat().st_size, p.orientation] for p in pictures}, read_json(record)
    if first.exists() and saved:
        if saved.get("format") != FORMAT:
            raise InputError(f"{folder}: was begun by another version of mi_ring, with another format; remove it, or "
                             "give another DIR")  # fmt: skip
        if saved["photographs"] != photographs:
            raise InputError(f"{folder}: is of other photographs than {pictures[0].path.parent} holds now; remove it, "
                             "or give another DIR")  # fmt: skip
    write_file(record, json.dumps({"format": FORMAT, "photographs": photographs}))


def make_upright(
    sparse: SparseModel, center: np.ndarray, plane: Plane | None, ups: Mapping[str, np.ndarray]
) -> tuple[SparseModel, Plane | None, bool]:
    """Transform cameras, points and table to a frame with origin `center` (3,), z up, and camera distances of about 1.

    Returns (model, table, True if the up direction is known). Up is the normal of the table `plane`. If that is None,
    up is the mean of `ups`: the up direction (3,) of each photograph in camera axes, by name. If these cancel out, up
    is unknown, and the axes stay.
    """
    scale = 1 / sparse.distance(center)
    up = plane.normal if plane else np.mean([pose[:3, :3] @ ups[n] for n, (_, pose) in sparse.cameras.items()], 0)
    known = bool(np.linalg.norm(up) > 0.1)
    rotation = Rotation.align_vectors([[0, 0, 1.0]], [up / np.linalg.norm(up)])[0].as_matrix() if known else np.eye(3)
    table = plane and Plane(rotation @ plane.normal, scale * (plane.offset - float(center @ plane.normal)))
    return sparse.moved(scale, rotation, -scale * rotation @ center), table, known


class SheetObservations(NamedTuple):
    """What the photographs show of the printed sheet: corners and white paper, by the photograph's name."""

    detections: dict[str, SheetDetection]
    papers: dict[str, PaperSamples]


def find_sheet(
    pictures: Sequence[Picture], square: float, folder: Path, progress: Progress
) -> SheetObservations | None:
    """Find the printed sheet in the photographs. Returns None if fewer than three photographs show it.

    `square`: side length of the sheet's squares [mm]. The result is saved in `folder`. If it is there already, it is
    only read. Raises InputError if a photograph cannot be read.
    """
    record = folder / "sheet.json"
    if (saved := read_json(record)) is None:

        def observe(picture: Picture) -> list | InputError | None:
            try:
                if max(SMALLEST, max(picture.size) / FLATTEST) > min(picture.size):
                    raise InputError("{}: is {} x {} pixels; the shorter side must be at least {}, and an {}th of the "
                                     "longer one".format(picture.path, *picture.size, SMALLEST, FLATTEST))  # fmt: skip
                detection = MarkerSheet(1.0).detect(picture.srgb())
                if detection is None:
                    return None
                paper = sample_paper(picture.pixels[..., :3], detection, picture.to_linear, picture.saturation)
                return [a.tolist() for a in (*detection, *paper)]
            except InputError as error:
                if isinstance(error.__cause__, ImportError):  # a package is missing: the file is fine
                    raise
                return error
            finally:
                picture.close()

        results = list(progress(in_threads(observe, pictures, most=DECODED), "sheet", len(pictures)))
        if bad := [(p.path.name, error) for p, error in zip(pictures, results) if isinstance(error, InputError)]:
            names = ", ".join(name for name, _ in bad)
            more = f"{len(bad)} photographs cannot be used: {names}; repair or remove them"
            raise InputError(f"{bad[0][1]}; {more if len(bad) > 1 else 'repair or remove it'}")
        saved = {picture.name: values for picture, values in zip(pictures, results) if values}
        write_file(record, json.dumps(saved))
    detections, papers = {}, {}
    for name, (ids, corners, pixels, points, colours, in_margin) in saved.items():
        detections[name] = SheetDetection(np.array(ids), square * np.array(corners), np.array(pixels))
        points, colours = square * np.reshape(points, (-1, 3)), np.reshape(colours, (-1, 3))
        papers[name] = PaperSamples(points, colours, np.array(in_margin, bool))
    return SheetObservations(detections, papers) if len(detections) >= MIN_DETECTIONS else None


def imported_cameras(pictures: Sequence[Picture]) -> SparseModel | None:
    """Read cameras that another tool has written beside the photographs. Returns None if there are none.

    Prints the importer's notes. Raises InputError if the cameras are invalid, or if most photographs have no camera.
    """
    source = detect(pictures[0].path.parent)
    if source is None:
        return None
    source = replace(source, photographs=[picture.path for picture in pictures])
    if isinstance(source, Photogrammetry):  # exposures come from `Picture`, where some may be missing
        source = replace(source, exif=False)
    imported = frames_of(source)
    require_cameras(imported)
    for note in source.notes:
        print(note)
    frames = {frame.image.stem: frame for frame in imported}
    for p in pictures:
        if p.name in frames:
            adapt(frames[p.name], p.size, 1)
        if p.name in frames and frames[p.name].lens.size != p.size:
            raise InputError("{}: has a camera of {} x {} pixels for {}, which has {} x {}; was it turned?".format(
                source.src, *frames[p.name].lens.size, p.path.name, *p.size))  # fmt: skip
    cameras = {p.name: (frames[p.name].lens, frames[p.name].pose) for p in pictures if p.name in frames}
    failed = {p.name: f"{source.src} has no camera for it" for p in pictures if p.name not in frames}
    if not cameras and source.scene.absolute().parent != pictures[0].path.absolute().parent:
        print(f"{source.src}: has cameras of other photographs alone; left out")
        return None
    if len(cameras) < len(failed):
        raise InputError(f"{source.src}: has cameras for {len(cameras)} of {len(pictures)} photographs; move it away "
                         "to have cameras found in the photographs")  # fmt: skip
    points, folder = np.zeros((0, 3)), Colmap.model(source.src)
    if isinstance(source, Colmap) and folder:
        points = model_points(need("pycolmap", f"{folder}").Reconstruction(folder))
    # Move the origin: geocentric coordinates in metres are too large for float32.
    middle = np.median([pose[:3, 3] for _, pose in cameras.values()], axis=0)
    return SparseModel(cameras, points, None, failed, f"{source.src}").moved(1.0, np.eye(3), -middle)


def require_parallax(sparse: SparseModel, folder: Path) -> None:
    """Raise InputError if all photographs are from one side, so that depth is unknown.

    `folder`: of the photographs, for the message.
    """
    forward = np.stack([pose[:3, 2] for _, pose in sparse.cameras.values()])
    widest = float(np.degrees(np.arccos(np.clip((forward @ forward.T).min(), -1, 1))))
    if widest < MIN_DEGREES:
        raise InputError(f"{folder}: photographs: all are from one side, within {widest:.0f} degrees; walk around the "
                         "object, 10 degrees at a time")  # fmt: skip


def find_cameras(
    pictures: Sequence[Picture], sheet: SheetObservations | None, turntable: bool, folder: Path, progress: Progress
) -> SparseModel:
    """Find the cameras: those of another tool, otherwise by structure from motion, otherwise by the printed sheet.

    `sheet`: what the photographs show of the sheet; None: nothing. `turntable`: the object turns with the sheet, so
    only the sheet is used: structure from motion would track the room. `folder`: results of structure from motion are
    saved there. Raises InputError if too few photographs get a camera.
    """
    if turntable:
        if sheet is None:
            raise InputError(f"{pictures[0].path.parent}: --turntable: the sheet of `mi-ring board` must turn with the "
                             "object; fewer than three photographs show it")  # fmt: skip
        return cameras_from_sheet(pictures, sheet)
    if imported := imported_cameras(pictures):
        return imported
    try:
        return structure_from_motion(pictures, sheet.detections if sheet else {}, folder, progress)
    except InputError as error:
        if sheet is None or len(sheet.detections) < len(pictures) / 2:
            raise
        print(f"{error}\nThe cameras are found by the sheet alone.")
        return cameras_from_sheet(pictures, sheet)


def cameras_from_sheet(pictures: Sequence[Picture], sheet: SheetObservations) -> SparseModel:
    """Find the cameras by the printed sheet alone, in the sheet's frame [mm].

    Raises InputError if fewer than half of the photographs get a camera.
    """
    cameras: dict[str, tuple[Lens, np.ndarray]] = {}
    errors: list[float] = []
    for size in dict.fromkeys(picture.size for picture in pictures):
        names = [p.name for p in pictures if p.size == size and p.name in sheet.detections]
        with contextlib.suppress(InputError):  # too few of this size
            lens, poses, own = calibrate({name: sheet.detections[name] for name in names}, size)
            cameras |= {name: (lens, pose) for name, pose in poses.items()}
            errors += own.values()
    if len(cameras) < len(pictures) / 2:
        raise InputError(f"{pictures[0].path.parent}: sheet: {len(cameras)} of {len(pictures)} photographs show enough "
                         "of it and fit each other; must be half of them: let more show more of it")  # fmt: skip
    why = "does not show enough of the sheet, or does not fit the others of its size"
    failed = {picture.name: why for picture in pictures if picture.name not in cameras}
    return SparseModel(cameras, np.zeros((0, 3)), float(np.mean(errors)), failed, "the sheet")


def flash_from_sheet(
    pictures: Sequence[Picture], sparse: SparseModel, found: SegmentedObject, offset: np.ndarray,
    sheet: SheetObservations,
) -> FlashCalibration | None:  # fmt: skip
    """Calibrate the flash by the sheet's white paper. Returns None if no photograph shows the paper.

    The frame of `sparse` and `found` must be that of the sheet [mm]. A sphere stands for the object. `offset` (3,):
    approximate position of the flash relative to the lens [mm], x right, y down, z forward in an upright photograph.
    """
    radii = []
    for name, mask in found.masks.items():
        lens, pose = sparse.cameras[name]
        pixels = np.sqrt((mask == OBJECT).sum() / np.pi) * reduction(mask, lens.size)
        radii.append(pixels / lens.focal[0] * np.linalg.norm(pose[:3, 3] - found.center))
    sphere = ObjectSphere(found.center, float(np.median(radii))) if radii else None
    poses = {name: pose for name, (_, pose) in sparse.cameras.items()}
    placed = [picture for picture in pictures if picture.name in poses]
    exposures = dict(zip((picture.name for picture in placed), relative_exposures(placed, np.nan)))
    curved = all(not picture.raw for picture in placed)  # raw files are linear
    axes = turn_with_cameras(pictures, np.eye(3))
    return calibrate_flash(sheet.papers, poses, axes, exposures, offset, sphere, curved)


def posed_pictures(
    pictures: Sequence[Picture], sparse: SparseModel, found: SegmentedObject, offset: np.ndarray,
    flash: FlashCalibration | None,
) -> list[PosedPicture]:  # fmt: skip
    """Return the photographs that have a camera, each with its camera, light and mask.

    `flash`: calibrated flash. None: the flash is at `offset` (3,) relative to the lens [scene units], x right, y down,
    z forward in an upright photograph, and its intensity follows from an assumed albedo of the object.
    """
    offsets = turn_with_cameras(pictures, flash.offset if flash else offset)
    known = flash.intensities if flash else {}
    assumed = np.full(3, np.pi * found.radiance / ASSUMED_ALBEDO * sparse.distance(found.center) ** 2)
    falloff, gamma = (flash.falloff, flash.gamma) if flash else (0.0, 1.0)
    result, placed = [], [picture for picture in pictures if picture.name in sparse.cameras]
    for picture, exposure in zip(placed, relative_exposures(placed)):
        name, (lens, pose) = picture.name, sparse.cameras[picture.name]
        intensity = known.get(name, exposure * (flash.power if flash else assumed * picture.saturation))
        light = Light("point", pose[:3, :3] @ offsets[name] + pose[:3, 3], intensity)
        result.append(PosedPicture(picture, lens, pose, found.masks.get(name), light, name in known, falloff, gamma))
    return result
