"""Lenses of other tools, converted to COLMAP's camera models, and conversions of poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera
from mi_ring.importers.reading import matrix
from mi_ring.system.optional import need

MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  #: from Mitsuba's camera axes (x left, y up, z forward) to OpenCV's
MAX_SIDE = 10**6  #: of a photograph [px]


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera, in one of COLMAP's camera models: https://colmap.github.io/cameras.html

    Raises InputError for a panorama, and if width or height is not 1 to `MAX_SIDE` pixels.
    """

    model: str  #: COLMAP's name
    size: tuple[int, int]  #: (width, height) [px]
    params: tuple[float, ...]  #: in COLMAP's order

    def __post_init__(self) -> None:
        if self.model == "EQUIRECTANGULAR":  # pycolmap crashes when asked for its focal length
            raise InputError("camera: is a panorama, EQUIRECTANGULAR; leave such photographs out")
        if not all(1 <= side <= MAX_SIDE for side in self.size):
            raise InputError("camera: is for photographs of {:g} x {:g} pixels; must be 1 to {}".format(
                *np.clip(self.size, -1e9, 1e9), MAX_SIDE))  # fmt: skip
        object.__setattr__(self, "size", tuple(map(int, self.size)))
        object.__setattr__(self, "params", tuple(map(float, self.params)))

    @cached_property
    def colmap(self) -> Any:
        """The lens as a `pycolmap.Camera`. Raises InputError if pycolmap is not installed."""
        pycolmap = need("pycolmap", f"camera model {self.model}")
        return pycolmap.Camera(model=self.model, width=self.size[0], height=self.size[1], params=list(self.params))

    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths (fx, fy) [px]."""
        if self.model == "PINHOLE":
            return self.params[0], self.params[1]
        return self.colmap.focal_length_x, self.colmap.focal_length_y

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (cx, cy) [px]. The centre of the first pixel is at (0.5, 0.5)."""
        if self.model == "PINHOLE":
            return self.params[2], self.params[3]
        return self.colmap.principal_point_x, self.colmap.principal_point_y

    @property
    def is_pinhole(self) -> bool:
        """True if the lens has no distortion, as its projection of some rays shows.

        So a fisheye lens is no pinhole even if all its coefficients are 0.
        """
        if self.model == "PINHOLE":
            return True
        rays = np.array([[x, y, 1.0] for x in (-0.3, 0.2) for y in (-0.1, 0.4)])
        return np.allclose(self.colmap.img_from_cam(rays), rays[:, :2] * self.focal + self.centre, atol=1e-6)

    def scaled(self, size: tuple[int, int]) -> "Lens":
        """Return the lens for photographs that were resized to `size` (width, height) [px]."""
        if self.model == "PINHOLE":
            return Lens("PINHOLE", size, tuple(np.tile(np.divide(size, self.size), 2) * self.params))
        camera = self.colmap  # cached: a copy is changed
        camera = type(camera)(camera.todict())
        camera.rescale(*size)
        return Lens(self.model, size, tuple(camera.params))

    def camera(self, pose: np.ndarray) -> Camera:
        """Return the pinhole camera of the undistorted photograph: same size, focal lengths and principal point.

        `pose` (4, 4): camera-to-world, with OpenCV's camera axes (x right, y down, z forward).
        """
        return Camera(pose @ MITSUBA, np.array(self.focal), np.array(self.centre), self.size)


def pinhole_lens(K: np.ndarray, size: Sequence[int] | np.ndarray, shift: float, what: str) -> Lens:
    """Make a lens without distortion from a calibration matrix `K` (3, 3) [px].

    `size`: (width, height) [px]. `shift`: added to cx and cy [px]; 0.5 if the other tool puts the centre of the first
    pixel at 0, otherwise 0. Raises InputError if `K` has skew, or if K[2, 2] is 0. The message begins with `what`.
    """
    if not K[2, 2]:
        raise InputError(f"{what}: is no calibration matrix (K[2][2] is 0)")
    K = K / K[2, 2]
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise InputError(f"{what}: has skew (K[0][1] is {K[0, 1]:.4g}), which is not supported; is the matrix "
                         "transposed?")  # fmt: skip
    return Lens("PINHOLE", (size[0], size[1]), (K[0, 0], K[1, 1], K[0, 2] + shift, K[1, 2] + shift))


def opencv_lens(size: Any, intrinsics: Sequence[float], k: Sequence[float], p: Sequence[float]) -> Lens:
    """Make a lens with OpenCV's distortion model; a pinhole if all coefficients are 0.

    `size`: (width, height) [px]. `intrinsics`: fx, fy, cx, cy [px]. `k`: radial coefficients k1, k2, k3. `p`:
    tangential coefficients p1, p2.
    """
    if not any((*k, *p)):
        return Lens("PINHOLE", (size[0], size[1]), tuple(intrinsics))
    return Lens("FULL_OPENCV", (size[0], size[1]), (*intrinsics, *k[:2], *p, k[2], 0, 0, 0))


def pose_of(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) of the rotation R (3, 3) followed by the translation t (3,)."""
    return np.block([[R, np.reshape(t, (3, 1))], [np.eye(4)[3:]]])


def rotation_of(quaternion: object, what: str) -> np.ndarray:
    """Convert a unit quaternion (x, y, z, w) that was read from a file to a rotation matrix (3, 3).

    Raises InputError if it is not four numbers, or if its length is not 1. The message begins with `what`.
    """
    numbers = matrix(quaternion, (4,), what)
    if abs(length := np.linalg.norm(numbers) - 1) > 1e-2:
        raise InputError(f"{what}: is of length {length + 1:.3g}; must be 1")
    return Rotation.from_quat(numbers).as_matrix()


def camera_to_world(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Invert extrinsics. Returns the camera-to-world pose (4, 4) for x_camera = R x_world + t, R (3, 3), t (3,)."""
    return pose_of(R.T, -R.T @ t)


def decompose_projection(P: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Decompose a projection matrix (3, 4). Returns (calibration matrix (3, 3), camera-to-world pose (4, 4)).

    Raises InputError if the matrix is singular. The message begins with `what`.
    """
    if abs(np.linalg.det(P[:, :3])) <= 1e-12 * np.linalg.norm(P[:, :3]) ** 3:
        raise InputError(f"{what}: is no projection matrix of a camera (singular)")
    K, R = scipy.linalg.rq(P[:, :3])
    signs = np.sign(np.diag(K))
    K, R = K * signs, signs[:, None] * R
    if np.linalg.det(R) < 0:  # P and -P are the same projection
        R, P = -R, -P
    return K, camera_to_world(R, np.linalg.solve(K, P[:, 3]))
