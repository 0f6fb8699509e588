"""Cameras as numpy arrays, with or without lens distortion, and projections to their pictures."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mi_ring.errors import InputError, require_numbers

#: Limits of `distortion` · r², where r is the distance of a corner of the picture from its centre [focal lengths].
#: Below −4/27 the lens folds: it shows some points twice. Above 10, Newton's method leaves an error of over 1e-6.
MIN_DISTORTION, MAX_DISTORTION = 0.9 * -4 / 27, 10.0
NEWTON_STEPS = 6
FARTHEST = 50  #: sizes of the picture from which a principal point may be


def pixels_per_unit(cameras: Sequence["Camera"], point: np.ndarray) -> float:
    """Return how many pixels show a length of 1 [scene units] at a `point` (3,): the median of the cameras."""
    return float(np.median([camera.focal.mean() / np.linalg.norm(camera.position - point) for camera in cameras]))


class NoParallax(InputError):
    """Raised if all cameras are at one place or look along one line, so that the distance of the object is unknown."""


def moved_pose(pose: np.ndarray, scale: float, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return a camera-to-world pose (4, 4) after the motion x ↦ scale · rotation (3, 3) x + shift (3,) of the world.

    Only the position is scaled. The result is again a rotation and a translation.
    """
    moved = np.eye(4)
    moved[:3, :3] = rotation @ pose[:3, :3]
    moved[:3, 3] = scale * rotation @ pose[:3, 3] + shift
    return moved


def undistortion_factor(distortion: Any, distance2: Any) -> Any:
    """Return the factor that removes distortion: the vector from the principal point to a point is multiplied by it.

    `distortion`: first radial coefficient. `distance2`: squared length of the distorted vector [focal lengths²]. The
    factor s solves s (1 + `distortion` s² `distance2`) = 1. Newton's method finds it, if `distortion` · `distance2` is
    between `MIN_DISTORTION` and `MAX_DISTORTION`. Arguments are arrays of numpy, torch or Dr.Jit.
    """
    k = distortion * distance2
    factor = 1 / (1 + k)
    for _ in range(NEWTON_STEPS):
        factor = factor - (factor + k * factor**3 - 1) / (1 + 3 * k * factor**2)
    return factor


def distortion_factor(distortion: Any, distance2: Any) -> tuple[Any, Any]:
    """Return (factor, visible) for a point.

    Distortion multiplies the vector from the principal point to it by the factor. `distortion`: first radial
    coefficient. `distance2`: squared length of the undistorted vector [focal lengths²]. `visible` is False for a point
    so far out that a strongly distorting lens would fold the picture over. Arguments are arrays of numpy, torch or
    Dr.Jit.
    """
    k = distortion * distance2
    return 1 + k, 1 + 3 * k > 0


def distortion_range(focal: Any, centre: Any, size: Any) -> tuple[Any, Any]:
    """Return the lowest and the highest distortion coefficient (...) that can be removed in the whole picture.

    `focal`: focal lengths. `centre`: principal point. `size`: width and height. All are (..., 2) [px], arrays of numpy
    or torch.
    """
    corner = (abs(centre - size / 2) + size / 2) / focal
    corner2 = (corner**2).sum(-1)
    return MIN_DISTORTION / corner2, MAX_DISTORTION / corner2


