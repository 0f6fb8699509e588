"""Make a capture from a folder of photographs: `python -m mi_ring.photos FOLDER DIR`."""

import contextlib
import json
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from mi_ring.capture.emitter_elements import room_element
from mi_ring.capture.loading import load_capture
from mi_ring.capture.reduction import WIDTH
from mi_ring.capture.scenefile import scene_bytes, scene_element
from mi_ring.errors import InputError
from mi_ring.image_headers import SUFFIXES, encodings, image_size
from mi_ring.importers.formats import detect
from mi_ring.importers.writer import Writer
from mi_ring.output.inspection import inspect
from mi_ring.photogrammetry import folder, workflow
from mi_ring.photogrammetry.capture_files import crop_windows, write_posed_picture, write_table
from mi_ring.photogrammetry.flash_light import FlashCalibration
from mi_ring.photogrammetry.marker_sheet import SQUARE, align
from mi_ring.photogrammetry.object_masks import SegmentationInput, SegmentedObject, find_object, require_half
from mi_ring.photogrammetry.structure_from_motion import SparseModel
from mi_ring.photogrammetry.table_plane import Plane
from mi_ring.rendering.spherical_harmonics import PER_FRAME
from mi_ring.system import command
from mi_ring.system.files import locked, read_json, write_file
from mi_ring.system.machine import in_threads
from mi_ring.system.optional import need
from mi_ring.system.progress import Part, Steps, progress

OPTIONS = "work/options.json"  #: the options of the command that made the capture
MADE = "scene.xml", "images", "masks", "valid", "table.png"  #: what the command may write, besides `work`
METRES = 1e-3  #: length of a scene unit if there is a sheet [m]


