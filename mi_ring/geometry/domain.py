"""Domains. A domain is the surface from which Shape-Net's flow starts, and on which BRDF-Net is defined."""

from functools import lru_cache

import numpy as np
import torch
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from mi_ring.system import cache
from mi_ring.system.cached_arrays import environment, key_of, remembered
from mi_ring.system.optional import LazyPackage

gpytoolbox = LazyPackage("gpytoolbox", "a start from another surface than the sphere")  # its import takes a second

REMESHED = 5  #: the finest level that is made by remeshing; finer levels subdivide it
CANDIDATES = 16  #: random positions for each vertex
MAX_SAMPLES = 2**20  #: most points to take candidates from; from level 6 on, some vertices have fewer candidates


def closed_domain(
    mesh: trimesh.Trimesh, center: ArrayLike | None = None, radius: float | None = None
) -> tuple["Domain", np.ndarray, float]:
    """Make a domain of a closed mesh. Returns (domain, centre (3,) and radius of the sphere that normalises it).

    The domain is the surface (mesh − centre) / radius. Default of `center`: centre of the bounding box. Default of
    `radius`: mean distance of the vertices from the centre. Both are in units of the mesh. If `mesh` is inside out, its
    faces are flipped in place.
    """
    if mesh.volume < 0:
        mesh.invert()
    center = mesh.bounds.mean(0) if center is None else np.asarray(center)
    radius = radius or float(np.linalg.norm(mesh.vertices - center, axis=1).mean())
    return Domain((mesh.vertices - center) / radius, mesh.faces), center, radius


