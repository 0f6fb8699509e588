"""Meshes from files, and what is asked of a closed surface."""

import io
from pathlib import Path
from typing import Any

import trimesh

from mi_ring.errors import InputError, require_file
from mi_ring.foreign import reading


def read_mesh(path: Path, field: str) -> trimesh.Trimesh:
    """A mesh from a file, its seams closed. Raises InputError, which names the `field`, if it cannot be read."""
    require_file(path, "the file of a mesh", field)
    with reading(f"{path}: {field}", "a mesh"):
        content = io.BytesIO(path.read_bytes())  # of which no more can be asked for than there is
        resolver = trimesh.resolvers.FilePathResolver(str(path))
        mesh: Any = trimesh.load(content, path.suffix, resolver=resolver, force="mesh", process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # textures and flat shading split vertices
    return mesh


def load_closed_mesh(path: Path, field: str) -> trimesh.Trimesh:
    """A closed mesh from a file. Raises InputError, which names the `field`, if it is none."""
    mesh = read_mesh(path, field)
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise InputError(f"{path}: {field}: is not a closed surface")
    return mesh


def genus(mesh: trimesh.Trimesh) -> int:
    """Number of handles of a closed surface, of all its pieces together."""
    return mesh.body_count - mesh.euler_number // 2
