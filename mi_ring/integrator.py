"""The `photometric` integrator: photographs of the scene, each lit by its own light (Mitsuba plugin)."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import ADIntegrator  # `mitsuba.ad` keeps the classes of an older variant

from mi_ring import photograph
from mi_ring.bsdf import MIN_COSINE, check_attributes
from mi_ring.edges import Curve, Edges, cast, leave
from mi_ring.photograph import Photograph, camera_ray, project, project_tangent

EDGE_ROUNDINGS = 16  #: the least offset to either side of an edge, in rounding errors of a pixel's coordinate


class Photometric(ADIntegrator):
    """The paper's image formation for photographs (equation 2): camera k sees the object lit by light k alone.

    Direct light only: radiance = B · max(0, n·i) · intensity / d² for the nested point light of the photograph being
    rendered, B · max(0, n·i) · irradiance for a directional one. Emitters at the top level of the scene (an environment
    map, a lamp) light every photograph, one emitter sample each.

    =========== ======= =============================================================================== =====
    Parameter   Type    Description                                                                     Flags
    =========== ======= =============================================================================== =====
    ``shadows`` boolean is a point lit only if it sees the light of its photograph? Default: true
    =========== ======= =============================================================================== =====

    Samples per pixel come from ``spp``. Alpha is the object's coverage, background included.

    Gradients, through `mi.render` and through `render_photographs`, are those with respect to vertices, BSDFs, cameras,
    lights and the placement of other shapes: shading by automatic differentiation, and the motion of outlines, creases
    and edges of cast shadows, of all meshes, rectangles, disks, spheres and cylinders, by sampling these edges (Li et
    al. 2018, "Differentiable Monte Carlo Ray Tracing through Edge Sampling").

    What it does not do: interreflection; lamps that are shapes cast light but are black to the camera; ``shadows`` is
    about the photographs' own lights, others always cast shadows. What Mitsuba's integrators have in common
    (``max_depth``, ``hide_emitters``, …) is accepted and has no effect. Gradients need an RGB variant and a
    `photograph` sensor; the soft shadows of area lights and environment maps give none when they move.

    .. tab-set-code::

        .. code-block:: xml

            <integrator type="photometric"><boolean name="shadows" value="true"/></integrator>

        .. code-block:: python

            {"type": "photometric", "shadows": True}
    """

    def __init__(self, props=None):
        props = mi.Properties() if props is None else props
        super().__init__(props)
        self.shadows = props.get("shadows", True)
        self.checked = None
        self.edges = None

    def sample(self, mode, scene, sampler, ray, depth=None, δL=None, state_in=None, active=True, **kwargs):
        self.check(scene)
        si = scene.ray_intersect(mi.Ray3f(ray), active)
        radiance = self.shade(scene, si, photograph.flash, sampler.next_2d, self.shadows)
        return radiance, si.is_valid(), [], None

    def check(self, scene):
        """Refuse a scene that would silently render black, once per scene."""
        shapes = scene.shapes()  # not the scene, which holds this integrator: nobody would free the two
        if shapes != self.checked:
            for shape in shapes:
                check_attributes(shape)
            self.checked = shapes

    @staticmethod
    def shade(scene, si, light, next_2d, shadows):
        """Radiance leaving `si` toward the viewer under `light(si)` → (DirectionSample3f, radiance · d⁻²)."""
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

        radiance = reflected(*light(si), shadows)
        for emitter in scene.emitters():
            if isinstance(emitter, photograph.Flash):
                continue
            radiance += reflected(*emitter.sample_direction(si, next_2d(), active), True)
            if emitter.is_environment():
                radiance += dr.select(active, 0, emitter.eval(si, ~active))
        return radiance

    def differentiable(self, scene, sensor, seed, spp):
        """The image of `render`, attached, the motion of edges included."""
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor]
        if not (mi.is_rgb and isinstance(sensor, Photograph)):
            raise ValueError("photometric: gradients need an RGB variant and a photograph sensor")
        self.edges = Edges.of(scene, self.edges)
        film = sensor.film()
        sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
        ray, weight, where = self.sample_rays(scene, sensor, sampler)
        radiance, valid, _, _ = self.sample(dr.ADMode.Backward, scene, sampler, ray)
        block = film.create_block()
        block.set_coalesce(block.coalesce() and spp >= 4)
        coverage = dr.select(valid, mi.Float(1), 0)
        ADIntegrator._splat_to_block(block, film, where, radiance * weight, 1.0, coverage, [], ray.wavelengths)
        film.put_block(block)
        one = Photographs.attached(sensor)
        border = film.rfilter().border_size() if film.sample_border() else 0
        low = mi.Point2f(film.crop_offset()) - border
        window = low, low + mi.Point2f(film.crop_size()) + 2 * border  # where `sample_rays` puts its samples
        for where, _, step, active in boundaries(scene, one, self.edges, seed, self.shadows, window):
            block = film.create_block()
            block.set_coalesce(False)
            # The film divides by the sum of the weights, `spp` per pixel.
            step = [dr.select(active, value * spp, 0) for value in step]
            ADIntegrator._splat_to_block(block, film, where, mi.Color3f(step[:3]), 0.0, step[3], [], ray.wavelengths)
            film.put_block(block)
        return film.develop()

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        image = self.differentiable(scene, sensor, seed, spp)
        dr.forward_to(image)
        return dr.grad(image)

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        image = self.differentiable(scene, sensor, seed, spp)
        dr.set_grad(image, grad_in)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)


def sees(scene, si, ds, active=True):
    """Does the surface at `si` see the light at `ds`?"""
    n, d = dr.detach(si.n), dr.detach(ds.d)
    origin = dr.detach(si.p) + n * dr.mulsign(leave(dr.detach(si.p), dr.detach(si.t)), dr.dot(n, d))
    to_light = dr.detach(ds.p) - origin
    distance = dr.norm(to_light)
    # Short of the light, which may be a surface
    ray = mi.Ray3f(origin, to_light / distance, (1 - 2.0**-10) * distance, si.time, si.wavelengths)
    return ~scene.ray_test(ray, active)


@dataclass(frozen=True)
class Photographs:
    """Cameras and lights of all photographs of a scene as Dr.Jit buffers, and which of them to render.

    `index` (UInt32) selects and orders them; `size` is (width, height) [px] of every selected photograph.
    """

    cameras: object  #: Float, 12 per photograph: the upper three rows of to_world
    intrinsics: object  #: Float, 4 per photograph: fx, fy, cx, cy [px]
    lights: object  #: Float, 8 per photograph: position or direction toward it, 0 point | 1 distant, intensity, unused
    index: object
    size: tuple[int, int]
    colocated: bool  #: is every light at its camera's centre? Then nothing that is seen is in shadow

    @classmethod
    def of(cls, sensors) -> "Photographs":
        """All `photograph` sensors of a scene; `size` is the first one's, `select` those of equal size."""
        cameras = np.stack([np.array(s.to_world.matrix).reshape(4, 4)[:3] for s in sensors])
        intrinsics = [[*np.array(s.focal).ravel(), *np.array(s.centre).ravel()] for s in sensors]
        lights = np.array([light_of(s) for s in sensors], np.float64).reshape(-1, 8)
        # Equal but for the rounding of float32.
        off = np.abs(lights[:, :3] - cameras[:, :, 3]).max(1) > 1e-6 * np.abs(cameras[:, :, 3]).max()
        return cls(
            mi.Float(cameras.astype(np.float32).ravel()),
            mi.Float(np.array(intrinsics, np.float32).ravel()),
            mi.Float(lights.astype(np.float32).ravel()),
            dr.arange(mi.UInt32, len(sensors)),
            sensors[0].size,
            not (off | (lights[:, 3] > 0)).any(),
        )

    @classmethod
    def attached(cls, sensor) -> "Photographs":
        """One photograph, its camera and its light attached to the parameters of the sensor."""
        m = sensor.to_world.matrix
        return replace(
            cls.of([sensor]),
            cameras=dr.concat([mi.Float(m[i, j]) for i in range(3) for j in range(4)]),
            intrinsics=dr.concat([*sensor.focal, *sensor.centre]),
            lights=dr.concat(light_of(sensor)),
        )

    def select(self, index, size: tuple[int, int], scale: int = 1) -> "Photographs":
        """Photographs `index` (a sequence of ints), all (width, height) = `size`, rendered `scale` times smaller."""
        width, height = size
        return Photographs(
            self.cameras, self.intrinsics / dr.opaque(mi.Float, scale), self.lights,
            mi.UInt32(np.asarray(index, np.uint32)), (width // scale, height // scale), self.colocated,
        )  # fmt: skip

    def __len__(self):
        return dr.width(self.index)

    def camera(self, view):
        """(to_world, focal, centre) of the selected photograph `view`, one per lane."""
        k = dr.gather(mi.UInt32, self.index, view)
        rows = [dr.gather(mi.Vector4f, self.cameras, 3 * k + row) for row in range(3)]
        f = dr.gather(mi.Vector4f, self.intrinsics, k)
        to_world = mi.Matrix4f(*[list(row) for row in rows], [0, 0, 0, 1])
        return to_world, mi.Point2f(f.x, f.y), mi.Point2f(f.z, f.w)

    def eye(self, view):
        """The camera of photograph `view`, one per lane, as an eye of `Edges`."""
        to_world, _, _ = self.camera(view)
        return mi.Vector3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]), mi.Bool(True)

    def source(self, view):
        """The light of photograph `view`, one per lane, as an eye of `Edges`."""
        where = dr.gather(mi.Vector4f, self.lights, 2 * dr.gather(mi.UInt32, self.index, view))
        return where.xyz, where.w == 0

    def light(self, view, si):
        """(DirectionSample3f, radiance · d⁻²) at `si` of the light of photograph `view`, one per lane."""
        where, finite = self.source(view)
        strength = dr.gather(mi.Vector4f, self.lights, 2 * dr.gather(mi.UInt32, self.index, view) + 1)
        ds = dr.zeros(mi.DirectionSample3f)
        to_light = dr.select(finite, where - si.p, where)
        distance2 = dr.squared_norm(to_light)
        ds.d = to_light * dr.rsqrt(distance2)
        ds.dist = dr.select(finite, dr.sqrt(distance2), photograph.FAR)
        ds.p = si.p + ds.d * ds.dist
        return ds, mi.Color3f(strength.xyz) * dr.select(finite, dr.rcp(distance2), 1)


