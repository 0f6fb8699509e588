"""Texture atlases: unwraps the fitted surface, and bakes the networks into images.

The networks are functions on the domain, which is the start surface of the fit in the normalised frame.
"""

from dataclasses import dataclass
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import scipy.ndimage
import torch
import trimesh

from mi_ring.objects.fitted_object import FittedObject
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.system.optional import need
from mi_ring.system.progress import progress

MAX_CUT_LEVEL = 5  #: finest level that is unwrapped: the time grows with the square of the number of triangles
PADDING = 4  #: between charts [texels]
CHUNK = 2**17  #: texels that are computed at once


class Atlas(NamedTuple):
    """A mesh of the fitted surface with texture coordinates. A vertex on a seam occurs once for each chart."""

    s: np.ndarray  # (V, 3) domain points
    uv: np.ndarray  # (V, 2) in [0, 1], the first texel at (0, 0)
    vertices: np.ndarray  # (V, 3) [scene units]
    normals: np.ndarray  # (V, 3), the same on both sides of seams
    tangents: np.ndarray  # (V, 4), as in glTF: along u, and the sign of the bitangent n × t
    faces: np.ndarray  # (F, 3)
    uncut: np.ndarray  # (V,) index of the vertex before unwrapping: the same on both sides of seams
    subdivisions: int


def unwrap(ring: FittedObject, subdivisions: int, resolution: int = 1024, time: float = 1.0) -> Atlas:
    """Unwrap the fitted surface into one square texture, by xatlas (Young 2018, after Thekla). Returns the mesh.

    `subdivisions`: level of the mesh; it has about 10 · 4^level vertices. `resolution`: width of the texture [texels],
    which sets the gap between charts. `time`: state of the deformation, from 0 (start surface) to 1 (fitted object).
    Raises InputError if the package xatlas is not installed.
    """
    points, faces = ring.domain.sample(min(subdivisions, MAX_CUT_LEVEL))
    xatlas = need("xatlas", "textures")
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = resolution, PADDING, True
    charts = xatlas.Atlas()
    charts.add_mesh(flow_points(ring, points.numpy(), time), faces.astype(np.uint32))  # normalised: it drops tiny faces
    charts.generate(pack_options=options)
    origin, faces, uv = charts[0]
    s, uv, faces = points.numpy()[origin], np.clip(uv, 0, 1), faces.astype(np.int64)
    for _ in range(subdivisions - MAX_CUT_LEVEL):
        s, uv, faces = subdivide(ring, s, uv, faces)
    return assemble(ring, s, uv, faces, subdivisions, time)


def flow_points(ring: FittedObject, s: np.ndarray, time: float = 1.0) -> np.ndarray:
    """Deform points `s` (V, 3) of the domain. Returns the points (V, 3) of the surface in the normalised frame.

    `time`: state of the deformation, from 0 (start surface, the domain itself) to 1 (fitted object).
    """
    with torch.no_grad():
        return ring.shape_net(torch.from_numpy(s.astype(np.float32)).to(ring.center.device), time).cpu().numpy()


