"""Reduced photographs with their cameras, free of distortion: what the object is looked for in."""

from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.images import srgb_to_linear
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.frames import MITSUBA
from mi_ring.importers.undistortion import Window, source_positions
from mi_ring.photogrammetry.folder import Picture

ROOM = 0.3  #: of the object's size, left around it in the pictures that its outlines are found in


class View(NamedTuple):
    """A photograph, reduced and without distortion."""

    name: str
    rgb: np.ndarray  #: (H, W, 3) uint8 sRGB
    shown: np.ndarray  #: (H, W) bool: does the photograph show it?
    camera: Camera

    @property
    def linear(self) -> np.ndarray:
        """(H, W, 3) float32"""
        return srgb_to_linear(np.arange(256, dtype=np.float32) / 255)[self.rgb]

    def places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where points (N, 3) are: rows and columns (N,) of pixels, and which points are in the picture (N,)."""
        projection, (width, height) = self.camera.projection.astype(np.float32), self.camera.size
        x, y, depth = projection[:, :3] @ points.astype(np.float32).T + projection[:, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / depth, y / depth
        inside = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        row, column = (np.where(inside, pixel, 0).astype(np.int32) for pixel in (y, x))
        inside &= self.shown[row, column]
        return row, column, inside


def camera_of(lens: Lens, pose: np.ndarray) -> Camera:
    """The camera without distortion; `pose` (4, 4) has OpenCV's axes."""
    return Camera(pose @ MITSUBA, np.array(lens.focal), np.array(lens.centre), lens.size)


def reduced(picture: Picture, lens: Lens, pose: np.ndarray, window: Window) -> View:
    """A part of a photograph, its distortion undone."""
    rgb, scale = picture.srgb(), window.scale
    camera = camera_of(lens, pose).shrunk(scale)
    width, height = camera.size
    small = cv2.resize(rgb[: height * scale, : width * scale], (width, height), interpolation=cv2.INTER_AREA)
    corner = np.array([window.left, window.top]) / scale
    camera = camera._replace(centre=camera.centre - corner, size=(window.width, window.height))
    places = ((source_positions(lens, window) + 0.5) / scale - 0.5).astype(np.float32)
    straight = cv2.remap(small, places[1], places[0], cv2.INTER_LINEAR)
    shown = cv2.remap(np.ones((height, width), np.uint8), places[1], places[0], cv2.INTER_NEAREST)
    return View(picture.name, straight, shown > 0, camera)


def whole_of(lens: Lens, longest: int) -> Window:
    """All of the picture, in so many pixels at most."""
    scale = -(-max(lens.size) // longest)
    return Window(0, 0, lens.size[0] // scale, lens.size[1] // scale, scale)


def around(lens: Lens, mask: np.ndarray, pixels: int) -> Window:
    """What a mask (h, w) of the whole picture covers, in about so many pixels, with room around it."""
    rows, columns = np.nonzero(mask)
    size = np.array(lens.size)
    unit = np.round(size / mask.shape[::-1])
    low, high = (np.array([end(columns), end(rows)]) * unit for end in (np.min, np.max))
    extent = float((high - low).max() + unit.max())
    scale = max(1, round(extent / pixels))
    low = np.clip(low - ROOM * extent, 0, size - 1).astype(int) // scale * scale  # a whole pixel of all, reduced
    high = np.clip(high + ROOM * extent, low + scale, size).astype(int)
    (left, top), (width, height) = low.tolist(), ((high - low) // scale).tolist()
    return Window(left, top, width, height, scale)


def pasted(mask: np.ndarray, lens: Lens, window: Window) -> np.ndarray:
    """A mask of a window as one of the whole picture, equally reduced; 0 around it."""
    full = np.zeros((lens.size[1] // window.scale, lens.size[0] // window.scale), mask.dtype)
    left, top = window.left // window.scale, window.top // window.scale
    part = full[top : top + mask.shape[0], left : left + mask.shape[1]]
    part[:] = mask[: part.shape[0], : part.shape[1]]
    return full


def reduced_mask(mask: np.ndarray, lens: Lens, longest: int) -> np.ndarray:
    """A mask (H, W) uint8 of a photograph, as `reduced` has the photograph: (h, w) uint8, 1 where it is above half."""
    window = whole_of(lens, longest)
    scale = window.scale
    small = cv2.resize(mask[: window.height * scale, : window.width * scale], (window.width, window.height),
                       interpolation=cv2.INTER_AREA)  # fmt: skip
    if not lens.is_pinhole:
        places = ((source_positions(lens, window) + 0.5) / scale - 0.5).astype(np.float32)
        small = cv2.remap(small, places[1], places[0], cv2.INTER_LINEAR)
    return (small > 127).astype(np.uint8)
