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

    def sample(self, subdivisions: int, rotation: Tensor | None = None) -> tuple[Tensor, np.ndarray]:
        """Points (V, 3), faces (F, 3): no fewer faces than an icosphere of that level has. `rotation` is unused."""
        points, faces = self.points, self.faces
        while len(faces) < 20 * 4**subdivisions:
            points, faces = trimesh.remesh.subdivide(points, faces)
        return torch.from_numpy(np.asarray(points, np.float32)), faces


class Sphere(Domain):
    """The unit sphere, sampled as an icosphere: 2,562 / 10,242 / 40,962 / 163,842 vertices at levels 4–7."""

    def __init__(self):
        self.levels: dict[int, trimesh.Trimesh] = {}

    def sample(self, subdivisions: int, rotation: Tensor | None = None) -> tuple[Tensor, np.ndarray]:
        """Points (V, 3) and faces (F, 3) of the icosphere, its points turned by `rotation` (3, 3)."""
        if subdivisions not in self.levels:
            self.levels[subdivisions] = trimesh.creation.icosphere(subdivisions=subdivisions)
        mesh = self.levels[subdivisions]
        points = torch.from_numpy(np.asarray(mesh.vertices, np.float32))
        return (points if rotation is None else points @ rotation.T), mesh.faces