class Camera(NamedTuple):
    """A camera. Its picture spans [0, W] × [0, H] [px], x right, y down.

    The centre of the first pixel is (0.5, 0.5).
    """

    to_world: np.ndarray  #: (4, 4) camera-to-world, Mitsuba's axes: x left, y up, z forward
    focal: np.ndarray  #: (2,) focal lengths [px]
    centre: np.ndarray  #: (2,) principal point [px]
    size: tuple[int, int]  #: (width, height) [px]
    #: First radial coefficient of the lens: a point at r focal lengths from the centre moves to r (1 + distortion r²).
    distortion: float = 0.0

    @property
    def position(self) -> np.ndarray:
        """Centre of projection (3,) [scene units]."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Viewing direction (3,) of length 1."""
        return self.to_world[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """Up direction (3,) of the picture, of length 1."""
        return self.to_world[:3, 1]

    @property
    def projection(self) -> np.ndarray:
        """Matrix (3, 4) that maps (x, y, z, 1) in the world to (pixel x · depth, pixel y · depth, depth).

        Lens distortion is ignored.
        """
        across = self.to_world[:3, :2] * -self.focal + np.outer(self.forward, self.centre)
        rows = np.column_stack([across, self.forward]).T
        return np.column_stack([rows, -rows @ self.position])

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Return the world directions (n, 3), of length 1, of the rays through picture coordinates (n, 2) [px]."""
        x, y = self.undistorted((pixels - self.centre) / self.focal).T
        d = np.stack([-x, -y, np.ones_like(x)], 1) @ self.to_world[:3, :3].T
        return d / np.linalg.norm(d, axis=1, keepdims=True)

    def undistorted(self, places: np.ndarray) -> np.ndarray:
        """Remove lens distortion from points in the picture. Returns (..., 2) in the same unit.

        `places` (..., 2): vectors from the principal point to the points [focal lengths].
        """
        if not self.distortion:
            return places
        return places * undistortion_factor(self.distortion, np.square(places).sum(-1, keepdims=True))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (n, 3) in the world. Returns pixel coordinates (n, 2) and depths (n,) along the optical axis.

        Depths are in scene units; points behind the camera have negative ones. Pixel coordinates are NaN for a point so
        far out that a strongly distorting lens would fold the picture over.
        """
        x, y, z = np.linalg.solve(self.to_world[:3, :3], (points - self.position).T)
        with np.errstate(divide="ignore", invalid="ignore"):  # the depth may be 0
            places = np.stack([x, y], 1) / z[:, None]
            factor, visible = distortion_factor(self.distortion, np.square(places).sum(1, keepdims=True))
            places *= np.where(visible, factor, np.nan)
            return self.centre - self.focal * places, z

    def cosines(self) -> np.ndarray:
        """Return the cosines (H, W) of the angles between the rays of the pixels and the optical axis."""
        width, height = self.size
        y, x = np.mgrid[:height, :width]
        places = self.undistorted((np.stack([x, y], -1) + 0.5 - self.centre) / self.focal)
        return (1 + np.square(places).sum(-1)) ** -0.5

    def shrunk(self, scale: int) -> "Camera":
        """Return the camera of a reduced photograph. Width and height are divided by `scale`, a whole number."""
        size = self.size[0] // scale, self.size[1] // scale
        return self._replace(focal=self.focal / scale, centre=self.centre / scale, size=size)

    @property
    def key(self) -> tuple[bytes, ...]:
        """Key for dictionaries. Equal cameras have equal keys."""
        return tuple(np.asarray(part).tobytes() for part in self)

    def fault(self) -> str | None:
        """Describe as text what is wrong with principal point, distortion or pose. Returns None if nothing is wrong.

        The text uses the names of fields in scene files.
        """
        if (far := np.abs(self.centre / np.array(self.size))).max() > FARTHEST:
            k = int(far.argmax())
            return (f"{('cx', 'cy')[k]} is {self.centre[k]:g}, which is more than {FARTHEST} times its film away; is "
                    "it in pixels?")  # fmt: skip
        least, most = distortion_range(self.focal, self.centre, np.array(self.size))
        if not least <= self.distortion <= most:
            return (f"distortion is {self.distortion:.6g}, must be within {least:.6g} and {most:.6g}: below, its "
                    "corners would show what is elsewhere, too")  # fmt: skip
        rotation = self.to_world[:3, :3]
        rigid = np.isfinite(self.to_world).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
        if not rigid or np.linalg.det(rotation) < 0:
            return "to_world must be a rotation and a translation, without scale or mirror"
        return None


def usable_camera(camera: Camera | None, what: str) -> Camera:
    """Check a camera, and return it with its numbers rounded to float32.

    Raises InputError if it is no camera or has invalid numbers. The message begins with `what`, the name of the camera.
    """
    if not isinstance(camera, Camera):
        raise InputError(f"{what}: is {type(camera).__name__}; must be a mi_ring.Camera")
    to_world, focal, centre, distortion, sides = (
        require_numbers(getattr(camera, name), shape, f"{what}: {name}")
        for name, shape in (("to_world", (4, 4)), ("focal", (2,)), ("centre", (2,)), ("distortion", ()), ("size", (2,)))
    )
    size = int(sides[0]), int(sides[1])
    own = Camera(to_world, focal, centre, size, float(distortion))
    if size != tuple(camera.size) or min(size) < 1:
        raise InputError(f"{what}: size is {tuple(camera.size)}; must be whole numbers above 0, (width, height)")
    if not (own.focal > 0).all():
        raise InputError(f"{what}: focal is {own.focal}; must be above 0 [px]")
    if not np.allclose(own.to_world[3], [0, 0, 0, 1]):
        raise InputError(f"{what}: to_world: its last row is {own.to_world[3]}, must be 0 0 0 1; is it transposed?")
    if fault := own.fault():
        raise InputError(f"{what}: {fault}")
    return own


def nearest_point(origins: np.ndarray, directions: np.ndarray, what: str) -> np.ndarray:
    """Return the point (3,) that is nearest to several lines in the least-squares sense.

    The lines are `origins` (n, 3) + t · `directions` (n, 3), unit vectors. Raises NoParallax if they do not determine a
    point. The message begins with `what`.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix, right = across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0]
    if np.linalg.cond(matrix) > 1e6 or not np.ptp(origins, axis=0).any():
        raise NoParallax(f"{what}: to_world: all cameras are in one place or look along one line, so the object's "
                         "place is unknown; if that is so, give center and radius of the shapenet shape")  # fmt: skip
    return np.linalg.solve(matrix, right)


def sphere_of_cameras(cameras: Sequence[Camera], what: str) -> tuple[np.ndarray, float]:
    """Estimate a sphere around the object from the cameras alone. Returns (centre (3,), radius) [scene units].

    The centre is the point nearest to all optical axes. The radius is half that of the largest ball around this centre
    which every camera sees completely. Raises NoParallax if there is no such point. The message begins with `what`.
    """
    origins = np.stack([camera.position for camera in cameras])
    center = nearest_point(origins, np.stack([camera.forward for camera in cameras]), what)
    half_angle = min(np.arctan(min(camera.size) / 2 / camera.focal.max()) for camera in cameras)
    return center, float(0.5 * np.sin(half_angle) * np.linalg.norm(origins - center, axis=1).min())
