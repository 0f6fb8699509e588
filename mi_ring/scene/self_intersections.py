"""Finds self-intersections of a mesh."""

import mitsuba as mi
import numpy as np

from mi_ring.scene.alignment import to_flat, to_vectors
from mi_ring.scene.plain_mesh import scene_of

HIT_OFFSET = 1e-6  #: step of a ray past a hit, for a mesh of size 1: more than float32's rounding error


def crossing_triangles(vertices, faces) -> np.ndarray:
    """Find self-intersections of a mesh. Returns (F,) bool: True for each triangle that crosses another one.

    `vertices` (V, 3), `faces` (F, 3): the mesh, in which neighbours share vertices. Two triangles cross if an edge of
    one pierces the other; both are then True. Triangles that only touch at a shared vertex or edge do not cross.
    Triangles that overlap in one plane are not found. All edges are traced as rays.
    """
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    low, high = vertices.min(0), vertices.max(0)
    vertices = (vertices - (low + high) / 2) / (high - low).max()  # for float32
    scene, crossing = scene_of(vertices, faces), np.zeros(len(faces), bool)
    # Each edge once; `edge_of` has the edges of each triangle.
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, edge_of = np.unique(sides, axis=0, return_inverse=True)
    pierces = np.zeros(len(edges), bool)
    origin, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along, reached = along / np.maximum(length, 1e-30)[:, None], np.zeros(len(edges))
    lanes = np.flatnonzero(length > 0)
    while len(lanes):
        start = origin[lanes] + along[lanes] * reached[lanes, None]
        ray = mi.Ray3f(mi.Point3f(to_vectors(start)), to_vectors(along[lanes]))
        ray.maxt = to_flat(mi.Float, (length - reached)[lanes])
        hit = scene.ray_intersect_preliminary(ray)
        valid, t, triangle = (np.array(a) for a in (hit.is_valid(), hit.t, hit.prim_index))
        lanes, t, triangle = lanes[valid], t[valid], triangle[valid]
        apart = (faces[triangle][:, :, None] != edges[lanes][:, None]).all((1, 2))
        crossing[triangle[apart]] = pierces[lanes[apart]] = True
        reached[lanes] += t + HIT_OFFSET
        lanes = lanes[reached[lanes] < length[lanes]]
    return crossing | pierces[edge_of].reshape(-1, 3).any(1)
