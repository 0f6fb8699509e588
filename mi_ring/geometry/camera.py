"""Pinhole cameras as numpy arrays: the twin of `mi_ring.rendering.pinhole`."""

from typing import NamedTuple

import numpy as np

from mi_ring.errors import InputError


class NoParallax(InputError):
    """All cameras are in one place or look along one line: they do not say how far the object is."""


def moved_pose(pose: np.ndarray, scale: float, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A camera-to-world pose (4, 4) in another frame: x ↦ scale · rotation (3, 3) x + shift (3,)."""
    there = np.eye(4)
    there[:3, :3] = rotation @ pose[:3, :3]
    there[:3, 3] = scale * rotation @ pose[:3, 3] + shift
    return there


class Camera(NamedTuple):
    """A pinhole camera. The picture spans [0, W] × [0, H], x right, y down: the first pixel's centre is (0.5, 0.5)."""

    to_world: np.ndarray  #: (4, 4) camera-to-world, Mitsuba's axes: x left, y up, z forward
    focal: np.ndarray  #: (2,) focal lengths [px]
    centre: np.ndarray  #: (2,) principal point [px]
    size: tuple[int, int]  #: (width, height) [px]

    @property
    def position(self) -> np.ndarray:
        """(3,) [scene units]"""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """(3,) where it looks, unit length."""
        return self.to_world[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """(3,) unit length."""
        return self.to_world[:3, 1]

    @property
    def projection(self) -> np.ndarray:
        """(3, 4): of a point (x, y, z, 1) pixel coordinates times depth, and depth."""
        across = self.to_world[:3, :2] * -self.focal + np.outer(self.forward, self.centre)
        rows = np.column_stack([across, self.forward]).T
        return np.column_stack([rows, -rows @ self.position])

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) in the world through pixel coordinates (n, 2)."""
        x, y = ((pixels - self.centre) / self.focal).T
        d = np.stack([-x, -y, np.ones_like(x)], 1) @ self.to_world[:3, :3].T
        return d / np.linalg.norm(d, axis=1, keepdims=True)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates (n, 2), and depths (n,) along the optical axis [scene units], of points (n, 3)."""
        x, y, z = np.linalg.solve(self.to_world[:3, :3], (points - self.position).T)
        with np.errstate(divide="ignore", invalid="ignore"):  # where the depth is 0
            return self.centre - self.focal * np.stack([x, y], 1) / z[:, None], z

    def cosines(self) -> np.ndarray:
        """(H, W) cosines of the angles between the pixels' rays and the optical axis."""
        width, height = self.size
        x = (np.arange(width) + 0.5 - self.centre[0]) / self.focal[0]
        y = (np.arange(height) + 0.5 - self.centre[1]) / self.focal[1]
        return (1 + x**2 + y[:, None] ** 2) ** -0.5

    def shrunk(self, scale: int) -> "Camera":
        """Of the same photograph, `scale` times smaller."""
        size = self.size[0] // scale, self.size[1] // scale
        return Camera(self.to_world, self.focal / scale, self.centre / scale, size)


def nearest_point(origins: np.ndarray, directions: np.ndarray, what: str) -> np.ndarray:
    """The point (3,) closest in the least-squares sense to lines (n, 3) + t (n, 3).

    Raises NoParallax, a message about `what`, if the lines do not determine one.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix, right = across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0]
    if np.linalg.cond(matrix) > 1e6 or not np.ptp(origins, axis=0).any():
        raise NoParallax(f"{what}: to_world: all cameras are in one place or look along one line, so the object's "
                         "place is unknown; if that is so, give center and radius of the shapenet shape")  # fmt: skip
    return np.linalg.solve(matrix, right)
