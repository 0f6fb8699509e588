"""Checks the arguments of `Capture.from_arrays`, and writes the arrays to files."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mi_ring.capture.decoding import is_linear
from mi_ring.capture.emitter_elements import room_elements
from mi_ring.capture.pixels import Pixels
from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.errors import LARGEST, InputError, require_numbers
from mi_ring.geometry.camera import Camera, usable_camera
from mi_ring.images import mask_values, write_image
from mi_ring.rendering.spherical_harmonics import BASIS, MAX_ORDER
from mi_ring.scene.lights import Light, usable_light
from mi_ring.scene.shot import Encoding, Files, Shot
from mi_ring.system.files import writing

FLATTEST = 8  #: largest ratio of a photograph's sides
#: Of a photograph, which is also the name of its files. XML lacks some characters, and $ begins Mitsuba's variables.
NAME = re.compile(r"(?!\.)[^/\\$\x00-\x1f\ud800-\udfff\ufffe\uffff]+")

Item = TypeVar("Item")


def images_of(images: Iterable[ArrayLike], encoding: Encoding) -> list[np.ndarray]:
    """Check photographs, and return them as arrays (H, W, 3) of their type: uint8, uint16 or float32.

    `encoding`: "auto", "srgb" or "linear". Raises InputError if there are no photographs, or if one is invalid.
    """
    if encoding not in ("auto", "srgb", "linear"):
        raise InputError(f"encoding: is {encoding!r}, must be one of auto, srgb, linear")
    found = [image_of(image, encoding, f"images[{k}]") for k, image in enumerate(listed(images, "images"))]
    if not found:
        raise InputError("images: is empty; give one array for each photograph")
    return found


def masks_of(masks: Iterable[ArrayLike | None] | None, images: Sequence[np.ndarray], what: str) -> Pixels:
    """Check masks, and return them as uint8 arrays (H, W), 255 on the object. A photograph without a mask has None.

    `masks`: one (H, W) bool or uint8, or None, for each of the `images`; None: no photograph has a mask. Raises
    InputError if a mask is invalid. The message begins with `what`.
    """
    several = zip(one_each(masks, len(images), what), images)
    return Pixels.of([mask_of(mask, image, f"{what}[{k}]") for k, (mask, image) in enumerate(several)])


def shots_of(
    images: Sequence[np.ndarray], cameras: Iterable[Camera], lights: Iterable[Light | None] | None,
    names: Sequence[str] | None, encoding: Encoding, saturation: float, calibrated: bool,
) -> tuple[Shot, ...]:  # fmt: skip
    """Check cameras, lights and names, and make a `Shot` of each photograph. The result does not contain pixels.

    `images`: N checked arrays (H, W, 3). `cameras`: N cameras. `lights`: N lights; None for a light at the camera.
    `names`: N names; None for 000, 001, …. `encoding`: "auto", "srgb" or "linear". `saturation`: encoded value (1 =
    full scale) from which a pixel is clipped. `calibrated`: True if cameras and lights are exact. Raises InputError if
    an argument is invalid.
    """
    count = len(images)
    full = float(require_numbers(saturation, (), "saturation"))
    if not full > 0:
        raise InputError(f"saturation: is {saturation}, must be above 0")
    encodings: list[Encoding] = ["linear" if is_linear(encoding, image) else "srgb" for image in images]
    each = one_each(cameras, count, "cameras"), one_each(lights, count, "lights")
    columns = names_of(names, count), encodings, images, *each
    return tuple(
        Shot(name, camera_of(camera, image, f"cameras[{k}]"), usable_light(light, f"lights[{k}]"), encoding=own,
             saturation=full, calibrated=calibrated)
        for k, (name, own, image, camera, light) in enumerate(zip(*columns))
    )  # fmt: skip


def listed(items: Iterable[Item], what: str) -> list[Item]:
    """Convert `items`, for example a tuple or a generator, to a list. Raises InputError if they cannot be iterated.

    The message begins with `what`, the name of the argument.
    """
    try:
        return list(items)
    except TypeError:
        raise InputError(f"{what}: is {type(items).__name__}; must be a list, one item for each photograph") from None


def array_of(value: ArrayLike, what: str) -> np.ndarray:
    """Convert a value to an array of any type and shape.

    Raises InputError if the rows of a nested list differ in length. The message begins with `what`, the name of the
    argument.
    """
    try:
        return np.asarray(value)
    except ValueError as error:
        raise InputError(f"{what}: is no array ({str(error).partition('.')[0]})") from error


def one_each(items: Iterable[Item] | None, count: int, what: str) -> list[Item | None]:
    """Return `items` as a list with one item for each of `count` photographs. If `items` is None, each item is None.

    Raises InputError if the number of items is not `count`. The message begins with `what`, the name of the argument.
    """
    found: list[Item | None] = [None] * count if items is None else listed(items, what)
    if len(found) != count:
        raise InputError(f"{what}: has {len(found)} for {count} images; give one for each")
    return found


def image_of(image: ArrayLike, encoding: Encoding, what: str) -> np.ndarray:
    """Check a photograph, and return it as an array (H, W, 3).

    `encoding`: "auto", "srgb" or "linear". Raises InputError if the type, the shape or the values are invalid. The
    message begins with `what`, the name of the argument.
    """
    array = array_of(image, what)
    if array.dtype not in (np.uint8, np.uint16, np.float32) or array.ndim != 3 or array.shape[2] != 3 or not array.size:
        raise InputError(f"{what}: is {array.dtype} of shape {array.shape}; must be (H, W, 3) of uint8, uint16 or "
                         "float32")  # fmt: skip
    if FLATTEST * min(array.shape[:2]) < max(array.shape[:2]):
        raise InputError(f"{what}: is {sides(array)} pixels; the sides must be at most {FLATTEST} : 1")
    if array.dtype == np.float32 and not (np.abs(array) <= LARGEST).all():
        raise InputError(f"{what}: contains pixels that are NaN, infinite or above {LARGEST:g}")
    if array.dtype == np.uint8 and is_linear(encoding, array):
        raise InputError(f"{what}: is uint8, which is sRGB, but encoding is linear; give uint16 or float32")
    return array


def mask_of(mask: ArrayLike | None, image: np.ndarray, what: str) -> np.ndarray | None:
    """Check a mask (H, W) bool or uint8, and return it as uint8, 255 on the object. If `mask` is None, return None.

    `image`: the photograph of the mask. Raises InputError if the mask is invalid, or if it has another size than
    `image`. The message begins with `what`, the name of the argument.
    """
    if mask is None:
        return None
    array = array_of(mask, what)
    if array.dtype not in (np.uint8, bool) or array.shape != image.shape[:2]:
        raise InputError(f"{what}: is {array.dtype} of shape {array.shape}; must be {image.shape[:2]} of bool, or of "
                         "uint8 from 0 to 255")  # fmt: skip
    return mask_values((array * np.uint8(255) if array.dtype == bool else array)[..., None], what)  # as of a file


def camera_of(camera: Camera | None, image: np.ndarray, what: str) -> Camera:
    """Check the camera of the photograph `image`. Returns the camera with its numbers rounded to float32.

    Raises InputError if the camera is invalid, or if it has another size than `image`. The message begins with `what`.
    """
    own, size = usable_camera(camera, what), (image.shape[1], image.shape[0])
    if own.size != size:
        raise InputError(f"{what}: size is {own.size}, (width, height); its image is {sides(image)}")
    return own


def names_of(names: Sequence[str] | None, count: int) -> list[str]:
    """Check the names of `count` photographs, and return them. If `names` is None, return 000, 001, ….

    Raises InputError if a name occurs twice, is "object", or cannot be the name of a file.
    """
    if names is None:
        return [f"{k:0{max(3, len(str(count - 1)))}}" for k in range(count)]
    names = listed(names, "names")
    for k, name in enumerate(one_each(names, count, "names")):
        if not isinstance(name, str) or not NAME.fullmatch(name) or name == "object":
            raise InputError(f'names[{k}]: is {name!r}; must be a file name without suffix and $, not "object"')
        if name in names[:k]:
            raise InputError(f"names[{k}]: {name!r} occurs twice")
    return names


def room_of(room: ArrayLike) -> np.ndarray:
    """Extend the spherical harmonics (n, 3) of a room's light to BASIS rows, with zeros. Returns (BASIS, 3).

    Raises InputError if n is none of 1, 4, 9, 16, 25, or if a number is not finite.
    """
    array, counts = array_of(room, "room"), [(order + 1) ** 2 for order in range(MAX_ORDER + 1)]
    if array.ndim != 2 or array.shape[0] not in counts:
        raise InputError(f"room: is of shape {array.shape}; must be (n, 3), n one of {', '.join(map(str, counts))}")
    found = require_numbers(array, (len(array), 3), "room").astype(float)
    return np.concatenate([found, np.zeros((BASIS - len(found), 3))])


def sides(image: np.ndarray) -> str:
    """Return the width and height of an image (H, W, …) as text for a message."""
    return "{} x {}".format(*image.shape[1::-1])


def files_of(shot: Shot, image: np.ndarray, masked: bool, valid: bool) -> Files:
    """Return names for the files of a photograph and its masks, relative to the scene file. No file is written.

    A float32 `image` gets the suffix exr, any other png. `masked`: True if the photograph has a mask. `valid`: True if
    it has a mask of valid pixels.
    """
    suffix = "exr" if image.dtype == np.float32 else "png"
    mask, shown = (Path(folder, f"{shot.name}.png") if there else None
                   for folder, there in (("masks", masked), ("valid", valid)))  # fmt: skip
    return Files(Path("images", f"{shot.name}.{suffix}"), mask, shown)


def scene_xml(
    shots: Sequence[Shot], files: Sequence[Files], center: ArrayLike | None, radius: float | None,
    room: ArrayLike | None,
) -> bytes:  # fmt: skip
    """Return the content of a new scene file for photographs from arrays. No file is written.

    `files`: names of the files of each photograph, relative to the scene file. `center` (3,), `radius`: sphere around
    the object [scene units]; None: unknown. `room` (n, 3): spherical harmonics of the room's light; None: dark. Raises
    InputError if one of these is invalid.
    """
    middle = None if center is None else require_numbers(center, (3,), "center")
    reach = None if radius is None else float(require_numbers(radius, (), "radius"))
    if reach is not None and not reach > 0:
        raise InputError(f"radius: is {radius}, must be above 0")
    elements = [photograph_element(replace(shot, files=own)) for shot, own in zip(shots, files)]
    root = scene_element(elements, middle, reach)
    root.extend([] if room is None else room_elements(room_of(room)))
    return scene_bytes(root)


def write_array(array: np.ndarray, file: Path) -> None:
    """Write a photograph (H, W, 3) or a mask (H, W) to `file`, a .png or .exr file. Missing folders are created.

    Raises InputError if this fails.
    """
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    write_image(array if array.ndim == 3 else array[..., None], file)
