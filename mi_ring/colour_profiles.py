"""Converts pixels from the colour space that an image file declares to sRGB or linear radiance."""

from functools import lru_cache
from typing import Any, NamedTuple

import imagecodecs
import numpy as np

SPACES = {b"RGB ": "rgb", b"GRAY": "gray"}  #: colour spaces of profiles, and their names in imagecodecs
WHITE, PRIMARIES = (0.3127, 0.3290), (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)  #: of sRGB: x, y of CIE
RELATIVE = 1  #: rendering intent: relative colorimetric


class Statement(NamedTuple):
    """The colour space that an image file declares: an ICC `profile` (bytes), or the `exponent` of its tone curve.

    The tone curve is: linear value = encoded value ^ exponent. The exponent 2.2 means the exact curve of sRGB instead.
    Both fields are None if the file declares nothing: 8-bit pixels are then sRGB, all others are linear.
    """

    profile: bytes | None = None  #: an ICC profile
    exponent: float | None = None  #: linear = encoded ^ exponent; 2.2 means the exact curve of sRGB


def srgb_to_linear(v: np.ndarray) -> np.ndarray:
    """Decode sRGB values of any shape to linear values, float32 (IEC 61966-2-1)."""
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def primaries_profile(white: tuple, primaries: tuple, exponent: float = 1.0) -> bytes:
    """Make the ICC profile of an RGB colour space. Returns its bytes.

    `white`: chromaticity (x, y) of white. `primaries`: x, y of red, of green and of blue, six numbers. `exponent`:
    linear value = encoded value ^ exponent. An exponent of 2.2 gives the exact curve of sRGB instead.
    """
    places = [value for k in range(3) for value in (*primaries[2 * k : 2 * k + 2], 1.0)]
    curve: dict[str, Any] = {"gamma": exponent}
    if exponent == 2.2:
        curve = {"transferfunction": (srgb_to_linear(np.linspace(0, 1, 4096)) * 65535 + 0.5).astype(np.uint16)}
    return imagecodecs.cms_profile("rgb", whitepoint=(*white, 1.0), primaries=tuple(places), **curve)


ADOBE_RGB = primaries_profile(WHITE, (0.64, 0.33, 0.21, 0.71, 0.15, 0.06), 563 / 256)
#: Primaries by the codes of ITU-T H.273; those of BT.709 and unknown ones are sRGB's.
CODED = {
    1: PRIMARIES, 2: PRIMARIES, 5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06), 6: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07),
    7: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07), 9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060),
}  # fmt: skip
#: Exponents by the codes of transfer curves. Still images with the curve of video, BT.709, are shown as sRGB.
CURVES = {1: 2.2, 2: 2.2, 4: 2.2, 5: 2.8, 6: 2.2, 8: 1.0, 13: 2.2, 14: 2.2, 15: 2.2}


def coded_statement(primaries: int, curve: int) -> Statement:
    """Convert ITU-T H.273 codes to a colour space. PNG, HEIF and AVIF files contain such codes.

    `primaries`: code of the primaries. `curve`: code of the transfer curve. Raises ValueError for HDR or unknown codes.
    """
    if curve not in CURVES or primaries not in CODED:
        what = {16: "PQ, of HDR", 18: "HLG, of HDR"}.get(curve, f"{primaries}/{curve} by ITU-T H.273")
        raise ValueError(f"its colours are {what}; save it as sRGB")
    if CODED[primaries] == PRIMARIES:
        return Statement(None, CURVES[curve])
    return Statement(primaries_profile(WHITE, CODED[primaries], CURVES[curve]))


@lru_cache(maxsize=8)
def is_usual(profile: bytes, linear: bool) -> bool:
    """Test whether an ICC profile describes the colour space that is assumed for a file without a profile.

    This is sRGB, or, if `linear` is True, linear radiance with sRGB's primaries.
    """
    axis = np.linspace(0, 1, 6, dtype=np.float32)
    colours = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(36, 6, 3)
    return bool(np.abs(transformed(colours, profile) - (colours if linear else srgb_to_linear(colours))).max() < 2e-3)


def transformed(colours: np.ndarray, profile: bytes) -> np.ndarray:
    """Convert encoded colours (H, W, 1 or 3) with an ICC profile to linear radiance with sRGB's primaries.

    `profile`: its bytes. Returns the same shape: uint16 for integers, float32 for floats. Raises ValueError if the
    profile is damaged, or if its colour space is neither RGB nor grey.
    """
    if (space := SPACES.get(profile[16:20])) is None:
        raise ValueError(f"its colour profile is of {profile[16:20].decode('ascii', 'replace').strip()}, not of RGB or "
                         "grey; save it as sRGB")  # fmt: skip
    count = colours.shape[2]
    data = np.repeat(colours, 3, 2) if space == "rgb" and count == 1 else colours
    kind = np.float32 if colours.dtype == np.float32 else np.uint16
    target = primaries_profile(WHITE, PRIMARIES)

    def convert(pixels: np.ndarray) -> np.ndarray:
        try:
            return imagecodecs.cms_transform(np.ascontiguousarray(pixels), profile, target, colorspace=space,
                                             outcolorspace="rgb", outdtype=kind, intent=RELATIVE)  # fmt: skip
        except imagecodecs.CmsError as error:
            raise ValueError(f"its colour profile cannot be used ({error}); save it as sRGB") from error

    if space == "gray":
        return np.stack([convert(data[..., c])[..., 1] for c in range(count)], -1)
    return convert(data)[..., :count] if count > 1 else convert(data)[..., 1:2]


def as_stated(pixels: np.ndarray, said: Statement) -> np.ndarray:
    """Convert pixels (H, W, C) from the colour space `said`, which their file declares. Alpha channels are kept.

    8-bit sRGB pixels, and linear pixels of other types with sRGB's primaries, are returned unchanged. All other pixels
    become linear with sRGB's primaries: uint16 if they were integers, float32 if they were floats. Clipped pixels
    remain clipped. Raises ValueError if an ICC profile is damaged, or if its colour space is neither RGB nor grey.
    """
    kind = pixels.dtype
    count = 3 if pixels.shape[2] > 2 else 1
    colours = pixels[..., :count]
    full = 1.0 if kind == np.float32 else np.iinfo(kind).max
    usual = 2.2 if kind == np.uint8 else 1.0
    if said.profile and not is_usual(said.profile, kind != np.uint8):
        linear = transformed(colours, said.profile)
    elif not said.profile and said.exponent and abs(said.exponent - usual) > 0.05:
        value = colours if kind == np.float32 else np.arange(full + 1, dtype=np.float32) / np.float32(full)
        srgb = abs(said.exponent - 2.2) < 0.05
        linear = srgb_to_linear(value) if srgb else np.maximum(value, 0) ** np.float32(said.exponent)
        linear = linear if kind == np.float32 else (linear * 65535 + 0.5).astype(np.uint16)[colours]
    else:
        return pixels
    alpha = pixels[..., count:]
    if linear.dtype == np.uint16:
        linear[colours == full] = 65535
        alpha = alpha.astype(np.uint16) * np.uint16(65535 // full)
    return np.concatenate([linear, alpha], -1) if alpha.size else linear
