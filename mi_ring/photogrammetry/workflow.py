"""The way from photographs to a capture, stage by stage; what each has found is kept, to go on from there."""

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.formats import detect
from mi_ring.importers.frames import frames_of, require_cameras
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.photogrammetry.capture_files import OBJECT, PosedPicture, reduction
from mi_ring.photogrammetry.flash_light import Ball, Flash, find_flash
from mi_ring.photogrammetry.folder import Picture, let_open, relative_exposures, turned_with
from mi_ring.photogrammetry.marker_sheet import Board, Sighting, White, calibrate, white
from mi_ring.photogrammetry.object_masks import Object
from mi_ring.photogrammetry.shading_trial import DIM
from mi_ring.photogrammetry.structure_from_motion import Motion, model_points, structure_from_motion
from mi_ring.photogrammetry.table_plane import Plane
from mi_ring.scene.lights import Light
from mi_ring.system.files import write_file, writing
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

FEWEST_DEGREES = 15.0  #: between the directions of two of the photographs
FEWEST_SIGHTINGS = 3  #: photographs that must show the sheet
FORMAT = 2  #: of what is kept; to be raised whenever that changes


def require_same_photographs(pictures: Sequence[Picture], folder: Path) -> None:
    """Raise InputError if what a folder holds was found in other photographs, or by another version."""
    with writing(f"{folder.parent}: DIR"):
        folder.mkdir(parents=True, exist_ok=True)
    kept, first = folder / "photographs.json", folder / "sheet.json"  # before this is there, nothing was found in them
    photographs = {p.path.name: [p.path.stat().st_size, p.orientation] for p in pictures}
    if first.exists() and kept.exists():
        known = json.loads(kept.read_text("utf-8"))
        if known.get("format") != FORMAT:
            raise InputError(f"{folder}: was begun by another version of mi_ring, which kept other things; remove it, "
                             "or give another DIR")  # fmt: skip
        if known["photographs"] != photographs:
            raise InputError(f"{folder}: is of other photographs than {pictures[0].path.parent} holds now; remove it, "
                             "or give another DIR")  # fmt: skip
    write_file(kept, json.dumps({"format": FORMAT, "photographs": photographs}))


def upright(
    motion: Motion, center: np.ndarray, plane: Plane | None, ups: Mapping[str, np.ndarray]
) -> tuple[Motion, Plane | None, bool]:
    """Moved so that the object's `center` (3,) is the origin, and z the table's normal or the photographs' mean up.

    `ups` (3,): where that is in the axes of each camera.

    The unit is the median distance from the cameras to the object. Also: is there an up? Not if photographs without a
    table were held in every way.
    """
    poses = np.stack([pose for _, pose in motion.cameras.values()])
    scale = 1 / float(np.median(np.linalg.norm(poses[:, :3, 3] - center, axis=1)))
    up = plane.normal if plane else np.mean([pose[:3, :3] @ ups[n] for n, (_, pose) in motion.cameras.items()], 0)
    known = bool(np.linalg.norm(up) > 0.1)
    rotation = rotation_to_z(up / np.linalg.norm(up)) if known else np.eye(3)
    table = plane and Plane(rotation @ plane.normal, scale * (plane.offset - float(center @ plane.normal)))
    return motion.moved(scale, rotation, -scale * rotation @ center), table, known


