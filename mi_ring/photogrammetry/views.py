"""Reduced photographs with their cameras, free of distortion: what the object is looked for in."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.images import srgb_to_linear
from mi_ring.importers.cameras import Lens
from mi_ring.importers.frames import MITSUBA
from mi_ring.importers.undistortion import distorted, whole
from mi_ring.photogrammetry.folder import Picture


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

    def places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (N, 3) are: pixels (N, 2) int, column and row, and which of them are in the picture (N,)."""
        local = (points - self.camera.position) @ self.camera.to_world[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = self.camera.centre - self.camera.focal * local[:, :2] / local[:, 2:]
        inside = (local[:, 2] > 0) & (pixel >= 0).all(1) & (pixel < self.camera.size).all(1)
        pixel = np.where(inside[:, None], pixel, 0).astype(np.int32)
        inside &= self.shown[pixel[:, 1], pixel[:, 0]]
        return pixel, inside


def camera_of(lens: Lens, pose: np.ndarray) -> Camera:
    """The camera without distortion; `pose` (4, 4) has OpenCV's axes."""
    return Camera(pose @ MITSUBA, np.array(lens.focal), np.array(lens.centre), lens.size)


def reduced(picture: Picture, lens: Lens, pose: np.ndarray, longest: int) -> View:
    """A photograph of at most so many pixels, its distortion undone."""
    rgb = picture.srgb()
    scale = -(-max(lens.size) // longest)
    camera = camera_of(lens, pose).shrunk(scale)
    width, height = camera.size
    small = cv2.resize(rgb[: height * scale, : width * scale], (width, height), interpolation=cv2.INTER_AREA)
    if lens.is_pinhole:
        return View(picture.name, small, np.ones((height, width), bool), camera)
    places = ((distorted(lens, whole(lens, scale)) + 0.5) / scale - 0.5).astype(np.float32)
    straight = cv2.remap(small, places[1], places[0], cv2.INTER_LINEAR)
    shown = cv2.remap(np.ones((height, width), np.uint8), places[1], places[0], cv2.INTER_NEAREST)
    return View(picture.name, straight, shown > 0, camera)


def reduced_mask(mask: np.ndarray, lens: Lens, longest: int) -> np.ndarray:
    """A mask (H, W) uint8 of a photograph, as `reduced` has the photograph: (h, w) uint8, 1 where it is above half."""
    scale = -(-max(lens.size) // longest)
    window = whole(lens, scale)
    small = cv2.resize(mask[: window.height * scale, : window.width * scale], (window.width, window.height),
                       interpolation=cv2.INTER_AREA)  # fmt: skip
    if not lens.is_pinhole:
        places = ((distorted(lens, window) + 0.5) / scale - 0.5).astype(np.float32)
        small = cv2.remap(small, places[1], places[0], cv2.INTER_LINEAR)
    return (small > 127).astype(np.uint8)


def reduced_all(
    pictures: Sequence[Picture], cameras: Mapping[str, tuple[Lens, np.ndarray]], longest: int
) -> list[View]:
    """Those that have a camera."""
    views = []
    for picture in pictures:
        if picture.name in cameras:
            views.append(reduced(picture, *cameras[picture.name], longest))
            picture.close()
    return views
