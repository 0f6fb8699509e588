"""The `photometric` integrator: photographs of a scene, each lit by its own light (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi
from mitsuba.python.ad.integrators.common import ADIntegrator  # `mitsuba.ad` keeps the classes of an older variant

from mi_ring.plugins.flash import flash_light
from mi_ring.plugins.photograph import Photograph
from mi_ring.rendering.direct_light import shade
from mi_ring.rendering.edge_gradients import boundary_terms
from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.mesh_attributes import require_attributes


class Photometric(ADIntegrator):
    """The paper's image formation (equation 2): in photograph k, only light k lights the object.

    The integrator computes direct light. The radiance is B · max(0, n·i) · intensity / d² for a point light that is
    nested in the rendered photograph, and B · max(0, n·i) · irradiance for a nested directional light. Emitters at the
    top level of the scene, such as an environment map or a lamp, light every photograph. The integrator takes one
    sample of each.

    =========== ======= =============================================================================== =====
    Parameter   Type    Description                                                                     Flags
    =========== ======= =============================================================================== =====
    ``shadows`` boolean true: the photographs' own lights cast shadows. Default: true
    =========== ======= =============================================================================== =====

    The sampler of the sensor says the number of samples per pixel. The alpha channel is the share of the pixel that
    shapes cover.

    `mi.render` and `render_photographs` give gradients with respect to vertices, BSDFs, cameras, lights and the
    placement of other shapes. Automatic differentiation gives the gradients of shading. Edge sampling (Li et al. 2018,
    "Differentiable Monte Carlo Ray Tracing through Edge Sampling") gives the gradients of moving outlines, creases and
    edges of cast shadows, for meshes, rectangles, disks, spheres and cylinders.

    What it does not do: interreflection. Shapes that are emitters give light, but the camera sees them black. The light
    of emitters at the top level always casts shadows. The common parameters of Mitsuba's integrators (``max_depth``,
    ``hide_emitters``, …) are accepted and have no effect. Gradients need an RGB variant and a `photograph` sensor. The
    motion of soft shadows, of area lights and environment maps, has no gradients.

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
        self.require_attributes(scene)
        si = scene.ray_intersect(mi.Ray3f(ray), active)
        radiance = shade(scene, si, flash_light, sampler.next_2d, self.shadows, rooms=True)
        return radiance, si.is_valid(), [], None

    def require_attributes(self, scene):
        """Raise SceneError if a mesh of the scene lacks an attribute that its BSDF reads. Checks each scene once."""
        shapes = scene.shapes()  # keeping the scene, which holds this integrator, would be a cycle
        if shapes != self.checked:
            for shape in shapes:
                require_attributes(shape)
            self.checked = shapes

    def differentiable(self, scene, sensor, seed, spp):
        """Render an image from which gradients can be computed, with respect to all parameters of the scene.

        Gradients include those of moving edges. `sensor`: a `photograph`, or its index in the scene. `spp`: samples per
        pixel; 0: as many as the sampler of the sensor says. Returns a tensor (H, W, channels of the film). Raises
        ValueError for another kind of sensor, and for a variant that is not RGB.
        """
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
        window = low, low + mi.Point2f(film.crop_size()) + 2 * border  # the range of `sample_rays`
        for where, _, step, active in boundary_terms(scene, one, self.edges, seed, self.shadows, window):
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


mi.register_integrator("photometric", Photometric)