def source_of(emitter):
    """Where a lamp is, attached: (Vector3f, True), or (direction toward it, False) if it is infinitely far away.

    None for lamps that are neither: area lights, environment maps.
    """
    params = mi.traverse(emitter)
    match emitter.class_name():
        case "PointLight":
            return mi.Vector3f(params["position"]), True
        case "SpotLight":
            m = params["to_world"].matrix
            return mi.Vector3f(m[0, 3], m[1, 3], m[2, 3]), True
        case "DirectionalEmitter":
            m = params["to_world"].matrix
            return -mi.Vector3f(m[0, 2], m[1, 2], m[2, 2]), False


def light_of(sensor):
    """The light of a photograph as one row of `Photographs.lights`, eight attached Floats."""
    light = sensor.light
    kind = light.class_name()
    if kind not in ("PointLight", "DirectionalEmitter"):
        raise ValueError(f'photograph "{sensor.id()}": nested emitter is a {kind}, must be "point" or "directional"')
    where, finite = source_of(light)
    strength = mi.Color3f(mi.traverse(light)["intensity.value" if finite else "irradiance.value"])
    if not (dr.all(dr.isfinite(strength) & (strength >= 0)) and dr.any(strength > 0)):
        raise ValueError(f'photograph "{sensor.id()}": its light is {strength} strong, must be positive')
    if not dr.all(dr.isfinite(where)):
        raise ValueError(f'photograph "{sensor.id()}": its light is at {where}, must be finite')
    return [*where, mi.Float(not finite), *strength, mi.Float(0)]


