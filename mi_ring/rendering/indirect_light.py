"""Indirect light: interreflection, and the light of the room with its occlusion, by path tracing without gradients."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, shade
from mi_ring.rendering.photographs import pixel_rays
from mi_ring.rendering.spherical_harmonics import bsdfs_with_lobes, evaluated_harmonics, reflected_harmonics

BOUNCES = 3  #: points of a path after the first surface


def render_indirect(scene, photographs, spp, seed, bounces=BOUNCES, harmonics=(), table=None):
    """Render interreflection: [R, G, B, coverage], linear radiance, Floats of N·H·W pixels without gradients.

    Paths start at the camera and sample BSDFs. At each of the `bounces` points after the first one the direct light is
    added; the own light of each photograph casts shadows there. This is unbiased but for longer paths. `table`: a scene
    that paths also hit after their first point; it casts no shadows.

    For n `harmonics` of `mi_ring.rendering.spherical_harmonics`, 6 n more Floats follow. The first 3 n are R, G, B of
    the radiance transfer of each harmonic: the radiance in a room whose radiance is the harmonic, with occlusion and
    with paths of at most `bounces` points. The last 3 n are the same without occlusion and interreflection, by
    `reflected_harmonics`. Both groups have the same noise-free part; only occlusion and interreflection have noise.
    """
    with dr.suspend_grad():
        ray, view = pixel_rays(photographs, spp, seed)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        covered = dr.select(hit.is_valid(), mi.Float(1), 0)
        lane = dr.compress(hit.is_valid())  # the background takes no time from here on
        channels = [dr.zeros(mi.Float, dr.width(covered)) for _ in range(3 + 6 * len(harmonics))]
        if dr.width(lane):
            ray, view = dr.gather(mi.Ray3f, ray, lane), dr.gather(mi.UInt32, view, lane)
            si = dr.gather(mi.PreliminaryIntersection3f, hit, lane).compute_surface_interaction(ray)
            random = next_2d(seed ^ 0x2545F491, dr.width(lane), lane + photographs.first_lane(spp))
            pose = photographs.camera(view).to_world
            bsdfs = bsdfs_with_lobes(scene) if harmonics else []
            unoccluded = reflected_harmonics(bsdfs, si, pose, harmonics, si.is_valid()) if harmonics else []
            radiance, escaped, blocked = trace_paths(scene, si, view, photographs, bounces, random, table, bsdfs)
            values = [*radiance]
            if harmonics:
                added, removed = (
                    [value * throughput for value in evaluated_harmonics(direction, pose, harmonics)]
                    for throughput, direction in (escaped, blocked)
                )
                transfer = [u + a - r for u, a, r in zip(unoccluded, added, removed)]
                values += [value for colour in (*transfer, *unoccluded) for value in colour]
            for channel, value in zip(channels, values):
                dr.scatter(channel, value, lane)
        channels.insert(3, covered)
        dr.schedule(channels)
        return [dr.block_sum(c, spp) / spp for c in channels]


def trace_paths(scene, si, view, photographs, bounces, random, table=None, known=()):
    """Trace one path per lane for the light that arrives at surface interactions `si` from other surfaces.

    Returns (radiance, escaped, blocked). Radiance leaves `si` toward the viewer. `escaped` and `blocked` are each a
    throughput and a direction: of paths that leave the scene, and of paths that hit another surface next to `si`. Both
    throughputs are 0 for other paths.

    `random`: a source of 2-D samples. `known`: BSDFs whose unoccluded room light the caller has from
    `reflected_harmonics`. Of paths from these BSDFs, `escaped` leaves out those that leave the scene at once. Paths
    that hit something at once are in `blocked`, for the caller to subtract.
    """
    context, active = mi.BSDFContext(), si.is_valid()
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    escaped, direction = mi.Color3f(0), mi.Vector3f(0, 0, 1)
    is_known, blocked = mi.Bool(False), (mi.Color3f(0), mi.Vector3f(0, 0, 1))
    for bsdf in known:
        is_known |= si.bsdf() == mi.BSDFPtr(bsdf)
    lighting = photographs.lighting(view)
    for bounce in range(bounces):
        sample, weight = si.bsdf().sample(context, si, random().x, random(), active)
        throughput = dr.select(active, throughput * weight, 0)
        out = si.spawn_ray(si.to_world(sample.wo))
        active &= dr.any(throughput > 0)
        si = scene.ray_intersect(out, active)
        if table is not None:
            separate_kernels(si)
            below = table.ray_intersect(out, active)
            si = dr.select(below.t < si.t, below, si)
            separate_kernels(si)
        leaves = active & ~si.is_valid()
        if known and bounce == 0:
            leaves &= ~is_known
            blocked = dr.select(is_known & active & si.is_valid(), throughput, 0), out.d
        escaped, direction = dr.select(leaves, throughput, escaped), dr.select(leaves, out.d, direction)
        active = si.is_valid()
        # Paths that leave toward an environment add nothing: `shade` has its light at each surface.
        lit = shade(scene, si, lighting, random, True)
        radiance += dr.select(active, throughput * lit, 0)
    return radiance, (escaped, direction), blocked


def separate_kernels(values) -> None:
    """On a GPU, evaluate `values` now: OptiX cannot trace rays through two scenes in one kernel."""
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        dr.eval(values)
