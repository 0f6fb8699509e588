"""Reads scene files, and raises an InputError for anything that cannot be fitted."""

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ring.capture.arrays import FLATTEST
from mi_ring.capture.brightness_masks import with_masks_by_brightness
from mi_ring.capture.capture import Capture, require_variant, views_of
from mi_ring.capture.decoding import read_mask, read_photograph, require_header
from mi_ring.capture.pairs import with_room_photographs
from mi_ring.capture.pixels import Pixels, Reader
from mi_ring.capture.reduction import reduced
from mi_ring.errors import InputError, SceneError, require_file
from mi_ring.image_headers import SUFFIXES
from mi_ring.plugins import photograph, shapenet
from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.spherical_harmonics import room_of
from mi_ring.scene.lobes import lobes_of
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.shot import Shot
from mi_ring.scene.visibility import MaskedCamera
from mi_ring.scene.xml_elements import require_parts
from mi_ring.system.machine import release_scenes
from mi_ring.system.progress import progress

PLACES = {"point": "position", "directional": "direction"}  #: what says where a light is
MANY = 2**28  #: if photographs have more pixels in total, at first only their headers are read
#: Photographs without a light of their own, if others have one: fewer hardly tell the room's light.
FEWEST_DARK = 3


def load_capture(
    path: str | Path, images: bool = True, masks: str = "given", width: int | None = None, crop: bool = True,
    pairs: str = "subtract",
) -> Capture:  # fmt: skip
    """Read a scene file with photographs. Raises InputError for anything that cannot be fitted.

    `images`: False reads only cameras and lights. This is enough for rendering. `width`: photographs are reduced to at
    most this width [px], and, unless `crop` is False, cropped to the object. None: they keep their size.

    `masks` is one of "given", "auto" and "none". "given" uses the masks of the scene. "auto" does the same, but makes
    masks by brightness if the scene has none. "none" ignores the masks of the scene, and makes masks by brightness.
    These need a dark room. If the room was lit, there are no masks then.

    `pairs` is one of "subtract" and "both". It is for photographs with an image `ambient`, which is always subtracted.
    "both" also makes this image another photograph, which the room alone lights, unless it has no mask.
    """
    path = Path(path)
    if pairs not in ("subtract", "both"):
        raise InputError(f"pairs: is {pairs}, must be one of subtract, both")
    if masks not in ("given", "auto", "none"):
        raise InputError(f"masks: is {masks}, must be one of given, auto, none")
    require_variant(path)
    if images:
        release_scenes()
    scene, shots = open_scene(path)
    shapes = [s for s in scene.shapes() if isinstance(s, shapenet.ShapeNetMesh)]
    if len(shapes) != 1:
        raise InputError(f'{path}: shape: found {len(shapes)} <shape type="shapenet">; a fit needs exactly one')
    shadows = getattr(scene.integrator(), "shadows", True)
    capture = Capture(path, path.read_bytes(), scene, shapes[0], shots, room_of(scene), shadows, lobes=lobes_of(scene))
    try:
        for shape in scene.shapes():
            require_attributes(shape)
        if images:
            Edges(scene)  # refuses shapes without gradients
        capture.photographs  # noqa: B018 (refuses lights that cannot be rendered)
    except SceneError as error:
        raise InputError(f"{path}: {error}") from error
    dark = [shot.name for shot, lit in zip(shots, capture.photographs.lit) if not lit]
    if capture.photographs.mixed and len(dark) < FEWEST_DARK:
        raise InputError(f'{path}: photograph "{dark[0]}": its light is 0 strong, must be positive. 0 is for '
                         f"photographs in the light of the room alone, at least {FEWEST_DARK}")  # fmt: skip
    if not images:
        return capture
    for shot in shots:
        if FLATTEST * min(shot.size) < max(shot.size):
            size = "{} x {}".format(*shot.size)
            raise InputError(f'{path}: photograph "{shot.name}", film: is {size} pixels; the sides must be at most '
                             f"{FLATTEST} : 1")  # fmt: skip
    pixels = Pixels(partial(read_photograph, shot, path) for shot in shots)
    given = masks_of(shots, "mask", path) if masks != "none" else Pixels([None] * len(shots))
    valid = masks_of(shots, "valid", path)
    capture = replace(capture, images=pixels, masks=given, valid=valid)
    by_brightness = masks != "given" and not any(given.given)
    if pairs == "both":
        capture = with_room_photographs(capture)
        if len(capture) == len(shots):
            raise InputError(f"{path}: --pairs both: no photograph with a mask names an image `ambient` of its own; "
                             "leave it out")  # fmt: skip
        shots, pixels, given, valid = capture.shots, capture.images, capture.masks, capture.valid
    many = sum(math.prod(shot.size) for shot in shots) > MANY
    for shot in shots if many or width else ():
        require_headers(shot, path, masks)
    if many:  # the first one shows at once what is wrong with all
        read_photograph(shots[0], path), given[0], valid[0]
    if width:
        capture, by_brightness = reduced(capture, width, by_brightness, crop), False
        if any(shot.window for shot in capture.shots):
            return capture
    if not many:
        for k in progress(range(len(shots)), "reading", unit="photograph", disable=None):
            pixels[k], given[k], valid[k]
    return with_masks_by_brightness(capture) if by_brightness else capture


