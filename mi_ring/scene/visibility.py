"""Finds which parts of a surface the photographs show."""

from collections.abc import Sequence
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import torch

from mi_ring.geometry.camera import Camera
from mi_ring.geometry.meshes import area_vectors
from mi_ring.scene.alignment import to_flat, to_vectors
from mi_ring.scene.assembly import RenderedObject
from mi_ring.scene.plain_mesh import mesh_of

#: Least cosine between normal and direction to the camera. At a smaller angle to the surface, a pixel covers more than
#: five times as much of it; there the normals of two captures of one object differed by 25 to 50 degrees.
GRAZING = 0.2
SURFACE_OFFSET = 1e-5  #: of rays from the surface, for a mesh of size 1: more than float32's rounding error


class MaskedCamera(NamedTuple):
    """The camera of a photograph, and which of its pixels are valid."""

    camera: Camera
    valid: np.ndarray | None  #: (H, W) uint8, 0 where a pixel is not valid; None if all are


class Visibility:
    """Tests which points of a mesh are seen by at least one of the cameras `views`.

    A camera sees a point if its line of sight meets the front of the surface at about 12 degrees or more (`GRAZING`),
    if the point projects to a valid pixel, and if the mesh does not hide it.
    `vertices` (V, 3) [scene units], `faces` (F, 3): the mesh.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, views: Sequence[MaskedCamera]) -> None:
        self.vertices = np.asarray(vertices, float)
        low, high = self.vertices.min(0), self.vertices.max(0)
        self.center, self.size = (low + high) / 2, (high - low).max()
        self.mesh = mesh_of((self.vertices - self.center) / self.size, faces)  # for float32
        self.scene = mi.load_dict({"type": "scene", "mesh": self.mesh})
        # Photographs that differ in their light alone show the same.
        keys = [(v.camera.key, id(v.valid)) for v in views]
        self.views = list(dict(zip(keys, views)).values())

    def of_vertices(self) -> np.ndarray:
        """Test all vertices of the mesh. Returns (V,) bool: True if at least one camera sees the vertex.

        Its normal is the smooth one.
        """
        return self.of_points(self.vertices, np.array(mi.traverse(self.mesh)["vertex_normals"]).reshape(-1, 3))

    def of_points(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Test points of the surface. Returns (N,) bool: True if at least one camera sees the point.

        `points` (N, 3): [scene units]. `normals` (N, 3): unit normals at the points.
        """
        points, normals = np.asarray(points, float), np.asarray(normals, float)  # trimesh has arrays of its own
        seen = np.zeros(len(points), bool)
        for view in self.views:
            unseen = np.flatnonzero(~seen)
            seen[unseen] = self.seen_by(view, points[unseen], normals[unseen])
        return seen

    def seen_by(self, view: MaskedCamera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Test points (N, 3) [scene units] with unit normals (N, 3) for one camera. Returns (N,) bool."""
        seen = np.zeros(len(points), bool)
        toward = view.camera.position - points
        lanes = np.flatnonzero((normals * toward).sum(1) > GRAZING * np.linalg.norm(toward, axis=1))
        lanes = lanes[in_picture(view, points[lanes])]
        if not len(lanes):  # Dr.Jit traces no empty arrays
            return seen
        start = (points[lanes] - self.center) / self.size + SURFACE_OFFSET * normals[lanes]
        along = (view.camera.position - self.center) / self.size - start
        distance = np.linalg.norm(along, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(to_vectors(start)), to_vectors(along / distance))
        ray.maxt = to_flat(mi.Float, distance)
        seen[lanes] = ~np.array(self.scene.ray_test(ray))
        return seen


def in_picture(view: MaskedCamera, points: np.ndarray) -> np.ndarray:
    """Test which points are in front of a camera and project to a valid pixel. Returns (N,) bool.

    `points` (N, 3): [scene units]. Whether something hides a point is not tested.
    """
    pixels, depth = view.camera.project(points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < view.camera.size).all(1)
    if view.valid is not None:
        column, row = pixels[inside].astype(int).T
        inside[inside] = view.valid[row, column] > 127
    return inside


def visible_points(
    ring: RenderedObject, s: np.ndarray, faces: np.ndarray, views: Sequence[MaskedCamera]
) -> tuple[np.ndarray, float]:
    """Find what the photographs show of an object. Returns (seen (V,) bool, share of the surface that is not seen).

    `seen` is True for the vertices that at least one photograph shows. `s` (V, 3): vertices on the domain of `ring`,
    the start surface. `faces` (F, 3): triangles. `views`: cameras of the photographs.
    """
    with torch.no_grad():
        vertices = ring.surface(torch.as_tensor(s, device=ring.center.device)).cpu()
    seen = Visibility(vertices.numpy(), faces, views).of_vertices()
    areas = area_vectors(vertices.double(), torch.as_tensor(faces)).norm(dim=1).numpy()
    return seen, float((areas * (~seen)[faces].mean(1)).sum() / areas.sum())
