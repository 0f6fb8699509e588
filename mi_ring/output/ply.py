"""Writes meshes as PLY files, with the material of each vertex."""

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import torch

from mi_ring.objects.fitted_object import FittedObject
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.visibility import MaskedCamera, visible_points
from mi_ring.system.files import write_file


def write_mesh(
    ring: FittedObject, subdivisions: int, path: Path, time: float = 1.0, views: Sequence[MaskedCamera] | None = None
) -> float | None:
    """Write the surface as a PLY file in scene units. Vertex attributes are the BSDF parameters (vertex_diffuse, …).

    `subdivisions`: level of the mesh, about 10 · 4^level vertices. `time`: state of the deformation, from 0 (start
    surface) to 1 (fitted object). `views`: cameras and masks of photographs; the attribute vertex_seen is 1 where one
    of them shows the vertex, otherwise 0. Returns the share of the surface area that no photograph shows; None without
    `views`.
    """
    s, faces = ring.domain.sample(subdivisions)
    with torch.no_grad():
        s = s.to(ring.center.device)
        vertices, material = ring(s, time)
    mesh = mesh_of(vertices.cpu().numpy(), faces)
    unseen = None
    if views is not None:
        seen, unseen = visible_points(ring, s.cpu().numpy(), faces, views)
        material = {"seen": torch.from_numpy(seen).float(), **material}
    for name, value in material.items():
        mesh.add_attribute(f"vertex_{name}", value[0].numel(), value.cpu().numpy().ravel())
    write_ply(mesh, path)
    return unseen


def write_ply(mesh: mi.Mesh, path: Path) -> None:
    """Write a mesh as a PLY file. Raises InputError if the file cannot be written."""
    stream = mi.MemoryStream()
    mesh.write_ply(stream)
    write_file(path, stream.raw_buffer())