def require_headers(shot: Shot, scene: Path, masks: str) -> None:
    """Raise InputError if an image file of a photograph is missing, is no image, or has a wrong size.

    Pixels are not read. `scene`: the scene file, for messages. `masks`: if it is "none", mask files are not examined.
    """
    for field, file in shot.files._asdict().items():
        if file and (field != "mask" or masks != "none"):
            require_header(file, field, shot, scene)


def require_capture(path: Path, masks: str) -> None:
    """Raise InputError if a scene file, or the header of one of its image files, is invalid. Pixels are not read.

    `masks`: if it is "none", mask files are not examined.
    """
    for shot in load_capture(path, images=False).shots:
        require_headers(shot, path, masks)


def masks_of(shots: Sequence[Shot], field: str, scene: Path) -> Pixels:
    """Return a sequence with the mask (H, W) uint8 of each photograph, or None. A mask is read when it is used.

    `field`: "mask" or "valid". `scene`: the scene file, for messages. Photographs with the same mask file share one
    array.
    """
    readers: dict[tuple, Reader] = {}

    def reader(shot: Shot) -> Reader | None:
        file = getattr(shot.files, field)
        key = file, shot.size, file == shot.files.filename
        return readers.setdefault(key, partial(read_mask, shot, field, scene)) if file else None

    return Pixels(map(reader, shots))


def require_scene(path: Path) -> None:
    """Raise InputError if `path` is not a file, or if its suffix is that of a photograph.

    The message says what to give. The content is not read.
    """
    photographs = path.is_dir() or path.suffix.lower() in SUFFIXES
    usual = "the XML file of a scene" + ("; mi-ring photos makes one of a folder of photographs" * photographs)
    inside = path / "scene.xml"
    require_file(path, str(inside) if inside.is_file() else usual)
    if photographs:
        raise InputError(f"{path}: is a photograph; give {usual}")


def open_scene(path: Path) -> tuple[mi.Scene, tuple[Shot, ...]]:
    """Load a scene file. Returns (Mitsuba scene, its photographs as `Shot`, without pixels).

    Raises InputError if the file cannot be read, if it has no photographs, or if two of them have the same image file.
    """
    require_scene(path)
    try:
        require_xml(path)
        scene = mi.load_file(str(path), optimize=False, parallel=False)
    except UnicodeDecodeError as error:
        what = f"is not UTF-8 at byte {error.start} ({error.reason})"
        raise InputError(f"{path}: {what}; give the XML file of a scene, in UTF-8") from error
    except RuntimeError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    try:
        shots = tuple(sensor.shot for sensor in photographs_in(scene))
    except SceneError as error:
        raise InputError(f"{path}: {error}") from error
    if not shots:
        raise InputError(f'{path}: sensor: found no <sensor type="photograph">; one per photograph is needed')
    known: dict[str, Shot] = {}
    for shot in shots:
        if (other := known.setdefault(os.path.realpath(str(shot.files.filename)), shot)) is not shot:
            raise InputError(f'{path}: photographs "{other.name}" and "{shot.name}": filename: both are '
                             f"{shot.files.filename}; give each its own, or remove one")  # fmt: skip
    return scene, shots


