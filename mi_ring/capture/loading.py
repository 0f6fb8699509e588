"""Opens scene files: what a fit would stumble over later is said at once."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ring.capture.brightness_masks import find_masks
from mi_ring.capture.capture import Capture, views_of
from mi_ring.capture.decoding import read_mask, read_photograph, require_header
from mi_ring.capture.pixels import Pixels, Reader
from mi_ring.errors import InputError, SceneError, require_file
from mi_ring.images import HEIF, PLAIN, RAW
from mi_ring.plugins import photograph, shapenet
from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import room_of
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.scene.xml_elements import require_parts
from mi_ring.system import llvm
from mi_ring.system.progress import progress

FLATTEST = 8  #: longer side of a photograph by its shorter one
MANY = 2**31  #: pixels of all photographs, about a minute of decoding; of more the headers must do at first


def load_capture(path: str | Path, images: bool = True, masks: str = "given") -> Capture:
    """Open a scene of photographs. Raises InputError, one line, for anything that a fit would stumble over later.

    Without `images` only cameras and lights are read: enough to render. `masks`: those "given" by the scene; if there
    are none, "auto" finds them by brightness where the room was dark; "none" does so even if there are.
    """
    path = Path(path)
    if masks not in ("given", "auto", "none"):
        raise InputError(f"masks: is {masks}, must be one of given, auto, none")
    if mi.variant() not in ("llvm_ad_rgb", "cuda_ad_rgb"):
        why = llvm.missing() or "call mi.set_variant('llvm_ad_rgb') first"
        raise InputError(f"{path}: needs the variant llvm_ad_rgb or cuda_ad_rgb of Mitsuba, not {mi.variant()}; {why}")
    scene, sensors = open_scene(path)
    shapes = [s for s in scene.shapes() if isinstance(s, shapenet.ShapeNetMesh)]
    if len(shapes) != 1:
        raise InputError(f'{path}: shape: found {len(shapes)} <shape type="shapenet">; a fit needs exactly one')
    try:
        for shape in scene.shapes():
            require_attributes(shape)
        if images:
            Edges(scene)  # refuses shapes without gradients
        photographs = Photographs.of(sensors, room_of(scene))
    except SceneError as error:
        raise InputError(f"{path}: {error}") from error
    shadows = getattr(scene.integrator(), "shadows", True)
    if not images:
        return Capture(path, scene, shapes[0], sensors, photographs, shadows)
    for sensor in sensors:
        if FLATTEST * min(sensor.size) < max(sensor.size):
            size = "{} x {}".format(*sensor.size)
            raise InputError(f'{path}: photograph "{sensor.id()}", film: is {size} pixels; sides of more than '
                             f"{FLATTEST} : 1 cannot be made smaller")  # fmt: skip
    pixels = Pixels([partial(read_photograph, s, path) for s in sensors])
    given = masks_of(sensors, "mask", path) if masks != "none" else Pixels([None] * len(sensors))
    valid = masks_of(sensors, "valid", path)
    many = sum(width * height for width, height in (s.size for s in sensors)) > MANY
    for k, sensor in enumerate(progress(sensors, "reading", unit="photograph", disable=None)):
        if many and k:  # decoded as they are needed; the first tells what all are like
            require_headers(sensor, path, masks)
        else:
            pixels[k], given[k], valid[k]
    capture = Capture(path, scene, shapes[0], sensors, photographs, shadows, pixels, given, valid)
    if masks != "given" and not any(given.given):
        find_masks(capture)
    return capture


def require_headers(sensor: Any, scene: Path, masks: str) -> None:
    """Raise InputError if a file that a photograph names is none that could be decoded. `masks`: as for a capture."""
    for field in ("filename", "mask", "valid", "ambient"):
        file = getattr(sensor, field)
        if file and (field != "mask" or masks != "none"):
            require_header(file, field, sensor, scene)


def require_capture(path: Path, masks: str) -> None:
    """Raise InputError, one line, for most of what `load_capture` would stumble over, without decoding anything."""
    for sensor in load_capture(path, images=False).sensors:
        require_headers(sensor, path, masks)


def masks_of(sensors: Sequence, field: str, scene: Path) -> Pixels:
    """The masks (H, W) that photographs name in a field; those that share a file share its pixels."""
    readers: dict[tuple, Reader] = {}

    def reader(sensor: Any, file: Path | None) -> Reader | None:
        key = file, sensor.size, file == sensor.filename
        return readers.setdefault(key, partial(read_mask, sensor, file, field, scene)) if file else None

    return Pixels(reader(sensor, getattr(sensor, field)) for sensor in sensors)


def require_scene(path: Path) -> None:
    """Raise InputError, which says what to give, if a path is no file, or is a photograph."""
    photographs = path.is_dir() or path.suffix.lower() in PLAIN + HEIF + RAW
    usual = "the XML file of a scene" + ("; mi-ring photos makes one of a folder of photographs" * photographs)
    inside = path / "scene.xml"
    require_file(path, str(inside) if inside.is_file() else usual)
    if photographs:
        raise InputError(f"{path}: is a photograph; give {usual}")


def open_scene(path: Path) -> tuple[mi.Scene, list]:
    """A scene file and its photographs, one or more. Raises InputError, one line, if it cannot be read."""
    require_scene(path)
    try:
        require_xml(path)
        scene = mi.load_file(str(path), optimize=False, parallel=False)
    except UnicodeDecodeError as error:
        what = f"is not UTF-8 at byte {error.start} ({error.reason})"
        raise InputError(f"{path}: {what}; give the XML file of a scene, in UTF-8") from error
    except RuntimeError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    sensors = [s for s in scene.sensors() if isinstance(s, photograph.Photograph)]
    if not sensors:
        raise InputError(f'{path}: sensor: found no <sensor type="photograph">; one per photograph is needed')
    return scene, sensors


def require_xml(path: Path) -> None:
    """Raise InputError for what Mitsuba reads and others do not, and for what it takes to be at the origin silently."""
    content = path.read_bytes()
    content.decode("utf-8")
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # of XML, of an encoding that is unknown
        raise InputError(f"{path}: is no XML ({error}); give the XML file of a scene, in UTF-8") from error
    require_parts(root)
    for sensor in root.iterfind(".//sensor[@type='photograph']"):
        name = f'{path}: photograph "{sensor.get("id", "")}"'
        if sensor.find("*[@name='to_world']") is None:
            raise InputError(f"{name}: to_world is missing; say where its camera is")
        for light in sensor.findall("emitter[@type='point']"):
            if not {"position", "to_world"} & {child.get("name") for child in light}:
                raise InputError(f"{name}: emitter: position is missing; say where its light is, or leave the emitter "
                                 "out if that is at the camera")  # fmt: skip


def load_views(path: Path) -> list[MaskedCamera]:
    """What each photograph of a scene file can show, without opening it. Raises InputError if it cannot be read."""
    _, sensors = open_scene(path)
    return views_of(sensors, masks_of(sensors, "valid", path))


def recompute_normals(scene: mi.Scene) -> None:
    """Sum the vertex normals of meshes whose files have none anew: one thread does so in one order, several in any."""
    for shape in scene.shapes():
        if not shape.is_mesh() or not shape.has_vertex_normals():
            continue
        parameters = mi.traverse(shape)
        before = np.array(parameters["vertex_normals"])
        shape.recompute_vertex_normals()
        if not np.allclose(before, np.array(parameters["vertex_normals"]), atol=1e-5):  # they were the file's own
            parameters["vertex_normals"] = before
            parameters.update()


def reason(error: RuntimeError) -> str:
    """What Mitsuba's parser has to say, in one line."""
    text = str(error).split("] ", 1)[-1]
    if "Traceback" in text:  # one of our plugins refused: its message follows the name of the exception
        text = text.split("Error: ", 1)[-1]
    return " ".join(text.split())
