"""The `photometric` integrator: photographs of the scene, each lit by its own light (Mitsuba plugin)."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import ADIntegrator  # `mitsuba.ad` keeps the classes of an older variant

from mi_ring import photograph
from mi_ring.bsdf import CookTorrance, check_attributes
from mi_ring.photograph import camera_ray, project

#: Offset to either side of a silhouette edge [px]. Radiance grows like the square root of the distance to the outline,
#: so that it must be small; float32 pixel coordinates of a 4096 px image still resolve it.
EDGE_OFFSET = 1e-3


class Photometric(ADIntegrator):
    """The paper's image formation for photographs (equation 2): camera k sees the object lit by light k alone.

    Direct light only: radiance = B · max(0, n·i) · intensity / d² for the nested point light of the photograph being
    rendered, B · max(0, n·i) · irradiance for a directional one. Emitters at the top level of the scene (an environment
    map, a lamp) light every photograph, one emitter sample each.

    =========== ===== =================================================================================
    parameter   type  meaning
    =========== ===== =================================================================================
    ``shadows`` bool  is a point lit only if it sees the light? Default: true
    =========== ===== =================================================================================

    Samples per pixel come from ``spp``. Alpha is the object's coverage, background included.

    What it does not do: interreflection; lamps that are shapes cast light but are black to the camera; ``shadows`` is
    about the photographs' own lights, others always cast shadows. Gradients through plain ``mi.render`` are those of
    shading inside the outline; the fit renders many photographs per launch with `render_photographs` and
    `backward_edges`, which add the outline.

    .. code-block:: xml

        <integrator type="photometric"><boolean name="shadows" value="true"/></integrator>
    """

    def __init__(self, props=None):
        props = mi.Properties() if props is None else props
        super().__init__(props)
        self.shadows = props.get("shadows", True)
        self.checked = None

    def sample(self, mode, scene, sampler, ray, depth=None, δL=None, state_in=None, active=True, **kwargs):
        self.check(scene)
        si = scene.ray_intersect(mi.Ray3f(ray), active)
        radiance = self.shade(scene, si, photograph.flash, sampler.next_2d, self.shadows)
        return radiance, si.is_valid(), [], None

    def check(self, scene):
        """Refuse a scene that would silently render black, once per scene."""
        if self.checked is not scene:
            for shape in scene.shapes():
                check_attributes(shape)
            self.checked = scene

    @staticmethod
    def shade(scene, si, light, next_2d, shadows):
        """Radiance leaving `si` toward the viewer under `light(si)` → (DirectionSample3f, radiance · d⁻²)."""
        context, bsdf, active = mi.BSDFContext(), si.bsdf(), si.is_valid()

        def reflected(ds, weight, shadows):
            lit = active & dr.any(weight != 0)
            if shadows:
                lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
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


@dataclass(frozen=True)
class Photographs:
    """Cameras and lights of all photographs of a scene as Dr.Jit buffers, and which of them to render.

    `index` (UInt32) selects and orders them; `size` is (width, height) [px] of every selected photograph.
    """

    cameras: object  # Float, 12 per photograph: the upper three rows of to_world
    intrinsics: object  # Float, 4 per photograph: fx, fy, cx, cy [px]
    lights: object  # Float, 8 per photograph: position or direction of travel, 0 point | 1 distant, intensity, unused
    index: object
    size: tuple[int, int]
    colocated: bool  # is every light at its camera's centre? Then nothing that is seen is in shadow

    @classmethod
    def of(cls, sensors) -> "Photographs":
        """All `photograph` sensors of a scene; `size` is the first one's, `select` those of equal size."""
        cameras = np.stack([np.array(s.matrix).reshape(4, 4)[:3] for s in sensors])
        intrinsics = [[*np.array(s.focal).ravel(), *np.array(s.centre).ravel()] for s in sensors]
        lights = np.stack([light_row(s) for s in sensors])
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

    def light(self, view, si):
        """(DirectionSample3f, radiance · d⁻²) at `si` of the light of photograph `view`, one per lane."""
        k = dr.gather(mi.UInt32, self.index, view)
        a = dr.gather(mi.Vector4f, self.lights, 2 * k)
        b = dr.gather(mi.Vector4f, self.lights, 2 * k + 1)
        distant = a.w > 0
        ds = dr.zeros(mi.DirectionSample3f)
        where = mi.Vector3f(a.x, a.y, a.z)
        to_light = dr.select(distant, -where, where - si.p)
        distance2 = dr.squared_norm(to_light)
        ds.d = to_light * dr.rsqrt(distance2)
        ds.dist = dr.select(distant, photograph.FAR, dr.sqrt(distance2))
        ds.p = dr.select(distant, si.p - where * ds.dist, where)
        intensity = mi.Color3f(b.x, b.y, b.z)
        return ds, intensity * dr.select(distant, 1, dr.rcp(distance2))


