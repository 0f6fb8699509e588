"""Indirect light: path traces interreflection, and the light of the room with its shadows. It computes no gradients."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, shade
from mi_ring.rendering.photographs import pixel_rays
from mi_ring.rendering.spherical_harmonics import BASIS, bsdfs_with_lobes, evaluated_harmonics, reflected_harmonics

BOUNCES = 3  #: points of a path after the first surface


def render_indirect(scene, photographs, spp, seed, bounces=BOUNCES, rows=(), table=None):
    """Render interreflection. Returns [R, G, B, coverage], Floats of N·H·W pixels without gradients.

    R, G, B are linear radiance. Paths start at the camera and sample BSDFs. After the first point, a path has at most
    `bounces` points. At each of these points, direct light is added, with shadows. The result is unbiased except that
    longer paths are missing. `spp`: paths per pixel. `table`: a scene of tables, which paths can hit after their first
    point; it casts no shadows. None: no table.

    `rows`: n rows of `Photographs.room_strengths`: harmonics, and from BASIS on all lobes of `photographs`. For
    these, 6 n more Floats follow. The first 3 n are R, G, B of the radiance transfer of each harmonic: the radiance of
    the surface in a room whose radiance is this harmonic, with shadows and interreflection; for a lobe, its flux is 1.
    The last 3 n are the same without interreflection, those of harmonics also without shadows and without noise.
    """
    with dr.suspend_grad():
        ray, view = pixel_rays(photographs, spp, seed)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        covered = dr.select(hit.is_valid(), mi.Float(1), 0)
        lane = dr.compress(hit.is_valid())  # the background takes no time from here on
        channels = [dr.zeros(mi.Float, dr.width(covered)) for _ in range(3 + 6 * len(rows))]
        if dr.width(lane):
            ray, view = dr.gather(mi.Ray3f, ray, lane), dr.gather(mi.UInt32, view, lane)
            si = dr.gather(mi.PreliminaryIntersection3f, hit, lane).compute_surface_interaction(ray)
            random = next_2d(seed ^ 0x2545F491, dr.width(lane), lane + photographs.first_lane(spp))
            pose = photographs.camera(view).to_world
            bsdfs = bsdfs_with_lobes(scene) if rows else []
            smooth = [k for k in rows if k < BASIS]
            lobes = photographs.lobes if len(smooth) < len(rows) else None
            unoccluded = reflected_harmonics(bsdfs, si, pose, smooth, si.is_valid()) if smooth else []
            direct = lobes.reflected(scene, bsdfs, si, pose, random, si.is_valid()) if lobes else []
            radiance, escaped, blocked, bounced = trace_paths(
                scene, si, view, photographs, bounces, random, table, bsdfs, lobes
            )
            values = [*radiance]
            if rows:
                added, removed = (
                    [value * throughput for value in evaluated_harmonics(direction, pose, smooth)] if smooth else []
                    for throughput, direction in (escaped, blocked)
                )
                transfer = [u + a - r for u, a, r in zip(unoccluded, added, removed)]
                transfer += [once + more for once, more in zip(direct, bounced)]
                unoccluded = [*unoccluded, *direct]
                values += [value for colour in (*transfer, *unoccluded) for value in colour]
            for channel, value in zip(channels, values):
                dr.scatter(channel, value, lane)
        channels.insert(3, covered)
        dr.schedule(channels)
        return [dr.block_sum(c, spp) / spp for c in channels]


def trace_paths(scene, si, view, photographs, bounces, random, table=None, known=(), lobes=None):
    """Trace one path per lane for the light that arrives at the surface interactions `si` from other surfaces.

    Returns (radiance, escaped, blocked, bounced). `radiance`: this light, reflected by `si` to the viewer. `escaped`:
    (throughput, direction) of paths that leave the scene. `blocked`: (throughput, direction) of paths that start at a
    BSDF in `known` and hit another surface directly after `si`. Throughputs of all other paths are 0. `bounced`: list
    of the radiance by each of the `lobes`, if its flux is 1; they light as many points of a path as harmonics do.

    `view`: index of the photograph of each lane. `bounces`: number of points of a path after `si`. `random`: function
    that returns random points in [0, 1)². `table`: a scene of tables, which paths can also hit; None: no table.
    `known`: BSDFs whose room light without shadows the caller computes in closed form. So `escaped` omits their paths
    that leave the scene directly after `si`, and the caller must subtract the room light of `blocked`.
    """
    context, active = mi.BSDFContext(), si.is_valid()
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    escaped, direction = mi.Color3f(0), mi.Vector3f(0, 0, 1)
    is_known, blocked = mi.Bool(False), (mi.Color3f(0), mi.Vector3f(0, 0, 1))
    for bsdf in known:
        is_known |= si.bsdf() == mi.BSDFPtr(bsdf)
    lighting, shared = photographs.lighting(view), photographs.shared(view)
    pose = photographs.camera(view).to_world
    bounced = [mi.Color3f(0) for _ in range(len(lobes or ()))]
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
        lit = shade(scene, si, lighting, random, True, shared=shared)
        radiance += dr.select(active, throughput * lit, 0)
        if lobes is not None and bounce < bounces - 1:
            one, lit = lobes.bounced(scene, si, pose, random, active)
            bounced = [sum_ + dr.select(active & (one == j), throughput * lit, 0) for j, sum_ in enumerate(bounced)]
    return radiance, (escaped, direction), blocked, bounced


def separate_kernels(values) -> None:
    """On a GPU, evaluate `values` (Dr.Jit arrays) now: OptiX cannot trace rays through two scenes in one kernel."""
    if dr.backend_v(mi.Float) == dr.JitBackend.CUDA:
        dr.eval(values)
