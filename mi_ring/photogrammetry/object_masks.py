"""Finds the object in the photographs: its position and its masks."""

import contextlib
import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.capture.grabcut import dilate_by_share
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

MIN_AGREEMENT = 0.8  #: a mask is used if its overlap (IoU) with the common silhouette is at least this
COARSE, GIVEN = 600, 1200  #: longer side [px] of photographs in which the object is searched, and of given masks
SMALL, CLOSE = 200, 400  #: size of the object in the views that find its concavities and its outlines [px]
TEXELS = 640  #: width of the table's texture for these views
WIDE = 2.0  #: half size of the table's texture from whole photographs [half size of their voxel grid]


class SegmentedObject(NamedTuple):
    """The object in the photographs: its masks, its position and brightness, and the table."""

    masks: dict[str, np.ndarray]  #: (H, W) uint8 of `OBJECT`, `UNKNOWN` and 0, by the photograph's name
    center: np.ndarray  #: (3,)
    radiance: float  #: mean radiance of the object (1 = white of the photographs)
    plane: Plane | None  #: the table under the object; None if there is none


class SegmentationInput(NamedTuple):
    """What is known about the object before it is searched, from the user or from the printed sheet."""

    plane: Plane | None = None  #: the table
    box: tuple[float, ...] | None = None  #: around the object: x low, x high, y low, y high, z low, z high
    masks: str | Path = "auto"  #: "auto": find them; otherwise the source for `Picture.mask`
    sheet: bool = False  #: is `plane` that of the printed sheet?

    def digest(self) -> str:
        """Return a text that changes if the source of masks changes.

        For a folder, it is a hash of file names, sizes and times; otherwise the name of the source.
        """
        if not isinstance(self.masks, Path):
            return self.masks
        files = [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(self.masks.iterdir()) if f.is_file()]
        return hashlib.blake2b(repr(files).encode(), digest_size=8).hexdigest()

    def allows(self, points: np.ndarray, camera_distance: float, flatness: float = 2 * FLATNESS) -> np.ndarray:
        """Test which points may belong to the object. Returns (N,) bool.

        They must be in the box, if there is one. If there is a table, they must be higher above it than `flatness` ·
        `camera_distance`. `points` (N, 3). `camera_distance`: median distance of the cameras from the object.
        """
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
    """Find the object in the photographs that have a camera, and write its masks into `folder`.

    `sparse`: cameras and points. `known`: what is known about the object. If `folder` has masks already, these are
    used, because the user may have edited them. Raises InputError if they were made with other cameras or another
    `known`, and if no object is found.
    """
    folder.mkdir(exist_ok=True)
    record = folder / "object.json"
    asked = {"masks": known.digest(), "box": known.box and list(known.box), "cameras": sparse.digest()}
    placed = [picture for picture in pictures if picture.name in sparse.cameras]
    if saved := read_json(record):
        if other := [name for name, value in asked.items() if saved["asked"][name] != value]:
            what = "cameras" if "cameras" in other else f"--{other[0]}"
            raise InputError(f"{folder}: has masks that were found with other {what}; remove it to find them again, or "
                             "give another DIR")  # fmt: skip
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
    """Read the masks in a folder, NAME.png for a photograph NAME. Returns masks by the photograph's name.

    A mask is (H, W) uint8 with the values `OBJECT`, `UNKNOWN` and 0. Photographs without a mask are left out. Raises
    InputError if there is no mask at all, or if the size of a mask is not that of its photograph divided by a whole
    number.
    """
    found = {}
    for picture in pictures:
        file = folder / f"{picture.name}.png"
        if file.exists():
            mask = read_as(file, "mask", read_image)[..., 0]
            (height, width), scale = mask.shape, max(1, reduction(mask, picture.size))
            if (width, height) != (picture.size[0] // scale, picture.size[1] // scale):
                raise InputError("{}: is {} x {} pixels, which is no whole part of the {} x {} of its photograph; do "
                                 "not change the size of masks".format(file, width, height, *picture.size))  # fmt: skip
            grey = mask / np.iinfo(mask.dtype).max if mask.dtype != np.float32 else mask
            found[picture.name] = np.array([0, UNKNOWN, OBJECT], np.uint8)[np.digitize(grey, [0.25, 0.75])]
    if not found:
        raise InputError(f"{folder}: has no masks any more; remove it to find them again")
    return found


def given_masks(
    pictures: Sequence[Picture], sparse: SparseModel, grid: VoxelGrid, known: SegmentationInput, progress: Progress
) -> tuple[VoxelObject, dict[str, np.ndarray]]:
    """Read the user's masks, and find the object by them.

    Returns (object, dict from the photograph's name to its mask). A mask is reduced and without distortion: (h, w)
    uint8, 0 or `OBJECT`. `pictures`: photographs with a camera in `sparse`. `grid`: voxels to search. `known`: where
    the masks are, and the box around the object, which the user gave. Raises InputError if there are too few masks, or
    if they disagree.
    """
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
    """Raise InputError if fewer than half of the photographs have a mask.

    `count`: number of masks. `source`: "alpha", "rembg" or the folder of the masks, for the message.
    """
    if count < len(pictures) / 2:
        name = pictures[0].path.name
        what = "--masks alpha: there are" if source == "alpha" else f"--masks: {source}: has"
        how = "PNG with transparency" if source == "alpha" else f"{name}.png or {pictures[0].name}.png for {name}"
        raise InputError(f"{what} masks for {count} of {len(pictures)} photographs; must be half of them: {how}")


def box_mask(camera: Camera, box: Sequence[float]) -> np.ndarray:
    """Return a mask (H, W) uint8 for a camera: 1 where the picture shows the box, otherwise 0.

    `box`: x low, x high, y low, y high, z low, z high. If the box reaches behind the camera, the mask is 1 everywhere.
    """
    pixels, depth = camera.project(np.array(list(itertools.product(*np.reshape(box, (3, 2))))))
    if depth.min() <= 0:  # a corner is behind the camera
        return np.ones(camera.size[::-1], np.uint8)
    hull = cv2.convexHull(np.clip(pixels, -1e6, 1e6).astype(np.float32))
    return cv2.fillConvexPoly(np.zeros(camera.size[::-1], np.uint8), np.round(hull).astype(np.int32), 1)


def find_masks(
    pictures: Sequence[Picture], sparse: SparseModel, grid: VoxelGrid, known: SegmentationInput, progress: Progress
) -> tuple[VoxelObject, dict[str, np.ndarray]]:
    """Find the object without masks of the user. Returns (object, masks by the photograph's name).

    `pictures`: photographs with a camera in `sparse`. `grid`: voxels to search, with views of the whole photographs.
    `known`: table and box. Photographs with unclear masks are left out. Raises InputError if no object is found, or if
    too few masks agree.
    """
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
            if known.plane:  # the object casts shadows on the table
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
    """Refine the object `found` and its masks in views that show it enlarged. Returns None if the masks disagree.

    `views`: enlarged views. `whole`: grid with the views of whole photographs, from which the table's appearance is
    estimated. `known`: table and box. `settings`: of the votes and of GrabCut.
    """
    grid = VoxelGrid.around(views, found)
    grid.allowed = known.allows(grid.points, grid.camera_distance, FLATNESS / 2)
    silhouettes, backgrounds = [found.silhouette(view) for view in views], automatic_masks.empty_masks(views)
    if known.plane:
        near = TexelGrid(known.plane, grid.center, grid.half_size, TEXELS)
        far = TexelGrid(known.plane, grid.center, WIDE * whole.half_size, TEXELS)
        parts = (views, near, silhouettes), (whole.views, far, [found.silhouette(view) for view in whole.views])
        tables = [TableAppearance(own, texels, progress, [dilate_by_share(s, settings.band) for s in hidden])
                  for own, texels, hidden in parts]  # fmt: skip
        backgrounds = bare_table(views, silhouettes, tables, progress) or tables[0].pattern_masks()
    else:  # parts under grazing light are as dark as the room: do not let a few masks remove them
        settings = settings._replace(agreement=automatic_masks.MIN_AGREEMENT)
    return automatic_masks.refine_masks(grid, silhouettes, backgrounds, progress, settings)


def locate_object(
    grid: VoxelGrid, points: np.ndarray, known: SegmentationInput, progress: Progress
) -> VoxelObject | None:
    """Find the object coarsely in the views of `grid`. Returns None if that fails.

    Three methods are tried in turn: the difference from the table, the brightness under the flash, and a short fit.
    Brightness is not used with the printed sheet, because its paper is bright, nor at pixels that show the table's
    pattern. `points` (N, 3): sparse points, from which the fit starts. `known`: table, box and sheet. `grid.allowed` is
    set.
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
