"""Between domains and the unit sphere: the map by which materials of objects from different starts correspond."""

import numpy as np
import trimesh
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere, carried, gpytoolbox, unit
from mi_ring.geometry.meshes import genus

LEVEL = 4  #: of the mesh that is mapped
STEPS, STEP = 40, 0.1  #: of the curvature flow, on a surface of the sphere's area


class SphericalMap:
    """A map of a domain onto the unit sphere and back, one to one and conformal, turned as little as can be.

    Raises InputError, which begins with `name`, for a domain with handles or of several pieces: there is none.
    """

    def __init__(self, domain: Domain, name: str = "domain") -> None:
        self.same = isinstance(domain, Sphere)
        if self.same:
            return
        points, faces = domain.sample(LEVEL)
        self.points, self.faces = points.numpy().astype(float), faces.astype(np.int32)
        mesh = trimesh.Trimesh(self.points, self.faces, process=False)
        if genus(mesh) or mesh.body_count > 1:
            shape = f"{genus(mesh)} handles and {mesh.body_count} pieces"
            what = f"was fitted from a surface of {shape}, whose points correspond to none of another"
            raise InputError(f"{name}: {what}; fit both with the same --domain, sphere or mesh FILE")
        self.directions = rounded(self.points, self.faces)
        outward = self.points - mesh.center_mass
        turn, _ = Rotation.align_vectors(outward, self.directions, np.linalg.norm(outward, axis=1))
        self.directions = turn.apply(self.directions)

    def to_sphere(self, points: np.ndarray) -> np.ndarray:
        """Where points (N, 3) of the domain are on the sphere."""
        return points if self.same else unit(carried(points, self.points, self.faces, self.directions))

    def to_domain(self, directions: np.ndarray) -> np.ndarray:
        """Which points (N, 3) of the domain are there."""
        return directions if self.same else carried(directions, self.directions, self.faces, self.points)


def rounded(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vectors (V, 3) for the vertices of a closed surface without handles, which its triangles map conformally.

    By the flow of "Can Mean-Curvature Flow Be Made Non-Singular?" (Kazhdan, Solomon and Ben-Chen, SGP 2012): as mean
    curvature flow, but with the Laplacian of the first surface throughout. No limb is pinched off; it ends on a sphere.
    """
    laplacian = gpytoolbox().cotangent_laplacian(points, faces)
    x = points
    for _ in range(STEPS):
        area = trimesh.Trimesh(x, faces, process=False).area
        x = x * np.sqrt(4 * np.pi / area)
        mass = gpytoolbox().massmatrix(x, faces)
        x = splu((mass + STEP * laplacian).tocsc()).solve(mass @ x)
        x = x - mass.diagonal() @ x / mass.diagonal().sum()
    return unit(x)
