"""Makes Mitsuba meshes from arrays."""

import mitsuba as mi

from mi_ring.scene.alignment import to_flat

# Mitsuba's names of mesh parameters. Mitsuba 3.10 renames them.
POSITIONS, NORMALS, FACES = "vertex_positions", "vertex_normals", "faces"


def mesh_of(vertices, faces, normals: bool = True, uv=None) -> mi.Mesh:
    """Make a Mitsuba mesh from vertices (V, 3) and triangles `faces` (F, 3).

    `normals`: True: smooth vertex normals; False: flat triangles. `uv` (V, 2): texture coordinates; None: none.
    """
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=normals, has_vertex_texcoords=uv is not None)
    params = mi.traverse(mesh)
    params[POSITIONS] = to_flat(mi.Float, vertices)
    params[FACES] = to_flat(mi.UInt32, faces)
    if uv is not None:
        params["vertex_texcoords"] = to_flat(mi.Float, uv)
    params.update()
    return mesh


def scene_of(vertices, faces) -> mi.Scene:
    """Make a scene that contains one mesh with smooth normals. `vertices` (V, 3), `faces` (F, 3): triangles."""
    return mi.load_dict({"type": "scene", "mesh": mesh_of(vertices, faces)})
