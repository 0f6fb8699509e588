"""The `cooktorrance` BSDF: equation 1 of the paper (Mitsuba plugin)."""

import functools
import math
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import MIN_COSINE

MIN_ROUGHNESS = 0.02  #: below it the highlight is narrower than float32 can integrate
DISTRIBUTIONS = {"ggx": mi.MicrofacetType.GGX, "beckmann": mi.MicrofacetType.Beckmann}
NODES, SIDE = 32, 32  #: of the table of gloss, in each direction; its samples in each


class CookTorrance(mi.BSDF):
    """The paper's reflectance, equation 1: B = ρᵈ + ρᵞ · D(n, h; r) · G(i, o; r) / (π (n·i)(n·o)).

    ================ ================= ================================================================= =====
    Parameter        Type              Description                                                       Flags
    ================ ================= ================================================================= =====
    ``diffuse``      rgb or texture    ρᵈ; the diffuse term has no 1/π. Default: the mesh attribute      P, ∂
                                       ``vertex_diffuse``
    ``specular``     float or texture  ρᵞ; Fresnel is constant and folded in. Default: the mesh          P, ∂
                                       attribute ``vertex_specular``
    ``roughness``    float or texture  r, the width α of the distribution itself, 0.02 at the least.     P, ∂
                                       Default: the mesh attribute ``vertex_roughness``
    ``distribution`` string            D and the G that belongs to it: ``ggx`` or ``beckmann``.
                                       Default: ``ggx``
    ``fresnel``      boolean           is more reflected at grazing angles? Default: false, the paper's
    ================ ================= ================================================================= =====

    The paper does not name D and G. Here they are those of Walter et al. 2007 (Microfacet Models for Refraction through
    Rough Surfaces): D is equation 33 (GGX) or 25 (Beckmann) without its 1/π, G Smith's product of equations 34 or 27,
    the latter Walter's rational fit to within 0.35 %. So the specular part is 4 ρᵞ times ``roughconductor`` with F = 1.

    With ``fresnel`` ρᵞ rises to 1/4, as of a mirror, with the angle between o and h, by "An Inexpensive BRDF Model for
    Physically-based Rendering" (Schlick 1994): F = F₀ + (1 − F₀) (1 − o·h)⁵ of F₀ = 4 ρᵞ, which must be the true one.
    A light next to the camera does not see it; light from a table does.

    **Energy.** Substitute di = 4 (o·h) dh in the specular part of the albedo, then G ≤ G₁(o) = n·o / ∫ D/π ⟨o, h⟩ dh::

        ∫ B (n·i) di = π ρᵈ + 4 ρᵞ ∫ D/π · G · (o·h) / (n·o) dh  ≤  π ρᵈ + 4 ρᵞ   for every o,

    and narrow lobes reach it, without ``fresnel``. A surface with π ρᵈ + 4 ρᵞ ≤ 1 in each channel thus conserves
    energy. Nothing enforces that: ρ also holds the scale of lamp and camera.

    With interpolated normals a strip about 0.01 px wide at the contour has n·o < 0 on a face that faces the viewer.
    Black there would be a discontinuity that corrupts gradients at the outline; the strip is lit instead, with n·o
    clamped. What it does not do: transmission, two-sided surfaces, anisotropy, light between microfacets.

    Raises ValueError if ``distribution`` is neither of the two.

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

    channels: ClassVar = {"diffuse": 3, "specular": 1, "roughness": 1}  #: of each parameter

    def __init__(self, props):
        super().__init__(props)
        self.distribution = props.get("distribution", "ggx")
        if self.distribution not in DISTRIBUTIONS:
            allowed = " or ".join(f'"{name}"' for name in DISTRIBUTIONS)
            raise ValueError(f'cooktorrance "{props.id()}": distribution is "{self.distribution}", must be {allowed}')
        self.fresnel = props.get("fresnel", False)
        if not isinstance(self.fresnel, bool):
            raise ValueError(f'cooktorrance "{props.id()}": fresnel is {self.fresnel}, must be true or false')
        self.textures = {}
        for name in self.channels:
            if name not in props:
                props[name] = mi.load_dict({"type": "mesh_attribute", "name": f"vertex_{name}"})
            self.textures[name] = props.get_unbounded_texture(name)
        side = mi.BSDFFlags.FrontSide
        self.m_components = [mi.BSDFFlags.DiffuseReflection | side, mi.BSDFFlags.GlossyReflection | side]
        self.m_flags = self.m_components[0] | self.m_components[1]

    def parameters(self, si, active=True):
        """(ρᵈ, ρᵞ, r) at a surface interaction."""
        diffuse = self.textures["diffuse"].eval(si, active)
        specular = self.textures["specular"].eval_1(si, active)
        return diffuse, specular, dr.maximum(self.textures["roughness"].eval_1(si, active), MIN_ROUGHNESS)

    @staticmethod
    def front(si, wo):
        """Do the viewer and `wo` see the front? By the shading or by the geometric normal."""
        n = si.to_local(si.n)
        return ((si.wi.z > 0) | (dr.dot(si.wi, n) > 0)) & (wo.z > 0)

    def lobe(self, r):
        """D / π, G and the visible normals of a roughness, by Mitsuba."""
        return mi.MicrofacetDistribution(DISTRIBUTIONS[self.distribution], r, True)

    def at(self, specular, cosine):
        """ρᵞ where o·h is a `cosine`."""
        if not self.fresnel:
            return specular
        return specular + dr.maximum(0.25 - specular, 0) * dr.power(1 - dr.clip(cosine, 0, 1), 5)

    def reflected(self, ctx, si, wo, diffuse, specular, r, active):
        """B (n·i) of equation 1 [1/sr]."""
        o, i = (mi.Vector3f(v.x, v.y, dr.maximum(v.z, MIN_COSINE)) for v in (si.wi, wo))
        h = dr.normalize(wo + si.wi)
        h.z = dr.abs(h.z)  # at the rim h may lie below; Mitsuba's D would jump to 0 there
        lobe, specular = self.lobe(r), self.at(specular, dr.dot(si.wi, h))
        # G for m = n: it asks nothing of m but the side, which is for `front` to say.
        gloss = specular * lobe.eval(h) * lobe.G(i, o, mi.Normal3f(0, 0, 1)) / (i.z * o.z)
        value = diffuse * ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        value += gloss * ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        return dr.select(active & self.front(si, wo), value * i.z, 0)

    def lobes(self, si, order, active=True):
        """What is reflected of light that varies slowly: of each lobe its direction in the world, and by how much each
        degree of spherical harmonics about that is, a list of `order` + 1.

        The diffuse lobe by "An Efficient Representation for Irradiance Environment Maps" (Ramamoorthi and Hanrahan
        2001). That of gloss is taken to be round about its mean direction; how wide it is says a table.
        """
        diffuse, specular, r = self.parameters(si, active)
        active &= self.front(si, mi.Vector3f(0, 0, 1))
        diffuse, specular = dr.select(active, diffuse, 0), dr.select(active, specular, 0)
        across = [(r - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS), dr.maximum(si.wi.z, MIN_COSINE)]
        at = mi.Point2f(*(x * (1 - 1 / NODES) + 0.5 / NODES for x in across))
        tilt, height, *shares = gloss_table(mi.variant(), self.distribution, order).eval(at)
        toward = dr.normalize(mi.Vector3f(-tilt * si.wi.x, -tilt * si.wi.y, height))
        specular = self.at(specular, dr.dot(si.wi, dr.normalize(si.wi + toward)))
        return [
            (si.sh_frame.n, [diffuse * share for share in cosine_shares(order)]),
            (si.to_world(toward), [specular * share for share in shares]),
        ]

    def gloss_probability(self, ctx, si, diffuse, specular):
        """Probability of sampling the specular lobe, in proportion to the bounds of the two albedos, π ρᵈ and 4 ρᵞ.

        Detached: the choice of a lobe does not move with the parameters, so that its probability must not either.
        """
        has_diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        has_gloss = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        if not (has_diffuse and has_gloss):
            return mi.Float(1.0 if has_gloss else 0.0)
        d, s = dr.detach(dr.pi * dr.mean(mi.unpolarized_spectrum(diffuse))), dr.detach(4 * self.at(specular, si.wi.z))
        return dr.select(d + s > 0, s / (d + s), 0.5)

    def density(self, si, wo, r, gloss, active):
        """Density [1/sr] of the mixture of the cosine and the visible-normal lobe, as `sample` draws it."""
        lobe = self.lobe(r)
        h = dr.normalize(wo + si.wi)
        # The density of visible normals is D G₁ (o·h) / (n·o), the Jacobian of the reflection 1 / (4 (o·h)).
        reflected = lobe.eval(h) * lobe.smith_g1(si.wi, h) / (4 * si.wi.z)
        pdf = (1 - gloss) * mi.warp.square_to_cosine_hemisphere_pdf(wo) + gloss * reflected
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), pdf, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.reflected(ctx, si, wo, *self.parameters(si, active), active)

    def pdf(self, ctx, si, wo, active=True):
        diffuse, specular, r = self.parameters(si, active)
        return self.density(si, wo, r, self.gloss_probability(ctx, si, diffuse, specular), active)

    def eval_pdf(self, ctx, si, wo, active=True):
        diffuse, specular, r = self.parameters(si, active)
        value = self.reflected(ctx, si, wo, diffuse, specular, r, active)
        return value, self.density(si, wo, r, self.gloss_probability(ctx, si, diffuse, specular), active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        diffuse, specular, r = self.parameters(si, active)
        gloss = self.gloss_probability(ctx, si, diffuse, specular)
        chosen = sample1 < gloss
        normal, _ = self.lobe(r).sample(si.wi, sample2)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(chosen, mi.reflect(si.wi, normal), mi.warp.square_to_cosine_hemisphere(sample2))
        bs.pdf = self.density(si, bs.wo, r, gloss, active)
        bs.eta = 1.0
        bs.sampled_component = dr.select(chosen, mi.UInt32(1), mi.UInt32(0))
        bs.sampled_type = dr.select(
            chosen, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        active &= bs.pdf > 0
        value = self.reflected(ctx, si, bs.wo, diffuse, specular, r, active)
        return bs, value / dr.select(active, bs.pdf, 1)

    def traverse(self, callback):
        for name, texture in self.textures.items():
            callback.put(name, texture, mi.ParamFlags.Differentiable)

    def to_string(self):
        inner = ", ".join(f"{name}={texture}" for name, texture in self.textures.items())
        return f"CookTorrance[distribution={self.distribution}, {inner}]"


def cosine_shares(order):
    """By how much a surface of B = 1 reflects each degree of spherical harmonics, up to `order`."""
    shares = [math.pi, 2 * math.pi / 3]
    for degree in range(2, order + 1):
        half = degree // 2
        central = math.comb(degree, half) / 2**degree
        sign = (-1) ** (half - 1)
        shares.append(0.0 if degree % 2 else 2 * math.pi * sign / ((degree + 2) * (degree - 1)) * central)
    return shares[: order + 1]


@functools.lru_cache(maxsize=8)
def gloss_table(variant, distribution, order):
    """The lobe of gloss for ρᵞ = 1, as a texture over (roughness, n·o) from (0.02, 0) to (1, 1).

    Its channels: how much its mean direction leans away from the viewer, by how much the viewer leans, and how high it
    is; and for each degree the lobe's integral with that degree's Legendre polynomial about this direction. By the
    visible normals of `CookTorrance.sample`, a grid of them.
    """
    with dr.suspend_grad():
        count = SIDE**2
        lane = dr.arange(mi.UInt32, NODES**2 * count)
        node, sample = lane // count, lane % count
        r = MIN_ROUGHNESS + mi.Float(node % NODES) / (NODES - 1) * (1 - MIN_ROUGHNESS)
        cosine = dr.clip(mi.Float(node // NODES) / (NODES - 1), MIN_COSINE, 1 - 1e-4)
        o = mi.Vector3f(dr.sqrt(1 - cosine**2), 0, cosine)
        lobe = mi.MicrofacetDistribution(DISTRIBUTIONS[distribution], r, True)
        h, _ = lobe.sample(o, mi.Point2f((sample % SIDE + 0.5) / SIDE, (sample // SIDE + 0.5) / SIDE))
        i = mi.reflect(o, h)
        weight = dr.select(i.z > 0, 4 * lobe.G(i, o, mi.Normal3f(0, 0, 1)) / lobe.smith_g1(o, h), 0)
        mean = [dr.block_sum(weight * part, count) for part in (i.x, i.z)]
        length = dr.rsqrt(mean[0] ** 2 + mean[1] ** 2)
        x, z = mean[0] * length, mean[1] * length
        toward = mi.Vector3f(dr.gather(mi.Float, x, node), 0, dr.gather(mi.Float, z, node))
        away = dr.gather(mi.Float, o.x, dr.arange(mi.UInt32, NODES**2) * count)
        polynomials = legendre(dr.dot(i, toward), order)
        channels = [-x / away, z, *(dr.block_sum(weight * p, count) / count for p in polynomials)]
        table = dr.zeros(mi.Float, NODES**2 * len(channels))
        for k, channel in enumerate(channels):
            dr.scatter(table, channel, dr.arange(mi.UInt32, NODES**2) * len(channels) + k)
        return mi.Texture2f(
            mi.TensorXf(table, (NODES, NODES, len(channels))), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )


def legendre(x, order):
    """Legendre's polynomials up to a degree, by Bonnet's recursion."""
    found = [mi.Float(1), x]
    for n in range(1, order):
        found.append(((2 * n + 1) * x * found[n] - n * found[n - 1]) / (n + 1))
    return found[: order + 1]


mi.register_bsdf("cooktorrance", CookTorrance)
