"""The visual hull of masks. It contains all points whose projections are inside the masks. A fit may start from it."""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import skimage.measure
import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera, distortion_factor, nearest_point
from mi_ring.system import cache
from mi_ring.system.cached_arrays import environment, key_of, remembered

MIN_SHARE = 0.25  #: a point is outside if a smaller share of the photographs shows it
MAX_MASKS, MAX_WIDTH = 128, 512  #: limits of the number of silhouettes and their width [px]; more hardly help


class NoHull(InputError):
    """Raised if no point in space is inside all masks."""


class Silhouette(NamedTuple):
    """A mask and its camera.

    If the mask is of a part of a photograph, `frame` gives the corners of the whole photograph.
    """

    mask: np.ndarray  #: (H, W) uint8, object above 127
    camera: Camera
    name: str  #: for messages
    valid: np.ndarray | None = None  #: (H, W) uint8: the mask is unknown where this is ≤ 127. None: known everywhere
    frame: np.ndarray | None = None  #: (2, 2) corners of the photograph if the mask is a part [px]; no object beyond

    @property
    def whole(self) -> "Silhouette":
        """The silhouette of the whole photograph.

        If this silhouette shows only a part of it, the rest of the mask becomes empty.
        """
        if self.frame is None:
            return self
        before = np.ceil(-self.frame[0]).astype(int)
        after = np.ceil(self.frame[1]).astype(int) - self.mask.shape[::-1]
        margins = [(before[1], max(0, after[1])), (before[0], max(0, after[0]))]
        mask = np.pad(self.mask, margins)
        camera = self.camera._replace(centre=self.camera.centre + before, size=mask.shape[::-1])
        valid = None if self.valid is None else np.pad(self.valid, margins, constant_values=255)
        return Silhouette(mask, camera, self.name, valid)


