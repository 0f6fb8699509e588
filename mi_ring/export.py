"""Write a fitted object for other programs: `python -m mi_ring.export RUN FILE.{ply,obj,glb,xml}`."""

import io
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
from tyro.conf import Positional, arg

from mi_ring import capture, command, gltf
from mi_ring.atlas import Atlas, Texels, rasterise, reflectances, unwrap
from mi_ring.capture import camera_of
from mi_ring.errors import InputError
from mi_ring.integrator import light_of
from mi_ring.material import MaterialOptions, dress
from mi_ring.mesh import mesh_of
from mi_ring.photograph import Photograph
from mi_ring.results import replace, require_place, write_image, write_mesh, write_ply
from mi_ring.ring import Ring

KINDS = (".ply", ".obj", ".glb", ".xml")
GLB_LEVEL = 5  #: of its mesh; the normal map has what is finer


@dataclass(frozen=True, kw_only=True)
class ExportConfig(MaterialOptions):
    """Write the object of a finished fit for other programs. The file's name says as what.

    .ply: the mesh with the parameters of its BSDF as vertex attributes. .glb: with a normal map and the material as
    glTF's metallic-roughness. .obj: the same as OBJ, MTL and PNG files. .xml: a scene for Mitsuba, with bitmap textures
    and a stock BSDF, that needs no mi_ring. Positions are in the scene's units and frame.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit, or its ring.pt."""
    file: Positional[Annotated[Path, arg(metavar="FILE")]]
    """File to write; OBJ and XML bring others of the same name along."""
    subdivisions: int | None = None
    """Level of the mesh: about 10 · 4^level vertices. Default: that of the fit; for .glb 5, it has a normal map."""
    resolution: int = 2048
    """Texels across the textures."""
    time: float = 1.0
    """Of the flow: 0 is where it starts, 1 the object."""
    metres: float | None = None
    """Length of a scene unit, which scales the GLB to glTF's metres. Default: it is not known."""


def check(config: ExportConfig) -> None:
    """Raise InputError for options out of range, and for a file that cannot be written."""
    if config.file.suffix.lower() not in KINDS:
        raise InputError(f"{config.file}: must end in {', '.join(KINDS)}")
    if config.subdivisions is not None and not 0 <= config.subdivisions <= 8:
        raise InputError(f"--subdivisions: is {config.subdivisions}, must be 0 to 8")
    if not 64 <= config.resolution <= 4096:
        raise InputError(f"--resolution: is {config.resolution}, must be 64 to 4096")
    if not 0 <= config.time <= 1:
        raise InputError(f"--time: is {config.time}, must be 0 to 1")
    if config.metres is not None and not 0 < config.metres < math.inf:
        raise InputError(f"--metres: is {config.metres}, must be a positive number")
    if config.metres is not None and config.file.suffix.lower() != ".glb":
        raise InputError(f"--metres: is for .glb alone; {config.file.name} keeps the scene's units")
    if config.file.is_dir():
        raise InputError(f"{config.file}: is a folder; name the file to write")
    run = config.run if config.run.is_dir() else config.run.parent
    photographs = config.file.suffix.lower() == ".xml" and config.file.is_file() and (
        b'"photograph"' in config.file.read_bytes()
    )  # fmt: skip
    if photographs or config.file.resolve() == (run / "mesh.ply").resolve():
        raise InputError(f"{config.file}: is a file of the fit or of a capture; choose another name")


def main(arguments: Sequence[str]) -> None:
    """The command."""
    config = command.parse(ExportConfig, arguments, "mi_ring.export")
    check(config)
    ring = Ring.load(config.run)
    dress(ring, config)
    kind = config.file.suffix.lower()
    level = config.subdivisions
    if level is None:
        level = min(GLB_LEVEL, ring.subdivisions) if kind == ".glb" else ring.subdivisions
    if kind in (".glb", ".obj"):
        gltf.require(ring)
    photograph = first_photograph(config.run) if kind == ".xml" else None
    require_place(config.file)
    if kind == ".ply":
        write_mesh(ring, level, config.file, config.time)
        files = [config.file]
    elif kind == ".glb":
        replace(config.file, gltf.glb(ring, level, config.resolution, config.time, config.metres))
        files = [config.file]
    else:
        print("Cutting the surface open and baking its material", flush=True)
        atlas = unwrap(ring, level, config.resolution, config.time)
        texels = rasterise(ring, atlas, config.resolution, config.time)
        values = reflectances(ring, texels.s)
        if kind == ".obj":
            files = write_obj(config.file, atlas, texels, gltf.metallic_roughness(ring.bsdf, values))
        else:
            files = write_scene(config.file, atlas, texels, ring.bsdf, values, photograph)
    print("\n".join(map(str, files)))


