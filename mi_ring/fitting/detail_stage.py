"""The stage `detail`: grids take what is finer than the networks, which stay as they are."""

import math

import numpy as np
import torch
import trimesh

from mi_ring.fitting.problem import Problem
from mi_ring.nets.registry import is_registered
from mi_ring.objects.detail import DetailedFlow, DetailedMaterial, Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import MAX_LEVEL

SPACING, CELL = 1.2, 1.25  #: of the finest mesh's vertices, and side of the finest cubes [px]
OCTAVES = 4  #: of the grids: the coarsest cubes are as large as what the networks represent
CHUNK = 2**16  #: points that the networks evaluate at once
STEEPEST, HALVINGS = 0.2, 8  #: least cosine between a triangle with and without details; see `unfold`
LEVELS = 2  #: number of meshes, from coarse to fine


def pixels_per_unit(problem: Problem, center: np.ndarray, radius: float) -> float:
    """Resolution [px] of the photographs for a length of 1 in the normalised frame: the median of all photographs."""
    width = max(problem.config.widths)
    found = []
    for k in problem.fitted:
        shot = problem.capture.shots[k]
        distance = float(np.linalg.norm(shot.camera.position - center))
        found.append(shot.camera.focal.mean() / -(-shot.size[0] // width) * radius / distance)
    return float(np.median(found))


def detail_levels(ring: FittedObject, resolution: float) -> list[int]:
    """Choose the levels of the meshes for details, from coarse to fine.

    `resolution`: pixels of the photographs for a length of 1 in the normalised frame. The list is empty if a network is
    not registered: no file could hold its details.
    """
    if not all(is_registered(net) for net in (ring.shape_net, ring.brdf_net)):
        return []
    area = trimesh.Trimesh(ring.domain.points, ring.domain.faces, process=False).area
    finest = math.log(area * (resolution / SPACING) ** 2 / 10, 4)
    finest = min(MAX_LEVEL, max(0, math.ceil(finest - 0.5)))
    return [max(0, finest - k) for k in reversed(range(LEVELS))]


@torch.no_grad()
def add_detail(ring: FittedObject, level: int, resolution: float) -> None:
    """Add grids of value 0 to both networks. `level`: of the finest mesh. `resolution`: see `pixels_per_unit`."""
    s, faces = ring.domain.sample(level)
    s = s.to(ring.center.device)
    points = torch.cat([ring.shape_net(part) for part in s.split(CHUNK)])
    surface = trimesh.Trimesh(points.numpy(force=True), faces, process=False)
    domain = trimesh.Trimesh(s.numpy(force=True), faces, process=False)
    cell = CELL * math.sqrt(domain.area / surface.area) / resolution  # the flow stretches the domain
    around = torch.cat([s, s[torch.from_numpy(faces)].mean(1)]).cpu()
    normals = torch.from_numpy(surface.vertex_normals.astype(np.float32))
    device = ring.center.device
    shape, material = (Grid.around(around, cell, OCTAVES, channels) for channels in (1, ring.brdf_net.outputs))
    ring.shape_net = DetailedFlow.of(ring.shape_net, shape, s, normals).to(device)
    ring.brdf_net = DetailedMaterial.of(ring.brdf_net, material).to(device)
    share_weights(ring)
    ring.subdivisions = level


def share_weights(ring: FittedObject) -> None:
    """Let both networks use the same memory for the weights of their grids, if they have details."""
    if isinstance(ring.shape_net, DetailedFlow) and isinstance(ring.brdf_net, DetailedMaterial):
        ring.brdf_net.grid.share(ring.shape_net.grid)


@torch.no_grad()
def unfold(ring: FittedObject, level: int) -> None:
    """Reduce displacements, in place, where they turn triangles of the mesh at this `level` away from their directions.

    The displacements around such a triangle are halved until none is left, and set to 0 if that takes too long.
    """
    s, faces = ring.domain.sample(level)
    s = s.to(ring.center.device)
    flow, corners = ring.shape_net, torch.from_numpy(faces).to(s.device)
    if not isinstance(flow, DetailedFlow):
        return

    def normals(points: torch.Tensor) -> torch.Tensor:
        a, b, c = points[corners].unbind(1)
        return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)

    smooth = normals(flow.base(flow.base.network, s, 1.0))
    for k in range(HALVINGS):
        folded = (normals(flow(s)) * smooth).sum(1) < STEEPEST
        if not folded.any():
            return
        around = torch.zeros(len(s))
        around[corners[folded].cpu().ravel()] = 1
        for values, weights in zip(flow.grid.values, flow.grid.weights(s)):
            near = torch.from_numpy(weights.T @ around.numpy() > 0).to(values.device)
            values[near] *= 0 if k == HALVINGS - 1 else 0.5
