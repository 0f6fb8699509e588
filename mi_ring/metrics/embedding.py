"""Tests whether a surface is an embedding: it has no inverted triangles, and it does not cross itself.

A flow that is computed exactly makes an embedding.
"""

import numpy as np
import torch
from torch.nn import functional as F

from mi_ring.geometry.meshes import area_vectors
from mi_ring.objects.detail import DetailedFlow
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.system.optional import need

STEP = 1e-3  #: distance from a triangle of the points on its two sides, in the normalised frame


def inside_out(ring: FittedObject, s: torch.Tensor, faces: np.ndarray) -> np.ndarray:
    """Find the triangles that Shape-Net flattens or turns inside out. Returns (F,) bool: True for such a triangle.

    `s` (V, 3), `faces` (F, 3): a mesh of the domain. Shape-Net moves a point on the outer side of such a triangle to
    the inner side. For infinitely small triangles this means det ∂Φ/∂s ≤ 0, which is impossible for an exactly computed
    flow. A triangle that details turn by more than 90° is inside out, too.
    """
    flow = ring.shape_net.base.network if isinstance(ring.shape_net, DetailedFlow) else ring.shape_net
    s = s.to(ring.center.device)
    corners = torch.as_tensor(faces, device=s.device)

    with torch.no_grad():
        centres, normals = s[corners].mean(1), F.normalize(area_vectors(s, corners), dim=1)
        outward = flow(centres + STEP * normals) - flow(centres - STEP * normals)
        smooth, found = area_vectors(flow(s), corners), area_vectors(ring.shape_net(s), corners)
        return (((smooth * outward).sum(1) <= 0) | ((smooth * found).sum(1) <= 0)).cpu().numpy()


def exactly_crossing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Find the triangles that intersect another triangle, in exact arithmetic.

    Returns (F,) bool: True for such a triangle. Neighbours do not count, as long as they have only their common edge or
    vertex in common. All other contacts count. Raises InputError if the package libigl is not installed.
    """
    need("igl", "the exact count of crossing triangles", "libigl")
    from igl.copyleft.cgal import remesh_self_intersections

    # Item 2 of the result: pairs of intersecting faces.
    pairs = remesh_self_intersections(np.asarray(vertices, float), np.asarray(faces, np.int64), detect_only=True)[2]
    crossing = np.zeros(len(faces), bool)
    crossing[np.asarray(pairs, int).ravel()] = True
    return crossing
