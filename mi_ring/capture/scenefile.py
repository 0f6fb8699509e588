"""Writes the XML of scene files, and changes it: photographs, cameras, lights, the fitted object."""

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from mi_ring.capture.emitter_elements import Element, emitter_element, numbers, room_elements
from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera
from mi_ring.plugins.shapenet import FOR_FITS
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.scene.lights import Light
from mi_ring.scene.lobes import Lobes
from mi_ring.scene.shot import Files, Shot
from mi_ring.system.files import relative_to

#: Properties of plugins that name a file. Values of other properties may look like file names.
FILES = "filename", "mask", "valid", "ambient", "domain", "weights"

#: Optional numbers of a photograph: where a `Shot` has them, and their defaults, which are not written.
OPTIONAL = {
    "gamma": ("response.curve.gamma", 1.0), "contrast": ("response.curve.contrast", 1.0),
    "toe": ("response.curve.toe", 0.0), "vignetting": ("response.vignetting", 0.0), "falloff": ("falloff", 0.0),
    "distortion": ("camera.distortion", 0.0),
}  # fmt: skip
#: Properties of a photograph, beside its light, that a fit may refine.
REFINED = {"fx", "fy", "cx", "cy", "to_world", "gain", "tilt", *OPTIONAL}


def photograph_element(shot: Shot) -> Element:
    """Make the XML element of a photograph. The file names in `shot` must be relative to the scene file."""
    shot = shot.whole
    element = ElementTree.Element("sensor", type="photograph", id=shot.name)
    for field, file in shot.files._asdict().items():
        if file:
            ElementTree.SubElement(element, "string", name=field, value=file.as_posix())
    if shot.encoding != "auto":
        ElementTree.SubElement(element, "string", name="encoding", value=shot.encoding)
    camera, response = shot.camera, shot.response
    fields = dict(zip(("fx", "fy", "cx", "cy"), (*camera.focal, *camera.centre)))
    if shot.saturation != 1:
        fields["saturation"] = shot.saturation
    for field, (where, default) in OPTIONAL.items():
        if (value := attrgetter(where)(shot)) != default:
            fields[field] = value
    for field, value in fields.items():
        ElementTree.SubElement(element, "float", name=field, value=numbers(value))
    if response.gain != (1, 1, 1):
        ElementTree.SubElement(element, "string", name="gain", value=numbers(response.gain))
    if shot.tilt != (0, 0):
        ElementTree.SubElement(element, "string", name="tilt", value=numbers(shot.tilt))
    if shot.calibrated:
        ElementTree.SubElement(element, "boolean", name="calibrated", value="true")
    add_pose(element, camera.to_world)
    add_film(element, *camera.size)
    if shot.light:
        element.append(emitter_element(shot.light))
    return element


def scene_element(
    photographs: Iterable[Element] = (), center: np.ndarray | None = None, radius: float | None = None,
    ground: np.ndarray | None = None, up: np.ndarray | None = None, metres: float | None = None, fresnel: bool = False,
) -> Element:  # fmt: skip
    """Make the XML of a scene: a `photometric` integrator, and a `shapenet` with the BSDF `cooktorrance`.

    `photographs`: XML elements to add. `center` (3,), `radius`: normalising sphere [scene units]. `ground` (3,): a
    point on the table. `up` (3,): normal of the table, or up direction. `metres`: length of a scene unit [m]. What is
    None is left out. `fresnel`: True gives the BSDF a Fresnel term.
    """
    root = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(root, "integrator", type="photometric")
    shape = ElementTree.SubElement(root, "shape", type="shapenet", id="object")
    for tag, name, vector in (("point", "center", center), ("point", "ground", ground), ("vector", "up", up)):
        if vector is not None:
            x, y, z = map(numbers, vector)
            ElementTree.SubElement(shape, tag, name=name, x=x, y=y, z=z)
    for name, number in (("radius", radius), ("metres", metres)):
        if number is not None:
            ElementTree.SubElement(shape, "float", name=name, value=numbers(number))
    bsdf = ElementTree.SubElement(shape, "bsdf", type="cooktorrance")
    if fresnel:
        ElementTree.SubElement(bsdf, "boolean", name="fresnel", value="true")
    root.extend(photographs)
    return root


def table_element(picture: str, square: np.ndarray) -> Element:
    """Make the XML of a diffuse table, a textured rectangle. `picture`: file name of the texture, the table's albedo.

    `square` (4, 4): the table's transform `to_world`.
    """
    element = ElementTree.Element("shape", type="table")
    add_pose(element, square)
    bsdf = ElementTree.SubElement(element, "bsdf", type="diffuse")
    texture = ElementTree.SubElement(bsdf, "texture", name="reflectance", type="bitmap")
    ElementTree.SubElement(texture, "string", name="filename", value=picture)
    ElementTree.SubElement(texture, "string", name="wrap_mode", value="clamp")
    return element