def subdivide(
    ring: FittedObject, s: np.ndarray, uv: np.ndarray, faces: np.ndarray, *more: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Subdivide every triangle of a mesh into four. Returns the new arrays (s, uv, faces, more…) in this order.

    `s` (V, 3): vertices, points of the domain. `uv` (V, 2): texture coordinates. `faces` (F, 3): triangles. `more`:
    other arrays (V, n) with values of the vertices. New vertices are projected onto the domain; their `uv` and `more`
    are means.
    """
    attributes = dict(enumerate((uv, *more)))
    finer, faces, attributes = trimesh.remesh.subdivide(s.astype(float), faces, vertex_attributes=attributes)
    finer[len(s) :] = ring.domain.project(finer[len(s) :])
    uv, *more = attributes.values()
    return finer.astype(np.float32), uv, faces, *more


def assemble(
    ring: FittedObject, s: np.ndarray, uv: np.ndarray, faces: np.ndarray, subdivisions: int, time: float
) -> Atlas:
    """Compute positions, normals and tangents of a mesh that has texture coordinates. Returns the complete atlas.

    `s` (V, 3): points of the start surface, one for each vertex; Shape-Net deforms them into the object. `uv` (V, 2):
    texture coordinates. `faces` (F, 3): triangles. `subdivisions`: level of this mesh, which the atlas keeps. `time`:
    state of the deformation, from 0 (start surface) to 1 (fitted object).
    """
    points, normals, uncut = seamless_surface(ring, s, faces, time)
    # The derivative of the position with respect to u: constant on a triangle, at vertices the mean weighted by area.
    (e1, e2), (d1, d2) = ([x[faces[:, k]] - x[faces[:, 0]] for k in (1, 2)] for x in (points, uv))
    sign = np.sign(d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0])
    along = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * sign[:, None]
    incidence = trimesh.geometry.index_sparse(len(s), faces)  # (V, F): which triangles a vertex belongs to
    tangents, signs = incidence @ along, incidence @ sign
    tangents -= (tangents * normals).sum(1, keepdims=True) * normals
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    aside = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])  # for a zero derivative, any direction
    tangents = np.where(length > 0, tangents / np.maximum(length, 1e-30), aside)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    # In glTF u points right and v down, so that the bitangent n × t points to smaller v.
    tangents = np.hstack([tangents, np.where(signs < 0, 1.0, -1.0)[:, None]])
    vertices = ring.center.cpu().numpy() + float(ring.radius) * points
    return Atlas(s, uv, vertices, normals, tangents, faces, uncut, subdivisions)


def seamless_surface(
    ring: FittedObject, s: np.ndarray, faces: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute positions and normals of a mesh whose vertices are duplicated along seams. Normals have no seams.

    `s` (V, 3): points of the domain, one for each vertex. `faces` (F, 3): triangles. `time`: state of the deformation,
    from 0 (start surface) to 1 (fitted object). Returns (positions (V, 3) in the normalised frame, unit normals (V, 3),
    vertex numbers (V,), which are equal for duplicates of one vertex).
    """
    unique, uncut = np.unique(s, axis=0, return_inverse=True)
    uncut = uncut.ravel()
    points = flow_points(ring, unique, time)
    normals = trimesh.Trimesh(points, uncut[faces], process=False).vertex_normals
    return points[uncut], normals[uncut], uncut


@dataclass(frozen=True)
class Texels:
    """The texels of a square texture. A texel outside of all charts copies the nearest texel in a chart."""

    s: np.ndarray  # (N, 3) domain points of the N texels in charts
    normals: np.ndarray  # (N, 3) unit normals in the tangent frame of the atlas: along t, the bitangent, n
    index: np.ndarray  # (resolution, resolution) texel, 0 … N − 1


def rasterise(ring: FittedObject, atlas: Atlas, resolution: int, time: float = 1.0) -> Texels:
    """Compute the domain point and the normal of each texel of an atlas.

    `resolution`: width and height of the texture [texels]. `time`: state of the deformation for which the atlas was
    made, from 0 (start surface) to 1 (fitted object). If `ring.subdivisions` is finer than the mesh of the atlas, the
    normals come from this finer mesh.
    """
    bitangents = np.cross(atlas.normals, atlas.tangents[:, :3]) * atlas.tangents[:, 3:]
    s, uv, faces, *frame = atlas.s, atlas.uv, atlas.faces, atlas.tangents[:, :3], bitangents, atlas.normals
    for _ in range(ring.subdivisions - atlas.subdivisions):
        s, uv, faces, *frame = subdivide(ring, s, uv, faces, *frame)
    finer = len(faces) > len(atlas.faces)
    normals = seamless_surface(ring, s, faces, time)[1] if finer else atlas.normals

    scene = mi.load_dict({"type": "scene", "atlas": mesh_of(np.pad(uv, ((0, 0), (0, 1))), faces, normals=False)})
    inside = np.zeros((resolution, resolution), bool)
    parts = []
    for rows in np.array_split(np.arange(resolution), -(-(resolution**2) // CHUNK)):
        y, x = np.meshgrid(rows, np.arange(resolution), indexing="ij")
        centre = mi.Point3f(*(to_flat(mi.Float, (k + 0.5) / resolution) for k in (x, y)), 1)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(centre, mi.Vector3f(0, 0, -1)))
        shown = np.array(hit.is_valid())
        inside[rows] = shown.reshape(x.shape)
        corners = faces[np.array(hit.prim_index)[shown]]
        b = np.array(hit.prim_uv).T[shown]
        weights = np.stack([1 - b.sum(1), b[:, 0], b[:, 1]], 1)[..., None]
        found = [(values[corners] * weights).sum(1) for values in (s, normals, *frame)]
        parts.append((found[0].astype(np.float32), in_frame(*found[1:]).astype(np.float32)))
    number = np.cumsum(inside, dtype=np.int32).reshape(inside.shape) - 1
    nearest = scipy.ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    points, local = map(np.concatenate, zip(*parts))
    return Texels(points, local, number[tuple(nearest)])


def in_frame(m: np.ndarray, t: np.ndarray, b: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return unit vectors (x, y, z) (N, 3) in a tangent frame: x t + y b + z n has the direction of `m` (N, 3).

    `t`, `b`, `n` (N, 3): the interpolated tangent, bitangent and normal of the mesh, as a renderer has them.
    """
    n, t, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (n, t, b))
    local = np.stack([(np.cross(p, q) * m).sum(1) for p, q in ((b, n), (n, t), (t, b))], 1)
    local *= np.sign((np.cross(b, n) * t).sum(1, keepdims=True))
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def reflectances(ring: FittedObject, s: np.ndarray) -> dict[str, np.ndarray]:
    """Evaluate the material network at points `s` (N, 3) of the domain, with its finest texture.

    Returns the BSDF parameters as arrays (N, 3) or (N,), with the parameters' names as keys.
    """
    with torch.no_grad():
        chunks = torch.from_numpy(s).to(ring.center.device).split(CHUNK)
        parts = [ring.brdf_net.fine(chunk) for chunk in progress(chunks, "baking", disable=len(chunks) < 3 or None)]
    return {name: torch.cat([part[name] for part in parts]).cpu().numpy() for name in parts[0]}
