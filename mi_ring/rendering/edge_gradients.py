"""The part of a photograph's gradient that comes from moving edges: its boundary terms."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, trace
from mi_ring.rendering.edge_curves import SHADOW_OFFSET, EdgeSamples, ray_offset
from mi_ring.scene.lights import position_of

EDGE_ROUNDINGS = 16  #: the least distance to rays beside an edge, in rounding errors of a pixel coordinate


def boundary_terms(scene, photographs, edges, seed, shadows=True, window=None):
    """Compute the gradient of photographs by moving edges. Returns a tuple (where, view, step, active) for each curve.

    Each entry has one value per sample of the curve: `where`, pixel coordinates; `view`, index of the photograph;
    `step`, [R, G, B, coverage] to add to the pixel at `where`; `active`, False for samples to ignore. The values of
    `step` are 0. Their derivative dI is the boundary term. Let n be the normal of the edge in the picture. If the edge
    moves by dq [px], it sweeps length · n·dq square pixels. There, the radiance changes from L_beyond, on the side to
    which n points, to L_before, on the other side. So dI = (L_before − L_beyond) · n·dq · length. Both radiances are
    traced along rays beside the edge, with occlusion, background, coverage and shadows as in the picture.

    `edges`: the edges of the scene. `shadows`: also edges of shadows. `window`: (lowest, highest) corner [px] of the
    part that is rendered; edges outside of it are skipped; None: all is rendered.
    """
    window = window or (mi.Point2f(0), mi.Point2f(photographs.size))
    views, before = len(photographs), photographs.before
    curves, fronts = edges.outlines(photographs.eye, views, seed, before)
    sources = [photographs.source] if shadows and photographs.casts_shadows else []
    for source in filter(None, map(position_of, scene.emitters())):
        sources.append(lambda view, source=source: (source[0], mi.Bool(source[1])))
    for k, source in enumerate(sources, 1):
        casters, terminators = edges.shadow_casters(source, views, seed + k, fronts, before)
        curves += terminators + [cast_shadow(scene, curve, source, photographs.eye) for curve in casters]
    terms = (boundary_term(scene, photographs, curve, seed + 2, shadows, window) for curve in curves)
    return [term for term in terms if term is not None]


def boundary_term(scene, photographs, curve: EdgeSamples, seed, shadows, window):
    """Compute the gradient of photographs by the motion of one curve. Returns None if the motion has no gradient.

    Otherwise returns (pixel coordinates, index of the photograph, [R, G, B, coverage] whose value is 0 and whose
    derivative is the boundary term, mask of the samples that count), with one value per sample. `shadows`: trace
    shadows. `window`: (lowest, highest) corner [px] of the part that is rendered.
    """
    camera = photographs.camera(curve.view)
    where, depth = camera.project(curve.point)
    if not dr.grad_enabled(where):
        return None
    with dr.suspend_grad():
        q = dr.detach(where)
        active = curve.active & (depth > 0) & dr.all((q > window[0]) & (q < window[1]))
        along = camera.project_tangent(curve.point, curve.tangent)
        across = mi.Vector2f(-along.y, along.x)
        active &= dr.isfinite(dr.squared_norm(across)) & (dr.squared_norm(across) > 0)
        offset = max(curve.offset, EDGE_ROUNDINGS * 2.0**-24 * max(photographs.size))
        shift = dr.select(active, offset * dr.rsqrt(dr.squared_norm(across)), 0) * across
        dr.eval(q, shift, across, active)
        n = dr.width(q)
        lane = dr.arange(mi.UInt32, 2 * n)
        sign, pair = mi.Float(lane % 2) * 2 - 1, lane // 2
        view = dr.gather(mi.UInt32, curve.view, pair)
        pixel = dr.gather(mi.Point2f, q, pair) + sign * dr.gather(mi.Vector2f, shift, pair)
        ray = mi.Ray3f(*photographs.camera(view).ray(pixel))
        # Rays of inactive samples may not be finite: OptiX must not trace them.
        traced = dr.gather(mi.Bool, active, pair)
        # The same random numbers on both sides: only the edge must make a difference.
        random = next_2d(seed, 2 * n, dr.gather(mi.UInt32, curve.lane, pair))
        sides = trace(scene, ray, view, photographs, shadows, random, traced)
        dr.eval(sides)
        before = 2 * dr.arange(mi.UInt32, n)
        jumps = [dr.gather(mi.Float, s, before, active) - dr.gather(mi.Float, s, before + 1, active) for s in sides]
        if curve.shadow:  # coverage only differs at outlines: one is between the two sides, and is sampled elsewhere
            active &= jumps[3] == 0
        dr.eval(jumps, active)
    moved = dr.dot(dr.select(active, across, 0), where)
    return q, curve.view, [dr.replace_grad(mi.Float(0), jump * moved) for jump in jumps], active


def cast_shadow(scene, curve: EdgeSamples, light, camera) -> EdgeSamples:
    """Project a curve from the light onto the scene. Returns the edge of the shadow that the curve casts.

    `curve`: samples of an outline as seen from the light. `light`, `camera`: functions from photograph indices (UInt32)
    to (position, True) or (direction toward it, False). The result is attached to light, curve and the surface that is
    in shadow. Samples whose shadow the camera does not see are inactive.
    """
    where, finite = light(curve.view)
    d = dr.normalize(dr.select(finite, curve.point - where, -where))
    away = dr.detach(dr.select(finite, dr.norm(curve.point - where), 0))
    start = ray_offset(dr.detach(curve.point), away)
    ray = mi.Ray3f(curve.point, d)
    with dr.suspend_grad():
        # A ray that grazes the shape must not hit it, so it passes a little outside. Where the shape is concave this is
        # inside of it: the ray then hits the shape, and the edge casts no shadow.
        aside = dr.normalize(dr.cross(curve.tangent, ray.d))
        aside *= dr.mulsign(start, dr.dot(aside, ray.o - curve.inside))
        origin = dr.detach(curve.point) + dr.select(dr.isfinite(aside.x), aside, 0)
        reach = dr.select(finite, (1 - 2.0**-10) * away, dr.largest(mi.Float))
        active = curve.active & ~scene.ray_test(mi.Ray3f(origin, -d, reach, 0, []), curve.active)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, d), active=active)
    si = hit.compute_surface_interaction(ray, active=active)
    d, n, t = dr.detach(d), dr.detach(si.n), dr.detach(si.t)
    slope = dr.dot(n, d)
    # The shadow of the tangent: scaled by the distance from the light, and sheared into the plane that it falls on.
    tangent = curve.tangent - d * (dr.dot(n, curve.tangent) / slope)
    tangent *= dr.select(finite, 1 + t / away, 1)
    with dr.suspend_grad():
        to_camera = dr.detach(camera(curve.view)[0] - si.p)
        above = ray_offset(dr.detach(si.p), dr.norm(to_camera))
        # The shadow must be visible. What hides it has no jump here, but its shading differs between the two sides.
        start = dr.detach(si.p) + n * dr.mulsign(above, dr.dot(n, to_camera))
        active &= si.is_valid() & (dr.abs(slope) > 1e-4)
        active &= ~scene.ray_test(mi.Ray3f(start, to_camera, 1 - 2.0**-10, 0, []), active)
        # Shadow rays start a little above the surface.
        above = dr.mulsign(above, -slope)
        shift = d * (above / slope) - n * above
    return EdgeSamples(curve.view, curve.lane, si.p + shift, tangent, curve.inside, active, SHADOW_OFFSET, shadow=True)
