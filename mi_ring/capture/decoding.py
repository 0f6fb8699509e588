"""Photographs and masks from files: encoded pixels, and the linear radiance that they mean."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mi_ring.errors import InputError, is_file
from mi_ring.foreign import reading
from mi_ring.images import contrasted, image_size, linear_to_srgb, read_image, srgb_to_linear
from mi_ring.plugins.properties import LARGEST

Read = TypeVar("Read")


def decode(
    image: np.ndarray, linear: bool, saturation: float, gamma: float = 1.0, contrast: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (float32) of encoded pixels and where they are at or above `saturation`, of `image`'s shape.

    `gamma`, `contrast`: of the camera's curve, by which linear values are radiance to this power, `contrasted`.
    """
    if image.dtype == np.float32:
        value = image
    else:
        full = np.iinfo(image.dtype).max
        value = np.arange(full + 1, dtype=np.float32) / full
    lookup = value if linear else srgb_to_linear(value)
    lookup = lookup if contrast == 1 else contrasted(lookup, 1 / contrast).astype(np.float32)
    lookup = lookup if gamma == 1 else np.maximum(lookup, 0) ** np.float32(1 / gamma)
    saturated = value >= saturation
    return (lookup, saturated) if image.dtype == np.float32 else (lookup[image], saturated[image])


def shade(sensor: Any, scale: int = 1) -> np.ndarray | float:
    """What lens and gain of a photograph make of light: factors (H, W, 3) or (3,), of a picture `scale` times smaller.

    1 if they leave it as it is.
    """
    gain = sensor.gain.astype(np.float32) if (sensor.gain != 1).any() else np.float32(1)
    if not sensor.vignetting:
        return gain
    cosines = sensor.camera.shrunk(scale).cosines()
    return (cosines[..., None] ** sensor.vignetting).astype(np.float32) * gain


def recorded(radiance: np.ndarray, sensor: Any, scale: int = 1) -> np.ndarray:
    """Linear radiance (H, W, 3) as lens, gain and curve of a photograph's camera record it, `scale` times smaller."""
    curved = (radiance * shade(sensor, scale)) ** sensor.gamma
    return curved if sensor.contrast == 1 else contrasted(curved, sensor.contrast)


def read_pixels(path: Path, field: str, sensor: Any, scene: Path) -> np.ndarray:
    """Encoded pixels (H, W, C) of an image file: uint8, uint16 or float32, all the bits that the file has.

    Raises InputError if there is no such file, if it is no image or not as large as the film of `sensor`.
    """
    pixels = read_by(read_image, path, field, sensor, scene)
    require_size(pixels.shape[1::-1], path, field, sensor)
    if pixels.dtype == np.float32 and not (np.abs(pixels) <= LARGEST).all():
        what = f'photograph "{sensor.id()}", {field}'
        raise InputError(f"{path}: {what}: contains pixels that are NaN, infinite or above {LARGEST:g}")
    return pixels


def require_header(path: Path, field: str, sensor: Any, scene: Path) -> None:
    """Raise as `read_pixels` does, for what the first bytes of an image file tell."""
    require_size(read_by(image_size, path, field, sensor, scene), path, field, sensor)


def read_by(read: Callable[[Path], Read], path: Path, field: str, sensor: Any, scene: Path) -> Read:
    """What is read of a file. Raises InputError if there is none, or if it is no image."""
    what = f'photograph "{sensor.id()}", {field}'
    if not is_file(path):
        raise InputError(f"{scene}: {what}: no such file: {path}")
    with reading(f"{path}: {what}", "an image"):
        return read(path)


def require_size(size: tuple[int, ...], path: Path, field: str, sensor: Any) -> None:
    """Raise InputError unless a picture is as large as the film of its photograph."""
    if size != sensor.size:
        found, expected = ("{} x {}".format(*size) for size in (size, sensor.size))
        what = f'photograph "{sensor.id()}", {field}'
        raise InputError(f"{path}: {what}: is {found} pixels, the film says {expected}")


def read_photograph(sensor: Any, scene: Path) -> np.ndarray:
    """Encoded pixels (H, W, 3) of a photograph, without the ambient light if it says what that shows, then float32."""
    image = read_colours(sensor, sensor.filename, "filename", scene)
    if not sensor.ambient:
        return image
    if (sensor.gamma, sensor.contrast) != (1, 1):
        raise InputError(f'{scene}: photograph "{sensor.id()}", ambient: cannot be subtracted where the camera has a '
                         "curve; leave out gamma and contrast, or subtract it before")  # fmt: skip
    pictures = [image, read_colours(sensor, sensor.ambient, "ambient", scene)]
    (lit, clipped), (ambient, too) = (decode(p, is_linear(sensor, p), sensor.saturation) for p in pictures)
    difference = lit - ambient  # noise about 0 and all
    if sensor.encoding == "srgb":
        difference = linear_to_srgb(difference.clip(min=0))
    # Where either is clipped nothing is known but that it is bright.
    return np.where(clipped | too, np.float32(sensor.saturation), difference).astype(np.float32)


def read_colours(sensor: Any, file: Path, field: str, scene: Path) -> np.ndarray:
    """Encoded pixels (H, W, 3) of a picture; one without colours is grey, and what is transparent is black."""
    pixels = read_pixels(file, field, sensor, scene)
    if sensor.encoding == "linear" and pixels.dtype == np.uint8:
        raise InputError(f'{scene}: photograph "{sensor.id()}", encoding: is linear, but {file.name} has 8 '
                         "bits, as sRGB has; leave it out, or give 16 bits or EXR if it is linear indeed")  # fmt: skip
    channels = pixels.shape[2]
    rgb = pixels[:, :, :3] if channels >= 3 else np.repeat(pixels[:, :, :1], 3, 2)
    if channels not in (2, 4) or pixels.dtype == np.float32:  # EXR files have the product already
        return rgb
    full = np.iinfo(pixels.dtype).max
    linear = is_linear(sensor, pixels)
    radiance = decode(rgb, linear, 1.0)[0] * (pixels[:, :, -1:] / np.float32(full))
    return ((radiance if linear else linear_to_srgb(radiance)) * full + 0.5).astype(pixels.dtype)


def is_linear(sensor: Any, pixels: np.ndarray) -> bool:
    """Is this image linear radiance? As its photograph says, else 8-bit files are not and others are."""
    return sensor.encoding == "linear" or (sensor.encoding == "auto" and pixels.dtype != np.uint8)


def read_mask(sensor: Any, file: Path, field: str, scene: Path) -> np.ndarray:
    """Mask (H, W) uint8 from a file that a photograph names in a `field`; its alpha channel if it names itself."""
    pixels = read_pixels(file, field, sensor, scene)
    if file == sensor.filename and pixels.shape[2] not in (2, 4):
        raise InputError(f'{file}: photograph "{sensor.id()}", {field}: is the photograph itself, which has no '
                         "alpha channel")  # fmt: skip
    channel = pixels[:, :, -1 if file == sensor.filename else 0]
    full = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}.get(pixels.dtype, 1)
    return (channel.astype(np.float32) * (255 / full)).round().astype(np.uint8)
