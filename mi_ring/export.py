"""Write a fitted object for other programs: `python -m mi_ring.export RUN FILE.{ply,obj,glb,xml}`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.capture.loading import load_views
from mi_ring.errors import InputError
from mi_ring.objects.material_edits import MaterialOptions, edit_material
from mi_ring.objects.ring_file import load_fit
from mi_ring.output.ambiguity import ambiguity_of
from mi_ring.output.exporting import export, require_exportable
from mi_ring.output.mitsuba_scene import first_photograph
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.system import command


@dataclass(frozen=True, kw_only=True)
class ExportConfig(MaterialOptions):
    """Write the object of a finished fit for other programs. The suffix of the file chooses the format.

    .ply: the mesh. Vertex attributes: the parameters of its BSDF, and whether a photograph shows the vertex.
    .glb: the mesh with a normal map and glTF's metallic-roughness material.
    .obj: the same content in OBJ, MTL and PNG files.
    .xml: a Mitsuba scene with textures and Mitsuba's own BSDFs. Mitsuba renders it without mi_ring.

    Positions are in the units and the frame of the scene. In a GLB, a node converts them to metres and turns the object
    upright, if the capture gives the unit and the up direction.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit, or its ring.pt."""
    file: Positional[Annotated[Path, arg(metavar="FILE")]]
    """File to write. Its suffix selects the format: .ply, .obj, .glb or .xml (a scene for Mitsuba).
    For .obj and .xml, textures and meshes are written beside it."""
    subdivisions: int | None = None
    """Level of the mesh, which has about 10 · 4^level vertices. The highest level is 10 for .ply, 8 for other files.
    A lower level gives a smaller file, a higher level a finer mesh.
    Without this option: the level of the fit, but at most 5 for .glb, whose normal map has the finer detail."""
    resolution: int | None = None
    """Width and height of the textures [texels], 64 to 4096. More texels keep finer detail and make larger files.
    A .ply has no textures. Without this option: 2048, or 4096 if the fit has found texture that needs it."""
    time: float = 1.0
    """Which state of the deformation to write, 0 to 1. 0: the start surface of the fit. 1: the finished object.
    0.5: the surface after half of the deformation."""
    metres: float | None = None
    """Length of a scene unit [m], to give the object its real size. 0.001: the unit is the millimetre. Only for .glb.
    Without this option: the length in the capture. Captures of mi-ring photos with the printed sheet have one."""


def require_options(config: ExportConfig) -> None:
    """Raise InputError if an option is out of range, or if the output would overwrite the fit or a capture."""
    kind = require_exportable(config.file, config.subdivisions, config.resolution, config.time, config.metres)
    run = config.run if config.run.is_dir() else config.run.parent
    capture = kind == ".xml" and config.file.is_file() and b'"photograph"' in config.file.read_bytes()
    if capture or config.file.resolve() == (run / "mesh.ply").resolve():
        raise InputError(f"{config.file}: is a file of the fit or of a capture; choose another name")


def seen_from(run: Path) -> list[MaskedCamera] | None:
    """Read the camera and the mask of each photograph of a fit. `run`: the results folder of the fit, or a file in it.

    Prints a warning and returns None if the scene.xml in this folder cannot be read.
    """
    try:
        return load_views((run if run.is_dir() else run.parent) / "scene.xml")
    except InputError as error:
        print(f"The file will not say what the photographs show: {error}", file=sys.stderr)
        return None


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(ExportConfig, arguments, "mi_ring.export")
    require_options(config)
    ring = load_fit(config.run)
    edit_material(ring, config)
    kind = config.file.suffix.lower()
    photograph = first_photograph(config.run) if kind == ".xml" else None
    views = seen_from(config.run) if kind in (".ply", ".glb") else None
    if kind != ".ply":
        print("Unwrapping the surface and baking its textures", flush=True)
    files = export(ring, config.file, config.subdivisions, config.resolution, config.time, config.metres, views,
                   photograph)  # fmt: skip
    if kind == ".glb" and not (config.metres or ring.metres):
        print("The length of a scene unit is not known: the GLB takes it for one metre; see --metres",
              file=sys.stderr)  # fmt: skip
    if unknown := ambiguity_of(config.material or config.run):
        print(unknown, file=sys.stderr)
    print("\n".join(map(str, files)))


command.make_callable(__name__, export)

if __name__ == "__main__":
    command.run("mi_ring.export", main)