@dataclass(frozen=True)
class PhotosConfig:
    """Find cameras and masks of photographs of an object, and write a capture to fit.

    The photographs show one object from all around. The object does not move. A flash beside the lens lights the object
    in a dim room. The files are JPEG, HEIC, PNG, TIFF, WebP, AVIF, BMP, OpenEXR or raw. With a sheet of `mi-ring board`
    under the object, the capture is in millimetres and upright. After an interruption, give the same command again: it
    continues.
    """

    folder: Positional[Annotated[Path, arg(metavar="FOLDER")]]
    """Folder of the photographs."""
    out: Positional[Annotated[Path, arg(metavar="DIR")]]
    """Folder to write: scene.xml, its files, and work/ with intermediate results.
    After an interruption, give the same command again: it continues from work/."""
    flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the flash relative to the lens: right, down, forward. 30 -60 0: 30 to the right, 60 above.
    With the printed sheet, give millimetres; the command then refines this position.
    Without the sheet, give fractions of the median distance from the cameras to the object, for example 0.06 -0.12 0.
    Measure while you hold the camera as in most photographs. For photographs with the camera on its side, the command
    turns the flash with the camera."""
    turntable: bool = False
    """Set this option if the object turned on a turntable while camera and flash stood still.
    The printed sheet of `mi-ring board` must lie under the object and turn with it."""
    masks: Literal["auto", "alpha", "rembg"] | Path = "auto"
    """Where the masks of the object come from. Give another source if the masks of auto are wrong.
    auto: found from the photographs and their 3-D points. alpha: the alpha channels of the photographs.
    rembg: found by the package rembg, which must be installed.
    A folder: the masks in it. The mask of photo.jpg is photo.jpg.png, photo.png or photo.jpg."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Box around the object [mm]: XLOW XHIGH YLOW YHIGH ZLOW ZHIGH, for example -40 40 -40 40 0 120.
    The masks then show only what is inside this box. Give a box if the masks also show a second thing near the object.
    The origin is the middle of the printed sheet. x points to the right edge of the sheet, y to its top edge, z up."""
    square_mm: float = SQUARE
    """Side of a square on the printed sheet [mm].
    Measure the sheet if the printer did not print at 100 %. If five squares together are 99 mm long, give 19.8."""

    def __post_init__(self) -> None:
        if not 0 < self.square_mm < np.inf:
            raise InputError(f"--square-mm: is {self.square_mm}, must be above 0")
        if self.box and not all(low < high for low, high in zip(self.box[::2], self.box[1::2])):
            raise InputError(f"--box: is {' '.join(map(str, self.box))}, must be lowest and highest x, then y, then z")
        if isinstance(self.masks, Path) and not self.masks.is_dir():
            raise InputError(f"--masks: {self.masks}: no such folder; give auto, alpha, rembg or a folder of masks")
        if self.masks == "rembg":
            need("rembg", "--masks rembg")

    def words(self) -> list[str]:
        """List all options as strings "name: value". They are stored in the output folder.

        When the command runs again, they show whether its options are the same.
        """
        return [f"{name}: {v.resolve() if isinstance(v, Path) else v}" for name, v in vars(self).items()]


def cameras_report(sparse: SparseModel) -> str:
    """Return a text for the user: one line about all cameras, and one line per photograph whose camera was not found.

    `sparse`: the cameras and 3-D points that structure from motion has found.
    """
    count, failed = len(sparse.cameras), sparse.failed
    how = f"as given by {sparse.source}" if sparse.source else f"by {len(sparse.points)} points"
    how += f", reprojection error {sparse.error:.2f} px" if sparse.error else ""
    return "\n".join([
        f"Cameras: {count} of {count + len(failed)} photographs, {how}",
        *(f"  without: {name}: {why}" for name, why in failed.items()),
    ])  # fmt: skip


def masks_report(found: SegmentedObject, sparse: SparseModel, source: str | Path) -> str:
    """Return a text for the user: one line about all masks, and one line per photograph without a mask.

    `found`: the masks. `sparse`: the cameras. `source`: where the masks come from, the option --masks.
    """
    without = [name for name in sparse.cameras if name not in found.masks]
    why = "does not show the object, or not clearly enough for a mask" if source == "auto" else "none was given"
    return "\n".join([
        f"Masks: {len(found.masks)} of {len(sparse.cameras)} photographs",
        *(f"  without: {name}: {why}" for name in without),
    ])  # fmt: skip


def flash_report(flash: FlashCalibration, sparse: SparseModel, found: SegmentedObject) -> str:
    """Return one line for the user about the flash, the room's light and the camera's response.

    `flash`: their values, measured on the printed sheet. `sparse`: the cameras. `found`: the object with its centre.
    """
    x, y, z = flash.offset
    where = f"{abs(x):.0f} mm {'left' if x < 0 else 'right'}, {abs(y):.0f} mm {'above' if y < 0 else 'below'}, "
    where += f"{abs(z):.0f} mm {'behind' if z < 0 else 'before'} the lens"
    share = (flash.room * sparse.distance(found.center) ** 2).mean()
    where += f", shines like the cosine to the power of {flash.falloff:.1f}"
    curve = f"; the camera's curve has the exponent {flash.gamma:.2f}" if flash.gamma != 1 else ""
    return (f"Flash, by the sheet in {len(flash.intensities)} photographs: {where}; the room's light on the sheet is "
            f"{share:.1%} of its light at the object{curve}")  # fmt: skip


def steps_of(pictures: Path) -> list[list[Part]]:
    """List the steps of the command, and how many seconds each part is likely to take.

    `pictures`: folder of the photographs. The times are those of 58 photographs of 0.8 megapixels and of 80 of 13
    megapixels, and of others in proportion.
    """
    files = [file for file in sorted(pictures.glob("[!.]*")) if file.suffix.lower() in SUFFIXES]
    count, size = max(3, len(files)), 1e6
    with contextlib.suppress(Exception):  # the command itself says what is wrong
        size = math.prod(image_size(files[0]))
    millions = min(size, 20e6) / 1e6
    pairs = min(count * (count - 1) / 2, 21 * count)
    outlines = 0.4 + 0.05 * millions
    sometimes = [Part(name, 0) for name in ("bare table", "a trial fit", "table", "beside the table", "pattern")]
    return [
        [Part("sheet", 0.01 * count * millions)],
        [Part("features", count * (0.35 + 0.05 * millions))],
        [Part("matching", pairs * (0.03 + 0.006 * millions))],
        [Part("all cameras", count * (0.17 + 0.1 * millions)), Part("cameras", count * (0.1 + 0.1 * millions)),
         Part("bundle adjustment", 0.04 * count), Part("principal points", 0.02 * count)],
        [Part("reading", count * 0.04 * (1 + millions)),
         *(Part(f"masks, the object's place, round {k}", 0.13 * count) for k in (1, 2, 3, 4)),
         Part("masks, the object's place", 0), *sometimes, Part("reading", 0.05 * count),
         *(Part(f"masks, openings, round {k}", 0.1 * count) for k in (1, 2)),
         *sometimes, *(Part(f"masks, outlines, round {k}", outlines * count) for k in (1, 2))],
        [Part("writing", count * (0.05 + 0.03 * millions))],
        [Part("reading", count * 0.02 * (1 + millions)), Part("inspecting", 0.2 * count)],
    ]  # fmt: skip


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(PhotosConfig, arguments, "mi_ring.photos")
    scene, sheet = config.out / "scene.xml", config.out / "check.png"
    require_apart(config)
    if scene.exists() and (sheet.exists() or read_json(config.out / OPTIONS) != config.words()):
        made = [name for name in MADE if (config.out / name).exists()]
        raise InputError(f"{config.out}: DIR: has a scene.xml already; give another folder. To make it again, remove "
                         f"{', '.join(made)} there, and keep work/")  # fmt: skip
    try:
        with (
            command.resumable(),
            locked(config.out, "DIR"),
            Steps(*steps_of(config.folder)[-1 if scene.exists() else 0 :]),
        ):
            if not scene.exists():
                make(config, scene)
            inspection = inspect(load_capture(scene, width=WIDTH))
    except KeyboardInterrupt as stop:
        # Exit at once, because native threads cannot be stopped. Their files are complete or absent.
        os._exit(command.exit_status(stop))
    inspection.save(sheet, "DIR")
    print(f"{inspection.text}\nContact sheet: {sheet}\nNow: mi-ring fit {scene}")


def require_apart(config: PhotosConfig) -> None:
    """Raise InputError if FOLDER or the folder of --masks is a folder that the command will write."""
    given = {"FOLDER": config.folder} | ({"--masks": config.masks} if isinstance(config.masks, Path) else {})
    out = config.out.resolve()
    written = [out / name for name in (*MADE, "work")]
    for field, path in given.items():
        place = path.resolve()
        if place == out or any(place.is_relative_to(taken) for taken in written):
            raise InputError(f"{path}: {field}: is where the capture is written; give another DIR than {config.out}")


def make(config: PhotosConfig, scene: Path) -> None:
    """Find cameras, masks and flash, and write the capture: the scene file `scene`, photographs and masks beside it.

    Prints reports for the user. Intermediate results are kept in the folder work/. If the command was interrupted,
    stages whose results are there are not repeated. Raises InputError if a stage fails.
    """
    pictures = folder.find_pictures(config.folder, upright=detect(config.folder) is None)
    if dark := folder.without_flash(pictures):
        print(f"Flash: did not fire, by EXIF data, in {', '.join(dark)}, which are left out")
        pictures = [picture for picture in pictures if picture.path.name not in dark]
    if len(cameras := folder.camera_names(pictures)) > 1:
        kinds = ", ".join(f"{count} by {model}" for model, count in cameras.items())
        print(f"Cameras: several models, by EXIF data ({kinds}); photographs of one size are assumed to share a lens, "
              "and all to have the flash in one place beside it; better give photographs of one camera")  # fmt: skip
    if isinstance(config.masks, Path):  # check it before the long work
        require_half(sum(p.mask_file(config.masks) is not None for p in pictures), pictures, config.masks)
    elif config.masks == "alpha" and not any(p.path.suffix.lower() in folder.TRANSPARENT for p in pictures):
        require_half(0, pictures, "alpha")
    pictures, note = folder.with_saturations(pictures)
    if note:
        print(note)
    print(f"Assumed: {'; '.join(encodings([picture.path for picture in pictures]))}")
    for left in config.out.glob(".scene.*/"):  # left by a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    work = config.out / "work"
    workflow.require_same_photographs(pictures, work)
    sheet = workflow.find_sheet(pictures, config.square_mm, work, progress)
    if config.box and not sheet:
        raise InputError(f"--box: is in the frame of the sheet of `mi-ring board`, which {config.folder} does not show")
    sparse, plane = workflow.find_cameras(pictures, sheet, config.turntable, work, progress), None
    print(cameras_report(sparse))
    workflow.require_parallax(sparse, config.folder)
    if sheet:
        moved = align(sheet.detections, sparse.cameras)
        sparse = sparse.moved(moved.scale, moved.rotation, moved.shift)
        plane = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
        print(f"Sheet: in {len(sheet.detections)} photographs, {moved.corners} corners, {moved.rms:.2g} mm off")
    else:
        print("Sheet: none seen, so that the scale is unknown")
    known = SegmentationInput(plane, config.box, config.masks, sheet is not None)
    found = find_object(pictures, sparse, known, work / "masks", progress)
    plane = found.plane
    print(masks_report(found, sparse, config.masks))
    if not plane:
        print("Table: none found; if there is one, check in the contact sheet that the masks do not contain it")
    if config.masks == "auto":  # without a mask, a fit would take the table for the object
        sparse = replace(sparse, cameras={n: camera for n, camera in sparse.cameras.items() if n in found.masks})
    has_up = True
    if not sheet:
        sparse, plane, has_up = workflow.make_upright(sparse, found.center, plane, folder.up_directions(pictures))
        found = found._replace(center=np.zeros(3))
    offset = np.array(config.flash_offset)
    flash = workflow.flash_from_sheet(pictures, sparse, found, offset, sheet) if sheet else None
    if flash:
        print(flash_report(flash, sparse, found))
    if not flash and not offset.any() and len({picture.camera_orientation for picture in pictures}) > 1:
        print("Flash: assumed at the lens, but the camera was held upright and sideways; if the flash is elsewhere, "
              "give its position by --flash-offset")  # fmt: skip
    taken = workflow.posed_pictures(pictures, sparse, found, offset, flash)
    if silent := folder.without_exposure([posed.picture for posed in taken if not posed.measured]):
        print(f"Exposure: assumed to be the median one where EXIF data have none: {', '.join(silent)}")
    ground, up = plane and plane.offset * plane.normal, np.array([0.0, 0.0, 1.0]) if has_up else None
    # The Fresnel term depends on the reflectance, which is known only if the flash's power is.
    root = scene_element(ground=ground, up=up, metres=METRES if sheet else None, fresnel=flash is not None)
    writer = Writer(scene)
    if config.turntable or (flash and flash.room.any()):  # on a turntable the object sees the room turn
        harmonics = np.zeros((PER_FRAME, 3))
        harmonics[0] = np.sqrt(4 * np.pi) * flash.ambient if flash else 0.0
        root.append(room_element("camera" if config.turntable else "world", harmonics))
    try:
        cuts = crop_windows([posed.mask for posed in taken], [posed.lens.size for posed in taken])
        written = in_threads(partial(write_posed_picture, writer), taken, cuts, most=folder.DECODED)
        root.extend(progress(written, "writing", len(taken)))
        if plane and flash:
            root.extend(write_table(writer, taken, plane, found.center, flash))
        write_file(config.out / OPTIONS, json.dumps(config.words()))
        writer.finish(scene_bytes(root))
    finally:
        writer.close()
    print(f"{scene}: {len(taken)} photographs\n")


if __name__ == "__main__":
    command.run("mi_ring.photos", main)