def rotation_to_z(direction: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) of a unit vector to z."""
    return Rotation.align_vectors([[0, 0, 1.0]], [direction])[0].as_matrix()


class Sheet(NamedTuple):
    """What photographs show of the printed sheet."""

    sightings: dict[str, Sighting]  #: by the photograph's name
    white: dict[str, White]  #: by the same


def require_read(pictures: Sequence[Picture], found: Sequence[object]) -> None:
    """Raise InputError, which names all of them, if photographs could not be read: those with an error."""
    bad = [(picture.path, error) for picture, error in zip(pictures, found) if isinstance(error, InputError)]
    if len(bad) > 1:
        names = ", ".join(path.name for path, _ in bad)
        raise InputError(f"{bad[0][1]}; {len(bad)} photographs cannot be read: {names}; mend or remove them")
    if bad:
        raise InputError(f"{bad[0][1]}; mend or remove it")


def find_sheet(pictures: Sequence[Picture], square: float, folder: Path, progress: Progress) -> Sheet | None:
    """Where photographs show the sheet, whose squares measure so much [mm]; None if fewer than three do."""
    kept = folder / "sheet.json"
    if kept.exists():
        known = json.loads(kept.read_text("utf-8"))
    else:

        def seen(picture: Picture) -> list | InputError | None:
            try:
                return shown(picture)
            except InputError as error:
                if isinstance(error.__cause__, ImportError):  # not the file's fault: a package is missing
                    raise
                return error

        def shown(picture: Picture) -> list | None:
            sighting = Board(1.0).detect(picture.srgb())
            paper = white(picture.linear(), sighting) if sighting else ()
            picture.close()
            return [a.tolist() for a in (*sighting, *paper)] if sighting else None

        found = list(progress(in_threads(seen, pictures), "sheet", len(pictures)))
        require_read(pictures, found)
        known = {picture.name: values for picture, values in zip(pictures, found) if values}
        write_file(kept, json.dumps(known))
    sightings, papers = {}, {}
    for name, (ids, points, pixels, places, colours, beside) in known.items():
        sightings[name] = Sighting(np.array(ids), square * np.array(points), np.array(pixels))
        papers[name] = White(square * np.reshape(places, (-1, 3)), np.reshape(colours, (-1, 3)), np.array(beside, bool))
    if len(sightings) < FEWEST_SIGHTINGS:
        return None
    return Sheet(sightings, papers)


def cameras_beside(pictures: Sequence[Picture]) -> Motion | None:
    """The cameras that lie beside the photographs in the format of another tool; None if there are none."""
    source = detect(pictures[0].path.parent)
    if source is None:
        return None
    source = replace(source, photographs=[picture.path for picture in pictures])
    if isinstance(source, Photogrammetry):  # exposures are found elsewhere, where some may be missing
        source = replace(source, exif=False)
    for picture in pictures:
        let_open(picture.path)
    taken = frames_of(source)
    require_cameras(taken)
    frames = {frame.image.stem: frame for frame in taken}
    for p in pictures:
        if p.name in frames and frames[p.name].size != p.size:
            raise InputError("{}: has a camera of {} x {} pixels for {}, which has {} x {}; was it turned?".format(
                source.src, *frames[p.name].size, p.path.name, *p.size))  # fmt: skip
    cameras = {p.name: (frames[p.name].lens, frames[p.name].pose) for p in pictures if p.name in frames}
    failed = {p.name: f"{source.src} has no camera for it" for p in pictures if p.name not in frames}
    if len(cameras) < len(failed):
        raise InputError(f"{source.src}: has cameras for {len(cameras)} of {len(pictures)} photographs; move it away "
                         "to have cameras found in the photographs")  # fmt: skip
    model = Colmap.model(source.src)
    points = model_points(model) if isinstance(source, Colmap) and model else np.zeros((0, 3))
    # Geocentric coordinates of metres are too large for float32.
    middle = np.median([pose[:3, 3] for _, pose in cameras.values()], axis=0)
    return Motion(cameras, points, None, failed, f"{source.src}").moved(1.0, np.eye(3), -middle)


def require_sides(motion: Motion, folder: Path) -> None:
    """Raise InputError if all photographs are from one side, which does not tell how deep anything is."""
    ahead = np.stack([pose[:3, 2] for _, pose in motion.cameras.values()])
    widest = float(np.degrees(np.arccos(np.clip((ahead @ ahead.T).min(), -1, 1))))
    if widest < FEWEST_DEGREES:
        raise InputError(f"{folder}: photographs: all are from one side, within {widest:.0f} degrees; walk around the "
                         "object, 10 degrees at a time")  # fmt: skip


def find_cameras(
    pictures: Sequence[Picture], sheet: Sheet | None, turntable: bool, folder: Path, progress: Progress
) -> Motion:
    """Cameras: those that lie beside the photographs, else from structure from motion, else from the sheet.

    On a turntable structure from motion would take the room that stands still for the object.
    """
    if turntable:
        if sheet is None:
            raise InputError(f"{pictures[0].path.parent}: --turntable: the sheet of `mi-ring board` must turn with the "
                             "object; fewer than three photographs show it")  # fmt: skip
        return cameras_of_sheet(pictures, sheet)
    if beside := cameras_beside(pictures):
        return beside
    try:
        return structure_from_motion(pictures, sheet.sightings if sheet else {}, folder, progress)
    except InputError as error:
        if sheet is None or len(sheet.sightings) < len(pictures) / 2:
            raise
        print(f"{error}\nThe cameras are those by the sheet alone.")
        return cameras_of_sheet(pictures, sheet)


def cameras_of_sheet(pictures: Sequence[Picture], sheet: Sheet) -> Motion:
    """Cameras from the sheet alone, in its frame [mm]: of objects without texture, and on turntables."""
    by_size: dict[tuple[int, int], list[str]] = {}
    for picture in pictures:
        by_size.setdefault(picture.size, []).append(picture.name)
    cameras: dict[str, tuple[Lens, np.ndarray]] = {}
    errors: list[float] = []
    for size, names in by_size.items():
        sightings = {name: sheet.sightings[name] for name in names if name in sheet.sightings}
        with contextlib.suppress(InputError):  # too few of this size
            lens, poses, own = calibrate(sightings, size)
            cameras |= {name: (lens, pose) for name, pose in poses.items()}
            errors += own.values()
    if len(cameras) < len(pictures) / 2:
        raise InputError(f"{pictures[0].path.parent}: sheet: {len(cameras)} of {len(pictures)} photographs show enough "
                         "of it and fit each other; must be half of them: let more show more of it")  # fmt: skip
    why = "does not show enough of the sheet, or does not fit the others of its size"
    failed = {picture.name: why for picture in pictures if picture.name not in cameras}
    return Motion(cameras, np.zeros((0, 3)), float(np.mean(errors)), failed, "the sheet")


def flash_of(
    pictures: Sequence[Picture], motion: Motion, object_: Object, offset: np.ndarray, sheet: Sheet
) -> Flash | None:  # fmt: skip
    """What the sheet tells of the flash, about so far from the lens (3,), and of the room; None if it tells nothing."""
    poses = {name: pose for name, (_, pose) in motion.cameras.items()}
    taken = [picture for picture in pictures if picture.name in poses]
    exposures = dict(zip((picture.name for picture in taken), relative_exposures(taken, np.nan)))
    raw = any(picture.encoding == "linear" for picture in taken)  # has no curve
    return find_flash(sheet.white, poses, turned_with(pictures, np.eye(3)), exposures, offset, ball_of(motion, object_),
                      curved=not raw)  # fmt: skip


def ball_of(motion: Motion, object_: Object) -> Ball | None:
    """A ball in the object's place that looks as large in the middle of the photographs; None if it has no mask."""
    radii = []
    for name, mask in object_.masks.items():
        lens, pose = motion.cameras[name]
        size = np.sqrt((mask == OBJECT).sum() / np.pi) * reduction(mask, lens.size) / lens.focal[0]
        radii.append(size * np.linalg.norm(pose[:3, 3] - object_.center))
    return Ball(object_.center, float(np.median(radii))) if radii else None


