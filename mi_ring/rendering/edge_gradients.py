"""What moving edges add to the gradient of a photograph."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, trace
from mi_ring.rendering.edge_curves import JUMP, Curve, leave
from mi_ring.rendering.pinhole import camera_ray, project, project_tangent
from mi_ring.scene.lights import place_of

EDGE_ROUNDINGS = 16  #: the least offset to either side of an edge, in rounding errors of a pixel's coordinate


def boundaries(scene, photographs, edges, seed, shadows=True, window=None):
    """What edges add to the gradient of photographs: (where [px], view, step, active) of samples along each curve.

    An edge that moves by n·dq [px] swaps the radiance beyond it for that before it over length · n·dq square pixels:
    dI = (L_before − L_beyond) · n·dq · length. Rays to either side of the edge see occlusion, background, coverage and
    shadows as the camera does. `step`, [R, G, B, coverage], is zero; its derivative is dI, to be added to the pixel at
    `where`. Edges count within `window`, the (lowest, highest) corner [px] of what is rendered, the whole by default.
    """
    window = window or (mi.Point2f(0), mi.Point2f(photographs.size))
    views, before = len(photographs), photographs.before
    curves, fronts = edges.outlines(photographs.eye, views, seed, before)
    sources = [photographs.source] if shadows and photographs.cast else []
    for source in filter(None, map(place_of, scene.emitters())):
        sources.append(lambda view, source=source: (source[0], mi.Bool(source[1])))
    for k, source in enumerate(sources, 1):
        casters, terminators = edges.shadow_casters(source, views, seed + k, fronts, before)
        curves += terminators + [cast(scene, curve, source, photographs.eye) for curve in casters]
    return [b for curve in curves if (b := boundary(scene, photographs, curve, seed + 2, shadows, window)) is not None]


def boundary(scene, photographs, curve: Curve, seed, shadows, window):
    """`boundaries` of one curve; None if nothing moves it."""
    camera = photographs.camera(curve.view)
    where, depth = project(*camera, curve.point)
    if not dr.grad_enabled(where):
        return None
    with dr.suspend_grad():
        q = dr.detach(where)
        active = curve.active & (depth > 0) & dr.all((q > window[0]) & (q < window[1]))
        along = project_tangent(camera[0], camera[1], camera[3], curve.point, curve.tangent)
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
        ray = mi.Ray3f(*camera_ray(*photographs.camera(view), pixel))
        # Where there is no edge rays may not be finite, which OptiX must not meet.
        meant = dr.gather(mi.Bool, active, pair)
        # The same random numbers on both sides: only what jumps must differ.
        random = next_2d(seed, 2 * n, dr.gather(mi.UInt32, curve.lane, pair))
        sides = trace(scene, ray, view, photographs, shadows, random, meant)
        dr.eval(sides)
        before = 2 * dr.arange(mi.UInt32, n)
        jumps = [dr.gather(mi.Float, s, before, active) - dr.gather(mi.Float, s, before + 1, active) for s in sides]
        if curve.shadow:  # no edge of light covers more: between the two sides there is an outline, which is not meant
            active &= jumps[3] == 0
        dr.eval(jumps, active)
    moved = dr.dot(dr.select(active, across, 0), where)
    return q, curve.view, [dr.replace_grad(mi.Float(0), jump * moved) for jump in jumps], active


def cast(scene, curve: Curve, light, camera) -> Curve:
    """The shadow of a curve: where the rays that leave the light and graze the curve arrive.

    Attached to the light, to the curve and to what the shadow falls on. `light` and `camera` are eyes.
    """
    where, finite = light(curve.view)
    d = dr.normalize(dr.select(finite, curve.point - where, -where))
    away = dr.detach(dr.select(finite, dr.norm(curve.point - where), 0))
    start = leave(dr.detach(curve.point), away)
    ray = mi.Ray3f(curve.point, d)
    with dr.suspend_grad():
        # A ray that grazes the shape may not meet it again: it passes a little outside. Where the shape is hollow that
        # is inside it, and such an edge casts no shadow.
        aside = dr.normalize(dr.cross(curve.tangent, ray.d))
        aside *= dr.mulsign(start, dr.dot(aside, ray.o - curve.inside))
        origin = dr.detach(curve.point) + dr.select(dr.isfinite(aside.x), aside, 0)
        reach = dr.select(finite, (1 - 2.0**-10) * away, dr.largest(mi.Float))
        active = curve.active & ~scene.ray_test(mi.Ray3f(origin, -d, reach, 0, []), curve.active)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, d), active=active)
    si = hit.compute_surface_interaction(ray, active=active)
    d, n, t = dr.detach(d), dr.detach(si.n), dr.detach(si.t)
    slope = dr.dot(n, d)
    # The shadow of a step along the curve: stretched by the distance from the light, and sheared into the plane that
    # it falls on.
    tangent = curve.tangent - d * (dr.dot(n, curve.tangent) / slope)
    tangent *= dr.select(finite, 1 + t / away, 1)
    with dr.suspend_grad():
        to_camera = dr.detach(camera(curve.view)[0] - si.p)
        above = leave(dr.detach(si.p), dr.norm(to_camera))
        # What hides the shadow from the camera would not jump, but its shading differs between the two sides as well.
        start = dr.detach(si.p) + n * dr.mulsign(above, dr.dot(n, to_camera))
        active &= si.is_valid() & (dr.abs(slope) > 1e-4)
        active &= ~scene.ray_test(mi.Ray3f(start, to_camera, 1 - 2.0**-10, 0, []), active)
        # Whether a point is in shadow is asked a little above the surface.
        above = dr.mulsign(above, -slope)
        shift = d * (above / slope) - n * above
    return Curve(curve.view, curve.lane, si.p + shift, tangent, curve.inside, active, JUMP, shadow=True)
