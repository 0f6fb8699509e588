"""Reads meshes from files."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
import trimesh
from scipy.sparse.linalg import LinearOperator, cg
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


def smoothed(values: np.ndarray, faces: np.ndarray, strength: float) -> np.ndarray:
    """Remove short waves from values (V, C) at the vertices of a mesh, such as their positions. Long waves stay.

    `faces` (F, 3): triangles of a closed mesh. Solves (1 + `strength` L²) x = `values`, where L is the normalised
    Laplacian of the mesh's edges ("Laplacian Mesh Optimization", Nealen et al. 2006). Waves of n edges have an
    eigenvalue of L of about (2 π / n)² / 4, and are halved if `strength` times its square is 1.
    """
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    both, count = np.concatenate([edges, edges[:, ::-1]]), len(values)
    degrees = np.bincount(both[:, 0], minlength=count).astype(float)
    root = np.sqrt(degrees)[:, None]
    between = 1 / (root[both[:, 0], 0] * root[both[:, 1], 0])
    laplacian = scipy.sparse.identity(count) - scipy.sparse.csr_matrix((between, tuple(both.T)), (count, count))
    operator = LinearOperator((count, count), lambda x: x + strength * (laplacian @ (laplacian @ x)))
    middle = values.mean(0)
    wanted = (values - middle) * root  # the Laplacian of a constant times `root` is 0
    # So exactly that processes and machines agree.
    solved = [cg(operator, column, column, rtol=1e-9)[0] for column in wanted.T.astype(float)]
    return (np.column_stack(solved) / root + middle).astype(values.dtype)