def scene_bytes(root: Element) -> bytes:
    """Indent the XML of a scene, and return it as the UTF-8 content of a file. `root` is indented in place."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, "utf-8")


def perspective_element(camera: Camera, points: np.ndarray) -> Element:
    """Make the XML of a camera as Mitsuba's sensor `perspective`. Lens distortion is left out.

    `points` (n, 3): the clipping planes enclose them. Mitsuba's pixels are square. If the camera's pixels are not
    square, the number of rows is changed.
    """
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.centre, camera.size
    distance = np.linalg.norm(points - camera.position, axis=1)
    height, cy = round(height * fx / fy), cy * fx / fy
    sensor = ElementTree.Element("sensor", type="perspective")
    for name, value in {
        "fov": math.degrees(2 * math.atan(width / 2 / fx)),
        "principal_point_offset_x": 0.5 - cx / width, "principal_point_offset_y": 0.5 - cy / height,
        "near_clip": 0.5 * distance.min(), "far_clip": 2 * distance.max(),
    }.items():  # fmt: skip
        ElementTree.SubElement(sensor, "float", name=name, value=numbers(value))
    ElementTree.SubElement(sensor, "string", name="fov_axis", value="x")
    add_pose(sensor, camera.to_world)
    add_film(sensor, width, height)
    return sensor


def add_pose(element: Element, to_world: np.ndarray) -> None:
    """Add the transform `to_world` (4, 4) to the XML of a sensor or shape."""
    transform = ElementTree.SubElement(element, "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=numbers(to_world))


def add_film(sensor: Element, width: int, height: int) -> None:
    """Add a film of `width` × `height` [px] to the XML of a sensor."""
    film = ElementTree.SubElement(sensor, "film", type="hdrfilm")
    for name, pixels in (("width", width), ("height", height)):
        ElementTree.SubElement(film, "integer", name=name, value=str(pixels))


def recalibrated_xml(
    scene: bytes, shots: Sequence[Shot], room: np.ndarray | None = None, frames: Collection[str] | None = None,
    lamps: Iterable[Light] | None = None, lobes: Lobes | None = None,
) -> bytes:  # fmt: skip
    """Return new content for a scene file, with the cameras, lights and responses of `shots`. No file is written.

    `scene`: the old content. A shot replaces the photograph whose id is its name; without ids, the photograph at the
    same position. `room` (BASIS, 3): spherical harmonics of the room's light; None: none. `frames`: "world" and/or
    "camera"; light in these axes is written even if it is black; None: the axes that the old content has. `lamps`:
    point and directional lights for all photographs; None: keep the old ones. `lobes`: small lights of the room.
    """
    root = ElementTree.fromstring(scene)
    for element, k in photographs_of(root, shots):
        new = photograph_element(shots[k])
        for child in list(element):
            known = f".//emitter[@id='{child.get('id')}']"
            lit = child.tag == "emitter" or (child.tag == "ref" and root.find(known) is not None)
            if lit or child.get("name") in REFINED:
                element.remove(child)
        element.extend(child for child in new if child.tag == "emitter" or child.get("name") in REFINED)
    if lamps is not None:
        for emitter in [e for e in root.findall("emitter") if e.get("type") in ("point", "directional")]:
            root.remove(emitter)
        root.extend(map(emitter_element, lamps))
    before = set()
    for emitter in root.findall("emitter[@type='room']"):
        frame = emitter.find("string[@name='frame']")
        before.add("world" if frame is None else frame.get("value", ""))
        root.remove(emitter)
    if room is not None or lobes is not None:
        room = np.zeros((BASIS, 3)) if room is None else room
        root.extend(room_elements(room, before if frames is None else frames, lobes))
    return scene_bytes(root)


def with_photographs(scene: bytes, shots: Iterable[Shot]) -> bytes:
    """Return new content for a scene file, in which `shots` replace all photographs. `scene`: the old content."""
    root = ElementTree.fromstring(scene)
    for element in root.findall("sensor[@type='photograph']"):
        root.remove(element)
    root.extend(map(photograph_element, shots))
    return scene_bytes(root)


def with_missing_photographs(scene: bytes, shots: Sequence[Shot], folder: Path) -> bytes:
    """Return new content for a scene file, with those photographs of `shots` that it lacks at its end.

    `scene`: the old content. `folder`: where the scene file will be. Ids say which photographs it has; without ids, it
    has the first ones of `shots`.
    """
    root = ElementTree.fromstring(scene)
    ids = [element.get("id", "") for element in root.findall(".//sensor[@type='photograph']")]
    missing = [shot for shot in shots if shot.name not in ids] if all(ids) else shots[len(ids) :]
    if not missing:
        return scene
    for shot in missing:
        files = (file and Path(relative_to(folder.resolve(), file.resolve())) for file in shot.files)
        root.append(photograph_element(replace(shot, files=Files(*files))))
    return scene_bytes(root)


def remasked_xml(scene: bytes, shots: Sequence[Shot], masks: Mapping[int, str]) -> bytes:
    """Return new content for a scene file, with new masks. No file is written. `scene`: the old content.

    `shots`: the photographs of the scene. `masks`: a dict from the index of a photograph to the name of its new mask
    file, relative to the scene file. Other photographs keep their masks.
    """
    root = ElementTree.fromstring(scene)
    for element, k in photographs_of(root, shots):
        if k in masks:
            for old in element.findall("string[@name='mask']"):
                element.remove(old)
            ElementTree.SubElement(element, "string", name="mask", value=masks[k])
    return scene_bytes(root)


def photographs_of(root: Element, shots: Sequence[Shot]) -> list[tuple[Element, int]]:
    """Find the XML elements of photographs in a scene. Returns a list of (element, index of its shot in `shots`).

    An element belongs to the shot whose name is its id; without ids, to the shot at the same position. If there are
    more elements than shots, elements without a shot are removed from `root`. Raises InputError if this is impossible
    because ids are missing.
    """
    elements = root.findall(".//sensor[@type='photograph']")
    named = {shot.name: k for k, shot in enumerate(shots) if shot.name}
    if len(elements) > len(shots):  # the capture is a part of the scene's photographs
        for parent in [root, *root.iter()]:
            for other in [e for e in parent if e in elements and e.get("id", "") not in named]:
                parent.remove(other)
        elements = root.findall(".//sensor[@type='photograph']")
    if len(elements) != len(shots):
        raise InputError("scene file: cannot be written with some of its photographs only, because these have no ids")
    return [(element, named.get(element.get("id", ""), k)) for k, element in enumerate(elements)]


def move_names(root: Element, source: Path, folder: Path) -> None:
    """Change the file names in a scene in place. Names relative to the folder `source` become relative to `folder`."""
    for element in root.iter("string"):
        if element.get("name") not in FILES:
            continue
        file = source / element.get("value", "")
        if element.get("value") and os.path.isfile(file):  # Path.is_file raises for what is too long for a name
            element.set("value", relative_to(folder.resolve(), file.resolve()))


def fitted_scene_xml(path: Path, folder: Path, subdivisions: int, bsdf: str) -> bytes:
    """Return new content for the scene file `path`, as a file of the results folder `folder`, with the fitted object.

    No file is written. `subdivisions`: level of the object's mesh. `bsdf`: XML of the object's BSDF. File names become
    relative to `folder`. Raises InputError if the scene has a feature that a fit does not support.
    """
    root = ElementTree.parse(path).getroot()
    old_bsdf, _ = bsdf_element(root, path)
    move_names(root, path.parent, folder)
    shape = next(e for e in root.iter("shape") if e.get("type") == "shapenet")
    for element in list(shape):
        if element.get("name") == "to_world":
            raise InputError(f"{path}: shapenet, to_world: is for finished fits; remove it to fit anew")
        if element.get("name") in ("weights", "subdivisions", *FOR_FITS):
            shape.remove(element)
    shape.remove(old_bsdf)
    shape.append(ElementTree.fromstring(bsdf))
    ElementTree.SubElement(shape, "integer", name="subdivisions", value=str(subdivisions))
    ElementTree.SubElement(shape, "string", name="weights", value="ring.pt")
    return scene_bytes(root)


def updated(scene: bytes, level: int, bsdf: str) -> bytes:
    """Return the scene file of a fit with another `level` of the object's mesh, and with the XML `bsdf` of its BSDF.

    `scene`: its content.
    """
    root = ElementTree.fromstring(scene)
    shape = next(e for e in root.iter("shape") if e.get("type") == "shapenet")
    next(e for e in shape if e.get("name") == "subdivisions").set("value", str(level))
    place = next(k for k, e in enumerate(shape) if e.tag == "bsdf")
    shape[place] = ElementTree.fromstring(bsdf)
    return scene_bytes(root)


def bsdf_element(root: Element, path: Path) -> tuple[Element, Element]:
    """Find the BSDF of the `shapenet` in a scene. Returns (element in the `shapenet`, <bsdf> element).

    Both are the same, or the first is a <ref> to the second. `path`: the scene file, for messages. Raises InputError if
    there is no BSDF, or if the scene has <include>, <default> or <path> elements.
    """
    for tag in ("include", "default", "path"):
        if root.find(f".//{tag}") is not None:
            raise InputError(f"{path}: <{tag}>: a fit needs a scene without it; write out what it stands for")
    shape = next(e for e in root.iter("shape") if e.get("type") == "shapenet")
    known = {e.get("id"): e for e in root.iter("bsdf")}
    for child in shape:
        if child.tag == "bsdf":
            return child, child
        if child.tag == "ref" and child.get("id") in known:
            return child, known[child.get("id")]
    raise InputError(f'{path}: shapenet: has no <bsdf>; add for instance <bsdf type="cooktorrance"/>')
