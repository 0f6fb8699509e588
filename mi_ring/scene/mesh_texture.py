"""The texture of a fitted object, which is finer than its mesh: colours at the points of a lattice in each triangle."""

import math
from typing import Any

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.scene.alignment import to_flat
from mi_ring.scene.mesh_attributes import fine_textures

MOST, AT_ONCE = 8_000_000, 2**20  #: points of all lattices, and of those that are computed at once
MEASURED = 100_000  #: triangles whose edges are measured


def write_texture(bsdf: mi.BSDF, net: Any, s: Tensor, faces: np.ndarray) -> None:
    """Give the texture of a material to the textures `fine_attribute` of a BSDF, or remove theirs if it has none.

    `net`: a `MaterialNet`. `s` (V, 3): vertices on its domain. `faces` (F, 3): triangles. In scalar and spectral
    variants, there is no texture.
    """
    remove_texture(bsdf)
    textures, cell = fine_textures(bsdf), net.texture_cell()
    if not textures or cell is None or not mi.is_rgb or mi.variant().startswith("scalar"):
        return
    divisions = divisions_for(s, faces, cell)
    shares, parts = lattice(divisions), []
    with torch.no_grad():
        for corners in torch.from_numpy(np.asarray(faces, np.int64)).split(max(1, AT_ONCE // len(shares))):
            points = torch.einsum("nk,fkc->fnc", shares, s.cpu()[corners])
            parts.append(net.texture(points.reshape(-1, 3).to(net.scale.device)).cpu().numpy())
    factors = to_flat(mi.Float, np.concatenate(parts))
    for texture in textures:
        texture.set_factors(factors, divisions)


def remove_texture(bsdf: mi.BSDF) -> None:
    """Let the textures `fine_attribute` of a BSDF show the mesh attribute alone."""
    for texture in fine_textures(bsdf):
        texture.set_factors(None, 0)


def lattice(divisions: int) -> Tensor:
    """Return the barycentric coordinates (n, 3) of the points of a lattice, in the order of `fine_attribute`."""
    j, i = np.indices((divisions + 1, divisions + 1)).reshape(2, -1)
    shares = np.stack([divisions - i - j, i, j], 1)[i + j <= divisions]
    return torch.from_numpy(shares.astype(np.float32) / divisions)


def divisions_for(s: Tensor, faces: np.ndarray, cell: float) -> int:
    """Choose the divisions of lattices whose points are about `cell` apart. There are at most `MOST` points.

    `s` (V, 3), `faces` (F, 3): the triangles.
    """
    corners = s.cpu()[torch.from_numpy(np.asarray(faces, np.int64)[:: 1 + len(faces) // MEASURED])]
    edges = (corners - corners.roll(1, 1)).norm(dim=-1).ravel()
    return max(1, min(math.ceil(float(edges.quantile(0.9)) / cell), math.isqrt(2 * MOST // len(faces)) - 2))
