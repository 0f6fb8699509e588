"""The object as the photographs show it: where it is, and its masks."""

import contextlib
import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.capture.grabcut import grown
from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera
from mi_ring.images import read_image, write_image
from mi_ring.importers.reading import read_as
from mi_ring.importers.undistortion import Window
from mi_ring.photogrammetry import automatic_masks
from mi_ring.photogrammetry.capture_files import OBJECT, UNSURE, reduction
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.reduced_photographs import View, around, camera_of, pasted, reduced, reduced_mask, whole_of
from mi_ring.photogrammetry.shading_trial import coverages, sphere_of
from mi_ring.photogrammetry.structure_from_motion import Motion
from mi_ring.photogrammetry.table_plane import FLAT, Ground, Plane, Table, bare, find_plane
from mi_ring.system.files import write_file
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

SURE = 0.8  #: agreement of a mask with what all say together that is needed at least
COARSE, BROUGHT = 600, 1200  #: pixels at most along photographs in which the object is looked for, and of masks given
SMALL, CLOSE = 200, 400  #: along the object, in the pictures that its hollows are found in, and its outlines
FINE = 640  #: texels across the table's picture there
WIDE = 2.0  #: how far the table is known from whole photographs, in their reach


class Object(NamedTuple):
    """The object as the photographs show it."""

    masks: dict[str, np.ndarray]  #: (H, W) uint8 by the photograph's name, but for those that are not sure
    center: np.ndarray  #: (3,)
    level: float  #: its mean radiance, 1 = full scale
    plane: Plane | None  #: of the table that it stands on, if there is one


class Hints(NamedTuple):
    """What is known of the object beforehand."""

    plane: Plane | None = None  #: of the table
    box: tuple[float, ...] | None = None  #: lowest and highest x, y, z of the object, one after another
    masks: str | Path = "auto"  #: where masks come from, as `Picture.mask` says; "auto": they are found

    def digest(self) -> str:
        """What tells where masks come from, and those of a folder, from others."""
        if not isinstance(self.masks, Path):
            return self.masks
        files = [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(self.masks.iterdir()) if f.is_file()]
        return hashlib.blake2b(repr(files).encode(), digest_size=8).hexdigest()

    def allow(self, points: np.ndarray, distance: float, flat: float = 2 * FLAT) -> np.ndarray:
        """Where the object may be, of points (N, 3): (N,) bool. `distance` is that of the cameras.

        `flat`: in units of it, height up to which it may be the table.
        """
        allowed = np.ones(len(points), bool)
        if self.plane:
            allowed &= self.plane.height(points) > flat * distance
        if self.box:
            low, high = np.reshape(self.box, (3, 2)).T
            allowed &= ((points >= low) & (points <= high)).all(1)
        return allowed


def find_object(pictures: Sequence[Picture], motion: Motion, hints: Hints, folder: Path, progress: Progress) -> Object:
    """The object and its masks.

    Masks that `folder` has already are taken as they are: anybody may have painted in them, or removed some. Raises
    InputError if they were found with other cameras or hints.
    """
    folder.mkdir(exist_ok=True)
    kept = folder / "object.json"
    asked = {"masks": hints.digest(), "box": hints.box and list(hints.box), "cameras": motion.digest()}
    shown = [picture for picture in pictures if picture.name in motion.cameras]
    if kept.exists():
        known = json.loads(kept.read_text("utf-8"))
        if other := [name for name, value in asked.items() if known["asked"][name] != value]:
            what = "cameras" if "cameras" in other else f"--{other[0]}"
            raise InputError(f"{folder}: has masks that were found with other {what}; remove it to have them found "
                             "anew, or give another DIR")  # fmt: skip
        plane = known["plane"] and Plane(np.array(known["plane"][0]), known["plane"][1])
        return Object(kept_masks(shown, folder), np.array(known["center"]), known["level"], plane)
    for lens, _ in motion.cameras.values():
        lens.is_pinhole  # noqa: B018  (loads pycolmap, if need be: it handles signals, which threads may not)

    def whole(picture: Picture) -> View:
        lens, pose = motion.cameras[picture.name]
        view = reduced(picture, lens, pose, whole_of(lens, COARSE))
        picture.close()
        return view

    views = list(progress(in_threads(whole, shown), "reading", len(shown)))
    space = automatic_masks.Space.seen_by(views)
    plane, sheet = hints.plane, hints.plane is not None
    if not sheet:
        positions = np.stack([view.camera.position for view in views])
        plane = find_plane(motion.points, positions, space.center, space.reach)
    if hints.masks == "auto":
        body, shades = searched(shown, motion, space, hints._replace(plane=plane), sheet, progress)
    else:
        body, shades = brought(shown, motion, space, hints, progress)
    for name, mask in shades.items():
        write_image(mask[..., None], folder / f"{name}.png")
    small = {
        view.name: automatic_masks.resized(shades[view.name] == OBJECT, view) for view in views if view.name in shades
    }
    levels = [view.linear[small[view.name]].mean() for view in views if view.name in small and small[view.name].any()]
    result = Object(shades, body.points.mean(0), float(np.median(levels)), plane)
    write_file(kept, json.dumps({
        "asked": asked, "center": result.center.tolist(), "level": result.level,
        "plane": plane and [plane.normal.tolist(), plane.offset],
    }))  # fmt: skip
    return result


