"""Renders images by Mitsuba's path tracer along rays of its own.

It shares no code with the renderer of a fit, so that it can test that renderer.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera

LANES = 1 << 22  #: largest number of paths in a launch
SEED_STEP = 1_000_003  #: between the seeds of consecutive launches
MARGIN = 4  #: around the object [px]

Window = tuple[int, int, int, int]  #: part of an image: left, top, right, bottom [px]
Trace = Callable[[mi.RayDifferential3f, int], list]  #: (rays, seed) ↦ list of channels with a value per ray


@dataclass(frozen=True)
class LensCamera:
    """A pinhole camera with lens distortion and motion blur."""

    camera: Camera
    distortion: tuple[float, float] = (0.0, 0.0)  #: k1, k2: x / z and y / z are multiplied by 1 + k1 r² + k2 r⁴
    motion: tuple[float, float] = (0.0, 0.0)  #: shift of the image during the exposure [px]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (n, 3) [scene units] at the middle of the exposure. Returns pixel coordinates (n, 2)."""
        x, y, z = ((points - self.camera.position) @ self.camera.to_world[:3, :3]).T
        tangents = np.stack([-x / z, -y / z], 1)
        r2 = (tangents**2).sum(1, keepdims=True)
        k1, k2 = self.distortion
        return tangents * (1 + k1 * r2 + k2 * r2**2) * self.camera.focal + self.camera.centre

    def around(self, points: np.ndarray) -> Window:
        """Return the smallest window of the image that contains the projections of points (n, 3), plus `MARGIN` pixels.

        The points must be in front of the camera. A window is (left, top, right, bottom) [px].
        """
        pixels, size = self.project(points), np.array(self.camera.size)
        left, top = np.clip(pixels.min(0) - MARGIN, 0, size - 1).astype(int).tolist()
        right, bottom = np.clip(pixels.max(0) + MARGIN + 1, [left + 1, top + 1], size).astype(int).tolist()
        return left, top, right, bottom


def rays_of(view: LensCamera, window: Window, spp: int, seed: int) -> mi.RayDifferential3f:
    """Make stratified random rays through each pixel of a window. Consecutive rays belong to the same pixel.

    `window`: (left, top, right, bottom) [px]. `spp`: rays per pixel, a square number.
    """
    left, top, right, bottom = window
    side = round(spp**0.5)
    number = functools.partial(dr.opaque, mi.Float)  # not a literal: all views share one compiled kernel
    lane: Any = dr.arange(mi.UInt32, (right - left) * (bottom - top) * spp)
    pixel, stratum = lane // spp, lane % spp
    columns = dr.opaque(mi.UInt32, right - left)
    seeds = [dr.opaque(mi.UInt32, (4 * seed + k) % 2**32) for k in range(3)]
    jitter: list[Any] = [mi.sample_tea_float32(lane, s) for s in seeds]  # type: ignore[call-overload]
    time = (mi.Float((7 * stratum + pixel) % spp) + jitter[2]) / spp - 0.5
    moved = [number(m) * time for m in view.motion]
    u = number(left) + mi.Float(pixel % columns) + (mi.Float(stratum % side) + jitter[0]) / side + moved[0]
    v = number(top) + mi.Float(pixel // columns) + (mi.Float(stratum // side) + jitter[1]) / side + moved[1]
    fx, fy, cx, cy = map(number, (*view.camera.focal, *view.camera.centre))
    distorted: Any = mi.Vector2f((u - cx) / fx, (v - cy) / fy)
    k1, k2 = map(number, view.distortion)
    tangents: Any = mi.Vector2f(distorted)
    for _ in range(8):  # fixed-point iteration; each step leaves a tenth of the error
        r2 = dr.squared_norm(tangents)
        tangents = distorted / (1 + r2 * (k1 + k2 * r2))
    pose = [[number(float(value)) for value in row] for row in view.camera.to_world[:3]]
    direction = mi.Vector3f(*(-row[0] * tangents.x - row[1] * tangents.y + row[2] for row in pose))
    return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*(row[3] for row in pose)), dr.normalize(direction)))


def radiance_along(rays: mi.RayDifferential3f, seed: int, scene: mi.Scene, depth: int, hidden: bool = False) -> list:
    """Trace light paths along rays by Mitsuba's path tracer. Returns three channels: RGB radiance of each ray.

    `depth`: largest length of paths; 2: direct light only. `hidden`: emitters are invisible to the camera.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed % 2**32, dr.width(rays))
    path = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": hidden})
    return list(path.sample(scene, sampler, rays)[0])


def clamped_radiance_along(rays: mi.RayDifferential3f, seed: int, scene: mi.Scene, depth: int, limit: float) -> list:
    """Trace light paths along rays by Mitsuba's path tracer, and clip indirect radiance to `limit`.

    Otherwise rare bright paths would leave white dots in the image. `depth`: largest length of paths; 2: direct light
    only. Returns a list of three channels: RGB radiance of each ray.
    """
    direct = radiance_along(rays, seed, scene, 2)
    if depth == 2:
        return direct
    return [d + dr.clip(a - d, 0, limit) for a, d in zip(radiance_along(rays, seed, scene, depth), direct)]


def hits_along(rays: mi.RayDifferential3f, seed: int, scene: mi.Scene, shape: mi.Shape) -> list:
    """Trace rays to their first hit. Returns a list of one channel: 1 if a ray hits `shape` first, otherwise 0.

    `seed` is not used; it belongs to the common signature.
    """
    hit = scene.ray_intersect_preliminary(rays)
    return [dr.select(hit.is_valid() & (hit.shape == mi.ShapePtr(shape)), mi.Float(1), 0)]


def pixel_means(trace: Trace, view: LensCamera, window: Window, spp: int, seed: int) -> np.ndarray:
    """Average a function over the rays of each pixel. Returns an image (H, W, channels) of the camera's size.

    `trace`: takes (rays, seed), returns a list of channels with a value for each ray. `window`: (left, top, right,
    bottom) [px]; pixels outside are 0 and are not rendered. `spp`: rays per pixel, a square number.
    """
    left, top, right, bottom = window
    rows = max(1, LANES // ((right - left) * spp))
    parts = []
    for k, row in enumerate(range(top, bottom, rows)):
        strip, strip_seed = (left, row, right, min(row + rows, bottom)), seed + k * SEED_STEP
        means = [dr.block_sum(c, spp) / spp for c in trace(rays_of(view, strip, spp, strip_seed), strip_seed)]
        dr.eval(means)
        parts.append(np.stack([mean.numpy() for mean in means], 1).reshape(-1, right - left, len(means)))
    picture = np.zeros((*reversed(view.camera.size), parts[0].shape[2]))
    picture[top:bottom, left:right] = np.concatenate(parts)
    return picture
