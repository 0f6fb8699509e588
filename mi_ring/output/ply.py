"""Meshes as PLY, with the material at each vertex."""

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
    """Write the surface as PLY in scene units, with the BSDF's parameters as vertex attributes (vertex_diffuse, …).

    With `views`, the attribute vertex_seen is 1 where a view shows the object, and the share of the area that no view
    shows is returned; otherwise None.
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
    """Write a mesh as PLY, by `write_file`."""
    stream = mi.MemoryStream()
    mesh.write_ply(stream)
    write_file(path, stream.raw_buffer())
