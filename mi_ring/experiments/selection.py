"""The datasets that the arguments DATA and --materials of `mi-ring paper` select."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_ring.errors import InputError
from mi_ring.experiments.datasets import Dataset, Synthetic, default_dataset, given
from mi_ring.experiments.experiment import ExperimentOptions
from mi_ring.synthesis.materials import COLOURS, load_material
from mi_ring.synthesis.options import SynthesizeConfig

MESHES = ".ply", ".obj", ".glb", ".stl", ".off"
#: Options of path-traced captures. Full: 50 photographs of 512² px, as in the paper. Fast fits use no more than 256².
SIZES: dict[str, dict[str, Any]] = {
    "full": {},
    "quick": {"views": 16, "novel": 4, "size": (128, 128), "spp": 16},
    "fast": {"views": 32, "novel": 8, "size": (256, 256), "spp": 16},
}


def datasets(options: ExperimentOptions) -> list[Dataset]:
    """Return a dataset for each capture and each mesh in DATA. If DATA is empty, return the default dataset.

    Photographs of a mesh are path traced later, by the dataset's method `prepare`. The first mesh gets the first of
    --materials, the second mesh the second, and so on. If there are fewer materials than meshes, the materials are
    repeated. Raises InputError if DATA or --materials are wrong.
    """
    meshes = [path for path in options.data if path.suffix.lower() in MESHES]
    if options.materials and not meshes:
        raise InputError("--materials: apply to meshes only; give meshes as DATA")
    if len(options.materials) > max(1, len(meshes)):
        raise InputError(f"--materials: are {len(options.materials)} for {len(meshes)} meshes; give one each, or "
                         "fewer, which are taken in turn")  # fmt: skip
    found: list[Dataset] = []
    for path in options.data:
        if path.is_file() and path.suffix.lower() not in (".xml", *MESHES):
            raise InputError(f"{path}: DATA: is neither a scene file, .xml, nor a mesh, {', '.join(MESHES)}; give one "
                             "of these")  # fmt: skip
        if path in meshes:
            material = options.materials[meshes.index(path) % len(options.materials)] if options.materials else None
            found.append(path_traced(options, path, material))
        else:
            found.append(given(path))
    return found or [default_dataset(options.captures)]


def path_traced(
    options: ExperimentOptions, mesh: Path | None, material: str | None, name: str = "", **more: Any
) -> Synthetic:
    """Return a dataset of path-traced photographs of a mesh, as in the paper. Nothing is rendered yet.

    `mesh`: None for the pot of `mi-ring example`. `material`: as in `mi-ring synthesize`; None: its default. `name`:
    name of the dataset; empty: the name of the mesh. `more`: other options of `mi-ring synthesize`.
    """
    settings: dict[str, Any] = {"format": "png8", "cameras": "free", **SIZES[options.size], **more}
    config = SynthesizeConfig(Path(), Path(), material, **settings)
    name = name or (mesh.stem if mesh else "pot")
    key = repr((config, mesh and mesh.resolve())).encode()  # two meshes or materials may have the same name
    folder = options.captures / f"{name}-{hashlib.blake2b(key, digest_size=3).hexdigest()}"
    config = replace(config, mesh=(mesh or options.captures / "pot.ply").resolve(), out=folder)
    return Synthetic(name, folder / "scene.xml", folder / "truth", config, mesh is None)


def require_no_materials(options: ExperimentOptions) -> None:
    """Raise InputError if --materials is given. This is for experiments that do not use materials."""
    if options.materials:
        raise InputError("--materials: apply to meshes, which this experiment does not use; leave them out")


def one_mesh(options: ExperimentOptions) -> Path | None:
    """Return the one mesh in DATA, or None if DATA is empty.

    Raises InputError if DATA is anything else than one mesh, or if one of --materials varies over the surface.
    """
    for material in options.materials:
        load_material(material, "--materials", coloured=True)
        text = Path(material).read_text(errors="replace") if material.lower().endswith(".xml") else material
        if "<texture" in text or f"={COLOURS}" in text:
            raise InputError(f"--materials: {material}: varies over the surface; give a material that is the same "
                             "everywhere")  # fmt: skip
    if len(options.data) > 1 or any(path.suffix.lower() not in MESHES for path in options.data):
        raise InputError(f"DATA: must be one mesh ({', '.join(MESHES)}), or nothing for the pot of mi-ring example")
    return options.data[0] if options.data else None


def short_name(material: str) -> str:
    """Return a short name of a material for file names: the name of its BSDF plugin or its file, and its roughness."""
    if ".npz:" in material:
        return material.rpartition(":")[2]
    words = material.split()
    values = [word.replace("roughness=", "r") for word in words[1:] if word.startswith("roughness=")]
    return "-".join([Path(words[0]).stem, *values])
