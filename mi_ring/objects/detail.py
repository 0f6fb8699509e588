"""What is finer than the networks: functions of domain points on grids, added to Shape-Net and BRDF-Net.

The grids are those of "Instant Neural Graphics Primitives" (Müller et al. 2022) without hashing and without a network:
only cubes that the domain passes have values.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from mi_ring.nets.brdf_net import MaterialNet
from mi_ring.nets.registry import architecture_of, build, register_network
from mi_ring.nets.shape_net import Flow
from mi_ring.scene.mesh_texture import stamp
from mi_ring.system.machine import release_memory

CORNERS = torch.tensor(list(itertools.product((0, 1), repeat=3)))  #: (8, 3) of a cube
AT_ONCE = 2**16  #: points whose weights are computed at once
PART = 2**20  #: points whose weights are kept: more than a mesh of a fit has, fewer than one to export may have
#: Factor of what details add to gloss. Few photographs show a highlight: a larger change would not suit the others.
GLOSS = 1 / 3
OPPOSITE = 0.3  #: normals cancel if the length of their sum is below this share of the sum of their lengths
MOST = 2**20  #: coordinates of cubes are from -`MOST` to `MOST` - 1
PLACES = torch.tensor([2**42, 2**21, 1])  #: a key is the scalar product of these and of coordinates from -`MOST`


class Grid(nn.Module):
    """A function of points in ℝ³: a sum of octaves, from coarse to fine. Each is trilinear on cubes.

    `cell`: side of the finest cubes; those of each coarser octave are twice as large. `nodes`: number of corners that
    have values, for each octave. `channels`: of the values, initially 0. Raises ValueError for a wrong `cell`.
    """

    def __init__(self, cell: float, nodes: Sequence[int], channels: int) -> None:
        super().__init__()
        if not 0 < cell * 2.0 ** len(nodes) < math.inf:
            raise ValueError(f"cell: is {cell}, must be a positive number")
        self.cells = [cell * 2**k for k in reversed(range(len(nodes)))]
        for k, n in enumerate(nodes):
            self.register_buffer(f"keys{k}", torch.zeros(n, dtype=torch.long))
        self.values = nn.ParameterList(nn.Parameter(torch.zeros(n, channels)) for n in nodes)
        #: the last points, their stamp, and their weights
        self.latest: list[tuple[Tensor, tuple, list[scipy.sparse.csr_matrix]]] = []

    @classmethod
    def around(cls, points: Tensor, cell: float, octaves: int, channels: int) -> "Grid":
        """Make a grid whose cubes contain the points (V, 3)."""
        keys = []
        for k in reversed(range(octaves)):
            corners = keys_of(torch.floor(points.double() / (cell * 2**k))).unique()
            for step in PLACES:  # along one axis after the other, so that there are never eight for each cube
                corners = torch.cat([corners, corners + step]).unique()
            keys.append(corners)
        grid = cls(cell, [len(own) for own in keys], channels)
        for k, own in enumerate(keys):
            grid.keys(k).copy_(own)
        return grid

    def like(self, channels: int) -> "Grid":
        """Make a grid with the same corners and another number of channels. Its values are 0."""
        grid = Grid(**self.arguments() | {"channels": channels})
        for k in range(len(self.values)):
            grid.keys(k).copy_(self.keys(k))
        return grid

    def keys(self, octave: int) -> Tensor:
        """Return the sorted keys (N,) of the corners of an octave, counted from the coarsest."""
        return getattr(self, f"keys{octave}")

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the constructor as plain data."""
        return {"cell": self.cells[-1], "nodes": [len(v) for v in self.values], "channels": self.values[0].shape[1]}

    def weights(self, s: Tensor) -> list[scipy.sparse.csr_matrix]:
        """Return the weights (V, N) of the corners at points (V, 3), for each octave. The last result is kept.

        The eight corners around a point have weights above 0. A corner without a value has none.
        """
        for _, known, weights in self.latest:
            if known == stamp(s):
                return weights
        self.latest.clear()
        rows, found = np.arange(0, 8 * len(s) + 1, 8, dtype=np.int32), []
        for k in range(len(self.values)):
            weight, node = np.empty((len(s), 8), np.float32), np.empty((len(s), 8), np.int32)
            for first in range(0, len(s), AT_ONCE):
                part = slice(first, first + AT_ONCE)
                weight[part], node[part] = self.octave_weights(s[part].detach().cpu(), k)
            found.append(scipy.sparse.csr_matrix((weight.ravel(), node.ravel(), rows), (len(s), len(self.keys(k)))))
        self.latest.append((s.detach(), stamp(s), found))
        release_memory()  # of intermediate results, which take more than the weights
        return found

    def share(self, other: "Grid") -> None:
        """Use the same memory for weights as `other`, if it has the same corners."""
        if self.cells == other.cells and all(torch.equal(self.keys(k), other.keys(k)) for k in range(len(self.cells))):
            self.latest = other.latest

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self.latest.clear()  # weights for other corners

    def octave_weights(self, s: Tensor, octave: int) -> tuple[Tensor, Tensor]:
        """Compute the weights (V, 8) of the corners around points (V, 3), and their places (V, 8) among the values."""
        keys, at = self.keys(octave).cpu(), s.double() / self.cells[octave]
        cube = torch.floor(at)
        key = keys_of(cube)[:, None] + CORNERS @ PLACES
        place = torch.searchsorted(keys, key).clamp(max=len(keys) - 1)
        share = (at - cube)[:, None]
        weight = torch.where(CORNERS == 1, share, 1 - share).prod(-1) * (keys[place] == key)
        weight = weight / weight.sum(1, keepdim=True).clamp(min=0.5)  # some points are in cubes without values
        return weight.float(), place.int()

    def forward(self, s: Tensor, values: Sequence[Tensor] | None = None) -> Tensor:
        """Interpolate at points (V, 3): (V, channels). `values` (N, channels) of each octave replace the grid's own."""
        if len(s) > PART:
            return torch.cat([self(part, values) for part in s.split(PART)])
        values = list(self.values) if values is None else values
        if wants_gradient(s):  # the sparse matrices have no gradient with respect to the points
            around = [self.octave_weights(s.cpu(), k) for k in range(len(values))]
            parts = [(weight[..., None].to(own) * own[node]).sum(1) for (weight, node), own in zip(around, values)]
        else:
            parts = [_Product.apply(own, weights) for weights, own in zip(self.weights(s), values)]
        return torch.stack(parts).sum(0)


