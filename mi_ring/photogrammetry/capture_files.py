"""Writes the files of a capture: undistorted photographs, cropped to the object, with masks and lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mi_ring.capture.emitter_elements import Element
from mi_ring.capture.grabcut import dilate_by_share
from mi_ring.capture.scenefile import photograph_element, table_element
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.undistortion import Window, undistort
from mi_ring.importers.writer import Writer
from mi_ring.photogrammetry.flash_light import FlashCalibration
from mi_ring.photogrammetry.folder import DECODED, Picture
from mi_ring.photogrammetry.reduced_photographs import ReducedView, reduce_photograph
from mi_ring.photogrammetry.table_plane import Plane, TexelGrid, estimate_albedo
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Response, Shot
from mi_ring.scene.tone_curve import ToneCurve
from mi_ring.system.machine import in_threads

MARGIN = 0.06  #: around the object in a crop [size of the object]
#: The table's albedo lights the object only indirectly, so that low resolutions suffice: longer side of the photographs
#: that it is estimated from [px], half of its width [distance of the cameras], and its width [texels].
TABLE_PIXELS, TABLE_HALF_SIZE, TABLE_TEXELS = 600, 1.0, 256
OBJECT, UNKNOWN = 255, 128  #: values of masks; the background is 0


@dataclass(frozen=True)
class PosedPicture:
    """A photograph with its camera, light and mask."""

    picture: Picture
    lens: Lens
    pose: np.ndarray  #: (4, 4) camera-to-world, OpenCV's axes [scene units]
    mask: np.ndarray | None  #: (h, w) uint8 of the whole undistorted photograph, full size or reduced
    light: Light
    measured: bool = False  #: is the light's intensity calibrated with the sheet?
    falloff: float = 0.0  #: exponent of the flash's cone
    gamma: float = 1.0  #: exponent of the camera's response


def crop_windows(masks: Sequence[np.ndarray | None], sizes: Sequence[tuple[int, int]]) -> list[Window]:
    """Choose a window around the object in each photograph. Photographs of one size get windows of one size.

    `masks`: one per photograph, full size or reduced; None: no mask. `sizes`: (width, height) of the photographs [px].
    If no photograph of a size has a mask, its windows are whole photographs.
    """
    bounds = [None if mask is None else mask_bounds(mask, size) for mask, size in zip(masks, sizes)]
    windows = []
    for size, own in zip(sizes, bounds):
        alike = [b for other, b in zip(sizes, bounds) if other == size and b is not None]
        extent = np.max([b[1] - b[0] for b in alike], 0) if alike else np.array(size)
        extent = np.minimum(np.ceil(extent + 2 * MARGIN * extent.max()), size).astype(int)
        middle = np.array(size) / 2 if own is None else own.mean(0)
        corner = np.clip(np.round(middle - extent / 2), 0, size - extent).astype(int)
        windows.append(Window(*map(int, corner), *map(int, extent)))
    return windows


def write_posed_picture(writer: Writer, posed: PosedPicture, window: Window) -> Element:
    """Write the undistorted crop and the masks of a photograph. Returns its XML element for the scene file.

    `window`: the crop in the undistorted photograph. `writer`: writes the files of the capture.
    """
    picture = posed.picture
    pixels = picture.pixels[..., :3]
    left, top, width, height = window[:4]
    if posed.lens.is_pinhole:
        crop, shown = pixels[top : top + height, left : left + width], np.ones((height, width), bool)
    else:
        crop, shown = undistort(pixels, posed.lens, picture.encoding == "srgb", picture.saturation, window)
    picture.close()

    def write_binary(folder: str, mask: np.ndarray) -> Path:
        return writer.relative(writer.image(f"{folder}/{picture.name}", np.uint8(255) * mask[..., None]))

    filename = writer.relative(writer.image(f"images/{picture.name}", crop))
    encoding = picture.encoding if crop.dtype == np.uint16 else "auto"
    mask = None
    if posed.mask is not None:
        values = crop_mask(posed.mask, posed.lens.size, window)
        shown = shown & (values != UNKNOWN)
        mask = write_binary("masks", values == OBJECT)
    valid = None if shown.all() else write_binary("valid", shown)
    camera = posed.lens.camera(posed.pose)
    camera = camera._replace(centre=camera.centre - [left, top], size=(width, height))
    files = Files(filename, mask, valid)
    response = Response(ToneCurve(posed.gamma))
    return photograph_element(Shot(picture.name, camera, posed.light, posed.falloff, response=response, files=files,
                                   encoding=encoding, saturation=picture.saturation))  # fmt: skip


def write_table(
    writer: Writer, pictures: Sequence[PosedPicture], plane: Plane, center: np.ndarray, flash: FlashCalibration
) -> list[Element]:
    """Estimate the albedo of the table around `center` (3,), and write it as a texture.

    Returns a list with the XML element of the table; the list is empty if no photograph shows the table. `pictures`:
    the photographs. `plane`: the table. `flash`: light and camera response, calibrated with the sheet.
    """

    def observe(posed: PosedPicture) -> tuple[ReducedView, np.ndarray, Light]:
        view = reduce_photograph(posed.picture, posed.lens, posed.pose, Window.whole(posed.lens, TABLE_PIXELS))
        # Views of linear photographs are divided by their white. So must the light be.
        white = posed.picture.white if posed.picture.encoding == "linear" else 1.0
        light = posed.light._replace(rgb=posed.light.rgb / white)
        posed.picture.close()
        if posed.mask is None:  # the object may be anywhere
            return view, np.ones(view.valid.shape, np.uint8), light
        mask = cv2.resize((posed.mask > 0).astype(np.uint8), view.camera.size, interpolation=cv2.INTER_NEAREST)
        return view, dilate_by_share(mask, MARGIN), light

    views, hidden, lights = zip(*in_threads(observe, pictures, most=DECODED))
    distance = float(np.median([np.linalg.norm(view.camera.position - center) for view in views]))
    texels = TexelGrid(plane, center, TABLE_HALF_SIZE * distance, TABLE_TEXELS)
    albedo = estimate_albedo(views, lights, hidden, texels, flash)
    if albedo is None:
        return []
    picture = writer.image("table", to_bytes(linear_to_srgb(albedo)))
    return [table_element(writer.relative(picture).as_posix(), texels.to_world)]


def mask_bounds(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Return the bounding box of the object in a mask: lowest and highest (column, row), (2, 2) [px of the photograph].

    `size`: (width, height) of the photograph [px]; the mask may be reduced. Returns None if the mask is empty.
    """
    rows, columns = np.nonzero(mask == OBJECT)
    if not len(rows):
        return None
    return reduction(mask, size) * np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])


def reduction(mask: np.ndarray, size: tuple[int, int]) -> int:
    """Return the whole number by which a mask is smaller than its photograph.

    `size`: (width, height) of the photograph [px].
    """
    return round(size[0] / mask.shape[1])


def crop_mask(mask: np.ndarray, size: tuple[int, int], window: Window) -> np.ndarray:
    """Enlarge a reduced mask to the size of its photograph, and crop it to a window. Returns (height, width) integers.

    Values are `OBJECT`, `UNKNOWN` and 0 (background). `size`: (width, height) of the photograph [px].
    """
    scale, (left, top, width, height) = reduction(mask, size), window[:4]
    to_mask = np.array([[1, 0, left + (1 - scale) / 2], [0, 1, top + (1 - scale) / 2]]) / scale
    is_object, is_unknown = (
        cv2.warpAffine((mask == value).astype(np.float32), to_mask, (width, height),
                       flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE) > 0.5
        for value in (OBJECT, UNKNOWN)
    )  # fmt: skip
    return np.where(is_object, OBJECT, np.where(is_unknown, UNKNOWN, 0))
