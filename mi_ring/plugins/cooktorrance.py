"""The `cooktorrance` BSDF: equation 1 of the paper (Mitsuba plugin)."""

from typing import Any, ClassVar, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.bsdf_lobes import (
    DARKER,
    DISTRIBUTIONS,
    GLOSS_NODES,
    MIN_ROUGHNESS,
    cosine_factors,
    gloss_table,
    rough_lobe,
    softened_cosine,
    widened_roughness,
)
from mi_ring.rendering.direct_light import MIN_COSINE

ROUGHNESS = "vertex_diffuse_roughness"


class Parameters(NamedTuple):
    """The parameters at surface interactions, each a Dr.Jit array."""

    diffuse: Any
    specular: Any
    roughness: Any
    diffuse_roughness: Any


class CookTorrance(mi.BSDF):
    """The paper's reflectance, equation 1: B = ρᵈ + ρᵞ · D(n, h; r) · G(i, o; r) / (π (n·i)(n·o)).

    ===================== ================= ================================================================= =====
    Parameter             Type              Description                                                       Flags
    ===================== ================= ================================================================= =====
    ``diffuse``           rgb or texture    ρᵈ; the diffuse term has no 1/π. Default: the mesh attribute      P, ∂
                                            ``vertex_diffuse``
    ``specular``          float or texture  ρᵞ; it contains the Fresnel factor, which is constant. Default:   P, ∂
                                            the mesh attribute ``vertex_specular``
    ``roughness``         float or texture  r, the width α of the distribution, at least 0.02. Default: the   P, ∂
                                            mesh attribute ``vertex_roughness``
    ``diffuse_roughness`` float or texture  σ of the diffuse term, 0 to 1. Default: the mesh attribute        P, ∂
                                            ``vertex_diffuse_roughness``; 0, as in the paper, if there is
                                            none
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

    **Energy.** Substitute di = 4 (o·h) dh in the specular part of the albedo, then G ≤ G₁(o) = n·o / ∫ D/π ⟨o, h⟩ dh::

        ∫ B (n·i) di = π ρᵈ + 4 ρᵞ ∫ D/π · G · (o·h) / (n·o) dh  ≤  π ρᵈ + 4 ρᵞ   for every o,

    and narrow lobes reach this bound without ``fresnel``. A surface with π ρᵈ + 4 ρᵞ ≤ 1 in each channel conserves
    energy. Nothing enforces this: ρ also contains the scale of lamp and camera.

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

    #: number of channels of each parameter
    channels: ClassVar = {"diffuse": 3, "specular": 1, "roughness": 1, "diffuse_roughness": 1}
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
        self.textures = {}
        for name in self.channels:
            if name not in props:
                props[name] = mi.load_dict({"type": "mesh_attribute", "name": f"vertex_{name}"})
            self.textures[name] = props.get_unbounded_texture(name)
        side = mi.BSDFFlags.FrontSide
        self.m_components = [mi.BSDFFlags.DiffuseReflection | side, mi.BSDFFlags.GlossyReflection | side]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def parameters(self, si, active=True):
        """Evaluate the parameters at the surface interactions `si`. The roughness r is at least 0.02."""
        diffuse, *others = self.textures.values()
        if dr.is_array_v(mi.Float) or not self.reads_optional or si.shape.has_attribute(ROUGHNESS):
            specular, r, sigma = (texture.eval_1(si, active) for texture in others)
        else:  # scalar variants raise an error if the mesh has no such attribute
            specular, r, sigma = *(texture.eval_1(si, active) for texture in others[:2]), 0.0
        return Parameters(diffuse.eval(si, active), specular, dr.maximum(r, MIN_ROUGHNESS), sigma)

    @staticmethod
    def front(si, wo):
        """Return a Dr.Jit mask: True where viewer and light are on the front side of the surface.

        `wo`: direction to the light in the local frame of `si`. It must be on the front side of the shading normal. For
        the viewer, the front side of either the shading normal or the geometric normal is enough.
        """
        n = si.to_local(si.n)
        return ((si.wi.z > 0) | (dr.dot(si.wi, n) > 0)) & (wo.z > 0)

    def microfacets(self, r):
        """Make Mitsuba's microfacet distribution for roughness `r`. Its `eval` is D / π, its `G` is G."""
        return mi.MicrofacetDistribution(DISTRIBUTIONS[self.distribution], r, True)

    def with_fresnel(self, specular, cosine):
        """Return the specular reflectance at an angle between viewer and half vector. `cosine`: of this angle, o·h.

        `specular`: ρᵞ, the reflectance at o = h. Without the parameter ``fresnel``, it is returned unchanged.
        """
        if not self.fresnel:
            return specular
        return specular + dr.maximum(0.25 - specular, 0) * dr.power(1 - dr.clip(cosine, 0, 1), 5)

    def reflected(self, ctx, si, wo, here, active):
        """Evaluate B (n·i) [1/sr], equation 1 times the cosine, for light from direction `wo` (local frame of `si`).

        `here`: the parameters at `si`. `ctx`: Mitsuba's BSDFContext; it can switch off the diffuse or the specular
        part. The result is 0 where `active` is False, and for light or viewer behind the surface.
        """
        o, i = (mi.Vector3f(v.x, v.y, dr.maximum(v.z, MIN_COSINE)) for v in (si.wi, wo))
        h = dr.normalize(wo + si.wi)
        h.z = dr.abs(h.z)  # at the contour h may be below the surface, where Mitsuba's D is 0
        facets, specular = self.microfacets(here.roughness), self.with_fresnel(here.specular, dr.dot(si.wi, h))
        # G with m = n: G only uses the side of m, and `front` tests the side.
        gloss = specular * facets.eval(h) * facets.G(i, o, mi.Normal3f(0, 0, 1)) / (i.z * o.z)
        matte = here.diffuse * roughened(i, o, here.diffuse_roughness)
        value = matte * ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        value += gloss * ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        return dr.select(active & self.front(si, wo), value * i.z, 0)

    def lobes(self, si, order, active=True):
        """Compute how the surface reflects light that is given by spherical harmonics. Returns two lobes.

        The first lobe is diffuse, the second specular. A lobe is a pair (axis, factors). The axis is a unit vector in
        the world, about which the lobe is symmetric. Factor l of the `order` + 1 factors multiplies the light's
        harmonics of degree l, evaluated at the axis; the sum over l is the reflected radiance. The diffuse lobe is that
        of "An Efficient Representation for Irradiance Environment Maps" (Ramamoorthi and Hanrahan 2001). With a
        ``diffuse_roughness`` it is exact up to degree 1. The specular lobe is an approximation, tabulated over
        roughness and viewing angle.
        """
        diffuse, specular, r, sigma = self.parameters(si, active)
        active &= self.front(si, mi.Vector3f(0, 0, 1))
        diffuse, specular = dr.select(active, diffuse, 0), dr.select(active, specular, 0)
        across = [(r - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS), dr.maximum(si.wi.z, MIN_COSINE)]
        at = mi.Point2f(*(x * (1 - 1 / GLOSS_NODES) + 0.5 / GLOSS_NODES for x in across))
        tilt, height, *factors = gloss_table(mi.variant(), self.distribution, order).eval(at)
        toward = dr.normalize(mi.Vector3f(-tilt * si.wi.x, -tilt * si.wi.y, height))
        specular = self.with_fresnel(specular, dr.dot(si.wi, dr.normalize(si.wi + toward)))
        albedo, aside, along = rough_lobe(si.wi.z, sigma)
        mean = mi.Vector3f(aside * si.wi.x, aside * si.wi.y, along)
        matte = [diffuse * albedo * factor for factor in cosine_factors(order)]
        matte[1] = diffuse * dr.pi * dr.norm(mean)
        return [
            (si.to_world(dr.normalize(mean)), matte),
            (si.to_world(toward), [specular * factor for factor in factors]),
        ]

    def reflected_lobe(self, si, direction, sharpness, active=True):
        """Compute the radiance that the surface reflects to the viewer by a lobe of light of unit flux.

        The light is a von Mises–Fisher distribution about the unit vector `direction` (in the world), of this
        `sharpness`. The diffuse part is exact for a diffuse roughness of 0. The specular part is that of a directional
        light on a rougher surface. Both are exact for sharp lobes. Attached to all arguments.
        """
        here, wo = self.parameters(si, active), si.to_local(direction)
        active &= self.front(si, mi.Vector3f(0, 0, 1))
        i, o = (mi.Vector3f(v.x, v.y, dr.maximum(v.z, MIN_COSINE)) for v in (wo, si.wi))
        matte = here.diffuse * roughened(i, o, here.diffuse_roughness) * softened_cosine(wo.z, sharpness)
        h = dr.normalize(wo + si.wi)
        wide = widened_roughness(here.roughness, sharpness, dr.dot(si.wi, h), self.distribution)
        gloss = self.reflected(gloss_alone(), si, wo, here._replace(roughness=wide), active)
        return dr.select(active, dr.maximum(matte, 0), 0) + gloss

    def gloss_probability(self, ctx, si, here):
        """Compute the probability with which `sample` chooses the specular lobe: 4 ρᵞ / (π ρᵈ + 4 ρᵞ).

        π ρᵈ and 4 ρᵞ are upper bounds of the albedos of both lobes. `here`: the parameters at `si`. `ctx`: Mitsuba's
        BSDFContext; if it switches one lobe off, the result is 0 or 1. The result has no gradients.
        """
        has_diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        has_gloss = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        if not (has_diffuse and has_gloss):
            return mi.Float(1.0 if has_gloss else 0.0)
        d, s = (
            dr.detach(dr.pi * dr.mean(mi.unpolarized_spectrum(here.diffuse))),
            dr.detach(4 * self.with_fresnel(here.specular, si.wi.z)),
        )
        return dr.select(d + s > 0, s / (d + s), 0.5)

    def density(self, si, wo, r, gloss, active):
        """Compute the probability density [1/sr] with which `sample` draws the direction `wo` (local frame of `si`).

        `r`: roughness. `gloss`: probability with which the specular lobe is chosen, 0 to 1.
        """
        facets = self.microfacets(r)
        h = dr.normalize(wo + si.wi)
        # The density of visible normals is D G₁ (o·h) / (n·o), the Jacobian of the reflection 1 / (4 (o·h)).
        reflected = facets.eval(h) * facets.smith_g1(si.wi, h) / (4 * si.wi.z)
        pdf = (1 - gloss) * mi.warp.square_to_cosine_hemisphere_pdf(wo) + gloss * reflected
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), pdf, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.reflected(ctx, si, wo, self.parameters(si, active), active)

    def pdf(self, ctx, si, wo, active=True):
        here = self.parameters(si, active)
        return self.density(si, wo, here.roughness, self.gloss_probability(ctx, si, here), active)

    def eval_pdf(self, ctx, si, wo, active=True):
        here = self.parameters(si, active)
        value = self.reflected(ctx, si, wo, here, active)
        return value, self.density(si, wo, here.roughness, self.gloss_probability(ctx, si, here), active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        here = self.parameters(si, active)
        gloss = self.gloss_probability(ctx, si, here)
        chosen = sample1 < gloss
        normal, _ = self.microfacets(here.roughness).sample(si.wi, sample2)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(chosen, mi.reflect(si.wi, normal), mi.warp.square_to_cosine_hemisphere(sample2))
        bs.pdf = self.density(si, bs.wo, here.roughness, gloss, active)
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


def roughened(i, o, sigma):
    """Compute the factor of the diffuse reflectance by its roughness `sigma`, for light from `i`, seen from `o`."""
    beside = dr.dot(i, o) - i.z * o.z
    back = beside / dr.select(beside > 0, dr.maximum(i.z, o.z), 1)
    return (1 + sigma * back) / (1 + DARKER * sigma)


def gloss_alone():
    """Make a context in which a BSDF has its specular part only."""
    context = mi.BSDFContext()
    context.component = 1
    return context


mi.register_bsdf("cooktorrance", CookTorrance)
