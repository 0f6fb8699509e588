"""Cameras and lights of many photographs as arrays, which a fit refines and the renderer reads."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.shot import Shot


class Views(NamedTuple):
    """Cameras and lights of P photographs, all as NumPy arrays, as torch tensors, or as flat Dr.Jit buffers."""

    cameras: Any  #: (P, 3, 4) camera-to-world
    intrinsics: Any  #: (P, 4) fx, fy, cx, cy [px]
    places: Any  #: (P, 3) of lights: positions [scene units], of distant ones unit directions toward them
    strengths: Any  #: (P, 3) intensities, of distant lights irradiances
    cone: Any  #: (P, 3) of the flashes: exponents of cones, tilts to the left and up; as a buffer None if all are 0
    distortion: Any  #: (P,) first radial distortions of the lenses; as a buffer None if all are 0

    @classmethod
    def of(cls, shots: Sequence[Shot], places: np.ndarray, strengths: np.ndarray) -> "Views":
        """Collect the cameras of P photographs as NumPy arrays.

        `places` (P, 3): positions of the photographs' lights [scene units], or unit directions toward distant lights.
        `strengths` (P, 3): RGB intensities, or irradiances of distant lights.
        """
        cameras = [shot.camera for shot in shots]
        return cls(
            np.stack([camera.to_world[:3] for camera in cameras]),
            np.array([[*camera.focal, *camera.centre] for camera in cameras]), places, strengths,
            np.array([(shot.falloff, *shot.tilt) for shot in shots]),
            np.array([camera.distortion for camera in cameras]),
        )  # fmt: skip

    def to(self, device: Any) -> "Views":
        """Return the tensors on another torch device."""
        return Views(*(tensor.to(device) for tensor in self))

    def buffers(self) -> "Views":
        """Convert NumPy arrays to flat Dr.Jit buffers of float32. `cone` and `distortion` become None if all 0."""
        buffers = {name: to_flat(mi.Float, array) for name, array in self._asdict().items()}
        return Views(**buffers | {name: None for name in ("cone", "distortion") if not getattr(self, name).any()})

    def camera(self, k: int, size: tuple[int, int]) -> Camera:
        """Return the camera of photograph `k`. `size`: (width, height) of the picture [px]. For NumPy arrays only."""
        lens = self.intrinsics[k]
        pose = np.vstack([self.cameras[k], [0, 0, 0, 1]])
        return Camera(pose, lens[:2], lens[2:], size, float(self.distortion[k]))
