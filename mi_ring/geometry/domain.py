"""Domains: the canonical surfaces that Shape-Net's flow starts from and on which BRDF-Net is defined."""

from types import ModuleType

import numpy as np
import torch
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from mi_ring.system.optional import need

FINEST = 5  #: level up to which domains are remeshed; beyond it triangles are cut in four
PLACES = 16  #: for each vertex to be at
MOST_SAMPLES = 2**20  #: of the surface, among which they are found: from level 6 on some vertices have fewer places


def closed_domain(
    mesh: trimesh.Trimesh, center: ArrayLike | None = None, radius: float | None = None
) -> tuple["Domain", np.ndarray, float]:
    """The domain that a closed mesh is, with the normalising sphere: by default its middle and its mean radius."""
    if mesh.volume < 0:
        mesh.invert()
    center = mesh.bounds.mean(0) if center is None else np.asarray(center)
    radius = radius or float(np.linalg.norm(mesh.vertices - center, axis=1).mean())
    return Domain((mesh.vertices - center) / radius, mesh.faces), center, radius


def gpytoolbox() -> ModuleType:
    """The package, when it is needed: it takes a second. Raises InputError where it is not installed."""
    return need("gpytoolbox", "a start from another surface than the sphere")


def carried(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Points (N, 3), or those of the mesh nearest to them, as its triangles lie with `others` (V, 3) as vertices."""
    mesh = vertices.astype(float), faces.astype(np.int32)
    _, face, weights = gpytoolbox().squared_distance(points.astype(float), *mesh, use_cpp=True)
    return (others[faces[face]] * weights[..., None]).sum(1)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (N, 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


class Domain:
    """A closed surface in the normalised frame, given as a mesh, points (V, 3) and faces (F, 3), of any triangles.

    Its samplings are other meshes of the same surface, of near-uniform triangles.
    """

    def __init__(self, points: ArrayLike, faces: ArrayLike) -> None:
        self.points = np.asarray(points, np.float32)
        self.faces = np.asarray(faces, np.int64)
        self.levels: dict[int, tuple[Tensor, np.ndarray]] = {}
        self.places: dict[int, Tensor] = {}

    def sample(self, level: int, random: torch.Generator | None = None) -> tuple[Tensor, np.ndarray]:
        """Points (V, 3) and faces (F, 3): about as many as an icosphere of that level has, 20 · 4^level.

        With `random` the points are elsewhere on the surface each time, so that in the course of a fit all of it is
        seen and not only what the vertices stand on. The faces stay the same.
        """
        if level not in self.levels:
            vertices, triangles = self.triangulate(level)
            self.levels[level] = torch.from_numpy(np.asarray(vertices, np.float32)), np.asarray(triangles, np.int64)
        points, faces = self.levels[level]
        return (points if random is None else self.move(level, points, random)), faces

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (N, 3) are inside, (N,) bool."""
        inside = np.linalg.norm(points, axis=1) < np.linalg.norm(self.points, axis=1).max()
        if inside.any():
            mesh = self.points.astype(float), self.faces.astype(np.int32)
            inside[inside] = gpytoolbox().fast_winding_number(points[inside], *mesh) > 0.5
        return inside

    def project(self, points: np.ndarray) -> np.ndarray:
        """The points of the surface that are nearest to these (N, 3)."""
        return carried(points, self.points, self.faces, self.points)

    def triangulate(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        """The surface in about 20 · 4^level triangles."""
        if level > FINEST:
            points, faces = trimesh.remesh.subdivide(*self.sample(level - 1))
            return self.project(points), faces

        vertices, faces = (self.points, self.faces) if level == FINEST else self.sample(level + 1)
        mesh = trimesh.Trimesh(np.asarray(vertices), faces)
        edge = np.sqrt(4 / np.sqrt(3) * mesh.area / (20 * 4**level))
        package = gpytoolbox()  # its absence is not among the errors below
        try:
            points, faces = package.remesh_botsch(mesh.vertices, mesh.faces.astype(np.int32), h=edge)
            remeshed = trimesh.Trimesh(points, faces)
            if remeshed.is_watertight and remeshed.euler_number == mesh.euler_number:
                return self.project(points), faces
        except ValueError:  # the surface touches itself in an edge
            pass
        points, faces = self.points, self.faces  # else too coarse for the surface's handles
        while len(faces) < 20 * 4**level:
            points, faces = trimesh.remesh.subdivide(points, faces)
        return points, faces

    def move(self, level: int, points: Tensor, random: torch.Generator) -> Tensor:
        """Every point to one of the places around it, on the surface and well inside its cell."""
        if level not in self.places:
            self.places[level] = self.find_places(level)
        chosen = torch.randint(PLACES, (len(points),), generator=random)
        return self.places[level][torch.arange(len(points)), chosen]

    def find_places(self, level: int) -> Tensor:
        """Random points (V, PLACES, 3) of the surface around each point of a level."""
        points, faces = self.sample(level)
        coarse = trimesh.Trimesh(points.numpy(), faces, process=False)
        fine = trimesh.Trimesh(self.points, self.faces, process=False)
        samples = min(4 * PLACES * len(points), MOST_SAMPLES)
        dense, triangle = trimesh.sample.sample_surface(fine, samples, seed=level)
        longest = coarse.edges_unique_length[coarse.faces_unique_edges].max(1)
        height = 2 * coarse.area_faces / longest
        reach = np.full(len(points), np.inf)
        np.minimum.at(reach, faces, 0.45 * height[:, None])  # less than half of it: no triangle can turn over
        distance, nearest = cKDTree(coarse.vertices).query(dense)
        near = distance < reach[nearest]
        dense, triangle, nearest = dense[near], triangle[near], nearest[near]
        same_side = (fine.face_normals[triangle] * coarse.vertex_normals[nearest]).sum(1) > 0.5
        dense, nearest = dense[same_side], nearest[same_side]
        order = np.argsort(nearest, kind="stable")
        dense, nearest = dense[order], nearest[order]
        first, count = np.searchsorted(nearest, np.arange(len(points))), np.bincount(nearest, minlength=len(points))
        rank = np.arange(PLACES) % np.maximum(count, 1)[:, None]
        found = dense[np.minimum(first[:, None] + rank, len(dense) - 1)]
        places = np.where(count[:, None, None] > 0, found, points.numpy()[:, None])
        return torch.from_numpy(places.astype(np.float32))


class Sphere(Domain):
    """The unit sphere, sampled as an icosphere: 2,562 / 10,242 / 40,962 / 163,842 vertices at levels 4–7."""

    def __init__(self) -> None:
        icosahedron = trimesh.creation.icosahedron()
        super().__init__(icosahedron.vertices, icosahedron.faces)

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=1) < 1

    def project(self, points: np.ndarray) -> np.ndarray:
        return unit(points)

    def triangulate(self, level: int) -> tuple[np.ndarray, np.ndarray]:
        mesh = trimesh.creation.icosphere(subdivisions=level)
        return mesh.vertices, mesh.faces

    def move(self, level: int, points: Tensor, random: torch.Generator) -> Tensor:
        """All points by one rotation: the sphere looks the same from everywhere."""
        rotation = Rotation.from_quat(torch.randn(4, generator=random).numpy()).as_matrix()
        return points @ torch.as_tensor(rotation, dtype=torch.float32).T
