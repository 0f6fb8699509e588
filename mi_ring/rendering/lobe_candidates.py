"""Pictures of an object in the light of many lobes, each at a few pixels: with them a fit finds lobes."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.direct_light import next_2d
from mi_ring.rendering.lobe_light import reflected_lobe
from mi_ring.rendering.photographs import LANES, Photographs, center_rays
from mi_ring.rendering.spherical_harmonics import bsdfs_with_lobes, to_world_axes
from mi_ring.rendering.surface import Surface
from mi_ring.scene.alignment import to_flat


def candidate_pictures(
    surface: Surface, photographs: Photographs, pixels: np.ndarray, toward: np.ndarray, sharpness: np.ndarray,
    in_camera: bool, seed: int,
) -> np.ndarray:  # fmt: skip
    """Render pixels of photographs in the light of one lobe after the other. Returns linear radiance (n, D, 3).

    Each lobe has a flux of 1. Its light is reflected once, with shadows by one ray. It is that of the pixel's centre.
    `pixels` (n,): numbers of pixels, counted through all selected photographs. `toward` (D, 3): directions of the lobes
    in the axes of the world, or, if `in_camera`, of the camera. `sharpness` (D,).
    """
    photographs, count, parts = photographs.in_units(surface.unit), len(toward), []
    step = max(1, LANES // count)
    with dr.suspend_grad():
        ray, view = center_rays(photographs)
        hit = surface.scene.ray_intersect_preliminary(ray, coherent=True)
        directions, sharp = to_flat(mi.Float, toward), to_flat(mi.Float, sharpness)
        bsdfs = bsdfs_with_lobes(surface.scene)
        for first in range(0, len(pixels), step):
            some = to_flat(mi.UInt32, pixels[first : first + step])
            lane = dr.arange(mi.UInt32, dr.width(some) * count)
            pixel, one = dr.gather(mi.UInt32, some, lane // count), lane % count
            seen = dr.gather(mi.PreliminaryIntersection3f, hit, pixel)
            si = seen.compute_surface_interaction(dr.gather(mi.Ray3f, ray, pixel))
            direction = dr.gather(mi.Vector3f, directions, one)
            if in_camera:
                camera = photographs.camera(dr.gather(mi.UInt32, view, pixel))
                direction = to_world_axes(direction, camera.to_world)
            random = next_2d(seed, dr.width(lane), lane + dr.opaque(mi.UInt32, first * count % 2**32))
            value = reflected_lobe(
                surface.scene, bsdfs, si, direction, dr.gather(mi.Float, sharp, one), random, si.is_valid()
            )
            dr.eval(value)
            parts.append(np.array(value).T.reshape(-1, count, 3))
    return np.concatenate(parts)
