"""The texture of a fitted object, which is finer than its mesh: colours at the points of a lattice in each triangle."""

import math
import weakref
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.scene.alignment import to_flat
from mi_ring.scene.mesh_attributes import fine_textures

MOST, AT_ONCE = 8_000_000, 2**19  #: points of all lattices, and of those that are computed at once
MEASURED = 100_000  #: triangles whose edges are measured
ROUND = 1e-4  #: a domain is the unit sphere if its vertices are this close to it


class Lattice(NamedTuple):
    """Factors of a colour on a lattice in each triangle of a mesh, see the plugin `fine_attribute`."""

    factors: Any  #: flat Float, three per point
    divisions: int
    low: float  #: least and largest colour after multiplication
    high: float


#: By the material: what its last lattice was made of, the triangles and points, and the lattice. A film shows one
#: texture in many states. The points are kept because others could get their memory, and so their stamp.
latest: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


def write_texture(shape: mi.Mesh, net: Any, s: Tensor, faces: np.ndarray) -> None:
    """Give the texture of a material to the `fine_attribute` that reads the albedo of a shape's BSDF.

    If the material has no texture, that of the shape is removed. `net`: a `MaterialNet`. `s` (V, 3): vertices on its
    domain. `faces` (F, 3): triangles. In scalar, spectral and monochrome variants, there is no texture.
    """
    remove_texture(shape)
    cell, albedo = net.texture_cell(), net.albedo
    textures = [texture for texture in fine_textures(shape.bsdf()) if albedo and texture.attribute == albedo.attribute]
    if not textures or cell is None or not mi.is_rgb or mi.variant().startswith("scalar"):
        return
    made_of = mi.variant(), stamp(s, *net.parameters(), *net.buffers())
    known, same_faces, _, lattice = latest.get(net, (None, None, None, None))
    if known != made_of or same_faces is not faces:
        divisions = divisions_for(s, faces, cell)
        factors = to_flat(mi.Float, factors_at(net, s.cpu(), np.ascontiguousarray(faces, np.int64), divisions))
        lattice = Lattice(factors, divisions, albedo.low, albedo.high)
        latest[net] = made_of, faces, s.detach(), lattice
    for texture in textures:
        own = mi.Float(lattice.factors)  # so that changes by `mi.traverse` change no other shape
        texture.set_lattice(shape, lattice._replace(factors=own))


def remove_texture(shape: mi.Mesh) -> None:
    """Let the textures `fine_attribute` of a shape's BSDF show the mesh attribute alone."""
    for texture in fine_textures(shape.bsdf()):
        texture.set_lattice(shape, None)


@torch.no_grad()
def factors_at(net: Any, s: Tensor, faces: np.ndarray, divisions: int) -> np.ndarray:
    """Compute the texture of a material at the points of the lattices: (F · n, 3)."""
    shares, parts = lattice_points(divisions), []
    is_sphere = bool(((s.norm(dim=1) - 1).abs() < ROUND).all())
    for corners in torch.from_numpy(faces).split(max(1, AT_ONCE // len(shares))):
        points = torch.einsum("nk,fkc->fnc", shares, s[corners]).reshape(-1, 3)
        if is_sphere:  # the middle of a large triangle is far from the surface, where a texture may have no values
            points = torch.nn.functional.normalize(points, dim=1)
        parts.append(net.texture(points.to(net.scale.device)).cpu().numpy())
    return np.concatenate(parts)


def lattice_points(divisions: int) -> Tensor:
    """Return the barycentric coordinates (n, 3) of the points of a lattice, in the order of `fine_attribute`."""
    j, i = np.indices((divisions + 1, divisions + 1)).reshape(2, -1)
    shares = np.stack([divisions - i - j, i, j], 1)[i + j <= divisions]
    return torch.from_numpy(shares.astype(np.float32) / divisions)


def divisions_for(s: Tensor, faces: np.ndarray, cell: float) -> int:
    """Choose the divisions of lattices whose points are about `cell` apart.

    `s` (V, 3), `faces` (F, 3): the triangles. There are at most `MOST` points, unless one division has more.
    """
    corners = s.cpu()[torch.from_numpy(np.ascontiguousarray(faces[:: 1 + len(faces) // MEASURED], np.int64))]
    edges = (corners - corners.roll(1, 1)).norm(dim=-1).ravel()
    most = math.floor(math.sqrt(2 * MOST / len(faces) + 0.25) - 1.5)  # (n + 1)(n + 2) / 2 points in each triangle
    return max(1, min(math.ceil(float(edges.quantile(0.9)) / cell), most))


def stamp(*tensors: Tensor) -> tuple:
    """Return a value that stays the same until one of the tensors is another one or is changed in place.

    Another tensor may get the memory of one that is gone. So keep them as long as the stamp.
    """
    return tuple((t.data_ptr(), t.shape, 0 if t.is_inference() else t._version) for t in tensors)