def light_row(sensor):
    """The light of a photograph as one row of `Photographs.lights`."""
    params = dict(mi.traverse(sensor.light))
    kind = sensor.light.class_name()
    if kind == "PointLight":
        where, strength = params["position"], params["intensity.value"]
    elif kind == "DirectionalEmitter":
        where, strength = np.array(params["to_world"].matrix).reshape(4, 4)[:3, 2], params["irradiance.value"]
    else:
        raise ValueError(f'photograph "{sensor.id()}": nested emitter is a {kind}, must be "point" or "directional"')
    strength = np.broadcast_to(np.array(strength).ravel(), 3)
    if not (np.isfinite(strength).all() and strength.min() >= 0 and strength.max() > 0):
        raise ValueError(f'photograph "{sensor.id()}": its light is {strength} strong, must be positive')
    return np.array([*np.array(where).ravel(), kind != "PointLight", *strength, 0.0])


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


def next_2d(seed, lanes):
    """A source of independent 2-D samples, one stream per lane."""
    # Hashed as in Mitsuba's samplers: the streams of neighbouring lanes would otherwise resemble each other.
    rng = mi.PCG32(lanes, *mi.sample_tea_32(dr.opaque(mi.UInt32, seed), dr.arange(mi.UInt32, lanes)))
    return lambda: mi.Point2f(rng.next_float32(), rng.next_float32())


def trace(scene, ray, view, photographs, shadows, seed):
    """[R, G, B, coverage] along `ray`, each lane under the light of its own photograph."""
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    dr.eval(hit)  # one traversal serves the image and its gradient
    si = hit.compute_surface_interaction(ray)
    radiance = Photometric.shade(
        scene, si, lambda si: photographs.light(view, si), next_2d(seed, dr.width(ray)), shadows
    )
    return [*radiance, dr.select(si.is_valid(), mi.Float(1), 0)]


def render_photographs(scene, photographs, spp, seed, shadows=True):
    """All selected photographs in one launch: [R, G, B, coverage], each a Float of N·H·W pixels, differentiable inside.

    Box-filtered linear radiance. The gradient is that of shading inside the outline; `backward_edges` adds the rest.
    """
    ray, view = pixel_rays(photographs, spp, seed)
    shadows = shadows and not photographs.colocated
    channels = trace(scene, ray, view, photographs, shadows, seed)
    dr.schedule(channels)  # together: block_sum would otherwise render once per channel
    return [dr.block_sum(c, spp) / spp for c in channels]


def render_maps(scene, photographs):
    """Normals and material where the centre of each pixel sees a `cooktorrance` surface, zero elsewhere.

    Returns Floats of N·H·W pixels: [nx, ny, nz, diffuse r, g, b, specular, roughness], normals in world space.
    """
    si = scene.ray_intersect(center_rays(photographs)[0])
    maps = [*si.sh_frame.n, *([mi.Float(0)] * 5)]
    for shape in scene.shapes():
        if isinstance(shape.bsdf(), CookTorrance):
            here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
            diffuse, specular, roughness = shape.bsdf().parameters(si, here)
            material = [*diffuse, specular, roughness]
            maps[3:] = [dr.select(here, new, old) for new, old in zip(material, maps[3:])]
    return [dr.select(si.is_valid(), m, 0) for m in maps]


