"""BRDF slices: values of a BRDF if light and camera are in the same direction. Mitsuba evaluates the BRDF."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.synthesis.materials import pattern_of
from mi_ring.synthesis.options import SynthesizeConfig

ANGLES = np.radians(np.arange(0, 76, 5))  #: between the normal and the common direction of light and camera


def bsdf_of(material: dict[str, np.ndarray]) -> mi.BSDF:
    """Make one `cooktorrance` BSDF for V materials. Each parameter is a texture of 1 × V pixels, one for each material.

    `material`: a dict from names of parameters to arrays (V, 3) or (V,).
    """
    texture = {"type": "bitmap", "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    return mi.load_dict({"type": "cooktorrance", **{
        name: texture | {"bitmap": mi.Bitmap(np.ascontiguousarray(value.reshape(1, len(value), -1), np.float32))}
        for name, value in material.items()
    }})  # fmt: skip


def brdf_slices(bsdf: mi.BSDF, count: int) -> np.ndarray:
    """Return BRDF values (count, angles, 3) [1/sr] of `count` materials, for light and camera in the same direction.

    The angles between this direction and the normal are `ANGLES`, 0° to 75°. `bsdf`: textures of its parameters have
    one pixel for each material, in a row.
    """
    angle, k = np.tile(ANGLES, count), np.repeat(np.arange(count), len(ANGLES))
    si = dr.zeros(mi.SurfaceInteraction3f, len(angle))
    si.uv = mi.Point2f(mi.Float((k + 0.5) / count), 0.5)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi = mi.Vector3f(mi.Float(np.sin(angle)), 0, mi.Float(np.cos(angle)))
    value = np.array(bsdf.eval(mi.BSDFContext(), si, si.wi)).reshape(3, count, len(ANGLES))
    return np.moveaxis(value, 0, -1) / np.cos(ANGLES)[:, None]


def is_second_material(config: SynthesizeConfig, bounds: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Test at points (P, 3) of an object whether it has its second material there. Returns (P,) bool.

    `config`: the options with which the object was made: its pattern of two materials. `bounds` (2, 3): lowest and
    highest corner of the true object. Points may be slightly off its surface.
    """
    edge = 1e-4 * (bounds[1] - bounds[0])  # outside the bounds the pattern would repeat
    inside = np.clip(points, bounds[0] + edge, bounds[1] - edge)
    pattern = pattern_of(config.pattern, np.concatenate([bounds, inside]), config.bands, "xyz".index(config.up), "")
    black, white = (mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": v}}) for v in (0.0, 1.0))
    si = dr.zeros(mi.SurfaceInteraction3f, len(points))
    si.uv, si.wi = mi.Point2f(*map(mi.Float, pattern.uv[2:].T)), mi.Vector3f(0, 0, 1)
    return np.array(pattern.blend(black, white).eval(mi.BSDFContext(), si, si.wi))[0] > 0.5 / np.pi
