"""The `merl` BSDF: measured materials (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.plugins.properties import beside_scene
from mi_ring.rendering.measured_brdf import MerlNetwork, MerlTable

HALF_NODES = 180  #: nodes of the density of half vectors, evenly spaced in the square root of θh
SAMPLED_THETA_D = np.radians(30)  #: θd of this density
MIN_ROOT = 1e-3  #: the least square root of θh / 90° in this density, and of sin θh; smaller ones are clamped


class Merl(mi.BSDF):
    """A measured, isotropic material: a table of the MERL database, or a network that was fitted to such a table.

    ============ ========= =====================================================================
    Parameter    Type      Description
    ============ ========= =====================================================================
    ``filename`` string    a ``.binary`` of the MERL database, or an ``.npz`` of networks
    ``material`` string    name of the network to use; not with a table
    ============ ========= =====================================================================

    The angles are θh and θd of Rusinkiewicz 1998 (A New Change of Variables for Efficient BRDF Representation).

    A table is interpolated between its cells. It is reciprocal. A cell that was not measured gets the value of the
    cells around it. If these were not measured either, it is black.

    A file of networks has the arrays ``names`` (M), ``w1`` (M, 6, 21), ``b1``, ``w2``, ``b2``, ``w3`` and ``b3`` for M
    materials. The input of a network is (sin θh, 0, cos θh) and the difference vector. Networks are only approximately
    reciprocal. Angles are clamped to θh ≤ 80° and θd ≤ 65°.

    One half of the directions is sampled from the cosine lobe. The other half is sampled by half vectors; their density
    follows the brightness of the material at θd = 30°.

    What it does not do: it has no differentiable parameters, no second side, and only RGB colours. Nothing enforces
    that it conserves energy. It needs one of Mitsuba's variants ``llvm_*_rgb`` or ``cuda_*_rgb``.

    Raises ValueError for a file of another kind, for a truncated file, and for an unknown material.

    .. tab-set-code::

        .. code-block:: xml

            <bsdf type="merl">
                <string name="filename" value="networks.npz"/>
                <string name="material" value="gold-paint"/>
            </bsdf>

        .. code-block:: python

            {"type": "merl", "filename": "networks.npz", "material": "gold-paint"}
    """

    def __init__(self, props):
        super().__init__(props)
        if not mi.is_rgb or dr.size_v(mi.Float) == 1:
            raise ValueError(f'merl "{props.id()}": needs a variant llvm_*_rgb or cuda_*_rgb, not {mi.variant()}')
        if "filename" not in props:
            raise ValueError(f'merl "{props.id()}": filename is missing; give a .binary of MERL or an .npz of networks')
        self.path, self.material = beside_scene(str(props["filename"])), str(props.get("material", ""))
        if not self.path.is_file():
            raise ValueError(f'merl "{props.id()}": filename is "{self.path}", which is no file')
        if self.path.suffix == ".npz":
            self.measured = MerlNetwork(self.path, self.material)
        elif self.material:
            raise ValueError(f'merl "{props.id()}": material is "{self.material}", but a table holds one alone')
        else:
            self.measured = MerlTable(self.path)
        root = np.linspace(0, 1, HALF_NODES)
        theta = mi.Float(root**2 * np.pi / 2)
        typical = mi.Vector3f(float(np.sin(SAMPLED_THETA_D)), 0, float(np.cos(SAMPLED_THETA_D)))
        bright = dr.mean(self.measured.value(theta, typical)).numpy()
        # The density of t, θh = t² π/2: f times the projected solid angle of a ring of half vectors.
        density = (bright + 1e-3 * bright.max() + 1e-9) * np.sin(2 * theta.numpy()).clip(0) * root
        self.half = mi.ContinuousDistribution(mi.ScalarVector2f(0, 1), mi.Float(density))
        self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
        self.m_flags = self.m_components[0]

    def reflected(self, si, wo, active):
        """Evaluate the BRDF times the cosine, f (n·i) [1/sr], for light from direction `wo` (local frame of `si`).

        The result is 0 where `active` is False, and for light or viewer behind the surface.
        """
        h = dr.normalize(si.wi + wo)
        sin = dr.sqrt(h.x * h.x + h.y * h.y)
        across = sin > 1e-7
        cos_phi, sin_phi = dr.select(across, h.x / sin, 1), dr.select(across, h.y / sin, 0)
        d = mi.Vector3f(
            h.z * (cos_phi * si.wi.x + sin_phi * si.wi.y) - sin * si.wi.z,
            cos_phi * si.wi.y - sin_phi * si.wi.x,
            dr.dot(si.wi, h),
        )
        value = self.measured.value(dr.atan2(sin, h.z), d) * wo.z
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), value, 0)

    def density(self, si, wo, active):
        """Compute the probability density [1/sr] with which `sample` draws the direction `wo` (local frame of `si`)."""
        h = dr.normalize(si.wi + wo)
        sin = dr.maximum(dr.sqrt(h.x * h.x + h.y * h.y), MIN_ROOT**2)
        root = dr.sqrt(dr.minimum(dr.atan2(sin, h.z) / (dr.pi / 2), 1))
        ring = self.half.eval_pdf_normalized(root) / (dr.pi * dr.maximum(root, MIN_ROOT)) / (dr.two_pi * sin)
        mixed = 0.5 * mi.warp.square_to_cosine_hemisphere_pdf(wo) + 0.5 * ring / (4 * dr.abs(dr.dot(si.wi, h)))
        return dr.select(active & (si.wi.z > 0) & (wo.z > 0), mixed, 0)

    def eval(self, ctx, si, wo, active=True):
        return self.reflected(si, wo, active & ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))

    def pdf(self, ctx, si, wo, active=True):
        return self.density(si, wo, active & ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        active = active & ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        theta = self.half.sample(sample2.x) ** 2 * (dr.pi / 2)
        (sin, cos), (sin_phi, cos_phi) = dr.sincos(theta), dr.sincos(dr.two_pi * sample2.y)
        mirrored = mi.reflect(si.wi, mi.Normal3f(sin * cos_phi, sin * sin_phi, cos))
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = dr.select(sample1 < 0.5, mirrored, mi.warp.square_to_cosine_hemisphere(sample2))
        bs.pdf = self.density(si, bs.wo, active)
        bs.eta = 1.0
        bs.sampled_component = mi.UInt32(0)
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        active &= bs.pdf > 0
        return bs, self.reflected(si, bs.wo, active) / dr.select(active, bs.pdf, 1)

    def to_string(self):
        return f"Merl[filename={self.path}, material={self.material}]"


mi.register_bsdf("merl", Merl)
