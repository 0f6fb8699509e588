"""Reads meshes from files."""

import io
import re
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from mi_ring.errors import InputError, require_file
from mi_ring.foreign import reading

JSON = 2**24  #: bytes at the beginning of a glTF file in which its extensions are looked for


def read_mesh(path: Path, field: str) -> trimesh.Trimesh:
    """Read a mesh from a file. Vertices at the same place are joined, so that seams of textures are closed.

    Raises InputError if the file cannot be read. The message contains `field`, the option or field that names the file.
    """
    require_file(path, "the file of a mesh", field)
    with reading(f"{path}: {field}", "a mesh"):
        data = path.read_bytes()
        needed = b" ".join(re.findall(rb'"extensionsRequired"\s*:\s*\[([^\]]*)\]', data[:JSON])).decode("latin-1")
        if path.suffix.lower() in (".glb", ".gltf") and (packed := re.search(r"\w*(draco|meshopt)\w*", needed)):
            raise InputError(f"{path}: {field}: is compressed by {packed[0]}; export it without compression")
        if path.suffix.lower().lstrip(".") not in trimesh.exchange.load.mesh_formats():
            raise InputError(f"{path}: {field}: is no mesh in a format that is read; save it as PLY, OBJ, STL or GLB")
        content = io.BytesIO(data)  # a damaged file cannot request more bytes than this has
        resolver = trimesh.resolvers.FilePathResolver(str(path))
        mesh: Any = trimesh.load(content, path.suffix, resolver=resolver, force="mesh", process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # textures and flat shading split vertices
    return mesh


def load_closed_mesh(path: Path, field: str) -> trimesh.Trimesh:
    """Read a closed mesh from a file. Vertices at the same place are joined, so that seams of textures are closed.

    Raises InputError if the file cannot be read or the mesh is not closed. The message contains `field`, the option or
    field that names the file.
    """
    mesh = read_mesh(path, field)
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise InputError(f"{path}: {field}: is not a closed surface")
    return mesh


def genus(mesh: trimesh.Trimesh) -> int:
    """Return the number of handles of a closed surface: 0 for a sphere, 1 for a torus. Several pieces are summed."""
    return mesh.body_count - mesh.euler_number // 2


def area_of(points: Tensor, faces: Tensor) -> float:
    """Return the area of a mesh. `points` (V, 3): vertices. `faces` (F, 3): triangles."""
    return float(area_vectors(points, faces).norm(dim=1).sum()) / 2


def area_vectors(points: Tensor, faces: Tensor) -> Tensor:
    """Compute normals of triangles, each as long as twice the triangle's area: (F, 3).

    `points` (V, 3), `faces` (F, 3): a mesh. Seen from where a normal points to, the corners are in counterclockwise
    order.
    """
    a, b, c = (points[corner] for corner in faces.T)
    return torch.linalg.cross(b - a, c - a)
