"""A map between a domain and the unit sphere. With two such maps, points of two domains correspond to each other."""

import numpy as np
import trimesh
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere, gpytoolbox, normalized, transfer_points
from mi_ring.geometry.meshes import genus

LEVEL = 4  #: of the domain's mesh that is mapped
STEPS, STEP = 40, 0.1  #: number and length of the steps of the curvature flow, for the surface area of the sphere


class SphericalMap:
    """A conformal one-to-one map between a domain and the unit sphere. It rotates the domain as little as possible.

    Raises InputError if the domain has handles or several pieces. The message begins with `name`.
    """

    def __init__(self, domain: Domain, name: str = "domain") -> None:
        self.identity = isinstance(domain, Sphere)
        if self.identity:
            return
        points, faces = domain.sample(LEVEL)
        self.points, self.faces = points.numpy().astype(float), faces.astype(np.int32)
        mesh = trimesh.Trimesh(self.points, self.faces, process=False)
        if genus(mesh) or mesh.body_count > 1:
            shape = f"{genus(mesh)} handles and {mesh.body_count} pieces"
            what = f"was fitted from a surface of {shape}, which cannot be mapped to another"
            raise InputError(f"{name}: {what}; fit both with the same --domain, sphere or mesh FILE")
        self.directions = sphere_directions(self.points, self.faces)
        outward = self.points - mesh.center_mass
        turn, _ = Rotation.align_vectors(outward, self.directions, np.linalg.norm(outward, axis=1))
        self.directions = turn.apply(self.directions)

    def to_sphere(self, points: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the sphere that correspond to `points` (N, 3) of the domain."""
        if self.identity:
            return points
        return normalized(transfer_points(points, self.points, self.faces, self.directions))

    def to_domain(self, directions: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the domain that correspond to points (N, 3) of the sphere."""
        return directions if self.identity else transfer_points(directions, self.directions, self.faces, self.points)


def sphere_directions(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Map the vertices (V, 3) of a closed surface without handles conformally to the unit sphere. Returns (V, 3).

    The method is "Can Mean-Curvature Flow Be Made Non-Singular?" (Kazhdan, Solomon and Ben-Chen, SGP 2012): mean
    curvature flow that keeps the Laplacian of the given surface in all steps. It does not pinch off thin parts, and
    ends on a sphere.
    """
    laplacian = gpytoolbox.cotangent_laplacian(points, faces)
    x = points
    for _ in range(STEPS):
        area = trimesh.Trimesh(x, faces, process=False).area
        x = x * np.sqrt(4 * np.pi / area)
        mass = gpytoolbox.massmatrix(x, faces)
        x = splu((mass + STEP * laplacian).tocsc()).solve(mass @ x)
        x = x - mass.diagonal() @ x / mass.diagonal().sum()
    return normalized(x)


def even_directions(count: int) -> np.ndarray:
    """Return `count` unit vectors (count, 3), evenly spaced: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)
