"""Interreflection: light that reaches the camera by way of more than one point of the scene."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.photographs import pixel_rays
from mi_ring.rendering.shading import next_2d, shade

BOUNCES = 3  # after the first surface


def render_indirect(scene, photographs, spp, seed, bounces=BOUNCES):
    """Light that has been reflected more than once: [R, G, B, coverage], Floats of N·H·W pixels, no gradients.

    Paths are traced from the camera, the BSDFs sampled, and shaded directly lit wherever they arrive (the light of
    each photograph casts shadows); `bounces` more points after the first. Box-filtered linear radiance, unbiased but
    for the light of longer paths.
    """
    with dr.suspend_grad():
        ray, view = pixel_rays(photographs, spp, seed)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        covered = dr.select(hit.is_valid(), mi.Float(1), 0)
        lane = dr.compress(hit.is_valid())  # the background costs nothing from here on
        channels = [dr.zeros(mi.Float, dr.width(covered)) for _ in range(3)]
        if dr.width(lane):
            ray, view = dr.gather(mi.Ray3f, ray, lane), dr.gather(mi.UInt32, view, lane)
            si = dr.gather(mi.PreliminaryIntersection3f, hit, lane).compute_surface_interaction(ray)
            for channel, value in zip(channels, reflect(scene, si, view, photographs, bounces, seed)):
                dr.scatter(channel, value, lane)
        channels.append(covered)
        dr.schedule(channels)
        return [dr.block_sum(c, spp) / spp for c in channels]


def reflect(scene, si, view, photographs, bounces, seed):
    """Radiance toward the viewer that arrives at surface interactions `si` from other surfaces, one path per lane."""
    random = next_2d(seed ^ 0x2545F491, dr.width(view))
    context, active = mi.BSDFContext(), si.is_valid()
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    for _ in range(bounces):
        sample, weight = si.bsdf().sample(context, si, random().x, random(), active)
        throughput = dr.select(active, throughput * weight, 0)
        si = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active & dr.any(throughput > 0))
        active = si.is_valid()
        # Rays that escape to an environment bring nothing: its light was counted where the surface was shaded.
        lit = shade(scene, si, lambda si: photographs.light(view, si), random, True)
        radiance += dr.select(active, throughput * lit, 0)
    return radiance