def write_obj(path: Path, atlas: Atlas, texels: Texels, material: gltf.Material) -> list[Path]:
    """OBJ with MTL and PNG. Positions and normals are those of the closed mesh, seams exist only in the texture."""
    baked, files = gltf.textures(material, texels), {}
    for name, image in {
        "diffuse": baked["baseColorTexture"], "normal": baked["normalTexture"],
        "specular": baked["specularTexture"][..., 3, None],
        "roughness": baked["metallicRoughnessTexture"][..., 1, None],
        "metallic": baked["metallicRoughnessTexture"][..., 2, None],
    }.items():  # fmt: skip
        files[name] = path.with_name(f"{path.stem}_{name}.png")
        write_image(image, files[name])
    library = path.with_suffix(".mtl")
    replace(library, "\n".join([
        "newmtl fitted", "illum 2", "Kd 1 1 1", f"map_Kd {files['diffuse'].name}",
        "Ks {0:.4g} {0:.4g} {0:.4g}".format(min(0.04 * material.specular_color, 1)), f"map_Ks {files['specular'].name}",
        "Pr 1", f"map_Pr {files['roughness'].name}", "Pm 1", f"map_Pm {files['metallic'].name}",
        f"norm {files['normal'].name}", "",
    ]))  # fmt: skip
    closed, first = np.unique(atlas.whole, return_index=True)
    whole = np.searchsorted(closed, atlas.whole)
    corners = np.stack([whole, np.arange(len(whole)), whole], 1)[atlas.faces] + 1
    text = io.StringIO()
    text.write(f"mtllib {library.name}\no object\nusemtl fitted\n")
    np.savetxt(text, atlas.vertices[first], "v %.9g %.9g %.9g")
    np.savetxt(text, atlas.uv * [1, -1] + [0, 1], "vt %.9g %.9g")  # v points up in OBJ
    np.savetxt(text, atlas.normals[first], "vn %.5f %.5f %.5f")
    np.savetxt(text, corners.reshape(-1, 9), "f %d/%d/%d %d/%d/%d %d/%d/%d")
    replace(path, text.getvalue())
    return [path, library, *files.values()]


def first_photograph(run: Path) -> Photograph:
    """The first photograph of a fit, as its scene.xml has it. Raises InputError if there is none."""
    if not run.is_dir():
        raise InputError(f"{run}: a scene for Mitsuba takes its camera from the results folder; give the folder")
    return capture.open_scene(run / "scene.xml")[1][0]