def transfer_points(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Find the place of points (N, 3) of a mesh after its vertices have moved. Returns (N, 3).

    `vertices` (V, 3), `faces` (F, 3): the mesh before. `others` (V, 3): its vertices after. A point keeps its
    barycentric coordinates. Points that are not on the mesh are first projected to it.
    """
    mesh = vertices.astype(float), faces.astype(np.int32)
    _, face, weights = gpytoolbox.squared_distance(points.astype(float), *mesh, use_cpp=True)
    return (others[faces[face]] * weights[..., None]).sum(1)


def normalized(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (N, 3) to length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@lru_cache(maxsize=4)
def samplings(kind: str, points: bytes, faces: bytes) -> tuple[dict, dict]:
    """Return two dicts that all domains of one surface share: meshes by level, and random surface points by level.

    They are empty at first. `kind`, `points`, `faces`: type and mesh of the domain, as a key. They are shared because
    it takes seconds to remesh a surface.
    """
    return {}, {}


class Domain:
    """A closed surface in the normalised frame, in which it is about as large as the unit sphere.

    It is given as a mesh with vertices (V, 3) and faces (F, 3). The method `sample` returns other meshes of the same
    surface, whose triangles are nearly equal in size.
    """

    def __init__(self, points: ArrayLike, faces: ArrayLike) -> None:
        self.points = np.asarray(points, np.float32)
        self.faces = np.asarray(faces, np.int64)
        self.levels: dict[int, tuple[Tensor, np.ndarray]]
        self.candidates: dict[int, Tensor]
        self.levels, self.candidates = samplings(type(self).__name__, self.points.tobytes(), self.faces.tobytes())

    def sample(self, level: int, random: torch.Generator | None = None) -> tuple[Tensor, np.ndarray]:
        """Return a mesh of the surface: vertices (V, 3) and faces (F, 3).

        F is about 20 · 4^level, as in an icosphere of this level. `random`: each call moves the vertices to other
        points of the surface; None: the vertices of a level are always the same. The faces of a level are always the
        same.
        """
        if level not in self.levels:
            vertices, triangles = self.triangulate(level)
            self.levels[level] = torch.from_numpy(np.asarray(vertices, np.float32)), np.asarray(triangles, np.int64)
        points, faces = self.levels[level]
        return (points if random is None else self.resample(level, points, random)), faces

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Test which points (N, 3) are inside the surface. Returns (N,) bool."""
        inside = np.linalg.norm(points, axis=1) < np.linalg.norm(self.points, axis=1).max()
        if inside.any():
            mesh = self.points.astype(float), self.faces.astype(np.int32)
            inside[inside] = gpytoolbox.fast_winding_number(points[inside], *mesh) > 0.5
        return inside

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the surface that are nearest to `points` (N, 3)."""
        return transfer_points(points, self.points, self.faces, self.points)

    def triangulate(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Make a mesh of the surface with about 20 · 4^level triangles. Returns (vertices (V, 3), faces (F, 3)).

        The cache folder keeps the mesh.
        """
        key = key_of("triangles", environment(), level, self.points, self.faces)
        vertices, faces = remembered(key, lambda: self.remesh(level))
        cache.prune()
        return vertices, faces

    def remesh(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mesh of `triangulate`: vertices (V, 3) and faces (F, 3).

        If it changes, change `cached_arrays.FORMAT`.
        """
        if level > REMESHED:
            points, faces = trimesh.remesh.subdivide(*self.sample(level - 1))
            return self.project(points), faces

        vertices, faces = (self.points, self.faces) if level == REMESHED else self.sample(level + 1)
        mesh = trimesh.Trimesh(np.asarray(vertices), faces)
        edge = np.sqrt(4 / np.sqrt(3) * mesh.area / (20 * 4**level))
        remesh = gpytoolbox.remesh_botsch  # outside `try`: InputError is a ValueError
        try:
            points, faces = remesh(mesh.vertices, mesh.faces.astype(np.int32), h=edge)
            remeshed = trimesh.Trimesh(points, faces)
            if remeshed.is_watertight and remeshed.euler_number == mesh.euler_number:
                return self.project(points), faces
        except ValueError:  # the surface touches itself along an edge
            pass
        points, faces = self.points, self.faces  # remeshed triangles are too large for the handles of the surface
        while len(faces) < 20 * 4**level:
            points, faces = trimesh.remesh.subdivide(points, faces)
        return points, faces

    def resample(self, level: int, points: Tensor, random: torch.Generator) -> Tensor:
        """Return new positions (V, 3) for the vertices of a level's mesh: random surface points near the old positions.

        `points` (V, 3): the old positions.
        """
        if level not in self.candidates:
            self.candidates[level] = self.find_candidates(level)
        chosen = torch.randint(CANDIDATES, (len(points),), generator=random)
        return self.candidates[level][torch.arange(len(points)), chosen]

    def find_candidates(self, level: int) -> Tensor:
        """Return `CANDIDATES` random points of the surface near each vertex of a level's mesh: (V, CANDIDATES, 3).

        If there are too few such points, some are repeated.
        """
        points, faces = self.sample(level)
        coarse = trimesh.Trimesh(points.numpy(), faces, process=False)
        fine = trimesh.Trimesh(self.points, self.faces, process=False)
        samples = min(4 * CANDIDATES * len(points), MAX_SAMPLES)
        dense, triangle = trimesh.sample.sample_surface(fine, samples, seed=level)
        longest = coarse.edges_unique_length[coarse.faces_unique_edges].max(1)
        height = 2 * coarse.area_faces / longest
        reach = np.full(len(points), np.inf)
        np.minimum.at(reach, faces, 0.45 * height[:, None])  # below half of the height no triangle can flip
        distance, nearest = cKDTree(coarse.vertices).query(dense)
        same_side = (fine.face_normals[triangle] * coarse.vertex_normals[nearest]).sum(1) > 0.5
        usable = (distance < reach[nearest]) & same_side
        order = np.argsort(nearest[usable], kind="stable")
        dense, nearest = dense[usable][order], nearest[usable][order]
        first, count = np.searchsorted(nearest, np.arange(len(points))), np.bincount(nearest, minlength=len(points))
        rank = np.arange(CANDIDATES) % np.maximum(count, 1)[:, None]
        found = dense[np.minimum(first[:, None] + rank, len(dense) - 1)]
        candidates = np.where(count[:, None, None] > 0, found, points.numpy()[:, None])
        return torch.from_numpy(candidates.astype(np.float32))


class Sphere(Domain):
    """The unit sphere. Its meshes are icospheres: 2,562 / 10,242 / 40,962 / 163,842 vertices at levels 4–7."""

    def __init__(self) -> None:
        icosahedron = trimesh.creation.icosahedron()
        super().__init__(icosahedron.vertices, icosahedron.faces)

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=1) < 1

    def project(self, points: np.ndarray) -> np.ndarray:
        return normalized(points)

    def triangulate(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        mesh = trimesh.creation.icosphere(subdivisions=level)
        return mesh.vertices, mesh.faces

    def resample(self, level: int, points: Tensor, random: torch.Generator) -> Tensor:
        """Return the vertices `points` (V, 3), all rotated by the same random rotation about the centre."""
        rotation = Rotation.from_quat(torch.randn(4, generator=random).numpy()).as_matrix()
        return points @ torch.as_tensor(rotation, dtype=torch.float32).T