class _Product(torch.autograd.Function):
    """A sparse matrix times dense values."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, matrix: scipy.sparse.csr_matrix) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ values.numpy(force=True)).to(values.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.matrix.T @ gradient.numpy(force=True)).to(gradient.device), None


def corner_values(shares: scipy.sparse.csr_matrix, wanted: np.ndarray, weights: np.ndarray, steps: int) -> np.ndarray:
    """Find values (N, C) of the corners of an octave whose interpolation is `wanted` (V, C), by some `steps`.

    `shares` (V, N): what `Grid.weights` returns for the octave. `weights` (V,): how much each point counts.
    """
    nodes = np.zeros((shares.shape[1], wanted.shape[1]), np.float32)
    total = np.maximum(shares.T @ weights, 1e-12)[:, None]
    for _ in range(steps):
        nodes += shares.T @ ((wanted - shares @ nodes) * weights[:, None]) / total
    return nodes


def wants_gradient(s: Tensor) -> bool:
    """Return True if a gradient with respect to the points `s` is wanted. In a fit it is not."""
    return s.requires_grad and torch.is_grad_enabled()


def keys_of(cubes: Tensor) -> Tensor:
    """Pack coordinates (..., 3) of cubes, whole numbers, into one integer each, (...), in lexicographic order."""
    return (cubes.clamp(-MOST, MOST - 1) + MOST).long() @ PLACES


class Remembered(nn.Module):
    """A frozen network that keeps its last result, because a fit of details asks for the same points again.

    It always computes in float32: the rounding of bfloat16 would be as large as details. `method`: the method of the
    network that is called.
    """

    def __init__(self, network: nn.Module, method: str = "forward") -> None:
        super().__init__()
        self.learned = [p for p in network.parameters() if p.requires_grad]
        self.network: Any = network.requires_grad_(False)
        self.method = method
        self.last: tuple[Tensor, tuple, Tensor] | None = None  #: points, stamp and further arguments, result

    def forward(self, s: Tensor, *more: float) -> Tensor:
        """Return what the network's method returns for points (V, 3) and further arguments.

        If they and the network are those of the last call, this is the result of the last call.
        """
        if wants_gradient(s):
            with torch.autocast(s.device.type, enabled=False):
                return getattr(self.network, self.method)(s, *more)
        last, asked = self.last, (stamp(s, *self.network.parameters(), *self.network.buffers()), more)
        if last is None or last[1] != asked:
            with torch.no_grad(), torch.autocast(s.device.type, enabled=False):
                self.last = last = s.detach(), asked, getattr(self.network, self.method)(s, *more)
        return last[2]

    def release(self) -> None:
        """Let the network learn again as before. It is for a network whose details are removed."""
        for parameter in self.learned:
            parameter.requires_grad_(True)


@register_network("detailed-flow")
class DetailedFlow(Flow):
    """A flow, and a displacement of its end points along given directions.

    Each corner of the grid has a direction. Its values are displacements in sides of the octave's cubes.
    """

    base: Remembered
    grid: Grid

    def __init__(self, flow: dict, grid: dict) -> None:
        """Make a flow without displacement. `flow`: result of `architecture_of`. `grid`: arguments of `Grid`.

        Raises ValueError if the grid has not one channel.
        """
        super().__init__()
        if grid["channels"] != 1:
            raise ValueError(f"displacements of {grid['channels']} channels have no meaning")
        self.base, self.grid = Remembered(build(flow)), Grid(**grid)
        self.steps = self.base.network.steps
        for k, n in enumerate(grid["nodes"]):
            self.register_buffer(f"directions{k}", torch.zeros(n, 3))

    @classmethod
    def of(cls, flow: Flow, grid: Grid, points: Tensor, normals: Tensor) -> "DetailedFlow":
        """Add a displacement to `flow`, which is frozen.

        The displacement is along the `normals` (V, 3) of the surface at domain `points` (V, 3). Longer normals have
        more weight in the mean direction of a corner. Where the object is thinner than a cube, normals of both sides
        would cancel: there this octave has no displacement.
        """
        detailed = cls(architecture_of(flow), grid.arguments())
        detailed.base, detailed.grid = Remembered(flow), grid
        for k, weights in enumerate(grid.weights(points)):
            mean = torch.from_numpy(weights.T @ normals.numpy(force=True))
            most = torch.from_numpy(weights.T @ normals.norm(dim=1).numpy(force=True))
            opposite = mean.norm(dim=1) < OPPOSITE * most
            directions = nn.functional.normalize(mean, dim=1).masked_fill(opposite[:, None], 0.0)
            getattr(detailed, f"directions{k}").copy_(directions)
        return detailed

    def arguments(self) -> dict:
        """Return the arguments of the constructor as plain data."""
        return {"flow": architecture_of(self.base.network), "grid": self.grid.arguments()}

    def velocity_of(self, step: int) -> Any:
        return self.base.network.velocity_of(step)

    def velocity(self, x: Tensor) -> Tensor:
        return self.base.network.velocity(x)

    def flow(self, x: Tensor, steps: int) -> Tensor:
        return self.base.network.flow(x, steps)

    def forward(self, x: Tensor, time: float = 1.0) -> Tensor:
        """Φ(x, time) for points (V, 3), displaced by the share `time` of the full displacement."""
        vectors = [cell * own * getattr(self, f"directions{k}")
                   for k, (cell, own) in enumerate(zip(self.grid.cells, self.grid.values))]  # fmt: skip
        return self.base(x, time) + time * self.grid(x, vectors)


@register_network("detailed-material")
class DetailedMaterial(MaterialNet):
    """A BRDF-Net, and what a grid adds to its outputs before these are mapped to the ranges of the parameters.

    Values of parameters that are no colours are multiplied by `GLOSS`.
    """

    base: Remembered
    grid: Grid

    def __init__(self, net: dict, grid: dict) -> None:
        """Make a network whose grid adds 0. `net`: result of `architecture_of`. `grid`: arguments of `Grid`.

        Raises ValueError if the grid has not one channel for each output of the network.
        """
        made = build(net)
        super().__init__(made.bsdf_parameters)
        if grid["channels"] != self.outputs:
            raise ValueError(f"details of {grid['channels']} channels do not suit a material of {self.outputs}")
        self.base, self.grid = Remembered(made, "evaluate"), Grid(**grid)

    @classmethod
    def of(cls, net: MaterialNet, grid: Grid) -> "DetailedMaterial":
        """Add a grid to `net`, which is frozen."""
        detailed = cls(architecture_of(net), grid.arguments())
        detailed.base, detailed.grid = Remembered(net, "evaluate"), grid
        detailed.set_parameters(net.bsdf_parameters, float(net.scale))
        return detailed

    def arguments(self) -> dict:
        """Return the arguments of the constructor as plain data."""
        return {"net": architecture_of(self.base.network), "grid": self.grid.arguments()}

    def evaluate(self, s: Tensor) -> Tensor:
        factors = [1.0 if p.channels == 3 else GLOSS for p in self.bsdf_parameters for _ in range(p.channels)]
        points = s.reshape(-1, 3)
        result = self.base(points).float() + self.grid(points) * torch.tensor(factors, device=s.device)
        return result.reshape(*s.shape[:-1], self.outputs)
