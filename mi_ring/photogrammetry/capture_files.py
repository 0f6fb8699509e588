"""The capture that is written: photographs cropped to the object, without distortion, with masks and lights."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mi_ring.capture.grabcut import grown
from mi_ring.capture.scenefile import Element, photograph_element, table_element
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.undistortion import Window, undistort
from mi_ring.importers.writer import Writer
from mi_ring.photogrammetry.flash_light import Flash
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.reduced_photographs import View, camera_of, reduced, whole_of
from mi_ring.photogrammetry.table_plane import Ground, Plane, reflectance
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Response, Shot
from mi_ring.system.machine import in_threads

MARGIN = 0.06  #: of the object's size, left free around it
#: Pixels along photographs in which the table's albedo is looked for, half of its width by the cameras' distance, and
#: texels across: what it reflects varies slowly.
TABLE_SEEN, TABLE_REACH, TABLE_TEXELS = 600, 1.0, 256
OBJECT, UNSURE = 255, 128  #: in masks; 0 is the background


@dataclass(frozen=True)
class PosedPicture:
    """A photograph with what was found of it: what a `mi_ring.scene.shot.Shot` is written from."""

    picture: Picture
    lens: Lens
    pose: np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes [scene units]
    mask: np.ndarray | None  #: (h, w) uint8 of all of the undistorted photograph, perhaps reduced
    light: Light
    measured: bool = False  #: does the sheet tell how strong the light is?
    falloff: float = 0.0  #: exponent of the flash's cone
    gamma: float = 1.0  #: exponent of the camera's curve


def windows(masks: Sequence[np.ndarray | None], sizes: Sequence[tuple[int, int]]) -> list[Window]:
    """What to cut out of each photograph of such a size (width, height) with such a mask.

    Equally much of all of a size, for one launch renders those.
    """
    extents = [None if mask is None else extent_of(mask, size) for mask, size in zip(masks, sizes)]
    result = []
    for size, extent in zip(sizes, extents):
        alike = [e for other, e in zip(sizes, extents) if other == size and e is not None]
        if not alike:
            result.append(Window(0, 0, *size))
            continue
        wanted = np.max([e[1] - e[0] for e in alike], 0)
        wanted = np.minimum(np.ceil(wanted + 2 * MARGIN * wanted.max()), size).astype(int)
        middle = np.array(size) / 2 if extent is None else extent.mean(0)
        corner = np.clip(np.round(middle - wanted / 2), 0, size - wanted).astype(int)
        result.append(Window(*map(int, corner), *map(int, wanted)))
    return result


def write_posed_picture(writer: Writer, posed: PosedPicture, window: Window) -> Element:
    """The files of a photograph and its element."""
    picture = posed.picture
    pixels = picture.pixels[..., :3]
    left, top, width, height = window[:4]
    if posed.lens.is_pinhole:
        cut, shown = pixels[top : top + height, left : left + width], np.ones((height, width), bool)
    else:
        cut, shown = undistort(pixels, posed.lens, picture.encoding == "srgb", window=window)
    picture.close()
    filename = writer.relative(writer.image(f"images/{picture.name}", cut))
    encoding = picture.encoding if cut.dtype == np.uint16 else "auto"
    mask = valid = None
    if posed.mask is not None:
        full = cut_mask(posed.mask, posed.lens.size, window)
        shown = shown & (full != UNSURE)
        white = np.where(full == OBJECT, 255, 0).astype(np.uint8)
        mask = writer.relative(writer.image(f"masks/{picture.name}", white[..., None]))
    if not shown.all():
        white = np.where(shown, 255, 0).astype(np.uint8)
        valid = writer.relative(writer.image(f"valid/{picture.name}", white[..., None]))
    camera = camera_of(posed.lens, posed.pose)
    camera = camera._replace(centre=camera.centre - [left, top], size=(width, height))
    return photograph_element(Shot(picture.name, camera, posed.light, posed.falloff, Response(posed.gamma),
                                   Files(filename, mask, valid), encoding))  # fmt: skip


def write_table(
    writer: Writer, pictures: Sequence[PosedPicture], plane: Plane, center: np.ndarray, flash: Flash
) -> list[Element]:  # fmt: skip
    """A `table`, for the light that it reflects onto the object at `center` (3,), and its picture.

    `flash`: what the lights of the photographs have in common. None of it if no photograph shows the table.
    """

    def seen(posed: PosedPicture) -> tuple[View, np.ndarray, Light]:
        view = reduced(posed.picture, posed.lens, posed.pose, whole_of(posed.lens, TABLE_SEEN))
        # What is white to a view is less in a raw photograph, whose light is as strong as that says.
        white = posed.picture.white if posed.picture.encoding == "linear" else 1.0
        light = posed.light._replace(rgb=posed.light.rgb / white)
        posed.picture.close()
        if posed.mask is None:  # it may be anywhere
            return view, np.ones(view.shown.shape, np.uint8), light
        mask = cv2.resize((posed.mask > 0).astype(np.uint8), view.camera.size, interpolation=cv2.INTER_NEAREST)
        return view, grown(mask, MARGIN), light

    views, hidden, lights = zip(*in_threads(seen, pictures))
    away = float(np.median([np.linalg.norm(view.camera.position - center) for view in views]))
    ground = Ground(plane, center, TABLE_REACH * away, TABLE_TEXELS)
    albedo = reflectance(views, lights, hidden, ground, flash)
    if albedo is None:
        return []
    picture = writer.image("table", to_bytes(linear_to_srgb(albedo)))
    return [table_element(writer.relative(picture).as_posix(), ground.square)]


def extent_of(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Of the object in a photograph of this size [px]: (2, 2), lowest and highest column and row."""
    rows, columns = np.nonzero(mask == OBJECT)
    if not len(rows):
        return None
    corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    return corners * reduction(mask, size)


def reduction(mask: np.ndarray, size: tuple[int, int]) -> int:
    """How many pixels of a photograph of this size (width, height) one of its mask is, across; some may be over."""
    return round(size[0] / mask.shape[1])


def cut_mask(mask: np.ndarray, size: tuple[int, int], window: Window) -> np.ndarray:
    """The part of a mask of a photograph of this size (width, height), enlarged: (H, W) float, 0 to 255."""
    left, top, width, height = window[:4]
    scale = reduction(mask, size)
    x = ((left + np.arange(width) + 0.5) / scale - 0.5).astype(np.float32)
    y = ((top + np.arange(height) + 0.5) / scale - 0.5).astype(np.float32)
    columns, rows = (np.ascontiguousarray(grid) for grid in np.broadcast_arrays(x, y[:, None]))
    object_, unsure = (
        cv2.remap((mask == value).astype(np.float32), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for value in (OBJECT, UNSURE)
    )
    return np.where(object_ > 0.5, OBJECT, np.where(unsure > 0.5, UNSURE, 0)).astype(np.float32)