def kept_masks(pictures: Sequence[Picture], folder: Path) -> dict[str, np.ndarray]:
    """By the photograph's name, masks of a folder as `Object` has them; what anybody painted is the nearest of these.

    Raises InputError if there is none, or one that is no reduction of its photograph.
    """
    found = {}
    for picture in pictures:
        file = folder / f"{picture.name}.png"
        if file.exists():
            mask = read_as(file, "mask", read_image)[..., 0]
            (height, width), scale = mask.shape, max(1, reduction(mask, picture.size))
            if (width, height) != (picture.size[0] // scale, picture.size[1] // scale):
                raise InputError("{}: is {} x {} pixels, which is no whole part of the {} x {} of its photograph; keep "
                                 "the size of masks".format(file, width, height, *picture.size))  # fmt: skip
            shade = mask / np.iinfo(mask.dtype).max if mask.dtype != np.float32 else mask
            found[picture.name] = np.array([0, UNSURE, OBJECT], np.uint8)[np.digitize(shade, [0.25, 0.75])]
    if not found:
        raise InputError(f"{folder}: has no masks any more; remove it to have them found anew")
    return found


def brought(
    pictures: Sequence[Picture], motion: Motion, space: automatic_masks.Space, hints: Hints, progress: Progress
) -> tuple[automatic_masks.Body, dict[str, np.ndarray]]:
    """What the user's masks say the object is, and these masks by name, as `Object` has them."""
    source, shades = hints.masks, {}
    for picture in progress(pictures, "masks"):
        mask = picture.mask(source)
        picture.close()
        if mask is not None:
            lens, pose = motion.cameras[picture.name]
            shade = OBJECT * reduced_mask(mask, lens, BROUGHT)
            if hints.box:
                shade *= box_in(camera_of(lens, pose).shrunk(whole_of(lens, BROUGHT).scale), hints.box)
            shades[picture.name] = shade
    require_half(len(shades), pictures, source)
    space = automatic_masks.Space([view for view in space.views if view.name in shades], space.center, space.reach)
    space.allowed = hints.allow(space.grid, space.distance)
    body = space.vote(
        [automatic_masks.resized(shades[view.name] == OBJECT, view) for view in space.views], automatic_masks.AGREE
    )
    if body is None:
        raise InputError(f"--masks: {source}: no point in space {'of --box ' * bool(hints.box)}is inside most of these "
                         "masks; are they of these photographs?")  # fmt: skip
    return body, shades


def require_half(count: int, pictures: Sequence[Picture], source: str | Path) -> None:
    """Raise InputError unless half of the photographs have a mask."""
    if count < len(pictures) / 2:
        name = pictures[0].path.name
        what = "--masks alpha: there are" if source == "alpha" else f"--masks: {source}: has"
        how = "PNG with transparency" if source == "alpha" else f"{name}.png or {pictures[0].name}.png for {name}"
        raise InputError(f"{what} masks for {count} of {len(pictures)} photographs; must be half of them: {how}")


def box_in(camera: Camera, box: Sequence[float]) -> np.ndarray:
    """(H, W) uint8: 1 where a photograph shows a box, as `Hints.box` has it."""
    corners = np.array(list(itertools.product(*np.reshape(box, (3, 2)))))
    pixels, depth = camera.project(corners)
    if depth.min() <= 0:  # the camera is next to it
        return np.ones(camera.size[::-1], np.uint8)
    hull = cv2.convexHull(np.clip(pixels, -1e6, 1e6).astype(np.float32))
    return cv2.fillConvexPoly(np.zeros(camera.size[::-1], np.uint8), np.round(hull).astype(np.int32), 1)


def searched(
    pictures: Sequence[Picture],
    motion: Motion,
    space: automatic_masks.Space,
    hints: Hints,
    sheet: bool,
    progress: Progress,
) -> tuple[automatic_masks.Body, dict[str, np.ndarray]]:
    """The object, and masks of all photographs but those that do not show it or are not sure.

    First in whole photographs, reduced; then closer to what was found. `sheet`: is the plane that of the sheet?
    """
    folder, plane = pictures[0].path.parent, hints.plane
    body = find_body(space, motion.points, hints, sheet, progress)
    covered = [(p, body.coverage(view)) for p, view in zip(pictures, space.views)] if body else []
    showing = [(picture, cover) for picture, cover in covered if cover.any()]
    if body is None or len(showing) < len(pictures) / 2:
        where = " in --box" if hints.box else ""
        raise InputError(f"{folder}: masks: no object was found{where}, neither one that stands on a table nor one "
                         "that the flash lights more than what is around it; give --masks")  # fmt: skip

    def near(picture: Picture, cover: np.ndarray) -> tuple[View, View, Window]:
        lens, pose = motion.cameras[picture.name]
        window = around(lens, cover, CLOSE)
        coarse, fine = (reduced(picture, lens, pose, part) for part in (around(lens, cover, SMALL), window))
        picture.close()
        return coarse, fine, window

    small, close, windows = zip(*progress(in_threads(near, *zip(*showing)), "reading", len(showing)))
    found = outlines(small, body, space, hints, automatic_masks.HOLLOWS, progress)
    found = found and outlines(close, found.body, space, hints, automatic_masks.OUTLINES, progress)
    sure = sum(agreed >= SURE for agreed in found.agreement) if found else 0
    if found is None or sure < len(pictures) / 2:
        raise InputError(f"{folder}: masks: those of {sure} of {len(pictures)} photographs agree; give --masks")
    shades = {}
    for view, window, mask, agreed in zip(close, windows, found.masks, found.agreement):
        if agreed >= SURE:
            if plane:  # beside the object there are shadows
                maybe = automatic_masks.disputed(mask, found.body.coverage(view), found.body.pixels(view))
            else:
                maybe = automatic_masks.unsure(mask, automatic_masks.bright(view))
            shade = np.where(maybe, UNSURE, np.where(mask > 0, OBJECT, 0)).astype(np.uint8)
            shades[view.name] = pasted(shade, motion.cameras[view.name][0], window)
    return found.body, shades


def outlines(
    views: Sequence[View],
    body: automatic_masks.Body,
    whole: automatic_masks.Space,
    hints: Hints,
    care: automatic_masks.Care,
    progress: Progress,
) -> automatic_masks.Found | None:
    """Masks of views that are near to the object, from what is known of it by now. `whole`: the whole photographs."""
    space = automatic_masks.Space.about(views, body)
    space.allowed = hints.allow(space.grid, space.distance, FLAT / 2)
    covered, tables = [body.coverage(view) for view in views], automatic_masks.nothing(views)
    if hints.plane:
        near = Ground(hints.plane, space.center, space.reach, FINE)
        far = Ground(hints.plane, space.center, WIDE * whole.reach, FINE)
        places = (views, near, covered), (whole.views, far, [body.coverage(view) for view in whole.views])
        known = [Table(of, ground, progress, [grown(c, care.band) for c in shown]) for of, ground, shown in places]
        tables = bare(views, covered, known, progress) or known[0].patterns()
    else:  # a part of the object that the flash grazes is as dark as the room: a few photographs do not tell
        care = care._replace(agree=automatic_masks.AGREE)
    return automatic_masks.settle(space, covered, tables, progress, care)


def find_body(
    space: automatic_masks.Space, points: np.ndarray, hints: Hints, sheet: bool, progress: Progress
) -> automatic_masks.Body | None:
    """The object by what differs from the table that it stands on; else by brightness; else by a trial fit.

    Not by brightness on a `sheet`, which differs from any object: there it would be the paper. Elsewhere what has the
    table's pattern is left out, for the flash lights the middle of the table, too. `points` (N, 3): the sparse ones,
    which say where the trial begins.
    """
    space.allowed = hints.allow(space.grid, space.distance)
    ground = hints.plane and Ground(hints.plane, space.center, space.reach)
    table = ground and Table(space.views, ground, progress)
    tables = table.patterns() if table else automatic_masks.nothing(space.views)

    def guesses() -> Iterator[list[np.ndarray]]:
        if table:
            yield table.others()
        if not sheet:
            yield [automatic_masks.bright(view) & (1 - known) for view, known in zip(space.views, tables)]
        sphere = sphere_of(points[hints.allow(points, space.distance)], space.center, space.reach)
        with contextlib.suppress(InputError):  # it diverged
            if sphere:
                yield coverages(space.views, *sphere, progress)

    for guess in guesses():
        found = automatic_masks.settle(space, guess, tables, progress)
        if found and found.quality >= SURE:
            return found.body
    return None
