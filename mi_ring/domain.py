"""Domains: the canonical surfaces that Shape-Net's flow starts from and on which BRDF-Net is defined."""

import numpy as np
import torch
import trimesh
from torch import Tensor


class Domain:
    """A closed triangle mesh in the normalised frame, sampled ever finer by midpoint subdivision.

    `points` (V, 3) and `faces` (F, 3) hold the coarsest sampling.
    """

    def __init__(self, points, faces):
        self.points = np.asarray(points, np.float32)
        self.faces = np.asarray(faces, np.int64)
        self.levels: dict[int, tuple[Tensor, np.ndarray]] = {}

    def sample(self, subdivisions: int, rotation: Tensor | None = None) -> tuple[Tensor, np.ndarray]:
        """Points (V, 3) and faces (F, 3): no fewer faces than an icosphere of that level has.

        `rotation` (3, 3) turns the points of a sphere, which looks the same from everywhere, and of no other domain.
        """
        if subdivisions not in self.levels:
            points, faces = self.subdivide(subdivisions)
            self.levels[subdivisions] = torch.from_numpy(np.asarray(points, np.float32)), faces
        return self.levels[subdivisions]

    def subdivide(self, subdivisions: int):
        points, faces = self.points, self.faces
        while len(faces) < 20 * 4**subdivisions:
            points, faces = trimesh.remesh.subdivide(points, faces)
        return points, faces


class Sphere(Domain):
    """The unit sphere, sampled as an icosphere: 2,562 / 10,242 / 40,962 / 163,842 vertices at levels 4–7."""

    def __init__(self):
        icosahedron = trimesh.creation.icosahedron()
        super().__init__(icosahedron.vertices, icosahedron.faces)

    def sample(self, subdivisions: int, rotation: Tensor | None = None) -> tuple[Tensor, np.ndarray]:
        points, faces = super().sample(subdivisions)
        return (points if rotation is None else points @ rotation.T), faces

    def subdivide(self, subdivisions: int):
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
        return mesh.vertices, mesh.faces
