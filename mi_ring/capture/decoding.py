"""Reads the image files of a capture, and decodes their pixels to linear radiance."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError, is_file
from mi_ring.foreign import reading
from mi_ring.image_headers import encoding_of, image_size
from mi_ring.images import linear_to_srgb, mask_values, read_image
from mi_ring.scene.shot import Encoding, Shot
from mi_ring.scene.tone_curve import STRAIGHT, ToneCurve

COMMON = 224, 248  #: the 8-bit values from the first to before the second are those of pixels that are not clipped
FREQUENT = 1.5  #: values are clipped that are so many times as frequent


class LinearImage(NamedTuple):
    """A photograph that is already decoded to linear radiance."""

    rgb: np.ndarray  #: (H, W, 3) linear radiance, float16 or float32
    clipped: np.ndarray  #: (H, W, 3) bool
    curve: ToneCurve = STRAIGHT  #: of the camera, which was removed

    @property
    def nbytes(self) -> int:
        """Number of bytes that `rgb` and `clipped` need together."""
        return self.rgb.nbytes + self.clipped.nbytes

    def radiance(self, curve: ToneCurve) -> np.ndarray:
        """Return the radiance (H, W, 3) float32 as if this tone curve had been removed instead.

        This is approximate at edges, because pixels were averaged under the other curve.
        """
        linear, own = self.rgb.astype(np.float32), self.curve
        if curve[1:] == own[1:]:  # the same S
            curve, own = (ToneCurve(one.gamma) for one in (curve, own))
        return linear if curve == own else curve.removed(own.applied(linear)).astype(np.float32)


def decode(
    image: np.ndarray | LinearImage, linear: bool, saturation: float, curve: ToneCurve = STRAIGHT
) -> tuple[np.ndarray, np.ndarray]:
    """Decode pixels. Returns (linear radiance, float32; clipped pixels, bool), both in the shape of `image`.

    `linear`: True if the encoded pixels are linear, False if they are sRGB. `saturation`: encoded value (1 = full
    scale) from which a pixel is clipped. `curve`: of the camera, which is removed. A `LinearImage` is decoded already;
    it is converted if another curve was removed.
    """
    if isinstance(image, LinearImage):
        return image.radiance(curve), image.clipped
    if image.dtype == np.float32:
        value = image
    else:
        full = np.iinfo(image.dtype).max
        value = np.arange(full + 1, dtype=np.float32) / full
    lookup = curve.removed(value if linear else srgb_to_linear(value))
    if image.dtype == np.float32:
        return lookup, value >= saturation
    return lookup[image], image >= np.searchsorted(value, np.float32(saturation))


def clip_value(image: np.ndarray | LinearImage, saturation: float) -> float:
    """Return the encoded value (1 = full scale) from which a pixel of a photograph (H, W, 3) is clipped.

    This is `saturation`, unless it is 1 and the pixels have 8 bits. Lossy coding moves clipped pixels to values a
    little below full scale, which are then more frequent than the values below them. These values count as clipped.
    """
    if saturation != 1 or isinstance(image, LinearImage) or image.dtype != np.uint8:
        return saturation
    pixels = np.ascontiguousarray(image)
    counts = np.sum([cv2.calcHist([pixels], [k], None, [256], [0, 256]).ravel() for k in range(image.shape[2])], 0)
    usual = FREQUENT * counts[slice(*COMMON)].mean()
    lowest = 255
    while lowest > COMMON[1] and min(counts[255], counts[lowest - 1]) > usual:
        lowest -= 1
    return lowest / 255


def shade(shot: Shot, scale: int = 1) -> np.ndarray | float:
    """Return the factors by which vignetting and gain change the radiance of each pixel: (H, W, 3).

    H, W: size of the photograph / `scale`. Without vignetting, returns the gain (3,). If the gain is 1, too, returns 1.
    """
    gain = np.float32(1) if shot.response.gain == (1, 1, 1) else np.array(shot.response.gain, np.float32)
    if not shot.response.vignetting:
        return gain
    cosines = shot.camera.shrunk(scale).cosines()
    return (cosines[..., None] ** shot.response.vignetting).astype(np.float32) * gain


def recorded(radiance: np.ndarray, shot: Shot, scale: int = 1) -> np.ndarray:
    """Convert radiance (H, W, 3) to the linear values that the camera records: vignetting, gain, then the tone curve.

    H, W: size of the photograph / `scale`.
    """
    return shot.response.curve.applied(radiance * shade(shot, scale))


def read_pixels(path: Path, field: str, shot: Shot, scene: Path) -> np.ndarray:
    """Read the encoded pixels (H, W, C) of an image file: uint8, uint16 or float32.

    `field`: what the file is in the scene file `scene`: "filename", "mask", "valid" or "ambient". Raises InputError if
    the file is missing, is no image, has another size than the camera, or has damaged, infinite or NaN pixels.
    """
    require_header(path, field, shot, scene)
    what = f'photograph "{shot.name}", {field}'
    with reading(f"{path}: {what}", "an image"):
        return read_image(path, heed=shot.encoding == "auto" and field in ("filename", "ambient"))


def require_header(path: Path, field: str, shot: Shot, scene: Path) -> None:
    """Raise InputError if a file is missing, is no image, or has another size than the camera of the photograph `shot`.

    `field`: what the file is in the scene file `scene`: "filename", "mask", "valid" or "ambient". Pixels are not read.
    """
    what = f'photograph "{shot.name}", {field}'
    if not is_file(path):
        raise InputError(f"{scene}: {what}: no such file: {path}")
    with reading(f"{path}: {what}", "an image"):
        size = image_size(path)
    if size != shot.size:
        found, expected = ("{} x {}".format(*pixels) for pixels in (size, shot.size))
        raise InputError(f"{path}: {what}: is {found} pixels, but the film says {expected}")


def read_photograph(shot: Shot, scene: Path) -> np.ndarray:
    """Read the encoded pixels (H, W, 3) of a photograph. `scene`: its scene file, for messages.

    If the photograph has an `ambient` image, which shows only the room's light, it is subtracted, and the result is
    float32. Raises InputError if a file cannot be read.
    """
    image = read_colours(shot, "filename", scene)
    if not shot.files.ambient:
        return image
    if shot.response.curve != STRAIGHT:
        raise InputError(f'{scene}: photograph "{shot.name}", ambient: cannot be subtracted if the camera has a curve; '
                         "leave out gamma, contrast and toe, or subtract it yourself")  # fmt: skip
    pictures = [image, read_colours(shot, "ambient", scene)]
    (lit, clipped), (ambient, too) = (
        decode(p, is_linear(shot.encoding, p), clip_value(p, shot.saturation)) for p in pictures
    )
    difference = lit - ambient  # noise about 0, negative values too
    if shot.encoding == "srgb":
        difference = linear_to_srgb(difference.clip(min=0))
    # If either is clipped, the difference is unknown: it counts as clipped.
    return np.where(clipped | too, np.float32(shot.saturation), difference).astype(np.float32)


def read_colours(shot: Shot, field: str, scene: Path) -> np.ndarray:
    """Read the encoded pixels (H, W, 3) of the image file of a photograph. Grey is repeated in R, G and B.

    `field`: "filename" for the photograph, "ambient" for the image of the room's light alone. `scene`: the scene file,
    for messages. Colours are multiplied by alpha. Raises InputError if the file cannot be read.
    """
    file = getattr(shot.files, field)
    pixels = read_pixels(file, field, shot, scene)
    if shot.encoding == "linear" and pixels.dtype == np.uint8:
        raise InputError(f'{scene}: photograph "{shot.name}", encoding: is linear, but {file.name} has 8 bits, which '
                         "is sRGB; leave it out, or give 16 bits or EXR if it is really linear")  # fmt: skip
    channels = pixels.shape[2]
    rgb = pixels[:, :, :3] if channels >= 3 else np.repeat(pixels[:, :, :1], 3, 2)
    if channels not in (2, 4) or pixels.dtype == np.float32:  # EXR files hold colours times alpha already
        return rgb
    full = np.iinfo(pixels.dtype).max
    linear = is_linear(shot.encoding, pixels)
    radiance = decode(rgb, linear, 1.0)[0] * (pixels[:, :, -1:] / np.float32(full))
    return ((radiance if linear else linear_to_srgb(radiance)) * full + 0.5).astype(pixels.dtype)


def is_linear(encoding: Encoding, pixels: np.ndarray | LinearImage) -> bool:
    """Return True if encoded pixels are linear radiance, False if they are sRGB.

    With the encoding "auto", 8-bit pixels are sRGB and all others are linear.
    """
    if isinstance(pixels, LinearImage):
        return True
    return encoding == "linear" or (encoding == "auto" and pixels.dtype != np.uint8)


def has_open_curve(shots: Sequence[Shot]) -> bool:
    """Return True if photographs are sRGB, and the scene file does not tell their camera's curve.

    Raises InputError if a file cannot be read.
    """
    if any(shot.response.curve != STRAIGHT or shot.files.ambient for shot in shots):
        return False
    encodings = set()
    for file, encoding in {(shot.files.filename, shot.encoding) for shot in shots}:
        if file and encoding == "auto":
            with reading(file, "an image"):
                encoding = encoding_of(file)
        encodings.add(encoding)
    return encodings == {"srgb"}


def read_mask(shot: Shot, field: str, scene: Path) -> np.ndarray:
    """Read a mask (H, W) uint8 of a photograph: 255 is the object, or a valid pixel.

    `field`: "mask" or "valid". `scene`: the scene file, for messages. If the file is the photograph itself, the mask is
    its alpha channel. Raises InputError if the file cannot be read or has no alpha channel.
    """
    file, itself = getattr(shot.files, field), getattr(shot.files, field) == shot.files.filename
    pixels = read_pixels(file, field, shot, scene)
    if itself and pixels.shape[2] not in (2, 4):
        raise InputError(f'{file}: photograph "{shot.name}", {field}: is the photograph itself, which has no '
                         "alpha channel")  # fmt: skip
    return mask_values(pixels[:, :, -1:] if itself else pixels, f'{file}: photograph "{shot.name}", {field}')
