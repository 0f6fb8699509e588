"""Whether a surface is what a flow can make: no triangle turned inside out, none that crosses another."""

import numpy as np
import torch
from torch.nn import functional as F

from mi_ring.objects.fitted_object import FittedObject
from mi_ring.system.optional import need

STEP = 1e-3  #: from a triangle to both sides, in the normalised frame


def inside_out(ring: FittedObject, s: torch.Tensor, faces: np.ndarray) -> np.ndarray:
    """Which triangles (F,) bool of a sampling of the domain, points (V, 3), Shape-Net flattens or turns inside out.

    Those for which what lay on their outer side lies on their inner side afterwards: det ∂Φ/∂s ≤ 0 there, if triangles
    were infinitely small. A flow, solved exactly, has none.
    """
    s = s.to(ring.center.device)
    corners = torch.as_tensor(faces, device=s.device)

    def crosses(points: torch.Tensor) -> torch.Tensor:
        a, b, c = points[corners].unbind(1)
        return torch.linalg.cross(b - a, c - a)

    with torch.no_grad():
        centres, normals = s[corners].mean(1), F.normalize(crosses(s), dim=1)
        outward = ring.shape_net(centres + STEP * normals) - ring.shape_net(centres - STEP * normals)
        return ((crosses(ring.shape_net(s)) * outward).sum(1) <= 0).cpu().numpy()


def exactly_crossing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles (F,) bool cross another, by exact arithmetic: CGAL's, in the package libigl (extra `exact`).

    The reference for `mi_ring.scene.self_intersections`, faster and without other packages; those that overlap in
    a plane, or touch, count as well. Raises InputError if it is not installed.
    """
    need("igl", "the exact count of crossing triangles", "libigl")
    from igl.copyleft.cgal import remesh_self_intersections

    # Vertices and faces, remeshed; pairs of faces that intersect; and which face and vertex came from which.
    pairs = remesh_self_intersections(np.asarray(vertices, float), np.asarray(faces, np.int64), detect_only=True)[2]
    crossing = np.zeros(len(faces), bool)
    crossing[np.asarray(pairs, int).ravel()] = True
    return crossing