def backward_edges(scene, photographs, positions, edges, channels_grad, seed, shadows=True, samples=4):
    """Accumulate into `positions` the gradient that is due to the object's outline moving across pixels.

    Moving a silhouette edge by n·dq [px] swaps the radiance beyond it for that before it over length · n·dq square
    pixels, so dI = (L_inside − L_outside) · n·dq · length. Rays 1/1000 px to either side of the edge see occlusion,
    background and coverage as the camera does.

    `positions`: attached Float (3 V) of the mesh; `edges`: (vertices (UInt32 × 2), opposite vertices (UInt32 × 2)),
    each of width E, the two triangles at an edge being (v0, v1, opposite0) and (v1, v0, opposite1); `channels_grad`:
    the loss's gradient as four Floats like the output of `render_photographs`; `samples` points per edge.
    """
    (v0, v1), (w0, w1) = edges
    count = dr.width(v0)
    width, height = photographs.size

    def vertex(source, index):
        return dr.gather(mi.Point3f, source, index)

    with dr.suspend_grad():
        fixed = dr.detach(positions)
        lane = dr.arange(mi.UInt32, count * len(photographs))
        view, edge = lane // count, lane % count
        a, b, c, d = (vertex(fixed, dr.gather(mi.UInt32, v, edge)) for v in (v0, v1, w0, w1))
        to_world, _, _ = photographs.camera(view)
        toward = a - mi.Point3f(to_world[0, 3], to_world[1, 3], to_world[2, 3])
        front0 = dr.dot(dr.cross(b - a, c - a), toward) < 0
        front1 = dr.dot(dr.cross(a - b, d - b), toward) < 0
        silhouette = dr.compress(front0 != front1)

        n = dr.width(silhouette)
        if n == 0:
            return
        lane = dr.arange(mi.UInt32, n * samples)
        chosen = dr.gather(mi.UInt32, silhouette, lane // samples)
        view, edge = chosen // count, chosen % count
        t = (mi.Float(lane % samples) + mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))) / samples
        i0, i1 = dr.gather(mi.UInt32, v0, edge), dr.gather(mi.UInt32, v1, edge)
        camera = photographs.camera(view)
        q0, z0 = project(*camera, vertex(fixed, i0))
        q1, z1 = project(*camera, vertex(fixed, i1))
        q, _ = project(*camera, dr.lerp(vertex(fixed, i0), vertex(fixed, i1), t))
        length = dr.norm(q1 - q0)
        normal = mi.Vector2f(q0.y - q1.y, q1.x - q0.x) / dr.maximum(length, 1e-8)
        seen = (q.x > 0) & (q.x < width) & (q.y > 0) & (q.y < height) & (z0 > 0) & (z1 > 0)
        # An edge seen from a slant is foreshortened: uniform steps along it are not uniform in the picture.
        length *= z0 * z1 / dr.square(dr.lerp(z0, z1, t))

        lane2 = dr.arange(mi.UInt32, 2 * n * samples)
        sign, lane2 = mi.Float(lane2 % 2) * 2 - 1, lane2 // 2
        q2 = dr.gather(mi.Point2f, dr.ravel(q), lane2)
        q2 += sign * EDGE_OFFSET * dr.gather(mi.Vector2f, dr.ravel(normal), lane2)
        view2 = dr.gather(mi.UInt32, view, lane2)
        ray = mi.Ray3f(*camera_ray(*photographs.camera(view2), q2))
        shadows = shadows and not photographs.colocated
        channels = trace(scene, ray, view2, photographs, shadows, seed)
        pixel = view * (width * height) + mi.UInt32(dr.clip(q.y, 0, height - 1)) * width
        pixel += mi.UInt32(dr.clip(q.x, 0, width - 1))
        dr.eval(channels)
        before, beyond = 2 * lane, 2 * lane + 1
        weight = mi.Float(0)
        for value, grad in zip(channels, channels_grad):
            step = dr.gather(mi.Float, value, before) - dr.gather(mi.Float, value, beyond)
            weight += step * dr.gather(mi.Float, grad, pixel, seen)
        weight = dr.select(seen, weight * length / samples, 0)
        dr.eval(weight, normal, i0, i1, t, view)

    point = dr.lerp(vertex(positions, i0), vertex(positions, i1), t)
    q, _ = project(*photographs.camera(view), point)
    dr.backward(dr.sum(weight * dr.dot(normal, q)))


mi.register_integrator("photometric", Photometric)
