"""Interreflection: light that reaches the camera by way of more than one point of the scene."""

import drjit as dr
import mitsuba as mi
import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring import bridge
from mi_ring.integrator import Photometric, next_2d, pixel_rays
from mi_ring.losses import blur

BOUNCES = 3  # after the first surface
WIDTH = 64  # of the pictures of interreflection, at most [px]: it varies slowly
SPP = 4
BLUR = 1.0  # [px]: smoothes the few samples


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
            si = scene.ray_intersect(ray)
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
        lit = Photometric.shade(scene, si, lambda si: photographs.light(view, si), random, True)
        radiance += dr.select(active, throughput * lit, 0)
    return radiance


def interreflection(surface, photographs, coverage: Tensor, seed: int) -> Tensor:
    """What interreflection adds to pictures of the surface as last written: linear radiance (N, H, W, 3).

    `photographs`: as they were rendered; `coverage` (N, H, W): of that picture, through which alone gradients flow: the
    outline feels this light too, shape and material do not (they are corrected for it, as in "Shape from
    Interreflections", Nayar, Ikeuchi and Kanade, IJCV 1991). It is rendered small, smoothed, and spread over what the
    object covers, so that its edges are those of the picture.
    """
    factor = -(-max(photographs.size) // WIDTH)
    small = photographs.select(photographs.index, photographs.size, factor)
    rgb, alpha = bridge.pictures(render_indirect(surface.scene, small, SPP, seed), small)
    images = torch.cat([rgb, alpha[..., None]], -1).movedim(-1, 1)
    images = blur(images.flatten(0, 1), BLUR).reshape(images.shape)
    images = F.interpolate(images, scale_factor=factor, mode="bilinear", align_corners=False)
    height, width = coverage.shape[1:]
    images = F.pad(images, (0, width - images.shape[3], 0, height - images.shape[2]), mode="replicate")
    return (images[:, :3] / images[:, 3:].clamp(min=1e-2)).movedim(1, -1) * coverage[..., None]


def draw(surface, photographs, spp=16, seed=0, shadows=True):
    """Like `bridge.draw`, interreflection included."""
    rgb, coverage = bridge.draw(surface, photographs, spp, seed, shadows)
    channels = render_indirect(surface.scene, photographs, spp, seed + 1)
    return rgb + bridge.pictures(channels, photographs)[0], coverage
