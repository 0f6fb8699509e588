"""Interreflection, light that reaches the camera by way of more than one point of the scene; and that of the room."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, shade
from mi_ring.rendering.photographs import pixel_rays
from mi_ring.rendering.spherical_harmonics import harmonics_toward, reflected, reflecting

BOUNCES = 3  # after the first surface


def render_indirect(scene, photographs, spp, seed, bounces=BOUNCES, room=(), table=None):
    """Light that has been reflected more than once: [R, G, B, coverage], Floats of N·H·W pixels, no gradients.

    Paths are traced from the camera, the BSDFs sampled, and shaded directly lit wherever they arrive (the light of
    each photograph casts shadows); `bounces` more points after the first. Box-filtered linear radiance, unbiased but
    for the light of longer paths. `table`: a scene that paths meet, too, after their first point; it casts no shadow.

    `room`: followed by R, G, B for each of these harmonics of `mi_ring.rendering.spherical_harmonics`, of what the
    surface shows of a room whose radiance is that harmonic, as what paths meet that escape after at most `bounces`
    points; and then by as many of what it would show if nothing were in the light's way, by `reflected`. Of the former,
    what leaves the scene at once is taken from there, so that only what is in the way makes noise.
    """
    with dr.suspend_grad():
        ray, view = pixel_rays(photographs, spp, seed)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        covered = dr.select(hit.is_valid(), mi.Float(1), 0)
        lane = dr.compress(hit.is_valid())  # the background costs nothing from here on
        channels = [dr.zeros(mi.Float, dr.width(covered)) for _ in range(3 + 6 * len(room))]
        if dr.width(lane):
            ray, view = dr.gather(mi.Ray3f, ray, lane), dr.gather(mi.UInt32, view, lane)
            si = dr.gather(mi.PreliminaryIntersection3f, hit, lane).compute_surface_interaction(ray)
            random = next_2d(seed ^ 0x2545F491, dr.width(lane), lane + photographs.lanes_before(spp))
            pose = photographs.camera(view)[0]
            bsdfs = reflecting(scene) if room else []
            free = reflected(bsdfs, si, pose, room, si.is_valid()) if room else []
            radiance, escaped, direction, first = reflect(scene, si, view, photographs, bounces, random, table, bsdfs)
            values = [*radiance]
            if room:
                weight, toward = first  # of what `reflected` has, but is not so
                shown = [f + e * escaped - b * weight for f, e, b in zip(
                    free, harmonics_toward(direction, pose, room), harmonics_toward(toward, pose, room))]  # fmt: skip
                values += [value for colour in (*shown, *free) for value in colour]
            for channel, value in zip(channels, values):
                dr.scatter(channel, value, lane)
        channels.insert(3, covered)
        dr.schedule(channels)
        return [dr.block_sum(c, spp) / spp for c in channels]


def reflect(scene, si, view, photographs, bounces, random, table=None, known=()):
    """Radiance toward the viewer that arrives at surface interactions `si` from other surfaces, one path per lane.

    Returns (radiance, throughput and direction of the paths that escape, 0 for others, `first`). If the BSDF at `si` is
    one of the `known`, paths that escape at once are left out, for `reflected` has them; it also has those that do not
    escape at once, of which `first` are throughput and direction. `random`: a source of 2-D samples.
    """
    context, active = mi.BSDFContext(), si.is_valid()
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    escaped, direction = mi.Color3f(0), mi.Vector3f(0, 0, 1)
    told, first = mi.Bool(False), (mi.Color3f(0), mi.Vector3f(0, 0, 1))
    for bsdf in known:
        told |= si.bsdf() == mi.BSDFPtr(bsdf)
    lighting = photographs.lighting(view)
    for bounce in range(bounces):
        sample, weight = si.bsdf().sample(context, si, random().x, random(), active)
        throughput = dr.select(active, throughput * weight, 0)
        out = si.spawn_ray(si.to_world(sample.wo))
        active &= dr.any(throughput > 0)
        si = scene.ray_intersect(out, active)
        if table is not None:
            apart(si)
            below = table.ray_intersect(out, active)
            si = dr.select(below.t < si.t, below, si)
            apart(si)
        leaves = active & ~si.is_valid()
        if known and bounce == 0:
            leaves &= ~told
            first = dr.select(told & active & si.is_valid(), throughput, 0), out.d
        escaped, direction = dr.select(leaves, throughput, escaped), dr.select(leaves, out.d, direction)
        active = si.is_valid()
        # Rays that escape to an environment bring nothing: its light was counted where the surface was shaded.
        lit = shade(scene, si, lighting, random, True)
        radiance += dr.select(active, throughput * lit, 0)
    return radiance, escaped, direction, first


def apart(values) -> None:
    """On a GPU, have values computed before what follows: OptiX refuses rays through two scenes in one kernel."""
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        dr.eval(values)
