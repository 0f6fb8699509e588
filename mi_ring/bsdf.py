"""The `cooktorrance` BSDF: equation 1 of the paper (Mitsuba plugin)."""

import re

import drjit as dr
import mitsuba as mi

#: The mesh attributes that carry BRDF-Net's output, and their channels.
ATTRIBUTES = {"vertex_diffuse": 3, "vertex_specular": 1, "vertex_roughness": 1}

MIN_COSINE = 1e-3  #: grazing cosines are clamped here: see `CookTorrance`
MIN_ROUGHNESS = 0.02  #: below it the highlight is narrower than float32 can integrate


def ggx(cos_h, r):
    """D(n, h; r) of equation 1: GGX without its 1/π, which the equation carries outside."""
    r2 = r * r
    return r2 / dr.square(dr.square(cos_h) * (r2 - 1) + 1)


def smith(cos_i, cos_o, r):
    """Smith's separable masking G(i, o; r) for GGX."""
    r2 = r * r

    def g1(c):
        return 2 * c / (c + dr.sqrt(r2 + (1 - r2) * c * c))

    return g1(cos_i) * g1(cos_o)


class CookTorrance(mi.BSDF):
    """The paper's reflectance, equation 1: B = ρᵈ + ρᵞ · D(n, h; r) · G / (π (n·i)(n·o)).

    ============= =================== ===========================================================================
    parameter     type                meaning
    ============= =================== ===========================================================================
    ``diffuse``   texture (rgb)       ρᵈ; the diffuse term has no 1/π. Default: mesh attribute ``vertex_diffuse``
    ``specular``  texture (1 channel) ρᵞ; Fresnel is constant and folded in. Default: ``vertex_specular``
    ``roughness`` texture (1 channel) r, the GGX width α itself. Default: ``vertex_roughness``
    ============= =================== ===========================================================================

    D is GGX without its 1/π and G is Smith's, so that the specular part is 4 ρᵞ times ``roughconductor`` with F = 1.
    Nothing keeps ρᵈ and ρᵞ below the conservation of energy: they also hold the scale of lamp and camera.

    With interpolated normals a strip about 0.01 px wide at the contour has n·o < 0 on a face that faces the viewer.
    Black there would be a discontinuity that corrupts gradients at the outline; the strip is lit instead, with n·o
    clamped. What it does not do: transmission, two-sided surfaces, anisotropy.

    .. code-block:: xml

        <bsdf type="cooktorrance"><rgb name="diffuse" value="0.2, 0.1, 0.1"/>
          <float name="specular" value="0.05"/><float name="roughness" value="0.3"/></bsdf>
    """

    def __init__(self, props):
        super().__init__(props)
        self.textures = {}
        for attribute in ATTRIBUTES:
            name = attribute.removeprefix("vertex_")
            if name not in props:
                props[name] = mi.load_dict({"type": "mesh_attribute", "name": attribute})
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

    def eval(self, ctx, si, wo, active=True):
        diffuse, specular, r = self.parameters(si, active)
        cos_i, cos_o = dr.maximum(wo.z, MIN_COSINE), dr.maximum(si.wi.z, MIN_COSINE)
        h = dr.normalize(wo + si.wi)
        gloss = specular * ggx(h.z, r) * smith(cos_i, cos_o, r) / (dr.pi * cos_i * cos_o)
        value = diffuse * ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        value += gloss * ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        return dr.select(active & self.front(si, wo), value * cos_i, 0)

    def gloss_probability(self, ctx, diffuse, specular):
        """Probability of sampling the specular lobe, in proportion to the two albedos (π ρᵈ and about 4 ρᵞ)."""
        has_diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 0)
        has_gloss = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 1)
        if not (has_diffuse and has_gloss):
            return mi.Float(1.0 if has_gloss else 0.0)
        d, s = dr.pi * dr.mean(mi.unpolarized_spectrum(diffuse)), 4 * specular
        return dr.select(d + s > 0, s / (d + s), 0.5)

    def lobes_pdf(self, si, wo, r, gloss):
        """Density [1/sr] of the mixture of the cosine and the visible-normal lobe, as `sample` draws it."""
        h = dr.normalize(wo + si.wi)
        lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, r, True)
        reflected = lobe.pdf(si.wi, h) / (4 * dr.maximum(dr.dot(wo, h), 1e-7))
        return (1 - gloss) * mi.warp.square_to_cosine_hemisphere_pdf(wo) + gloss * reflected

    def pdf(self, ctx, si, wo, active=True):
        diffuse, specular, r = self.parameters(si, active)
        pdf = self.lobes_pdf(si, wo, r, self.gloss_probability(ctx, diffuse, specular))
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), pdf, 0)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        diffuse, specular, r = self.parameters(si, active)
        gloss = self.gloss_probability(ctx, diffuse, specular)
        chosen = sample1 < gloss
        normal, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, r, True).sample(si.wi, sample2)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(chosen, mi.reflect(si.wi, normal), mi.warp.square_to_cosine_hemisphere(sample2))
        bs.pdf = self.lobes_pdf(si, bs.wo, r, gloss)
        bs.eta = 1.0
        bs.sampled_component = dr.select(chosen, mi.UInt32(1), mi.UInt32(0))
        bs.sampled_type = dr.select(
            chosen, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        )
        active &= (si.wi.z > 0) & (bs.wo.z > 0) & (bs.pdf > 0)
        weight = self.eval(ctx, si, bs.wo, active) / dr.select(active, bs.pdf, 1)
        bs.pdf = dr.select(active, bs.pdf, 0)
        return bs, weight

    def traverse(self, callback):
        for name, texture in self.textures.items():
            callback.put(name, texture, mi.ParamFlags.Differentiable)

    def to_string(self):
        inner = ", ".join(f"{name}={texture}" for name, texture in self.textures.items())
        return f"CookTorrance[{inner}]"


def check_attributes(shape):
    """Raise ValueError if a BSDF asks `shape` for a mesh attribute that it lacks or has with other channels.

    Mitsuba renders such a surface black without a word. Attributes work with 1 or 3 channels only.
    """
    bsdf = shape.bsdf()
    asked = re.findall(r'MeshAttribute\[\s*name = "([^"]+)"', str(bsdf))
    for name in asked:
        if not shape.is_mesh() or not shape.has_attribute(name):
            raise ValueError(
                f'shape "{shape.id()}": its BSDF reads the mesh attribute "{name}", which the shape does not have'
            )
    if not isinstance(bsdf, CookTorrance):
        return
    for name, texture in bsdf.textures.items():
        attribute = re.match(r'MeshAttribute\[\s*name = "([^"]+)"', str(texture))
        if attribute:
            count = shape.face_count() if attribute[1].startswith("face_") else shape.vertex_count()
            found = dr.width(mi.traverse(shape)[attribute[1]]) // count
            expected = ATTRIBUTES[f"vertex_{name}"]
            if found != expected:
                raise ValueError(
                    f'shape "{shape.id()}": {name} of its BSDF needs a mesh attribute of {expected} channel(s), '
                    f'"{attribute[1]}" has {found}'
                )


mi.register_bsdf("cooktorrance", CookTorrance)
