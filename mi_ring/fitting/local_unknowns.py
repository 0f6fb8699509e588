"""Surface and material as unknowns: each patch of the surface has its own.

A flash elsewhere, or another curve of the camera, looks in part like another surface of another material. So standard
deviations of calibration are too small unless surface and material are unknown, too.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mi_ring.nets.brdf_net import Parameter
from mi_ring.rendering.image_formation import find_triangles
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.plain_mesh import NORMALS, POSITIONS

PATCH = 0.1  #: side of the cubes that divide the domain into patches [radius]
FACTOR, SHARE = 1.0, 0.3  #: priors of the material: logarithm of a parameter without limit, or share of its range
TILT, OFFSET = 0.3, 0.02  #: priors of the surface: tilt of the normals [rad], displacement along them [radius]


class LocalUnknown(NamedTuple):
    """An unknown of each patch. Its unit is the standard deviation of its prior."""

    name: str  #: the parameter of the mesh that it changes
    width: float  #: standard deviation of the prior
    channels: int = 1  #: of a colour: each is an unknown
    axis: int = 0  #: about which normals are tilted
    low: float = -np.inf  #: least and greatest value of a parameter of the material. One without limit is changed by a
    high: float = np.inf  #: factor, of which the unknown is the logarithm


class Patches:
    """The patches of a surface that is shown, and their unknowns.

    They are the parameters of the BSDF, two tilts of the normals (except of flat triangles), and a displacement along
    the normals.
    """

    def __init__(self, surface: Surface, s: Tensor, radius: float, material: Sequence[Parameter]) -> None:
        """Divide the surface. `s` (V, 3): its vertices on the domain. `radius` of the object [scene units].

        `material`: the parameters of its BSDF.
        """
        self.surface = surface
        _, numbers = torch.floor(s / PATCH).long().cpu().unique(dim=0, return_inverse=True)
        self.of_vertex = numbers.numpy()  #: (V,) number of the patch
        self.count = int(self.of_vertex.max()) + 1
        self.unknowns = [
            LocalUnknown(p.attribute, FACTOR if np.isinf(p.high) else SHARE * (p.high - p.low), p.channels,
                         low=p.low, high=p.high) for p in material
        ]  # fmt: skip
        if not surface.shape.has_face_normals():
            self.unknowns += [LocalUnknown(NORMALS, TILT, axis=axis) for axis in range(2)]
        self.unknowns.append(LocalUnknown(POSITIONS, OFFSET * radius / surface.unit))
        self.components = sum(unknown.channels for unknown in self.unknowns)  #: number of unknowns of a patch
        names = {unknown.name for unknown in self.unknowns} | {NORMALS}
        self.values = {name: np.array(surface.params[surface.prefix + name]) for name in names}
        self.axes = axes_of(self.values[NORMALS].reshape(-1, 3), self.of_vertex, self.count)

    @contextmanager
    def changed(self, unknown: LocalUnknown, step: float) -> Iterator[None]:
        """Change an unknown of all patches by `step` while the context is open."""
        value, step = self.values[unknown.name], step * unknown.width
        if unknown.name == NORMALS:
            tilted = value.reshape(-1, 3) + step * self.axes[unknown.axis]
            now = (tilted / np.linalg.norm(tilted, axis=1, keepdims=True)).ravel()
        elif unknown.name == POSITIONS:
            now = value + step * self.values[NORMALS]
        else:
            low, high = unknown.low, unknown.high
            now = low + (value - low) * np.exp(step) if np.isinf(high) else (value + step).clip(low, high)
        try:
            self.surface.write_arrays({unknown.name: to_flat(mi.Float, now)})
            yield
        finally:
            self.surface.write_arrays({unknown.name: to_flat(mi.Float, value)})

    def seen(self, photographs: Photographs) -> np.ndarray:
        """Find the patch (n, H, W) that each pixel of n photographs shows. Beside the object it is the nearest one.

        In photographs without the object it is 0.
        """
        own = photographs.in_units(self.surface.unit)
        hits = [find_triangles(self.surface.scene, self.surface.shape, own, 1, 0, pixels) for pixels in own.chunks(1)]
        shown, triangle = (np.concatenate([np.array(hit[k]) for hit in hits]).reshape(own.shape) for k in range(2))
        patches = np.zeros(own.shape, int)
        patches[shown] = self.of_vertex[self.surface.faces[triangle[shown], 0]]
        for n, inside in enumerate(shown):
            if inside.any():
                row, column = distance_transform_edt(~inside, return_distances=False, return_indices=True)
                patches[n] = patches[n][row, column]
        return patches


def axes_of(normals: np.ndarray, patch: np.ndarray, count: int) -> np.ndarray:
    """Return two unit vectors (2, V, 3) along the surface at each vertex, of about the same directions in a patch.

    `normals` (V, 3). `patch` (V,): number of the patch of each vertex, below `count`.
    """

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-9)

    sizes = np.stack([np.bincount(patch, np.square(part), count) for part in normals.T], 1)
    one = unit(np.cross(normals, np.eye(3)[sizes.argmin(1)][patch]))
    return np.stack([one, np.cross(normals, one)])
