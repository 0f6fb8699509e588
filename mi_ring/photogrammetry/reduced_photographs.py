"""Reduced and undistorted photographs with their cameras, in which the object is searched."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.geometry.camera import Camera
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.undistortion import Window, source_positions
from mi_ring.photogrammetry.folder import DECODED, Picture
from mi_ring.system.machine import in_threads
from mi_ring.system.progress import Progress

MARGIN = 0.3  #: around the object in a window [size of the object]


class ReducedView(NamedTuple):
    """A photograph, or a window of a photograph, reduced and undistorted, with its camera."""

    name: str
    rgb: np.ndarray  #: (H, W, 3) uint8 sRGB
    valid: np.ndarray  #: (H, W) bool: does the photograph show this pixel?
    camera: Camera

    @property
    def linear(self) -> np.ndarray:
        """The pixels as linear radiance, (H, W, 3) float32."""
        return srgb_to_linear(np.arange(256, dtype=np.float32) / 255)[self.rgb]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project points (N, 3). Returns (rows (N,), columns (N,), (N,) bool: True if the view shows the point).

        Rows and columns are whole pixels; 0 for points outside. Whether something hides a point is not tested.
        """
        projection, (width, height) = self.camera.projection.astype(np.float32), self.camera.size
        x, y, depth = projection[:, :3] @ points.astype(np.float32).T + projection[:, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / depth, y / depth
        inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        row, column = (np.where(inside, pixel, 0).astype(np.int32) for pixel in (y, x))
        return row, column, inside & self.valid[row, column]


Views = Sequence[ReducedView]
Masks = Sequence[np.ndarray]  #: (H, W) uint8 each, above 0 inside


def undistort_view(image: np.ndarray, lens: Lens, window: Window, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """Reduce and undistort an image, and crop it to a window. Returns pixels (h, w, …) uint8.

    `image` (H, W, …) uint8: the whole photograph. `lens`: lens of the photograph. `window`: position, size and scale of
    the result. `interpolation`: OpenCV's flag for the undistortion.
    """
    height, width = (side // window.scale for side in image.shape[:2])
    whole = image[: height * window.scale, : width * window.scale]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    rows, columns = ((source_positions(lens, window) + 0.5) / window.scale - 0.5).astype(np.float32)
    return cv2.remap(small, columns, rows, interpolation)


def reduce_photograph(picture: Picture, lens: Lens, pose: np.ndarray, window: Window) -> ReducedView:
    """Reduce and undistort a photograph, and crop it to a window. Returns the view.

    `lens`: lens of the whole photograph. `pose` (4, 4): camera-to-world, OpenCV's axes. `window`: position, size and
    scale of the view.
    """
    rgb, camera = picture.srgb(), lens.camera(pose).shrunk(window.scale)
    corner = np.array([window.left, window.top]) / window.scale
    camera = camera._replace(centre=camera.centre - corner, size=(window.width, window.height))
    valid = undistort_view(np.ones(rgb.shape[:2], np.uint8), lens, window, cv2.INTER_NEAREST)
    return ReducedView(picture.name, undistort_view(rgb, lens, window), valid > 0, camera)


def read_windows(
    pictures: Sequence[Picture], windows: Sequence[Sequence[Window]], cameras: Mapping[str, tuple[Lens, np.ndarray]],
    progress: Progress,
) -> list[list[ReducedView]]:  # fmt: skip
    """Read each photograph once, and make the views of its windows. Returns a list of views for each photograph.

    `windows`: a list of windows for each photograph. `cameras`: (lens, camera-to-world pose (4, 4)) by the photograph's
    name.
    """

    def read(picture: Picture, wanted: Sequence[Window]) -> list[ReducedView]:
        views = [reduce_photograph(picture, *cameras[picture.name], window) for window in wanted]
        picture.close()
        return views

    return list(progress(in_threads(read, pictures, windows, most=DECODED), "reading", len(pictures)))


def reduce_mask(mask: np.ndarray, lens: Lens, longest: int) -> np.ndarray:
    """Undistort and reduce a photograph's mask (H, W) uint8 of 0 to 255. Returns (h, w) uint8, 0 or 1.

    `longest`: largest length of the longer side [px].
    """
    return (undistort_view(mask, lens, Window.whole(lens, longest)) > 127).astype(np.uint8)


def window_around(lens: Lens, mask: np.ndarray, pixels: int) -> Window:
    """Choose a window around the object in a photograph, with a margin, and the scale of its reduction.

    `lens`: lens of the photograph. `mask` (h, w): above 0 on the object. It covers the whole undistorted photograph,
    and may be reduced. `pixels`: approximate length of the object in the reduced window [px].
    """
    rows, columns = np.nonzero(mask)
    size = np.array(lens.size)
    unit = np.round(size / mask.shape[::-1])
    low, high = (np.array([end(columns), end(rows)]) * unit for end in (np.min, np.max))
    extent = float((high - low).max() + unit.max())
    scale = max(1, round(extent / pixels))
    low = np.clip(low - MARGIN * extent, 0, size - 1).astype(int) // scale * scale  # on a pixel of the reduced picture
    high = np.clip(high + MARGIN * extent, low + scale, size).astype(int)
    (left, top), (width, height) = low.tolist(), ((high - low) // scale).tolist()
    return Window(left, top, width, height, scale)


def paste_mask(mask: np.ndarray, lens: Lens, window: Window) -> np.ndarray:
    """Paste the mask of a window into a mask of the whole photograph, which is returned, at the window's scale.

    `mask` (h, w): mask of the window. Outside of the window, the result is 0.
    """
    full = np.zeros((lens.size[1] // window.scale, lens.size[0] // window.scale), mask.dtype)
    left, top = window.left // window.scale, window.top // window.scale
    part = full[top : top + mask.shape[0], left : left + mask.shape[1]]
    part[:] = mask[: part.shape[0], : part.shape[1]]
    return full