def shrink_mask(mask: np.ndarray, width: int) -> tuple[np.ndarray, int]:
    """Reduce a mask (H, W) uint8 by a whole factor, to at most `width` [px] wide. Returns (mask, factor)."""
    scale = -(-mask.shape[1] // width)
    height, width = (n // scale for n in mask.shape)
    blocks = mask[: height * scale, : width * scale].reshape(height, scale, width, scale)
    return blocks.mean((1, 3)).astype(np.uint8), scale


def small_silhouette(silhouette: Silhouette, width: int = MAX_WIDTH) -> Silhouette:
    """Return a copy of a silhouette, mask and camera, that is reduced to at most `width` [px] wide."""
    mask, scale = shrink_mask(silhouette.mask, width)
    valid = None if silhouette.valid is None else shrink_mask(silhouette.valid, width)[0]
    frame = None if silhouette.frame is None else silhouette.frame / scale
    return silhouette._replace(mask=mask, camera=silhouette.camera.shrunk(scale), valid=valid, frame=frame)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Return at most `most` indices, evenly spaced in 0 … `count` − 1."""
    number = min(most, count)
    return [k * count // number for k in range(number)]


def subsample(silhouettes: Sequence[Silhouette], most: int, width: int) -> list[Silhouette]:
    """Choose at most `most` silhouettes, evenly spaced. Returns them, each reduced to at most `width` [px]."""
    return [small_silhouette(silhouettes[k], width) for k in evenly_spaced(len(silhouettes), most)]


class Hull:
    """The visual hull of silhouettes. Raises InputError if a silhouette is empty.

    `center` (3,) and `reach` are the centre and the radius of a ball that contains the hull [scene units]. `outliers`:
    a point may be outside this share of the silhouettes and still belong to the hull, so that a few wrong masks do no
    harm. `what`: name of the capture, at the beginning of error messages.
    """

    def __init__(self, silhouettes: Sequence[Silhouette], what: str, outliers: float = 0.02) -> None:
        self.silhouettes = subsample(silhouettes, MAX_MASKS, MAX_WIDTH)
        self.what, self.outliers = what, outliers
        origins = np.stack([s.camera.position for s in self.silhouettes])
        rays = [self.rays(s) for s in self.silhouettes]
        self.center = nearest_point(origins, np.stack([r.mean(0) / np.linalg.norm(r.mean(0)) for r in rays]), what)
        across = (np.cross(r, self.center - o) for r, o in zip(rays, origins))
        self.reach = max(np.linalg.norm(a, axis=1).max() for a in across)

    @functools.cached_property
    def distances(self) -> list[Tensor]:
        """For each silhouette, the `signed_distance` (H, W) from its outline [px]. Only a new surface needs it."""
        return [torch.from_numpy(signed_distance(s.mask)) for s in self.silhouettes]

    @staticmethod
    def rays(silhouette: Silhouette) -> np.ndarray:
        """Return the world directions (n, 3), of length 1, of the rays through the object's pixels of a mask.

        Raises InputError if the mask is empty.
        """
        rows, columns = np.nonzero(silhouette.mask > 127)
        if not len(rows):
            raise InputError(f"{silhouette.name}: mask: is empty, or nearly: no pixels above 127")
        return silhouette.camera.directions(np.stack([columns, rows], 1) + 0.5)

    def depth(self, points: Tensor) -> Tensor:
        """Return the approximate signed distance (N,) of points (N, 3) from the hull's surface, positive inside.

        It is in scene units. For each silhouette, it is the distance of the projected point from the outline, at the
        depth of the point. The result is the smallest of these distances, after a few outliers are left out. A
        photograph that does not show the point does not count. A point that few photographs show is outside.
        """
        worst = math.floor(self.outliers * len(self.silhouettes)) + 1
        lowest, shown = torch.full((worst, len(points)), torch.inf), torch.zeros(len(points))
        for (mask, camera, _, valid, frame), distance in zip(self.silhouettes, self.distances):
            matrix, focal, centre = (torch.tensor(a, dtype=torch.float32) for a in camera[:3])
            local = (points - matrix[:3, 3]) @ matrix[:3, :3]
            z, across = local[:, 2], local[:, :2] / local[:, 2:]
            if camera.distortion:
                factor, visible = distortion_factor(camera.distortion, across.square().sum(1, keepdim=True))
                across = across * torch.where(visible, factor, torch.nan)
            size = torch.tensor(mask.shape[::-1])
            place = (centre - focal * across) / size  # in [0, 1]
            low, high = (0, 1) if frame is None else (torch.from_numpy(frame).to(place) / size).unbind()
            seen = (z > 0) & ((place >= low) & (place <= high)).all(1)
            if valid is not None:
                row, column = (place * size).nan_to_num(-1).long().flip(1).T
                row, column = row.clamp(0, mask.shape[0] - 1), column.clamp(0, mask.shape[1] - 1)
                beyond = ((place - 0.5).abs() > 0.5).any(1)  # of a part of the photograph; nothing is there
                seen &= beyond | torch.from_numpy(valid > 127)[row, column]
            where, padding = 2 * place[None, None] - 1, "zeros" if frame is None else "border"
            sampled = F.grid_sample(distance[None, None], where, padding_mode=padding, align_corners=False)
            inside = sampled[0, 0, 0]
            deep = torch.where(seen, inside * z / focal.mean(), torch.inf)
            for low in lowest:  # insert into the sorted rows; the larger value goes on to the next row
                deep, low[:] = torch.maximum(low, deep), torch.minimum(low, deep)
            shown += seen
        return torch.where(shown >= MIN_SHARE * len(self.silhouettes), lowest[-1], -self.reach).clamp(max=self.reach)

    def shortfall(
        self, of: Sequence[Silhouette] | None = None, pixels: int = 100, samples: int = 64, outline: bool = False
    ) -> np.ndarray:
        """Return how far N silhouettes reach beyond the projected hull: (N, pixels) [px]. 0: not at all.

        Each value is the distance of the hull from the ray through a random pixel of a mask. `of`: the N silhouettes;
        None: those of the hull. `pixels`: number of rays for each mask. `samples`: number of points on a ray at which
        the distance is computed. `outline`: True takes pixels only from the outline of the mask.
        """
        random, result = np.random.default_rng(0), []
        along = torch.linspace(-self.reach, self.reach, samples)[:, None]
        for silhouette in self.silhouettes if of is None else of:
            rays = self.rays(silhouette)
            if outline:
                inside = silhouette.mask > 127
                rays = rays[~scipy.ndimage.binary_erosion(inside)[inside]]
            rays = rays[random.integers(len(rays), size=pixels)]
            origin = silhouette.camera.position
            middle = origin + rays * (rays @ (self.center - origin))[:, None]
            near, ahead = (torch.as_tensor(a, dtype=torch.float32) for a in (middle, rays))
            deepest = self.depth((near[:, None] + along * ahead[:, None]).reshape(-1, 3)).reshape(pixels, samples)
            pixel = np.linalg.norm(self.center - origin) / silhouette.camera.focal.mean()
            result.append((-deepest.amax(1).numpy() / pixel).clip(0))
        return np.array(result)

    def grid(self, low: np.ndarray, high: np.ndarray, spacing: float) -> tuple[Tensor, tuple[int, ...]]:
        """Return the points (N, 3) of a regular grid, and the grid's shape (number of points along x, y and z).

        `low` (3,), `high` (3,): lowest and highest corner. `spacing`: distance of neighbours. All are in scene units.
        """
        axes = [torch.as_tensor(np.arange(a, b + spacing, spacing), dtype=torch.float32) for a, b in zip(low, high)]
        return torch.cartesian_prod(*axes), tuple(map(len, axes))

    def require(self, inside: int) -> None:
        """Raise NoHull if `inside`, the number of grid points inside the hull, is 0."""
        if not inside:
            raise NoHull(f"{self.what}: mask: no point in space is inside all masks; check to_world, fx, fy, cx, cy")

    def ball(self, resolution: int = 48) -> tuple[np.ndarray, float]:
        """Return the hull's centre of mass (3,), and the radius of a ball of the same volume [scene units].

        `resolution`: points of the grid along each side. Raises NoHull if the hull is empty.
        """
        spacing = 2 * self.reach / (resolution - 1)
        points, _ = self.grid(self.center - self.reach, self.center + self.reach, spacing)
        inside = points[self.depth(points) > 0].double()
        self.require(len(inside))
        return inside.mean(0).numpy(), (3 * len(inside) * spacing**3 / (4 * math.pi)) ** (1 / 3)

    def surface(self, resolution: int = 128) -> trimesh.Trimesh:
        """Return the closed surface of the hull's largest piece, a mesh in scene units. It is found by marching cubes.

        `resolution`: number of grid cells along the longest side. The cache folder keeps the mesh. Raises NoHull if the
        hull is empty.
        """
        parts = [part for s in self.silhouettes for part in (s.mask, s.valid, s.frame, *s.camera)]
        key = key_of("hull", environment(), self.center, self.reach, self.outliers, resolution, *parts)
        vertices, faces = remembered(key, lambda: self.march(resolution))
        cache.prune()
        return trimesh.Trimesh(vertices, faces, process=False)

    def march(self, resolution: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mesh of `surface`: vertices (V, 3) [scene units] and faces (F, 3). Raises NoHull.

        If it changes, change `cached_arrays.FORMAT`.
        """
        low, high = self.center - self.reach, self.center + self.reach
        spacing = 2 * self.reach / 64
        points, shape = self.grid(low, high, spacing)
        coarse = self.depth(points).reshape(shape).numpy()
        inside = np.argwhere(coarse > -spacing)
        self.require(len(inside))
        low, high = low + spacing * (inside.min(0) - 1), low + spacing * (inside.max(0) + 1)
        fine = (high - low).max() / resolution
        points, shape = self.grid(low, high, fine)
        index = (points.numpy() - (self.center - self.reach)).T / spacing
        depth = torch.from_numpy(scipy.ndimage.map_coordinates(coarse, index, order=1, mode="nearest"))
        near = depth.abs() < 2 * spacing  # elsewhere only the sign matters
        depth[near] = self.depth(points[near])
        field = depth.reshape(shape).numpy().clip(-3 * fine, 3 * fine)
        field = np.pad(scipy.ndimage.gaussian_filter(field, 1.0), 1, constant_values=-fine)  # closed at the border
        self.require(int((field > 0).sum()))
        vertices, faces, _, _ = skimage.measure.marching_cubes(field, 0.0, gradient_direction="ascent")
        mesh = trimesh.Trimesh((vertices - 1) * fine + low, faces)
        largest = max(mesh.split(only_watertight=False), key=lambda piece: piece.area)
        return np.asarray(largest.vertices), np.asarray(largest.faces)


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """Return the distance (H, W) [px] of each pixel's centre from the outline of a mask (H, W), positive inside."""
    inside = mask > 127
    edge = scipy.ndimage.distance_transform_edt
    return np.where(inside, edge(inside) - 0.5, 0.5 - edge(~inside)).astype(np.float32)