def photographs_in(scene: mi.Scene) -> list[photograph.Photograph]:
    """Return the `photograph` sensors of a scene."""
    return [sensor for sensor in scene.sensors() if isinstance(sensor, photograph.Photograph)]


def require_xml(path: Path, above: tuple[Path, ...] = ()) -> None:
    """Raise InputError if a scene file is no XML, or if it does not say where a camera or a photograph's light is.

    Mitsuba would then use the origin, also for a pose matrix of 9 numbers, which is a rotation alone. The last row of a
    pose matrix must be 0 0 0 1, because Mitsuba ignores it. Files that the scene includes are checked, too. `above`:
    the files that include this one; empty for the scene file. Raises UnicodeDecodeError if the file is not UTF-8.
    """
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
            raise InputError(f"{name}: to_world is missing; give the pose of its camera")
        parts = {element.tag for element in sensor.iterfind("transform/*")}
        for element in sensor.iterfind("transform/matrix"):
            words = element.get("value", "").replace(",", " ").split()
            if len(words) == 9 and not parts & {"translate", "lookat"}:  # Mitsuba puts it at the origin
                raise InputError(f"{name}: to_world: its matrix has 9 numbers, a rotation without a place; give 16, "
                                 "the last four 0 0 0 1, or a <translate> after it")  # fmt: skip
            row = words[12:]
            if len(row) == 4 and not is_affine(row):
                raise InputError(f"{name}: to_world: the last row of its matrix is {' '.join(row)}, must be 0 0 0 1; "
                                 "is it transposed?")  # fmt: skip
        for light in sensor.findall("emitter"):
            place = PLACES.get(light.get("type", ""))
            if place and not {place, "to_world"} & {child.get("name") for child in light}:
                raise InputError(f"{name}: emitter: {place} is missing; give it, or leave out the emitter if the "
                                 "light is at the camera")  # fmt: skip
    for element in root.iter("include"):
        inner = (above or (path,))[0].parent / element.get("filename", "")
        if inner.is_file() and inner not in (*above, path):  # Mitsuba refuses the others
            require_xml(inner, (*above, path))


def is_affine(row: Sequence[str]) -> bool:
    """Test whether `row`, the last row of a matrix as four words, is 0 0 0 1.

    Returns True, too, if a word is no number.
    """
    try:
        return bool(np.allclose([float(word) for word in row], [0, 0, 0, 1]))
    except ValueError:  # parameters, and words that Mitsuba refuses
        return True


def load_views(path: Path) -> list[MaskedCamera]:
    """Read the camera of each photograph in a scene file, with its mask of valid pixels; None: all pixels are valid.

    Both are reduced in size. Raises InputError if the file cannot be read.
    """
    _, shots = open_scene(path)
    return views_of(shots, masks_of(shots, "valid", path))


def recompute_normals(scene: mi.Scene) -> None:
    """Recompute the vertex normals of meshes in `scene`, in place. Normals that come from a mesh file do not change.

    After this, all processes of a fit have exactly the same normals.
    """
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
    """Return the message of an error of Mitsuba's parser as one line, without its prefix and traceback."""
    text = str(error).split("] ", 1)[-1]
    if "Traceback" in text:  # of one of our plugins: the message follows the name of the exception
        text = text.split("Error: ", 1)[-1]
    return " ".join(text.split())
