"""Writes a scene that Mitsuba renders without mi_ring, because it uses only textures and Mitsuba's own plugins."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from mi_ring.capture.emitter_elements import emitter_element
from mi_ring.capture.loading import open_scene
from mi_ring.capture.scenefile import perspective_element
from mi_ring.errors import InputError
from mi_ring.images import write_image
from mi_ring.output import gltf
from mi_ring.output.atlas import Atlas, Texels
from mi_ring.output.ply import write_ply
from mi_ring.rendering.spherical_harmonics import room_envmap, room_of
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.lobes import Lobes, lobes_of
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.shot import Shot
from mi_ring.system.files import write_file

ATTRIBUTES = "mesh_attribute", "fine_attribute"  #: plugins that read mesh attributes


class Lit(NamedTuple):
    """A photograph and the light of its room. None: no such light."""

    shot: Shot
    room: np.ndarray | None = None  #: (BASIS, 3) spherical harmonics
    lobes: Lobes | None = None


def first_photograph(run: Path) -> Lit:
    """Read scene.xml in the results folder `run`.

    Returns the first photograph and the light of the room.
    Raises InputError if there is no scene.xml, or if neither the photograph nor the room has a light.
    """
    if not run.is_dir():
        raise InputError(f"{run}: a scene for Mitsuba takes its camera from the results folder; give the folder")
    scene, shots = open_scene(run / "scene.xml")
    room = room_of(scene)
    if room is None and not shots[0].own_light.rgb.any():
        raise InputError(f"{run}/scene.xml: a scene for Mitsuba needs the photographs' own light, and there is "
                         "none; export OBJ or GLB and light it yourself")  # fmt: skip
    return Lit(shots[0], room, lobes_of(scene))


def write_scene(
    path: Path, atlas: Atlas, texels: Texels, bsdf: str, values: dict[str, np.ndarray], shot: Shot,
    room: np.ndarray | None, lobes: Lobes | None = None,
) -> list[Path]:  # fmt: skip
    """Write a scene with the textured object, and camera and light of a photograph. Returns the paths of its files.

    `path`: the XML file; the other files lie beside it. `texels`: the N points with values, and which of them each
    texel shows. `values`: BSDF parameters (N, 3) or (N,) by name. `bsdf`: Mitsuba's XML. `shot`: the photograph. The
    cone of its flash is left out. `room` (BASIS, 3): room light, spherical harmonics; it becomes an environment map if
    the photograph has no light. None: no room light. `lobes`: small lights of the room.
    """
    files = [path]
    mesh = mesh_of(atlas.vertices, atlas.faces, uv=atlas.uv)
    params = mi.traverse(mesh)
    params["vertex_normals"] = to_flat(mi.Float, atlas.normals)  # Mitsuba's own have seams
    params.update()
    files.append(path.with_name(f"{path.stem}_object.ply"))
    write_ply(mesh, files[-1])

    def bitmap(parent: ElementTree.Element, name: str, image: np.ndarray, parameter: str = "") -> None:
        """Write a texture with values (N, 3) or (N,) at the texels, and add its XML to `parent`.

        `name`: of the file, and of the BSDF's parameter unless `parameter` is given.
        """
        files.append(path.with_name(f"{path.stem}_{name}.exr"))
        write_image(image[texels.index].astype(np.float32).reshape(*texels.index.shape, -1), files[-1])
        texture = ElementTree.SubElement(parent, "texture", name=parameter or name, type="bitmap")
        ElementTree.SubElement(texture, "string", name="filename", value=files[-1].name)
        if image.ndim == 1:
            ElementTree.SubElement(texture, "boolean", name="raw", value="true")

    scene = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(scene, "integrator", type="path")
    shape = ElementTree.SubElement(scene, "shape", type="ply", id="object")
    ElementTree.SubElement(shape, "string", name="filename", value=files[1].name)
    element, scale = ElementTree.fromstring(bsdf), 1.0
    if element.get("type") == "cooktorrance":
        matte, gloss, widths, scale = gltf.shares(gltf.Values(bsdf, values))
        weight = gloss.sum(1).clip(0, 1)
        distribution = next((e.get("value", "") for e in element if e.get("name") == "distribution"), "ggx")
        element = ElementTree.SubElement(shape, "bsdf", type="blendbsdf")
        bitmap(element, "weight", weight)
        base = (matte / np.maximum(1 - weight, 1e-3)[:, None]).clip(0, 1)
        bitmap(ElementTree.SubElement(element, "bsdf", type="diffuse"), "reflectance", base)
        if gloss.shape[1] > 1:
            element = ElementTree.SubElement(element, "bsdf", type="blendbsdf")
            bitmap(element, "coat", gloss[:, 1] / np.maximum(gloss.sum(1), 1e-12), "weight")
        for name, width in zip(("alpha", "coat_alpha"), widths.T):
            conductor = ElementTree.SubElement(element, "bsdf", type="roughconductor")
            ElementTree.SubElement(conductor, "string", name="material", value="none")
            ElementTree.SubElement(conductor, "string", name="distribution", value=distribution)
            bitmap(conductor, name, width, "alpha")
    else:
        shape.append(element)
        for texture in [t for t in element.iter("texture") if t.get("type") in ATTRIBUTES]:
            name = texture.get("name", "")
            parent = next(e for e in element.iter() if texture in e)
            parent.remove(texture)
            bitmap(parent, name, values[name])
    light = shot.own_light
    scene.append(perspective_element(shot.camera, atlas.vertices))
    if light.rgb.any():
        scene.append(emitter_element(light._replace(rgb=light.rgb / scale)))  # reflectances are scaled
    elif room is not None:
        files.append(path.with_name(f"{path.stem}_environment.exr"))
        radiance = room_envmap(room, shot.camera.to_world, lobes=lobes).clip(min=0) / scale
        write_image(radiance.astype(np.float32), files[-1])
        environment = ElementTree.SubElement(scene, "emitter", type="envmap")
        ElementTree.SubElement(environment, "string", name="filename", value=files[-1].name)
    ElementTree.indent(scene)
    write_file(path, ElementTree.tostring(scene, "utf-8"))
    return files
