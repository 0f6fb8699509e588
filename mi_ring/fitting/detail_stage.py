"""The stage for details: grids represent what is finer than the networks, which stay as they are."""

import math

import numpy as np
import torch
import trimesh

from mi_ring.fitting.problem import Problem
from mi_ring.geometry.camera import pixels_per_unit
from mi_ring.geometry.meshes import area_of, area_vectors, smoothed
from mi_ring.nets.registry import is_registered
from mi_ring.objects.detail import DetailedFlow, DetailedMaterial, Grid, corner_values
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import MAX_LEVEL

SPACING, CELL = 1.2, 1.25  #: of the finest mesh's vertices, and side of the finest cubes [px]
FEWEST_PHOTOGRAPHS = 4  #: that show whether they agree on details
OCTAVES = 4  #: of the grids: the coarsest cubes are as large as what the networks represent
STIFFNESS, SOLVING = 2.5, 10  #: of `smoothed`, for one edge of the trained mesh; steps to find values of corners
STEEPEST, HALVINGS = 0.2, 8  #: least cosine between a triangle with and without details; see `unfold`


def fit_resolution(problem: Problem, center: np.ndarray, radius: float) -> float:
    """Compute how many pixels of a photograph show a length of 1 in the normalised frame. Returns the median.

    `center` (3,), `radius`: normalising sphere [scene units]. The photographs are as wide as in the last stage.
    """
    cameras = [problem.capture.shots[k].camera for k in problem.fitted]
    width = max(problem.config.widths)
    return radius * pixels_per_unit([camera.shrunk(-(-camera.size[0] // width)) for camera in cameras], center)


def detail_levels(ring: FittedObject, resolution: float) -> list[int]:
    """Choose the levels of the two meshes for details, the coarse one and the fine one.

    `resolution`: pixels of a photograph for a length of 1 in the normalised frame. The list is empty if a network is
    not registered: no file could hold its details.
    """
    if not all(is_registered(net) for net in (ring.shape_net, ring.brdf_net)):
        return []
    area = trimesh.Trimesh(ring.domain.points, ring.domain.faces, process=False).area
    finest = math.log(area * (resolution / SPACING) ** 2 / 10, 4)
    finest = min(MAX_LEVEL, max(0, math.ceil(finest - 0.5)))
    return [max(0, finest - 1), finest]


@torch.no_grad()
def add_detail(ring: FittedObject, level: int, resolution: float) -> None:
    """Add grids of value 0 to both networks, in place.

    `level`: level of the finest mesh. `resolution`: pixels of a photograph for a length of 1 in the normalised frame.
    """
    s, faces = ring.domain.sample(level)
    s, corners = s.to(ring.center.device), torch.from_numpy(faces).to(ring.center.device)
    points = ring.shape_net(s)
    stretch = math.sqrt(area_of(points, corners) / area_of(s, corners))  # of lengths on the domain, by the flow
    around = torch.cat([s, s[corners].mean(1)]).cpu()
    grid = Grid.around(around, CELL / stretch / resolution, OCTAVES, channels=1)
    normals = torch.zeros_like(s).index_add(0, corners.ravel(), area_vectors(points, corners).repeat_interleave(3, 0))
    ring.brdf_net = DetailedMaterial.of(ring.brdf_net, grid.like(ring.brdf_net.outputs)).to(s.device)
    ring.shape_net = DetailedFlow.of(ring.shape_net, grid, s, normals).to(s.device)
    share_weights(ring)
    ring.subdivisions = level


@torch.no_grad()
def smooth_between(ring: FittedObject, level: int, trained: int) -> None:
    """Let displacements, in place, remove what the flow does between the vertices of the mesh that it was trained with.

    Photographs have not determined it. `level`: of the finest mesh. `trained`: that of the mesh of the flow. Where a
    cube has no direction, because the object is thin, nothing is removed.
    """
    s, faces = ring.domain.sample(level)
    s = s.to(ring.center.device)
    flow, ratio = ring.shape_net, 2.0 ** (level - trained)
    if not isinstance(flow, DetailedFlow) or ratio <= 1:
        return
    points = flow.base(s, 1.0).cpu()
    change = smoothed(points.numpy(), faces, STIFFNESS * ratio**4) - points.numpy()
    normals = trimesh.Trimesh(points.numpy(), faces, process=False).vertex_normals
    wanted = (change * normals).sum(1, keepdims=True).astype(np.float32) / flow.grid.cells[-1]
    nodes = corner_values(flow.grid.weights(s)[-1], wanted, np.ones(len(s), np.float32), SOLVING)
    flow.grid.values[-1].copy_(torch.from_numpy(nodes))


def share_weights(ring: FittedObject) -> None:
    """Let both networks use the same memory for the weights of their grids, if they have details."""
    if isinstance(ring.shape_net, DetailedFlow) and isinstance(ring.brdf_net, DetailedMaterial):
        ring.brdf_net.grid.share(ring.shape_net.grid)


@torch.no_grad()
def unfold(ring: FittedObject, level: int) -> None:
    """Reduce displacements, in place, where they turn triangles of the mesh at `level` by about 80 degrees or more.

    The displacements around such a triangle are halved, seven times at most. After that they become 0. A second call
    changes nothing.
    """
    s, faces = ring.domain.sample(level)
    s = s.to(ring.center.device)
    flow, corners = ring.shape_net, torch.from_numpy(faces).to(s.device)
    if not isinstance(flow, DetailedFlow):
        return

    def normals(points: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.normalize(area_vectors(points, corners), dim=1)

    smooth = normals(flow.base(s, 1.0))
    changed, rounds = True, 0
    while changed:
        folded = (normals(flow(s)) * smooth).sum(1) < STEEPEST
        around = torch.zeros(len(s))
        around[corners[folded].cpu().ravel()] = 1
        changed, rounds = False, rounds + 1
        for values, weights in zip(flow.grid.values, flow.grid.weights(s)):
            near = torch.from_numpy(weights.T @ around.numpy() > 0).to(values.device)
            changed = changed or bool(values[near].any())
            values[near] *= 0.5 if rounds < HALVINGS else 0