def pixel_rays(photographs, spp, seed):
    """`spp` stratified primary rays per pixel: (rays, photograph per lane). A pixel's samples are consecutive lanes."""
    width, height = photographs.size
    lane = dr.arange(mi.UInt32, len(photographs) * width * height * spp)
    pixel = lane // spp
    view, pixel = pixel // (width * height), pixel % (width * height)
    jitter_x = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))
    jitter_y = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed) ^ 0x5BD1E995)
    columns = int(np.sqrt(spp))
    while spp % columns:
        columns -= 1
    stratum = lane % spp
    x = mi.Float(pixel % width) + (mi.Float(stratum % columns) + jitter_x) / columns
    y = mi.Float(pixel // width) + (mi.Float(stratum // columns) + jitter_y) / (spp // columns)
    return mi.Ray3f(*camera_ray(*photographs.camera(view), mi.Point2f(x, y))), view


def center_rays(photographs):
    """One ray through the centre of every pixel: (rays, photograph per lane)."""
    width, height = photographs.size
    lane = dr.arange(mi.UInt32, len(photographs) * width * height)
    view, pixel = lane // (width * height), lane % (width * height)
    where = mi.Point2f(mi.Float(pixel % width) + 0.5, mi.Float(pixel // width) + 0.5)
    return mi.Ray3f(*camera_ray(*photographs.camera(view), where)), view


def next_2d(seed, lanes, stream=None):
    """A source of 2-D samples: independent streams, the lane's own or the one that `stream` (UInt32) says."""
    # Hashed as in Mitsuba's samplers: neighbouring streams would otherwise resemble each other.
    stream = dr.arange(mi.UInt32, lanes) if stream is None else stream
    rng = mi.PCG32(lanes, *mi.sample_tea_32(dr.opaque(mi.UInt32, seed), stream))
    return lambda: mi.Point2f(rng.next_float32(), rng.next_float32())


def trace(scene, ray, view, photographs, shadows, next_2d):
    """[R, G, B, coverage] along `ray`, each lane under the light of its own photograph."""
    shadows = shadows and not photographs.colocated
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    dr.eval(hit)  # one traversal serves the image and its gradient
    si = hit.compute_surface_interaction(ray)
    radiance = Photometric.shade(scene, si, lambda si: photographs.light(view, si), next_2d, shadows)
    return [*radiance, dr.select(si.is_valid(), mi.Float(1), 0)]


def render_photographs(scene, photographs, spp, seed, shadows=True, edges=None):
    """All selected photographs in one launch: [R, G, B, coverage], each a Float of N·H·W pixels, attached.

    Box-filtered linear radiance. Without `edges` the gradient is that of shading between the edges.
    """
    ray, view = pixel_rays(photographs, spp, seed)
    channels = trace(scene, ray, view, photographs, shadows, next_2d(seed, dr.width(ray)))
    dr.schedule(channels)  # together: block_sum would otherwise render once per channel
    channels = [dr.block_sum(c, spp) / spp for c in channels]
    if edges is None:
        return channels
    width, height = photographs.size
    for where, view, step, active in boundaries(scene, photographs, edges, seed, shadows):
        pixel = view * (width * height) + mi.UInt32(where.y) * width + mi.UInt32(where.x)
        for k, value in enumerate(step):
            motion = dr.zeros(mi.Float, dr.width(channels[k]))
            dr.scatter_add(motion, value, pixel, active)
            channels[k] += motion
    return channels


def boundaries(scene, photographs, edges, seed, shadows=True, window=None):
    """What edges add to the gradient of photographs: (where [px], view, step, active) of samples along each curve.

    An edge that moves by n·dq [px] swaps the radiance beyond it for that before it over length · n·dq square pixels:
    dI = (L_before − L_beyond) · n·dq · length. Rays to either side of the edge see occlusion, background, coverage and
    shadows as the camera does. `step`, [R, G, B, coverage], is zero; its derivative is dI, to be added to the pixel at
    `where`. Edges count within `window`, the (lowest, highest) corner [px] of what is rendered, the whole by default.
    """
    window = window or (mi.Point2f(0), mi.Point2f(photographs.size))
    views = len(photographs)
    curves, fronts = edges.outlines(photographs.eye, views, seed)
    sources = [photographs.source] if shadows and not photographs.colocated else []
    for source in filter(None, map(source_of, scene.emitters())):
        sources.append(lambda view, source=source: (source[0], mi.Bool(source[1])))
    for k, source in enumerate(sources, 1):
        casters, terminators = edges.shadow_casters(source, views, seed + k, fronts)
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
        along = project_tangent(camera[0], camera[1], curve.point, curve.tangent)
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
        # The same random numbers on both sides: only what jumps must differ.
        sides = trace(scene, ray, view, photographs, shadows, next_2d(seed, 2 * n, pair))
        dr.eval(sides)
        before = 2 * dr.arange(mi.UInt32, n)
        jumps = [dr.gather(mi.Float, s, before, active) - dr.gather(mi.Float, s, before + 1, active) for s in sides]
        if curve.shadow:  # no edge of light covers more: between the two sides there is an outline, which is not meant
            active &= jumps[3] == 0
        dr.eval(jumps, active)
    moved = dr.dot(dr.select(active, across, 0), where)
    return q, curve.view, [dr.replace_grad(mi.Float(0), jump * moved) for jump in jumps], active


def render_maps(scene, photographs, attributes):
    """Normals, and mesh attributes (channels by name) of the shapes that have them, at the centres of pixels.

    Returns Floats of N·H·W pixels: [nx, ny, nz, first attribute, …], normals in world space, zero where there is none.
    """
    si = scene.ray_intersect(center_rays(photographs)[0])
    maps = [dr.select(si.is_valid(), n, 0) for n in si.sh_frame.n]
    for name, channels in attributes.items():
        values = [mi.Float(0)] * channels
        for shape in scene.shapes():
            if shape.is_mesh() and shape.has_attribute(name):
                here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
                one = channels == 1
                found = [shape.eval_attribute_1(name, si, here)] if one else shape.eval_attribute_3(name, si, here)
                values = [dr.select(here, new, old) for new, old in zip(found, values)]
        maps += values
    return maps


mi.register_integrator("photometric", Photometric)
