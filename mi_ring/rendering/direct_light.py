"""Direct light: what a surface reflects toward the viewer (equation 2 of the paper)."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.edge_curves import leave
from mi_ring.scene.lights import shared_emitters

MIN_COSINE = 1e-3  #: grazing cosines are clamped here: see `CookTorrance`


def shade(scene, si, light, next_2d, shadows, rooms=False, around=None):
    """Radiance leaving `si` toward the viewer under `light(si)` → (DirectionSample3f, radiance · d⁻²), if not None.

    `around(si)`: radiance that is added, of light from everywhere. `rooms`: and under the scene's `room` emitters, by
    one sample each; `render_indirect` does so with less noise.
    """
    context, bsdf, active = mi.BSDFContext(), si.bsdf(), si.is_valid()
    # At an outline interpolated normals turn away before the faces do. Black there would be an edge of its own.
    rim = (si.wi.z < MIN_COSINE) & (dr.dot(si.wi, si.to_local(si.n)) > 0)
    si.wi = dr.normalize(mi.Vector3f(si.wi.x, si.wi.y, dr.select(rim, MIN_COSINE, si.wi.z)))

    def reflected(ds, weight, shadows):
        lit = active & dr.any(weight != 0)
        if shadows:
            lit &= sees(scene, si, ds, lit)
        value = bsdf.eval(context, si, si.to_local(ds.d), lit)
        return dr.select(lit, value * weight, 0)

    radiance = reflected(*light(si), shadows) if light else dr.zeros(mi.Color3f, dr.width(si.t))
    if around:
        radiance += dr.select(active, around(si), 0)
    for emitter in shared_emitters(scene, rooms):
        radiance += reflected(*emitter.sample_direction(si, next_2d(), active), True)
        if emitter.is_environment():
            radiance += dr.select(active, 0, emitter.eval(si, ~active))
    return radiance


def sees(scene, si, ds, active=True):
    """Does the surface at `si` see the light at `ds`?"""
    n, d = dr.detach(si.n), dr.detach(ds.d)
    origin = dr.detach(si.p) + n * dr.mulsign(leave(dr.detach(si.p), dr.detach(si.t)), dr.dot(n, d))
    to_light = dr.detach(ds.p) - origin
    distance = dr.norm(to_light)
    # Short of the light, which may be a surface
    ray = mi.Ray3f(origin, to_light / distance, (1 - 2.0**-10) * distance, si.time, si.wavelengths)
    return ~scene.ray_test(ray, active)


def next_2d(seed, lanes, stream=None):
    """A source of 2-D samples: independent streams, the lane's own or the one that `stream` (UInt32) says."""
    # Hashed as in Mitsuba's samplers: neighbouring streams would otherwise resemble each other.
    stream = dr.arange(mi.UInt32, lanes) if stream is None else stream
    # Of size 1: of another it would add the lane to the stream.
    rng = mi.PCG32(1, *mi.sample_tea_32(dr.opaque(mi.UInt32, seed), stream))
    return lambda: mi.Point2f(rng.next_float32(), rng.next_float32())


def trace(scene, ray, view, photographs, shadows, next_2d, active=True):
    """[R, G, B, coverage] along `ray`, each lane under the light of its own photograph; zero where not `active`.

    And under the light of the photographs' room as if nothing were in its way: what is, `render_indirect` knows.
    """
    shadows = shadows and photographs.cast
    hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
    dr.eval(hit)  # one traversal serves the image and its gradient
    si = hit.compute_surface_interaction(ray, active=active)
    radiance = shade(scene, si, photographs.lighting(view), next_2d, shadows, around=photographs.around(scene, view))
    return [*radiance, dr.select(si.is_valid(), mi.Float(1), 0)]
