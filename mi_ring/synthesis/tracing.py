"""Path traced pictures along rays of our own, by Mitsuba's stock integrator: pinholes, lenses, a shaken hand.

It shares nothing with what predicts photographs in a fit but the layout of a camera.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera

LANES = 1 << 22  #: paths per launch, at most
STRIDE = 1_000_003  #: between the seeds of launches
MARGIN = 4  #: around what is photographed [px]

Window = tuple[int, int, int, int]  #: part of a picture: left, top, right, bottom [px]
Traced = Callable[[Window, int, int], list]  #: values along the rays of a window with so many per pixel, by a seed


@dataclass(frozen=True)
class LensCamera:
    """A camera with its lens: `camera` without distortion, which is x ↦ x (1 + k1 r² + k2 r⁴) of tangents."""

    camera: Camera
    distortion: tuple[float, float] = (0.0, 0.0)
    motion: tuple[float, float] = (0.0, 0.0)  #: of the picture while it is exposed [px]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) in which points (n, 3) are seen in the middle of the exposure."""
        x, y, z = ((points - self.camera.position) @ self.camera.to_world[:3, :3]).T
        tangents = np.stack([-x / z, -y / z], 1)
        r2 = (tangents**2).sum(1, keepdims=True)
        k1, k2 = self.distortion
        return tangents * (1 + k1 * r2 + k2 * r2**2) * self.camera.focal + self.camera.centre

    @property
    def whole(self) -> Window:
        """All of the picture."""
        return 0, 0, *self.camera.size

    def around(self, points: np.ndarray) -> Window:
        """The part of the picture that holds points (n, 3) before the camera, and a margin."""
        pixels, size = self.project(points), np.array(self.camera.size)
        left, top = np.clip(pixels.min(0) - MARGIN, 0, size - 1).astype(int).tolist()
        right, bottom = np.clip(pixels.max(0) + MARGIN + 1, [left + 1, top + 1], size).astype(int).tolist()
        return left, top, right, bottom


def rays_of(lens_camera: LensCamera, window: Window, spp: int, seed: int) -> mi.RayDifferential3f:
    """`spp` = n² stratified rays through each pixel of a part of the picture, in consecutive lanes."""
    left, top, right, bottom = window
    width, height = right - left, bottom - top
    side = round(spp**0.5)
    lane: Any = dr.arange(mi.UInt32, width * height * spp)
    pixel, stratum = lane // spp, lane % spp

    seeds = [dr.opaque(mi.UInt32, (4 * seed + k) % 2**32) for k in range(3)]
    jitter: list[Any] = [mi.sample_tea_float32(lane, own) for own in seeds]  # type: ignore[call-overload]
    time = (mi.Float((7 * stratum + pixel) % spp) + jitter[2]) / spp - 0.5
    moved = [dr.opaque(mi.Float, m) * time for m in lens_camera.motion]
    columns = dr.opaque(mi.UInt32, width)
    u = dr.opaque(mi.Float, left) + mi.Float(pixel % columns) + (mi.Float(stratum % side) + jitter[0]) / side + moved[0]
    v = dr.opaque(mi.Float, top) + mi.Float(pixel // columns) + (mi.Float(stratum // side) + jitter[1]) / side
    v += moved[1]
    (fx, fy), (cx, cy) = lens_camera.camera.focal, lens_camera.camera.centre
    bent: Any = mi.Vector2f((u - dr.opaque(mi.Float, cx)) / dr.opaque(mi.Float, fx),
                       (v - dr.opaque(mi.Float, cy)) / dr.opaque(mi.Float, fy))  # fmt: skip
    k1, k2 = (dr.opaque(mi.Float, k) for k in lens_camera.distortion)
    straight: Any = mi.Vector2f(bent)
    for _ in range(8):  # contracts by a tenth each time
        r2 = dr.squared_norm(straight)
        straight = bent / (1 + r2 * (k1 + k2 * r2))
    pose = [[dr.opaque(mi.Float, float(value)) for value in row] for row in lens_camera.camera.to_world[:3]]
    direction = mi.Vector3f(*(-row[0] * straight.x - row[1] * straight.y + row[2] for row in pose))
    return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*(row[3] for row in pose)), dr.normalize(direction)))


def radiance_along(rays: mi.RayDifferential3f, scene: mi.Scene, seed: int, depth: int, hidden: bool = False) -> list:
    """Radiance along rays by `path`: [R, G, B]. `depth`: 2 is direct light alone; `hidden`: lamps are not seen."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed % 2**32, dr.width(rays))
    path = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": hidden})
    return list(path.sample(scene, sampler, rays)[0])


def flashed_along(rays: mi.RayDifferential3f, scene: mi.Scene, seed: int, depth: int, brightest: float) -> list:
    """As `radiance_along`, but what one path brings by way of other surfaces is `brightest` at most.

    Rare paths that meet a small light in a highlight would be white dots, which no photograph has.
    """
    direct = radiance_along(rays, scene, seed, 2)
    if depth == 2:
        return direct
    return [d + dr.clip(a - d, 0, brightest) for a, d in zip(radiance_along(rays, scene, seed, depth), direct)]


def covered(rays: mi.RayDifferential3f, scene: mi.Scene, shape: mi.Shape) -> mi.Float:
    """1 where a ray meets this shape first, else 0."""
    hit = scene.ray_intersect_preliminary(rays)
    return dr.select(hit.is_valid() & (hit.shape == mi.ShapePtr(shape)), mi.Float(1), 0)


def averaged(traced: Traced, lens_camera: LensCamera, window: Window, spp: int, seed: int) -> np.ndarray:
    """Means (H, W, channels) over the pixels of a part of the picture, 0 around it, of values `traced` along rays."""
    width, height = lens_camera.camera.size
    parts = []
    for strip, own in strips(window, spp, seed):
        left, top, right, bottom = strip
        means = [dr.block_sum(value, spp) / spp for value in traced(strip, spp, own)]
        dr.eval(means)
        parts.append(np.stack([mean.numpy() for mean in means], 1).reshape(bottom - top, right - left, -1))
    left, top, right, bottom = window
    picture = np.zeros((height, width, parts[0].shape[2]))
    picture[top:bottom, left:right] = np.concatenate(parts)
    return picture


def strips(window: Window, spp: int, seed: int) -> Iterator[tuple[Window, int]]:
    """Rows of a window that make `LANES` rays at most, and the seed of each."""
    left, top, right, bottom = window
    rows = max(1, LANES // ((right - left) * spp))
    for k, row in enumerate(range(top, bottom, rows)):
        yield (left, row, right, min(row + rows, bottom)), seed + k * STRIDE
