"""Priors on shape and material, as terms of the loss: off by default.

The paper names TV-L1 for the shape, L1 and low rank for the BRDF; these are ours of that name. None depends on the
resolution of the mesh or on the units of the scene.
"""

import math

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn import functional as F

from mi_ring.fitting.iteration import Iteration
from mi_ring.nets.brdf_net import MaterialNet

FAINT = 1e-3  #: means that nothing is divided by less than, and how far from its ends a parameter's logit stays


def variation_of_normals(vertices: Tensor, faces: np.ndarray) -> Tensor:
    """Total variation of the normals of a closed mesh, vertices (V, 3) and faces (F, 3): a length.

    The sum over edges of their length times how far the normals of both sides are apart ("Discrete total variation of
    the normal vector field as shape prior", Bergmann et al., Inverse Problems 2020; chords instead of angles). A turn
    costs about as much if it is sharp as if it is spread over many edges, so that flat sides and edges are as good as
    what is round, and ripples are not. 8πR for a sphere of even triangles.
    """
    pairs, ends = trimesh.graph.face_adjacency(faces, return_edges=True)
    a, b, c = vertices[torch.as_tensor(faces, device=vertices.device)].unbind(1)
    normals = F.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    length = (vertices[ends[:, 0]] - vertices[ends[:, 1]]).norm(dim=1)
    return (length * (normals[pairs[:, 0]] - normals[pairs[:, 1]]).norm(dim=1)).sum()


def variation_of_values(vertices: Tensor, faces: np.ndarray, values: Tensor) -> Tensor:
    """Mean over a mesh of the gradient's length of values (V, C), linear on each triangle; summed over the channels.

    Per unit of length of the vertices (V, 3).
    """
    corners = torch.as_tensor(faces, device=vertices.device)
    a, b, c = vertices[corners].unbind(1)
    u, v = values[corners].unbind(1)[1:]
    u, v = u - values[corners[:, 0]], v - values[corners[:, 0]]
    # |∇f|² · (2A)² = |u (c − a) − v (b − a)|², where u and v are what f gains along both edges: ∇f turned by 90°.
    turned = u[:, :, None] * (c - a)[:, None] - v[:, :, None] * (b - a)[:, None]
    return turned.norm(dim=-1).sum() / torch.linalg.cross(b - a, c - a).norm(dim=1).sum()


def number_of_bases(values: Tensor) -> Tensor:
    """‖M‖₁ / ‖M‖₂ of the singular values of M (V, C), its nuclear norm over Frobenius' norm.

    1 for multiples of one basis material, √k for k that are orthogonal and as strong as each other, √C at most. The
    nuclear norm is the convex stand-in for the rank (Fazel 2002); divided like this it does not darken the material.
    """
    return torch.linalg.matrix_norm(values, "nuc") / values.norm()


def columns_of(material: dict[str, Tensor], brdf_net: MaterialNet) -> Tensor:
    """The material at V points as a matrix (V, C) of numbers near 1: in units of `scale`, or as shares of a range."""
    columns = []
    for p in brdf_net.bsdf_parameters:
        unit = float(brdf_net.scale) if math.isinf(p.high) else p.high - p.low
        columns.append((material[p.name].reshape(-1, p.channels) - p.low) / unit)
    return torch.cat(columns, 1)


def normal_variation(it: Iteration) -> Tensor:
    """Over that of a sphere of the object's size."""
    return variation_of_normals(it.vertices, it.faces) / (8 * math.pi * it.fit.ring.radius)


def albedo_variation(it: Iteration) -> Tensor:
    """How fast the material changes over the surface, in the mean, times the object's radius.

    Reflectances are divided by their mean: half the reflectance in twice the light looks the same. A parameter with an
    upper bound (a roughness) enters by its logit: as a share it would vary less near its bounds. The shape gets no
    gradient.
    """
    ring, net = it.fit.ring, it.fit.ring.brdf_net
    values = columns_of(it.material, net)
    ends = torch.tensor([math.isfinite(p.high) for p in net.bsdf_parameters for _ in range(p.channels)])
    values = torch.where(ends.to(values.device), values.logit(FAINT), values / values.mean(0).clamp(min=FAINT))
    return ring.radius * variation_of_values(it.vertices.detach(), it.faces, values)


def material_rank(it: Iteration) -> Tensor:
    """Of the material at all vertices."""
    return number_of_bases(columns_of(it.material, it.fit.ring.brdf_net))