def write_scene(path: Path, atlas: Atlas, texels: Texels, bsdf: str, values, photograph: Photograph) -> list[Path]:
    """A scene with the textured object, and the camera and the light of a photograph, of stock plugins alone."""
    files = [path]
    mesh = mesh_of(atlas.vertices, atlas.faces, uv=atlas.uv)
    params = mi.traverse(mesh)
    params["vertex_normals"] = mi.Float(atlas.normals.astype(np.float32).ravel())  # Mitsuba's know of the seams
    params.update()
    files.append(path.with_name(f"{path.stem}_object.ply"))
    write_ply(mesh, files[-1])

    def bitmap(parent, name: str, image: np.ndarray) -> None:
        """A texture (N, 3) or (N,) of the texels."""
        files.append(path.with_name(f"{path.stem}_{name}.exr"))
        write_image(image[texels.index].astype(np.float32).reshape(*texels.index.shape, -1), files[-1])
        texture = ElementTree.SubElement(parent, "texture", name=name, type="bitmap")
        ElementTree.SubElement(texture, "string", name="filename", value=files[-1].name)
        if image.ndim == 1:
            ElementTree.SubElement(texture, "boolean", name="raw", value="true")

    scene = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(scene, "integrator", type="path")
    shape = ElementTree.SubElement(scene, "shape", type="ply", id="object")
    ElementTree.SubElement(shape, "string", name="filename", value=files[1].name)
    element, scale = ElementTree.fromstring(bsdf), 1.0
    if element.get("type") == "cooktorrance":
        material = gltf.metallic_roughness(bsdf, values)
        scale = material.scale
        distribution = next((e.get("value") for e in element if e.get("name") == "distribution"), "ggx")
        element = ElementTree.SubElement(shape, "bsdf", type="blendbsdf")
        bitmap(element, "weight", material.specular)
        bitmap(ElementTree.SubElement(element, "bsdf", type="diffuse"), "reflectance", material.base_color)
        gloss = ElementTree.SubElement(element, "bsdf", type="roughconductor")
        ElementTree.SubElement(gloss, "string", name="material", value="none")
        ElementTree.SubElement(gloss, "string", name="distribution", value=distribution)
        bitmap(gloss, "alpha", material.roughness**2)
    else:
        shape.append(element)
        for texture in [t for t in element.iter("texture") if t.get("type") == "mesh_attribute"]:
            name = texture.get("name")
            parent = next(e for e in element.iter() if texture in e)
            parent.remove(texture)
            bitmap(parent, name, values[name])
    scene.append(camera(photograph, atlas.vertices))
    scene.append(light(photograph, scale))
    ElementTree.indent(scene)
    replace(path, ElementTree.tostring(scene, "utf-8"))
    return files


def camera(photograph: Photograph, vertices: np.ndarray) -> ElementTree.Element:
    """The camera of a photograph as `perspective`. Its pixels are square, so that it may have more or fewer rows."""
    matrix, (fx, fy), (cx, cy) = camera_of(photograph)
    distance = np.linalg.norm(vertices - matrix[:3, 3], axis=1)
    width, height = photograph.size
    height, cy = round(height * fx / fy), cy * fx / fy
    sensor = ElementTree.Element("sensor", type="perspective")
    for name, value in {
        "fov": math.degrees(2 * math.atan(width / 2 / fx)),
        "principal_point_offset_x": 0.5 - cx / width, "principal_point_offset_y": 0.5 - cy / height,
        "near_clip": 0.5 * distance.min(), "far_clip": 2 * distance.max(),
    }.items():  # fmt: skip
        ElementTree.SubElement(sensor, "float", name=name, value=f"{value:.9g}")
    ElementTree.SubElement(sensor, "string", name="fov_axis", value="x")
    to_world = ElementTree.SubElement(sensor, "transform", name="to_world")
    ElementTree.SubElement(to_world, "matrix", value=" ".join(f"{v:.9g}" for v in matrix.ravel()))
    film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
    for name, pixels in (("width", width), ("height", height)):
        ElementTree.SubElement(film, "integer", name=name, value=str(pixels))
    return sensor


def light(photograph: Photograph, scale: float) -> ElementTree.Element:
    """The light of a photograph as an emitter of the scene, for reflectances that were multiplied by `scale`."""
    x, y, z, distant, *intensity = np.ravel(light_of(photograph))[:7].tolist()
    emitter = ElementTree.Element("emitter", type="directional" if distant else "point")
    if distant:
        ElementTree.SubElement(emitter, "vector", name="direction", x=f"{-x:.9g}", y=f"{-y:.9g}", z=f"{-z:.9g}")
    else:
        ElementTree.SubElement(emitter, "point", name="position", x=f"{x:.9g}", y=f"{y:.9g}", z=f"{z:.9g}")
    ElementTree.SubElement(emitter, "rgb", name="irradiance" if distant else "intensity",
                           value=", ".join(f"{v / scale:.9g}" for v in intensity))  # fmt: skip
    return emitter


if __name__ == "__main__":
    command.run("mi_ring.export", main)
