"""Slices of BRDFs, for light and camera at one place, as Mitsuba evaluates them."""

import xml.etree.ElementTree as ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import InputError
from mi_ring.ring.ring import Ring
from mi_ring.synthesis.config import SynthesizeConfig
from mi_ring.synthesis.materials import pattern_of

ANGLES = np.radians(np.arange(0, 76, 5))  #: θh of slices, light and camera at one place


def bsdf_of(ring: Ring, material: dict[str, np.ndarray]) -> mi.BSDF:
    """A material (V, 3) or (V,) by name as the BSDF of a strip of V pixels."""
    snippet = ElementTree.fromstring(ring.bsdf)
    if snippet.get("type") != "cooktorrance":
        raise InputError(f"BSDF: is {snippet.get('type')}, slices are of cooktorrance; leave out --parameters")
    strips = {name: mi.Bitmap(np.ascontiguousarray(value.reshape(1, len(value), -1), np.float32))
              for name, value in material.items()}  # fmt: skip
    return mi.load_dict({"type": "cooktorrance", **{
        name: {"type": "bitmap", "bitmap": strip, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
        for name, strip in strips.items()
    }})  # fmt: skip


def slices(bsdf: mi.BSDF, count: int) -> np.ndarray:
    """BRDF (count, angles, 3) [1/sr] at `ANGLES` from the normal, light and camera at one place, along a strip."""
    angle, k = np.tile(ANGLES, count), np.repeat(np.arange(count), len(ANGLES))
    si = dr.zeros(mi.SurfaceInteraction3f, len(angle))
    si.uv = mi.Point2f(mi.Float((k + 0.5) / count), 0.5)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.wi = mi.Vector3f(mi.Float(np.sin(angle)), 0, mi.Float(np.cos(angle)))
    value = np.array(bsdf.eval(mi.BSDFContext(), si, si.wi)).reshape(3, count, len(ANGLES))
    return np.moveaxis(value, 0, -1) / np.cos(ANGLES)[:, None]


def second_at(config: SynthesizeConfig, vertices: np.ndarray) -> np.ndarray:
    """Which vertices (V,) of the true mesh are of the second material."""
    pattern = pattern_of(config.pattern, vertices, config.bands, "xyz".index(config.up), "--pattern")
    black, white = (mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": v}}) for v in (0.0, 1.0))
    si = dr.zeros(mi.SurfaceInteraction3f, len(vertices))
    si.uv, si.wi = mi.Point2f(*map(mi.Float, pattern.uv.T)), mi.Vector3f(0, 0, 1)
    return np.array(pattern.of(black, white).eval(mi.BSDFContext(), si, si.wi))[0] > 0.5 / np.pi
