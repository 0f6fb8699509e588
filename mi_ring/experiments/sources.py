"""The captures of an experiment: what DATA and --materials mean."""

from pathlib import Path
from typing import Any

from mi_ring.errors import InputError
from mi_ring.experiments.experiment import Asked
from mi_ring.experiments.recipes import Recipe, Synthetic, given, own
from mi_ring.synthesis.materials import COLOURS, load_material
from mi_ring.synthesis.options import SynthesizeConfig

MESHES = ".ply", ".obj", ".glb", ".stl", ".off"
#: Of captures that are path traced: less than the paper's 50 and 50 photographs of 512² px, where fits see no more.
SIZES: dict[str, dict[str, Any]] = {
    "full": {},
    "quick": {"views": 16, "novel": 4, "size": (128, 128), "spp": 16},
    "fast": {"views": 32, "novel": 8, "size": (256, 256), "spp": 16},
}


def captures(asked: Asked) -> list[Recipe]:
    """Those that are given, else the one at hand; a mesh is path traced with a material of its own."""
    meshes = [path for path in asked.data if path.suffix.lower() in MESHES]
    if asked.materials and not meshes:
        raise InputError("--materials: are what meshes are made of; give meshes as DATA")
    if len(asked.materials) > max(1, len(meshes)):
        raise InputError(f"--materials: are {len(asked.materials)} for {len(meshes)} meshes; give one each, or fewer, "
                         "which are taken in turn")  # fmt: skip
    found: list[Recipe] = []
    for path in asked.data:
        if path.is_file() and path.suffix.lower() not in (".xml", *MESHES):
            raise InputError(f"{path}: DATA: is neither a scene file, .xml, nor a mesh, {', '.join(MESHES)}; give one "
                             "of these")  # fmt: skip
        if path in meshes:
            material = asked.materials[meshes.index(path) % len(asked.materials)] if asked.materials else None
            found.append(traced(asked, path, material))
        else:
            found.append(given(path))
    return found or [own()]


def traced(asked: Asked, mesh: Path | None, material: str | None, name: str = "", **options: Any) -> Synthetic:
    """A capture as the paper's: 50 photographs, 60° wide, flash at the camera, overexposed in parts, of 8 bits."""
    settings: dict[str, Any] = {"format": "png8", "cameras": "free", **SIZES[asked.size], **options}
    return Synthetic(
        name or (mesh.stem if mesh else "pot"), SynthesizeConfig(Path(), Path(), material, **settings), mesh
    )


def require_no_materials(asked: Asked) -> None:
    """Raise InputError if materials are given where nothing is made of them."""
    if asked.materials:
        raise InputError("--materials: are what meshes are made of, and this experiment takes none; leave them out")


def one_mesh(asked: Asked) -> Path | None:
    """That is given, if one is. Raises InputError if that is not one mesh, or if a material is not one BRDF."""
    for material in asked.materials:
        require_uniform(material)
    if len(asked.data) > 1 or any(path.suffix.lower() not in MESHES for path in asked.data):
        raise InputError(f"DATA: must be one mesh ({', '.join(MESHES)}), or nothing for the pot that is at hand")
    return asked.data[0] if asked.data else None


def require_uniform(material: str) -> None:
    """Raise InputError for what is no material, and for one that varies over the surface."""
    load_material(material, "--materials", coloured=True)
    said = Path(material).read_text(errors="replace") if material.lower().endswith(".xml") else material
    if "<texture" in said or f"={COLOURS}" in said:
        raise InputError(f"--materials: {material}: varies over the surface, and slices are of one BRDF; give one that "
                         "is the same everywhere")  # fmt: skip


def short(material: str) -> str:
    """A name for a material that is fit for a file."""
    if ".npz:" in material:
        return material.rpartition(":")[2]
    words = material.split()
    values = [word.replace("roughness=", "r") for word in words[1:] if word.startswith("roughness=")]
    return "-".join([Path(words[0]).stem, *values])
