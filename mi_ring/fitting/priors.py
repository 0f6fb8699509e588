"""Priors on shape and material, as terms of the loss. All but `settling` are off by default.

The paper names such priors: TV-L1 for the shape, L1 and low rank for the BRDF. The priors here do not depend on the
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

EPS = 1e-3  #: least mean to divide by, and least distance of a share from 0 and 1 in a logit


def variation_of_normals(vertices: Tensor, faces: np.ndarray) -> Tensor:
    """Compute the total variation of the normals of a closed mesh: vertices (V, 3), faces (F, 3). It is a length.

    It is a sum over all edges: the length of the edge times the distance between the normals of the two adjacent
    triangles ("Discrete total variation of the normal vector field as shape prior", Bergmann et al., Inverse Problems
    2020; chords instead of angles). A sharp bend costs about as much as a round one, and ripples cost more. A sphere of
    radius R and even triangles has 8πR.
    """
    pairs, ends = trimesh.graph.face_adjacency(faces, return_edges=True)
    a, b, c = vertices[torch.as_tensor(faces, device=vertices.device)].unbind(1)
    normals = F.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    length = (vertices[ends[:, 0]] - vertices[ends[:, 1]]).norm(dim=1)
    return (length * (normals[pairs[:, 0]] - normals[pairs[:, 1]]).norm(dim=1)).sum()


def variation_of_values(vertices: Tensor, faces: np.ndarray, values: Tensor) -> Tensor:
    """Compute the mean length of the gradient of `values` (V, C) along a mesh, summed over channels. Unit: 1 / length.

    The mesh has `vertices` (V, 3) and `faces` (F, 3). The values are linear on each triangle. The mean is over the
    area.
    """
    corners = torch.as_tensor(faces, device=vertices.device)
    a, b, c = vertices[corners].unbind(1)
    u, v = values[corners].unbind(1)[1:]
    u, v = u - values[corners[:, 0]], v - values[corners[:, 0]]
    # |∇f|² · (2A)² = |u (c − a) − v (b − a)|², where u and v are what f gains along both edges: ∇f turned by 90°.
    turned = u[:, :, None] * (c - a)[:, None] - v[:, :, None] * (b - a)[:, None]
    return turned.norm(dim=-1).sum() / torch.linalg.cross(b - a, c - a).norm(dim=1).sum()


def number_of_bases(values: Tensor) -> Tensor:
    """Measure the rank of a matrix M = `values` (V, C) smoothly, by nuclear norm over Frobenius norm, ‖M‖₁ / ‖M‖₂.

    The rows are materials. The result is 1 if all rows are multiples of one row, √k for k orthogonal basis materials of
    equal strength, and at most √C. The nuclear norm is the convex relaxation of the rank (Fazel 2002). Because of the
    division, a darker material does not cost less.
    """
    return torch.linalg.matrix_norm(values, "nuc") / values.norm()


def columns_of(material: dict[str, Tensor], brdf_net: MaterialNet) -> Tensor:
    """Arrange the material parameters of V points as a matrix (V, C) of numbers near 1.

    `material`: a dict from names of parameters to values (V, …). A parameter without upper bound is divided by
    `brdf_net.scale`, the order of magnitude of the reflectances. Any other parameter is mapped from its range to [0,
    1].
    """
    columns = []
    for p in brdf_net.bsdf_parameters:
        unit = float(brdf_net.scale) if math.isinf(p.high) else p.high - p.low
        columns.append((material[p.name].reshape(-1, p.channels) - p.low) / unit)
    return torch.cat(columns, 1)


def normal_variation(it: Iteration) -> Tensor:
    """Compute the term `normal_variation`: the total variation of the normals, divided by that of a sphere.

    This sphere is as large as the normalising sphere of the object.
    """
    radius = it.context.model.ring.radius
    return variation_of_normals(it.prediction.vertices, it.batch.faces) / (8 * math.pi * radius)


def albedo_variation(it: Iteration) -> Tensor:
    """Compute the mean length of the surface gradient of the material, times the object's radius.

    The term `settling` uses it. Reflectances are divided by their mean, because half the reflectance in twice the light
    looks the same. A parameter with an upper bound, such as a roughness, is replaced by its logit; its share of the
    range would vary less near the bounds. The shape gets no gradient.
    """
    ring, prediction = it.context.model.ring, it.prediction
    values = columns_of(prediction.material, ring.brdf_net)
    bounded = torch.tensor([math.isfinite(p.high) for p in ring.brdf_net.bsdf_parameters for _ in range(p.channels)])
    values = torch.where(bounded.to(values.device), values.logit(EPS), values / values.mean(0).clamp(min=EPS))
    return ring.radius * variation_of_values(prediction.vertices.detach(), it.batch.faces, values)


def material_rank(it: Iteration) -> Tensor:
    """Compute the term `material_rank`: a smooth measure of how many basis materials the material consists of."""
    return number_of_bases(columns_of(it.prediction.material, it.context.model.ring.brdf_net))
