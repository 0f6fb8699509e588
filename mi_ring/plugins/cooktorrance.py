"""The `cooktorrance` BSDF: equation 1 of the paper (Mitsuba plugin)."""

from typing import Any, ClassVar, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_ring.plugins.matte_reflection import cosine_factors, mean_albedo, rough_lobe, roughened, softened_cosine
from mi_ring.plugins.microfacets import (
    DISTRIBUTIONS,
    GLOSS_NODES,
    MIN_ROUGHNESS,
    gloss_table,
    microfacets,
    widened_roughness,
)
from mi_ring.rendering.direct_light import MIN_COSINE

ROUGHNESS = "vertex_diffuse_roughness"
COAT = "coat", "coat_roughness"  #: parameters of the coat


class Parameters(NamedTuple):
    """The parameters at surface interactions, each a Dr.Jit array. Without a coat, its parameters are None."""

    diffuse: Any
    specular: Any
    roughness: Any
    diffuse_roughness: Any
    coat: Any = None
    coat_roughness: Any = None


class CookTorrance(mi.BSDF):
    """The paper's reflectance, equation 1: B = ρᵈ + ρᵞ · D(n, h; r) · G(i, o; r) / (π (n·i)(n·o)).

    ===================== ================= ================================================================= =====
    Parameter             Type              Description                                                       Flags
    ===================== ================= ================================================================= =====
    ``diffuse``           rgb or texture    ρᵈ; the diffuse term has no 1/π. Default: the mesh attribute      P, ∂
                                            ``vertex_diffuse``, by `fine_attribute`
    ``specular``          float or texture  ρᵞ; it contains the Fresnel factor, which is constant. Default:   P, ∂
                                            the mesh attribute ``vertex_specular``
    ``roughness``         float or texture  r, the width α of the distribution, at least 0.02. Default: the   P, ∂
                                            mesh attribute ``vertex_roughness``
    ``diffuse_roughness`` float or texture  σ of the diffuse term, 0 to 1. Default: the mesh attribute        P, ∂
                                            ``vertex_diffuse_roughness``; 0, as in the paper, if there is
                                            none
    ``coat``              float or texture  ρᶜ, the strength of a second specular lobe. Default: the mesh     P, ∂
                                            attribute ``vertex_coat`` if ``coat_roughness`` is given, else
                                            none
    ``coat_roughness``    float or texture  its width, like ``roughness``. Default: the mesh attribute        P, ∂
                                            ``vertex_coat_roughness`` if ``coat`` is given
    ``distribution``      string            D and its G: ``ggx`` or ``beckmann``. Default: ``ggx``
    ``fresnel``           boolean           true: it reflects more at grazing angles. Default: false, as in
                                            the paper
    ===================== ================= ================================================================= =====

    The paper does not name D and G. Here they are those of Walter et al. 2007 (Microfacet Models for Refraction through
    Rough Surfaces). D is equation 33 (GGX) or 25 (Beckmann) without its 1/π. G is Smith's product of equation 34 or 27;
    for Beckmann, it is Walter's rational fit, to within 0.35 %. So the specular part is 4 ρᵞ times ``roughconductor``
    with F = 1.

    With ``fresnel``, ρᵞ grows with the angle between o and h up to 1/4, the value of a mirror, by "An Inexpensive BRDF
    Model for Physically-based Rendering" (Schlick 1994): F = F₀ + (1 − F₀) (1 − o·h)⁵ with F₀ = 4 ρᵞ. This needs the
    true ρᵞ. It makes no difference for a light next to the camera, but it matters for light from a table.

    Wood, cloth, stone and other rough surfaces that are lit from the viewer are brighter at their rims than Lambert's
    law says. With
    ``diffuse_roughness``, ρᵈ is multiplied by (1 + σ s/t) / (1 + (1/2 − 2/(3π)) σ). Here s is i·o − (n·i)(n·o), and t
    is max(n·i, n·o) if s > 0, else 1. This is Fujii's form of the model of Oren and Nayar, as in "EON: A Practical
    Energy-Preserving Rough Diffuse BRDF" (Portsmouth, Kutz and Hill 2024), without its second term for light between
    microfacets. Its albedo is at most Lambert's, for every viewer.

    Varnish over wood, glaze over clay and polished metal have a sharp highlight in a wide one. With ``coat``, B has a
    second specular part, ρᶜ · D(n, h; rᶜ) · G(i, o; rᶜ) / (π (n·i)(n·o)), whose rᶜ is ``coat_roughness``. It has the
    same D and G as the first. With ``fresnel``, ρᵞ + ρᶜ grows up to 1/4, and both keep their shares. The coat takes no
    light from the base: what a real one absorbs and reflects is in ρᵈ and ρᵞ. Without ``coat``, nothing of it is
    computed.

    **Energy.** Substitute di = 4 (o·h) dh in the specular part of the albedo, then G ≤ G₁(o) = n·o / ∫ D/π ⟨o, h⟩ dh::

        ∫ B (n·i) di = π ρᵈ + 4 ρᵞ ∫ D/π · G · (o·h) / (n·o) dh  ≤  π ρᵈ + 4 ρᵞ   for every o,

    and narrow lobes reach this bound without ``fresnel``. A surface with π ρᵈ + 4 ρᵞ + 4 ρᶜ ≤ 1 in each channel
    conserves energy. Nothing enforces this: ρ also contains the scale of lamp and camera.

    With interpolated normals, a strip about 0.01 px wide at the contour has n·o < 0 on a face that faces the viewer. If
    it were black, this discontinuity would make gradients at the outline wrong. It is lit instead, with n·o clamped.

    What it does not do: transmission, two-sided surfaces, anisotropy, light between microfacets.

    Raises ValueError if ``distribution`` is neither ``ggx`` nor ``beckmann``, or if ``fresnel`` is no boolean.

    .. tab-set-code::

        .. code-block:: xml

            <bsdf type="cooktorrance">
              <rgb name="diffuse" value="0.2, 0.1, 0.1"/>
              <float name="specular" value="0.05"/>
              <float name="roughness" value="0.3"/>
              <string name="distribution" value="beckmann"/>
            </bsdf>

        .. code-block:: python

            {
                "type": "cooktorrance", "diffuse": {"type": "rgb", "value": [0.2, 0.1, 0.1]},
                "specular": 0.05, "roughness": 0.3, "distribution": "beckmann",
            }
    """

    optional: ClassVar = {ROUGHNESS}  #: mesh attributes that a mesh may lack: they are then 0

    def __init__(self, props):
        super().__init__(props)
        self.distribution = props.get("distribution", "ggx")
        if self.distribution not in DISTRIBUTIONS:
            allowed = " or ".join(f'"{name}"' for name in DISTRIBUTIONS)
            raise ValueError(f'cooktorrance "{props.id()}": distribution is "{self.distribution}", must be {allowed}')
        self.fresnel = props.get("fresnel", False)
        if not isinstance(self.fresnel, bool):
            raise ValueError(f'cooktorrance "{props.id()}": fresnel is {self.fresnel}, must be true or false')
        self.reads_optional = "diffuse_roughness" not in props
        #: number of channels of each parameter
        self.channels = {"diffuse": 3, "specular": 1, "roughness": 1, "diffuse_roughness": 1}
        if any(name in props for name in COAT):
            self.channels |= dict.fromkeys(COAT, 1)
        self.textures = {}
        for name in self.channels:
            if name not in props:
                kind = "fine_attribute" if name == "diffuse" else "mesh_attribute"
                props[name] = mi.load_dict({"type": kind, "name": f"vertex_{name}"})
            self.textures[name] = props.get_unbounded_texture(name)
        side = mi.BSDFFlags.FrontSide
        self.m_components = [mi.BSDFFlags.DiffuseReflection | side, mi.BSDFFlags.GlossyReflection | side]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def parameters(self, si, active=True):
        """Evaluate the parameters at the surface interactions `si`. The roughness r is at least 0.02."""
        textures = self.textures
        diffuse = textures["diffuse"].eval(si, active)
        specular, r = (textures[name].eval_1(si, active) for name in ("specular", "roughness"))
        sigma = 0.0  # scalar variants raise an error if the mesh has no such attribute
        if dr.is_array_v(mi.Float) or not self.reads_optional or si.shape.has_attribute(ROUGHNESS):
            sigma = textures["diffuse_roughness"].eval_1(si, active)
        here = Parameters(diffuse, specular, dr.maximum(r, MIN_ROUGHNESS), sigma)
        if "coat" not in textures:
            return here
        coat, r = (textures[name].eval_1(si, active) for name in COAT)
        return here._replace(coat=coat, coat_roughness=dr.maximum(r, MIN_ROUGHNESS))

    @staticmethod
    def front(si, wo):
        """Return a Dr.Jit mask: True where viewer and light are on the front side of the surface.

        `wo`: direction to the light in the local frame of `si`. It must be on the front side of the shading normal. For
        the viewer, the front side of either the shading normal or the geometric normal is enough.
        """
        n = si.to_local(si.n)
        return ((si.wi.z > 0) | (dr.dot(si.wi, n) > 0)) & (wo.z > 0)

    def glosses(self, here):
        """List the specular lobes. There is one without a coat, otherwise two. `here`: the parameters.

        A lobe is a tuple of its strength ρ, of what the Fresnel term adds to it at most, and of its roughness.
        """
        total, strengths = here.specular, [(here.specular, here.roughness)]
        if here.coat is not None:
            total = here.specular + here.coat
            strengths.append((here.coat, here.coat_roughness))
        if not self.fresnel:
            return [(strength, 0, r) for strength, r in strengths]
        more = dr.maximum(0.25 - total, 0)
        if len(strengths) == 1:
            return [(here.specular, more, here.roughness)]
        share = dr.select(total > 0, here.coat / total, 0)
        return [(strength, more * part, r) for part, (strength, r) in zip((1 - share, share), strengths)]

    def with_fresnel(self, strength, more, cosine):
        """Return the strength of a lobe at an angle between viewer and half vector. `cosine`: of this angle, o·h.

        `strength`, `more`: of the method `glosses`. Without the parameter ``fresnel``, `strength` is returned.
        """
        if not self.fresnel:
            return strength
        return strength + more * dr.power(1 - dr.clip(cosine, 0, 1), 5)

    def reflected(self, ctx, si, wo, here, active):
        """Evaluate B (n·i) [1/sr], equation 1 times the cosine, for light from direction `wo` (local frame of `si`).

        `here`: the parameters at `si`. `ctx`: Mitsuba's BSDFContext; it can switch off the diffuse or the specular
        part. The result is 0 where `active` is False, and for light or viewer behind the surface.
        """
        o, i = (mi.Vector3f(v.x, v.y, dr.maximum(v.z, MIN_COSINE)) for v in (si.wi, wo))
        h = dr.normalize(wo + si.wi)
        h.z = dr.abs(h.z)  # at the contour h may be below the surface, where Mitsuba's D is 0
        gloss = 0
        for strength, more, r in self.glosses(here):
            facets, specular = microfacets(self.distribution, r), self.with_fresnel(strength, more, dr.dot(si.wi, h))
            # G with m = n: G only uses the side of m, and `front` tests the side.
            gloss += specular * facets.eval(h) * facets.G(i, o, mi.Normal3f(0, 0, 1)) / (i.z * o.z)
        matte = here.diffuse * roughened(i, o, here.diffuse_roughness)
        value = matte * ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        value += gloss * ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        return dr.select(active & self.front(si, wo), value * i.z, 0)

    def lobes(self, si, order, active=True):
        """Compute how the surface reflects light that is given by spherical harmonics. Returns two or three lobes.

        The first lobe is diffuse, the second specular, and the third is that of a coat. A lobe is a pair (axis,
        factors). The axis is a unit vector in the world, about which the lobe is symmetric. Factor l of the `order` + 1
        factors multiplies the light's harmonics of degree l, evaluated at the axis; the sum over l is the reflected
        radiance. The diffuse lobe is that of "An Efficient Representation for Irradiance Environment Maps" (Ramamoorthi
        and Hanrahan 2001). With a ``diffuse_roughness`` it is exact up to degree 1. Specular lobes are approximations,
        tabulated over roughness and viewing angle.
        """
        here = self.parameters(si, active)
        active &= self.front(si, mi.Vector3f(0, 0, 1))
        diffuse = dr.select(active, here.diffuse, 0)
        here = here._replace(
            specular=dr.select(active, here.specular, 0),
            coat=None if here.coat is None else dr.select(active, here.coat, 0),
        )
        glosses = [self.gloss_lobe(si, *gloss, order) for gloss in self.glosses(here)]
        albedo, aside, along = rough_lobe(si.wi.z, here.diffuse_roughness)
        mean = mi.Vector3f(aside * si.wi.x, aside * si.wi.y, along)
        matte = [diffuse * albedo * factor for factor in cosine_factors(order)]
        matte[1] = diffuse * dr.pi * dr.norm(mean)
        return [(si.to_world(dr.normalize(mean)), matte), *glosses]

    def gloss_lobe(self, si, strength, more, r, order):
        """Compute a specular lobe as the method `lobes` returns it. `strength`, `more`, `r`: of `glosses`."""
        across = [(r - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS), dr.maximum(si.wi.z, MIN_COSINE)]
        at = mi.Point2f(*(x * (1 - 1 / GLOSS_NODES) + 0.5 / GLOSS_NODES for x in across))
        tilt, height, *factors = gloss_table(mi.variant(), self.distribution, order).eval(at)
        toward = dr.normalize(mi.Vector3f(-tilt * si.wi.x, -tilt * si.wi.y, height))
        specular = self.with_fresnel(strength, more, dr.dot(si.wi, dr.normalize(si.wi + toward)))
        return si.to_world(toward), [specular * factor for factor in factors]

    def reflected_lobe(self, si, direction, sharpness, active=True):
        """Compute the radiance that the surface reflects to the viewer by a lobe of light of unit flux.

        The light is a von Mises–Fisher distribution about the unit vector `direction` (in the world), of this
        `sharpness`. The diffuse part is exact for a diffuse roughness of 0. The specular parts are those of a
        directional light on a rougher surface. All are exact for sharp lobes. Attached to all arguments.
        """
        here, wo = self.parameters(si, active), si.to_local(direction)
        active &= self.front(si, mi.Vector3f(0, 0, 1))
        i, o = (mi.Vector3f(v.x, v.y, dr.maximum(v.z, MIN_COSINE)) for v in (wo, si.wi))
        matte = here.diffuse * roughened(i, o, here.diffuse_roughness) * softened_cosine(wo.z, sharpness)
        cosine = dr.dot(si.wi, dr.normalize(wo + si.wi))
        wide = {"roughness": widened_roughness(here.roughness, sharpness, cosine, self.distribution)}
        if here.coat is not None:
            wide["coat_roughness"] = widened_roughness(here.coat_roughness, sharpness, cosine, self.distribution)
        gloss = self.reflected(gloss_alone(), si, wo, here._replace(**wide), active)
        return dr.select(active, dr.maximum(matte, 0), 0) + gloss

    def gloss_probabilities(self, ctx, si, here):
        """Compute the probabilities with which `sample` chooses the specular lobes, as a list of one or two arrays.

        Without a coat it is 4 ρᵞ / (π ρᵈ + 4 ρᵞ): π ρᵈ and 4 ρᵞ are upper bounds of the albedos of both lobes. A coat
        adds 4 ρᶜ. `here`: the parameters at `si`. `ctx`: Mitsuba's BSDFContext; if it switches the diffuse or the
        specular part off, the sum is 1 or 0. The result has no gradients.
        """
        has_diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        has_gloss = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        d = dr.detach(dr.pi * dr.mean(mi.unpolarized_spectrum(here.diffuse)))
        bounds = [dr.detach(4 * self.with_fresnel(strength, more, si.wi.z)) for strength, more, _ in self.glosses(here)]
        s = sum(bounds[1:], bounds[0])
        both = dr.select(d + s > 0, s / (d + s), 0.5)
        if not (has_diffuse and has_gloss):
            both = mi.Float(1.0 if has_gloss else 0.0)
        if len(bounds) == 1:
            return [both]
        coat = both * dr.select(s > 0, bounds[1] / s, 0.5)
        return [both - coat, coat]

    def density(self, si, wo, here, probabilities, active):
        """Compute the probability density [1/sr] with which `sample` draws the direction `wo` (local frame of `si`).

        `here`: the parameters at `si`. `probabilities`: those with which the specular lobes are chosen.
        """
        h = dr.normalize(wo + si.wi)
        pdf = (1 - sum(probabilities[1:], probabilities[0])) * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        for probability, (*_, r) in zip(probabilities, self.glosses(here)):
            facets = microfacets(self.distribution, r)
            # The density of visible normals is D G₁ (o·h) / (n·o), the Jacobian of the reflection 1 / (4 (o·h)).
            pdf += probability * (facets.eval(h) * facets.smith_g1(si.wi, h) / (4 * si.wi.z))
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), pdf, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.reflected(ctx, si, wo, self.parameters(si, active), active)

    def eval_diffuse_reflectance(self, si, active=True):
        """Compute the mean albedo of the diffuse part, without highlights, as the `aov` integrator shows it."""
        here = self.parameters(si, active)
        return dr.select(active, dr.pi * here.diffuse * mean_albedo(here.diffuse_roughness), 0)

    def pdf(self, ctx, si, wo, active=True):
        here = self.parameters(si, active)
        return self.density(si, wo, here, self.gloss_probabilities(ctx, si, here), active)

    def eval_pdf(self, ctx, si, wo, active=True):
        here = self.parameters(si, active)
        value = self.reflected(ctx, si, wo, here, active)
        return value, self.density(si, wo, here, self.gloss_probabilities(ctx, si, here), active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        here = self.parameters(si, active)
        probabilities = self.gloss_probabilities(ctx, si, here)
        chosen, r = sample1 < sum(probabilities[1:], probabilities[0]), here.roughness
        if here.coat is not None:
            r = dr.select(sample1 < probabilities[0], r, here.coat_roughness)
        normal, _ = microfacets(self.distribution, r).sample(si.wi, sample2)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(chosen, mi.reflect(si.wi, normal), mi.warp.square_to_cosine_hemisphere(sample2))
        bs.pdf = self.density(si, bs.wo, here, probabilities, active)
        bs.eta = 1.0
        bs.sampled_component = dr.select(chosen, mi.UInt32(1), mi.UInt32(0))
        bs.sampled_type = dr.select(
            chosen, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        active &= bs.pdf > 0
        value = self.reflected(ctx, si, bs.wo, here, active)
        return bs, value / dr.select(active, bs.pdf, 1)

    def traverse(self, callback):
        for name, texture in self.textures.items():
            callback.put(name, texture, mi.ParamFlags.Differentiable)

    def to_string(self):
        inner = ", ".join(f"{name}={texture}" for name, texture in self.textures.items())
        return f"CookTorrance[distribution={self.distribution}, {inner}]"


def gloss_alone():
    """Make a context in which a BSDF has its specular part only."""
    context = mi.BSDFContext()
    context.component = 1
    return context


mi.register_bsdf("cooktorrance", CookTorrance)