def posed_pictures(
    pictures: Sequence[Picture], motion: Motion, object_: Object, offset: np.ndarray, flash: Flash | None
) -> list[PosedPicture]:
    """The photographs of the scene, in its frame; the `offset` (3,) of a flash is in the camera's axes [scene units].

    The sheet tells where it is and how strong. Without one it is where the offset says, and how strong is not known: it
    is made so weak that fits see that.
    """
    places = turned_with(pictures, flash.offset if flash else offset)
    known = flash.intensities if flash else {}
    away = np.median([np.linalg.norm(pose[:3, 3] - object_.center) for _, pose in motion.cameras.values()])
    usual = flash.power if flash else np.full(3, np.pi * object_.level / DIM * away**2)
    result, taken = [], [picture for picture in pictures if picture.name in motion.cameras]
    for picture, exposure in zip(taken, relative_exposures(taken)):
        lens, pose = motion.cameras[picture.name]
        name = picture.name
        light = Light("point", pose[:3, :3] @ places[name] + pose[:3, 3], known.get(name, exposure * usual))
        posed = PosedPicture(picture, lens, pose, object_.masks.get(name), light)
        if flash:
            posed = replace(posed, measured=name in known, falloff=flash.falloff, gamma=flash.gamma)
        result.append(posed)
    return result
