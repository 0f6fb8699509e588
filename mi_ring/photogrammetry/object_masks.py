"""Finds the object in the photographs: where it is, and its masks."""

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
from mi_ring.photogrammetry.automatic_masks import RefinementSettings, Segmentation, VoxelGrid, VoxelObject
from mi_ring.photogrammetry.capture_files import OBJECT, UNKNOWN, reduction
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.reduced_photographs import Views, paste_mask, read_windows, reduce_mask, window_around
from mi_ring.photogrammetry.shading_trial import initial_sphere, shading_silhouettes
from mi_ring.photogrammetry.structure_from_motion import SparseModel
from mi_ring.photogrammetry.table_plane import FLATNESS, Plane, TableAppearance, TexelGrid, bare_table, find_plane
from mi_ring.system.files import read_json, write_file
from mi_ring.system.progress import Progress

MIN_AGREEMENT = 0.8  #: of a mask with the common silhouette, intersection over union; else it is not used
COARSE, GIVEN = 600, 1200  #: pixels along photographs in which the object is looked for, and along given masks; at most
SMALL, CLOSE = 200, 400  #: pixels along the object in the views for its concavities and for its outlines
TEXELS = 640  #: across the table's texture for those views
WIDE = 2.0  #: half size of the table's texture from whole photographs, in that of their voxel grid


class SegmentedObject(NamedTuple):
    """The object as the photographs show it."""

    masks: dict[str, np.ndarray]  #: (H, W) uint8 by the photograph's name, of `OBJECT`, `UNKNOWN` and 0
    center: np.ndarray  #: (3,)
    radiance: float  #: of the object, mean, 1 = full scale
    plane: Plane | None  #: the table under the object; None if there is none


class SegmentationInput(NamedTuple):
    """What the user, or the sheet, says of the object."""

    plane: Plane | None = None  #: the table
    box: tuple[float, ...] | None = None  #: lowest and highest x, y and z of the object, one after another
    masks: str | Path = "auto"  #: "auto": find them; else as `Picture.mask` has it
    sheet: bool = False  #: is the plane that of the printed sheet?

    def digest(self) -> str:
        """A text that changes with the source of the masks, and with the files in a folder of masks."""
        if not isinstance(self.masks, Path):
            return self.masks
        files = [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(self.masks.iterdir()) if f.is_file()]
        return hashlib.blake2b(repr(files).encode(), digest_size=8).hexdigest()

    def allows(self, points: np.ndarray, camera_distance: float, flatness: float = 2 * FLATNESS) -> np.ndarray:
        """(N,) bool: are points (N, 3) in the box and above the table's relief, `flatness` · `camera_distance`?"""
        allowed = np.ones(len(points), bool)
        if self.plane:
            allowed &= self.plane.height(points) > flatness * camera_distance
        if self.box:
            low, high = np.reshape(self.box, (3, 2)).T
            allowed &= ((points >= low) & (points <= high)).all(1)
        return allowed


def find_object(
    pictures: Sequence[Picture], sparse: SparseModel, known: SegmentationInput, folder: Path, progress: Progress
) -> SegmentedObject:
    """The object and its masks. Masks in `folder` are used again: the user may have edited or removed some.

    Raises InputError if they were found with other cameras or another `known`, and if no object is found.
    """
    folder.mkdir(exist_ok=True)
    record = folder / "object.json"
    asked = {"masks": known.digest(), "box": known.box and list(known.box), "cameras": sparse.digest()}
    placed = [picture for picture in pictures if picture.name in sparse.cameras]
    if saved := read_json(record):
        if other := [name for name, value in asked.items() if saved["asked"][name] != value]:
            what = "cameras" if "cameras" in other else f"--{other[0]}"
            raise InputError(f"{folder}: has masks that were found with other {what}; remove it to have them found "
                             "anew, or give another DIR")  # fmt: skip
        plane = saved["plane"] and Plane(np.array(saved["plane"][0]), saved["plane"][1])
        return SegmentedObject(kept_masks(placed, folder), np.array(saved["center"]), saved["level"], plane)
    for lens, _ in sparse.cameras.values():
        lens.colmap  # noqa: B018  (loads pycolmap here, not in a thread: it installs signal handlers)
    windows = [[Window.whole(sparse.cameras[picture.name][0], COARSE)] for picture in placed]
    views = [view for (view,) in read_windows(placed, windows, sparse.cameras, progress)]
    grid, positions = VoxelGrid.seen_by(views), np.stack([view.camera.position for view in views])
    plane = known.plane or find_plane(sparse.points, positions, grid.center, grid.half_size)
    if known.masks == "auto":
        found, masks = find_masks(placed, sparse, grid, known._replace(plane=plane), progress)
    else:
        found, masks = given_masks(placed, sparse, grid, known, progress)
    for name, mask in masks.items():
        write_image(mask[..., None], folder / f"{name}.png")
    shown = [view for view in views if view.name in masks]
    small = [automatic_masks.resize_mask(masks[view.name] == OBJECT, view) for view in shown]
    radiance = float(np.median([view.linear[mask].mean() for view, mask in zip(shown, small) if mask.any()]))
    result = SegmentedObject(masks, found.points.mean(0), radiance, plane)
    write_file(record, json.dumps({
        "asked": asked, "center": result.center.tolist(), "level": radiance,
        "plane": plane and [plane.normal.tolist(), plane.offset],
    }))  # fmt: skip
    return result


