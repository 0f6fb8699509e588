"""Writes a fitted object as a file for other programs."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from mi_ring.errors import InputError
from mi_ring.geometry.meshes import area_of
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.output import gltf
from mi_ring.output.atlas import rasterise, reflectances, unwrap
from mi_ring.output.mitsuba_scene import Lit, write_scene
from mi_ring.output.obj import write_obj
from mi_ring.output.ply import write_mesh
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.system.files import all_or_none, require_place, write_file

KINDS = ".ply", ".obj", ".glb", ".xml"
GLB_LEVEL = 5  #: of its mesh; finer detail is in the normal map
MAX_LEVEL, MAX_PLY_LEVEL = 8, 10  #: finest level of a mesh with textures, and of one without
RESOLUTION, FINE_RESOLUTION = 2048, 4096  #: width of textures [px]: usual; for a material whose texture needs more
AREA_LEVEL = 4  #: of the mesh that tells the area of a domain
FILLED = 0.6  #: share of the texels that show a part of the surface


def export(
    ring: FittedObject, file: str | Path, subdivisions: int | None = None, resolution: int | None = None,
    time: float = 1.0, metres: float | None = None, views: Sequence[MaskedCamera] | None = None,
    photograph: Lit | None = None,
) -> list[Path]:  # fmt: skip
    """Write a fitted object as PLY, OBJ, GLB or Mitsuba XML, by the suffix of `file`. Returns all files written.

    `subdivisions`: level of the mesh, about 10 · 4^level vertices; None: the level of the fit, at most 5 for GLB.
    `resolution`: width of the textures [px]; None: see `resolution_of`. `time`: state of the deformation, from 0 (start
    surface) to 1 (fitted object). `metres`: length of a scene unit [m], only for GLB; None: the length that `ring`
    knows, if any. `views`: cameras and masks of the photographs; PLY and GLB then mark the vertices that a photograph
    shows. `photograph`: for XML, the photograph whose camera and light are written, and the room light: spherical
    harmonics (BASIS, 3) or None, and lobes or None.

    Raises InputError for values out of range, for a BSDF that glTF cannot express, and if a file cannot be written.
    """
    if not isinstance(ring, FittedObject):
        raise InputError(f"ring: is {type(ring).__name__}; must be a fitted object, which mi_ring.load_fit returns")
    file = Path(file)
    kind = require_exportable(file, subdivisions, resolution, time, metres)
    if kind == ".xml" and photograph is None:
        raise InputError(f"{file}: a scene for Mitsuba needs a photograph, for its camera and light")
    if kind in (".glb", ".obj"):
        gltf.require_expressible(ring)
    require_place(file)
    level, resolution = subdivisions, resolution or resolution_of(ring)
    if level is None:
        level = min(GLB_LEVEL, ring.subdivisions) if kind == ".glb" else ring.subdivisions
    if kind == ".ply":
        write_mesh(ring, level, file, time, views)
        return [file]
    if kind == ".glb":
        write_file(file, gltf.glb(ring, level, resolution, time, metres or ring.metres, views, ring.up))
        return [file]
    atlas = unwrap(ring, level, resolution, time)
    texels = rasterise(ring, atlas, resolution, time)
    values = reflectances(ring, texels.s)
    with all_or_none(file) as new:
        if kind == ".xml" and photograph is not None:
            files = write_scene(new, atlas, texels, ring.bsdf, values, *photograph)
        else:
            files = write_obj(new, atlas, texels, gltf.metallic_roughness(ring.bsdf, values))
    return [file.with_name(made.name) for made in files]


def resolution_of(ring: FittedObject) -> int:
    """Choose the width of the textures of an object [px]: 2048, or 4096 if its own texture is finer than that."""
    s, faces = ring.domain.sample(AREA_LEVEL)
    area = area_of(s, torch.from_numpy(faces))
    cell = ring.brdf_net.texture_cell()
    return FINE_RESOLUTION if cell and area / cell**2 > FILLED * RESOLUTION**2 else RESOLUTION


def require_exportable(
    file: Path, subdivisions: int | None, resolution: int | None, time: float, metres: float | None
) -> str:  # fmt: skip
    """Check arguments for the export to `file`. Returns its suffix in lower case: .ply, .obj, .glb or .xml.

    `subdivisions`: level of the mesh; None: any. `resolution`: width of the textures [px]; None: not given. `time`:
    state of the deformation, 0 to 1. `metres`: length of a scene unit [m]; None: not given. Raises InputError if one is
    invalid.
    """
    kind = file.suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{file}: must end in {', '.join(KINDS)}")
    finest = MAX_PLY_LEVEL if kind == ".ply" else MAX_LEVEL
    if subdivisions is not None and not (isinstance(subdivisions, int | np.integer) and 0 <= subdivisions <= finest):
        more = f"; textures have the finer detail; .ply takes up to {MAX_PLY_LEVEL}" * (finest == MAX_LEVEL)
        raise InputError(f"--subdivisions: is {subdivisions}, must be 0 to {finest}{more}")
    if resolution is not None and not 64 <= resolution <= 4096:
        raise InputError(f"--resolution: is {resolution}, must be 64 to 4096")
    if not 0 <= time <= 1:
        raise InputError(f"--time: is {time}, must be 0 to 1")
    if metres is not None and not 0 < metres < math.inf:
        raise InputError(f"--metres: is {metres}, must be a positive number")
    if metres is not None and kind != ".glb":
        raise InputError(f"--metres: is for .glb alone; {file.name} keeps the scene's units")
    if file.is_dir():
        raise InputError(f"{file}: is a folder; name the file to write")
    return kind
