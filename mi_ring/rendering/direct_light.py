"""Direct light: light that a surface reflects once, from a lamp to the camera (equation 2 of the paper)."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.edge_curves import ray_offset
from mi_ring.scene.lights import shared_emitters

MIN_COSINE = 1e-3  #: the least cosine between viewer and normal; smaller ones are clamped: see `CookTorrance`


def shade(scene, si, light, next_2d, shadows, rooms=False, room_radiance=None, shared=None):
    """Compute the radiance (Color3f) that the surface interactions `si` send to the viewer by direct light.

    The result is attached (it carries gradients). `light`: function from `si` to (DirectionSample3f, intensity /
    distance²) of the photograph's own light; None: it has none. `next_2d`: function that returns random points; each
    emitter of the scene that lights all photographs gets one. `shadows`: the own light casts shadows; the other
    emitters always do. `rooms`: also sample `room` emitters. `room_radiance`: function of `si` and `next_2d` to
    radiance that is added; None: nothing is added. `shared`: factor of all light but the own light, one for each of
    `si`; None: 1.
    """
    context, bsdf, active = mi.BSDFContext(), si.bsdf(), si.is_valid()
    # At an outline interpolated normals turn away before the faces do. A black strip there would be another edge.
    rim = (si.wi.z < MIN_COSINE) & (dr.dot(si.wi, si.to_local(si.n)) > 0)
    si.wi = dr.normalize(mi.Vector3f(si.wi.x, si.wi.y, dr.select(rim, MIN_COSINE, si.wi.z)))

    def reflected(ds, weight, shadows):
        lit = active & dr.any(weight != 0)
        if shadows:
            lit &= light_visible(scene, si, ds, lit)
        value = bsdf.eval(context, si, si.to_local(ds.d), lit)
        return dr.select(lit, value * weight, 0)

    radiance = reflected(*light(si), shadows) if light else dr.zeros(mi.Color3f, dr.width(si.t))
    factor = 1 if shared is None else shared
    if room_radiance:
        radiance += dr.select(active, factor * room_radiance(si, next_2d), 0)
    for emitter in shared_emitters(scene, rooms):
        radiance += factor * reflected(*emitter.sample_direction(si, next_2d(), active), True)
        if emitter.is_environment():
            radiance += dr.select(active, 0, factor * emitter.eval(si, ~active))
    return radiance


def light_visible(scene, si, ds, active=True):
    """Test whether light reaches the surface interactions `si`. Returns a Dr.Jit mask: True if no shape is in the way.

    `ds`: direction sample toward the light. Without gradients.
    """
    n, d = dr.detach(si.n), dr.detach(ds.d)
    origin = dr.detach(si.p) + n * dr.mulsign(ray_offset(dr.detach(si.p), dr.detach(si.t)), dr.dot(n, d))
    to_light = dr.detach(ds.p) - origin
    distance = dr.norm(to_light)
    # The ray ends before the light, which may be a surface.
    ray = mi.Ray3f(origin, to_light / distance, (1 - 2.0**-10) * distance, si.time, si.wavelengths)
    return ~scene.ray_test(ray, active)


def next_2d(seed, lanes, stream=None):
    """Make a random number generator: a function that returns new points (Point2f) in [0, 1)² at each call.

    `lanes`: number of points at each call; those of different lanes are independent. `stream` (UInt32): number of the
    random stream of each lane; None: the number of the lane.
    """
    # Hashed as in Mitsuba's samplers: without this, neighbouring streams are correlated.
    stream = dr.arange(mi.UInt32, lanes) if stream is None else stream
    # Of size 1: a larger generator would add the lane's number to the stream.
    rng = mi.PCG32(1, *mi.sample_tea_32(dr.opaque(mi.UInt32, seed), stream))
    return lambda: mi.Point2f(rng.next_float32(), rng.next_float32())


def trace(scene, ray, view, photographs, shadows, next_2d, active=True):
    """Trace camera rays, one per lane, and shade what they hit. Returns [R, G, B, coverage], with 0 in inactive lanes.

    `view`: index of the photograph of each lane, whose light is used. `next_2d`: function that returns random points.
    `shadows`: the photographs' own lights cast shadows. The radiance contains the light of the room: its
    harmonics as if nothing blocked them, its lobes with shadows. Coverage is 1 where a ray hits a shape.
    """
    shadows = shadows and photographs.casts_shadows
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    dr.eval(hit)  # one traversal serves the image and its gradient
    si = hit.compute_surface_interaction(ray, active=active)
    room_radiance = photographs.room_radiance(scene, view)
    radiance = shade(scene, si, photographs.lighting(view), next_2d, shadows, room_radiance=room_radiance,
                     shared=photographs.shared(view))  # fmt: skip
    return [*radiance, dr.select(si.is_valid(), mi.Float(1), 0)]