def kept_masks(pictures: Sequence[Picture], folder: Path) -> dict[str, np.ndarray]:
    """The masks in a folder as `SegmentedObject` has them. Raises InputError if there are none or a size is wrong."""
    found = {}
    for picture in pictures:
        file = folder / f"{picture.name}.png"
        if file.exists():
            mask = read_as(file, "mask", read_image)[..., 0]
            (height, width), scale = mask.shape, max(1, reduction(mask, picture.size))
            if (width, height) != (picture.size[0] // scale, picture.size[1] // scale):
                raise InputError("{}: is {} x {} pixels, which is no whole part of the {} x {} of its photograph; keep "
                                 "the size of masks".format(file, width, height, *picture.size))  # fmt: skip
            grey = mask / np.iinfo(mask.dtype).max if mask.dtype != np.float32 else mask
            found[picture.name] = np.array([0, UNKNOWN, OBJECT], np.uint8)[np.digitize(grey, [0.25, 0.75])]
    if not found:
        raise InputError(f"{folder}: has no masks any more; remove it to have them found anew")
    return found


def given_masks(
    pictures: Sequence[Picture], sparse: SparseModel, grid: VoxelGrid, known: SegmentationInput, progress: Progress
) -> tuple[VoxelObject, dict[str, np.ndarray]]:
    """The object, and the user's masks. Raises InputError if these are too few or have no object in common."""
    masks = {}
    for picture in progress(pictures, "masks"):
        mask = picture.mask(known.masks)
        picture.close()
        if mask is not None:
            lens, pose = sparse.cameras[picture.name]
            masks[picture.name] = OBJECT * reduce_mask(mask, lens, GIVEN)
            if known.box:
                masks[picture.name] *= box_mask(lens.camera(pose).shrunk(Window.whole(lens, GIVEN).scale), known.box)
    require_half(len(masks), pictures, known.masks)
    grid = VoxelGrid([view for view in grid.views if view.name in masks], grid.center, grid.half_size)
    grid.allowed = known.allows(grid.points, grid.camera_distance)
    small = [automatic_masks.resize_mask(masks[view.name] == OBJECT, view) for view in grid.views]
    found = grid.vote(small, automatic_masks.MIN_AGREEMENT)
    if found is None:
        raise InputError(f"--masks: {known.masks}: no point in space {'of --box ' * bool(known.box)}is inside most of "
                         "these masks; are they of these photographs?")  # fmt: skip
    return found, masks


def require_half(count: int, pictures: Sequence[Picture], source: str | Path) -> None:
    """Raise InputError if the `count` of masks is below half of the photographs."""
    if count < len(pictures) / 2:
        name = pictures[0].path.name
        what = "--masks alpha: there are" if source == "alpha" else f"--masks: {source}: has"
        how = "PNG with transparency" if source == "alpha" else f"{name}.png or {pictures[0].name}.png for {name}"
        raise InputError(f"{what} masks for {count} of {len(pictures)} photographs; must be half of them: {how}")


def box_mask(camera: Camera, box: Sequence[float]) -> np.ndarray:
    """(H, W) uint8: 1 where a photograph shows the box, as `SegmentationInput` has it."""
    pixels, depth = camera.project(np.array(list(itertools.product(*np.reshape(box, (3, 2))))))
    if depth.min() <= 0:  # a corner is behind the camera
        return np.ones(camera.size[::-1], np.uint8)
    hull = cv2.convexHull(np.clip(pixels, -1e6, 1e6).astype(np.float32))
    return cv2.fillConvexPoly(np.zeros(camera.size[::-1], np.uint8), np.round(hull).astype(np.int32), 1)


def find_masks(
    pictures: Sequence[Picture], sparse: SparseModel, grid: VoxelGrid, known: SegmentationInput, progress: Progress
) -> tuple[VoxelObject, dict[str, np.ndarray]]:
    """The object, and masks where it is clear. Raises InputError if no object is found or too few masks agree."""
    folder = pictures[0].path.parent
    found = locate_object(grid, sparse.points, known, progress)
    silhouettes = [found.silhouette(view) for view in grid.views] if found else []
    showing = [(picture, silhouette) for picture, silhouette in zip(pictures, silhouettes) if silhouette.any()]
    if found is None or len(showing) < len(pictures) / 2:
        where = " in --box" if known.box else ""
        raise InputError(f"{folder}: masks: no object was found{where}, neither one that stands on a table nor one "
                         "that the flash lights more than what is around it; give --masks")  # fmt: skip
    windows = [[window_around(sparse.cameras[picture.name][0], silhouette, pixels) for pixels in (SMALL, CLOSE)]
               for picture, silhouette in showing]  # fmt: skip
    small, close = zip(*read_windows([picture for picture, _ in showing], windows, sparse.cameras, progress))
    result = refine_object(small, found, grid, known, automatic_masks.CONCAVITIES, progress)
    result = result and refine_object(close, result.object, grid, known, automatic_masks.OUTLINES, progress)
    sure = sum(agreement >= MIN_AGREEMENT for agreement in result.agreement) if result else 0
    if result is None or sure < len(pictures) / 2:
        raise InputError(f"{folder}: masks: those of {sure} of {len(pictures)} photographs agree; give --masks")
    masks = {}
    for view, (_, window), mask, agreement in zip(close, windows, result.masks, result.agreement):
        if agreement >= MIN_AGREEMENT:
            if known.plane:  # there are shadows beside the object
                silhouette, tolerance = result.object.silhouette(view), result.object.voxel_pixels(view)
                unknown = automatic_masks.disputed_pixels(mask, silhouette, tolerance)
            else:
                unknown = automatic_masks.touching_pixels(mask, automatic_masks.bright_mask(view))
            mask = np.where(unknown, UNKNOWN, np.where(mask > 0, OBJECT, 0)).astype(np.uint8)
            masks[view.name] = paste_mask(mask, sparse.cameras[view.name][0], window)
    return result.object, masks


def refine_object(
    views: Views, found: VoxelObject, whole: VoxelGrid, known: SegmentationInput, settings: RefinementSettings,
    progress: Progress,
) -> Segmentation | None:  # fmt: skip
    """Refined masks in views of the object, which is `found` so far. `whole`: the grid with the whole photographs."""
    grid = VoxelGrid.around(views, found)
    grid.allowed = known.allows(grid.points, grid.camera_distance, FLATNESS / 2)
    silhouettes, backgrounds = [found.silhouette(view) for view in views], automatic_masks.empty_masks(views)
    if known.plane:
        near = TexelGrid(known.plane, grid.center, grid.half_size, TEXELS)
        far = TexelGrid(known.plane, grid.center, WIDE * whole.half_size, TEXELS)
        parts = (views, near, silhouettes), (whole.views, far, [found.silhouette(view) for view in whole.views])
        tables = [TableAppearance(own, texels, progress, [grown(s, settings.band) for s in hidden])
                  for own, texels, hidden in parts]  # fmt: skip
        backgrounds = bare_table(views, silhouettes, tables, progress) or tables[0].pattern_masks()
    else:  # parts that the flash grazes are as dark as the room: a few photographs must not decide
        settings = settings._replace(agreement=automatic_masks.MIN_AGREEMENT)
    return automatic_masks.refine_masks(grid, silhouettes, backgrounds, progress, settings)


def locate_object(
    grid: VoxelGrid, points: np.ndarray, known: SegmentationInput, progress: Progress
) -> VoxelObject | None:
    """The object by its difference from the table, else by its brightness, else by a short fit; None if all fail.

    `points` (N, 3): sparse points, for the start of the fit. Brightness is not used on the sheet, as paper is bright,
    nor on pixels with the table's pattern, as the flash lights the middle of the table.
    """
    grid.allowed = known.allows(grid.points, grid.camera_distance)
    table = known.plane and TableAppearance(grid.views, TexelGrid(known.plane, grid.center, grid.half_size), progress)
    backgrounds = table.pattern_masks() if table else automatic_masks.empty_masks(grid.views)

    def guesses() -> Iterator[list[np.ndarray]]:
        if table:
            yield table.foreign_masks()
        if not known.sheet:
            yield [automatic_masks.bright_mask(view) & (1 - mask) for view, mask in zip(grid.views, backgrounds)]
        sphere = initial_sphere(points[known.allows(points, grid.camera_distance)], grid.center, grid.half_size)
        with contextlib.suppress(InputError):  # the fit diverged
            if sphere:
                yield shading_silhouettes(grid.views, *sphere, progress)

    for guess in guesses():
        result = automatic_masks.refine_masks(grid, guess, backgrounds, progress)
        if result and np.quantile(result.agreement, 0.2) >= MIN_AGREEMENT:
            return result.object
    return None
