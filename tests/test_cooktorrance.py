"""The `cooktorrance` BSDF: equation 1 of the paper, its sampling, and the attributes that it reads."""

import re
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers.microfacets import CONTEXT, TWINS, direction, directions, draw, evaluate, interaction, twin, vectors

from mi_ring.plugins.matte_reflection import cosine_factors, rough_lobe
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.system import machine

DISTRIBUTIONS = ["ggx", "beckmann"]

#: (diffuse, specular, roughness); the last one is brighter than energy allows.
MATERIALS = {
    "diffuse": ([0.3, 0.1, 0.02], 0.0, 0.7),
    "gloss": ([0.0, 0.0, 0.0], 0.2, 0.35),
    "mixed": ([0.25, 0.2, 0.05], 0.1, 0.3),
    "sharp": ([0.02, 0.01, 0.0], 0.2, 0.05),
    "rough": ([3.0, 2.0, 1.0], 1.5, 0.9),
}


#: Where the viewer stands.
VIEWERS = {"normal": direction(0, 0), "oblique": direction(45, -37), "grazing": direction(80, 110)}

every_material = pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS)
every_viewer = pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)
every_distribution = pytest.mark.parametrize("distribution", DISTRIBUTIONS)


def cooktorrance(diffuse, specular, roughness, distribution="ggx", **more):
    return mi.load_dict({
        "type": "cooktorrance",
        "diffuse": {"type": "rgb", "value": list(diffuse)},
        "specular": float(specular),
        "roughness": float(roughness),
        "distribution": distribution, **more,
    })  # fmt: skip


def mirrored(o, r, distribution, u):
    """`o` (N, 3) mirrored at normals h drawn from D n·h by `u` (N, 2): (i (N, 3), 1 / density (N,) [sr]).

    The mean of f(i) / density is ∫ f di over the upper hemisphere. Where i is below, it is (0, 0, 1) and 1 / density 0.
    """
    tan2 = r**2 * (u[:, 0] / (1 - u[:, 0]) if distribution == "ggx" else -np.log1p(-u[:, 0]))
    cos, phi = 1 / np.sqrt(1 + tan2), 2 * np.pi * u[:, 1]
    sin = np.sqrt(tan2) * cos
    h = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], -1)
    o_h = (o * h).sum(1)
    i = 2 * o_h[:, None] * h - o
    up = (o_h > 0) & (i[:, 2] > 0)
    area = 4 * o_h / (TWINS[distribution][0](cos, tan2, r) * cos)  # di = 4 (o·h) dh
    i = np.where(up[:, None], i, [0, 0, 1]).astype(np.float32).astype(float)
    return i, np.where(up, area, 0)


def grid(n):
    """Points (n², 2) evenly over the unit square."""
    t = (np.arange(n) + 0.5) / n
    return np.stack(np.meshgrid(t, t), -1).reshape(-1, 2)


def pairs(r, distribution, seed, count=300):
    """Directions (i, o), (2 N, 3) each: half of them anywhere, half in the highlight."""
    o = directions(2 * count, seed)
    i, _ = mirrored(o, r, distribution, np.random.default_rng(seed + 1).uniform(size=(2 * count, 2)))
    return np.where((np.arange(2 * count) < count)[:, None] | (i[:, 2:] < 0.05), directions(2 * count, seed + 2), i), o


def albedo(o, diffuse, specular, r, distribution, n=300):
    """∫ BSDF · n·i di (3,) seen from `o` (3,), by a sum of the twin over mirrored directions."""
    i, area = mirrored(np.repeat(o[None], n * n, 0), r, distribution, grid(n))
    return np.pi * np.array(diffuse) + (twin(i, o[None], [0, 0, 0], specular, r, distribution) * area[:, None]).mean(0)


def density(bsdf, i, o):
    return np.array(bsdf.pdf(CONTEXT, interaction(o), vectors(i)))


# Values, in float32.


@every_distribution
def test_equals_equation_1(distribution):
    random = np.random.default_rng(4)
    for seed in range(20):
        material = random.uniform(0, 2, 3), random.uniform(0, 1), random.uniform(0.05, 1)
        i, o = pairs(material[2], distribution, seed)
        value, expected = evaluate(cooktorrance(*material, distribution), i, o), twin(i, o, *material, distribution)
        np.testing.assert_allclose(value, expected, rtol=2e-5, atol=1e-7)
        if distribution == "beckmann":  # twice the error of the fit, for i and for o
            np.testing.assert_allclose(value, twin(i, o, *material, "beckmann, exact"), rtol=7e-3, atol=1e-7)


@every_distribution
@every_material
def test_is_reciprocal_and_not_negative(material, distribution):
    bsdf, (i, o) = cooktorrance(*material, distribution), pairs(material[2], distribution, 1)
    there, back = evaluate(bsdf, i, o), evaluate(bsdf, o, i)
    np.testing.assert_allclose(there / i[:, 2:], back / o[:, 2:], rtol=1e-5, atol=1e-7)
    assert (there >= 0).all()


def test_with_fresnel_it_is_as_glossy_as_glass_from_all_sides():
    """Of F₀ = 0.04, a refractive index of 1.5: by Fresnel's own formula, which Schlick's is near."""
    i, o = directions(400, 5), directions(400, 6)
    h = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)
    exact = np.array(mi.fresnel(mi.Float((h * o).sum(1).astype(np.float32)), 1.5)[0])
    lobe = twin(i, o, [0, 0, 0], 0.25, 0.4)  # of a mirror
    found = evaluate(cooktorrance([0, 0, 0], 0.01, 0.4, fresnel=True), i, o)
    np.testing.assert_allclose(found / lobe, exact[:, None] * np.ones(3), atol=0.035)
    schlick = 0.04 + 0.96 * (1 - (h * o).sum(1)) ** 5
    np.testing.assert_allclose(found / lobe, schlick[:, None] * np.ones(3), rtol=1e-4)
    toward = evaluate(cooktorrance([0.1, 0.1, 0.1], 0.01, 0.4, fresnel=True), o, o)
    np.testing.assert_allclose(toward, evaluate(cooktorrance([0.1, 0.1, 0.1], 0.01, 0.4), o, o), rtol=1e-5)
    # More than a mirror, as where the lamp's power is not known, stays as it is.
    bright = evaluate(cooktorrance([0, 0, 0], 0.5, 0.4, fresnel=True), i, o)
    np.testing.assert_allclose(bright, evaluate(cooktorrance([0, 0, 0], 0.5, 0.4), i, o), rtol=1e-5)


@every_viewer
def test_with_fresnel_samples_follow_the_density(viewer):
    xml = ('<rgb name="diffuse" value="0.2,0.1,0.1"/><float name="specular" value="0.01"/>'
           '<float name="roughness" value="0.3"/><boolean name="fresnel" value="true"/>')  # fmt: skip
    sample, pdf = mi.chi2.BSDFAdapter("cooktorrance", xml, wi=viewer.tolist())
    test = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=1_000_000, res=201, ires=16
    )
    assert test.run(significance_level=0.01, test_count=len(VIEWERS), quiet=True), test.messages


def test_fresnel_is_true_or_false():
    with pytest.raises(RuntimeError, match="fresnel is yes, must be true or false"):
        cooktorrance([0, 0, 0], 0.1, 0.3, fresnel="yes")


def test_is_lambert_without_specular():
    """π ρ is the albedo of the stock plugin."""
    i, o = directions(200, 3), directions(200, 4)
    diffuse = np.array([0.3, 0.1, 0.02])
    stock = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": (np.pi * diffuse).tolist()}})
    bsdf = cooktorrance(diffuse, 0, 0.4)
    np.testing.assert_allclose(evaluate(bsdf, i, o), evaluate(stock, i, o), rtol=1e-5)
    np.testing.assert_allclose(density(bsdf, i, o), density(stock, i, o), rtol=1e-5)


@every_distribution
@pytest.mark.parametrize("r", [0.05, 0.3, 0.8])
def test_specular_part_is_four_times_roughconductor(r, distribution):
    i, o = pairs(r, distribution, 5)
    stock = mi.load_dict({"type": "roughconductor", "distribution": distribution, "material": "none", "alpha": r})
    bsdf = cooktorrance([0, 0, 0], 0.15, r, distribution)
    # Stock Fresnel of a mirror is sqrt(0) off 1: on a GPU, at 45 degrees, the root of a rounding error.
    rtol = 1e-5 if machine.device().type == "cpu" else 1e-3
    np.testing.assert_allclose(evaluate(bsdf, i, o), 4 * 0.15 * evaluate(stock, i, o), rtol=rtol, atol=1e-7)
    np.testing.assert_allclose(density(bsdf, i, o), density(stock, i, o), rtol=1e-5, atol=1e-7)


def test_distribution_is_ggx_unless_said_otherwise():
    i, o = pairs(0.3, "ggx", 11)
    plain = mi.load_dict({"type": "cooktorrance", "diffuse": 0.0, "specular": 0.1, "roughness": 0.3})
    np.testing.assert_allclose(evaluate(plain, i, o), twin(i, o, [0, 0, 0], 0.1, 0.3, "ggx"), rtol=2e-5, atol=1e-7)


@pytest.mark.parametrize("distribution", ["phong", "GGX", "", 0.3])
def test_other_distributions_are_refused(distribution):
    found = f'cooktorrance "glaze": distribution is "{distribution}", must be "ggx" or "beckmann"'
    with pytest.raises(Exception, match=re.escape(found)):
        mi.load_dict({"type": "cooktorrance", "id": "glaze", "distribution": distribution})


def test_components_can_be_asked_for_one_by_one():
    bsdf, (i, o) = cooktorrance(*MATERIALS["mixed"]), (directions(50, 7), directions(50, 8))
    parts = []
    for component in (0, 1):
        context = mi.BSDFContext()
        context.component = component
        parts.append(np.array(bsdf.eval(context, interaction(o), vectors(i))).T)
    np.testing.assert_allclose(sum(parts), evaluate(bsdf, i, o), rtol=1e-5)
    np.testing.assert_allclose(parts[0], np.array(MATERIALS["mixed"][0]) * i[:, 2:], rtol=1e-5)


def test_is_black_from_below_and_where_inactive():
    up, down = directions(50, 9), directions(50, 10) * [1, 1, -1]
    bsdf = cooktorrance(*MATERIALS["mixed"])
    for i, o, active in ((up, down, True), (down, up, True), (down, down, True), (up, up, False)):
        arguments = CONTEXT, interaction(o), vectors(i), mi.Bool(active)
        for result in (bsdf.eval(*arguments), bsdf.pdf(*arguments), *bsdf.eval_pdf(*arguments)):
            assert (np.array(result) == 0).all()


# Energy.


@every_distribution
@pytest.mark.parametrize("r", [0.02, 0.05, 0.1, 0.3, 0.6, 0.9, 1.5])
def test_white_furnace(r, distribution):
    """The albedo is at most π ρᵈ + 4 ρᵞ, from everywhere: even from the rim, and reached by narrow lobes."""
    specular, n = 0.15, 150
    diffuse = (1 - 4 * specular) / np.pi * np.array([1.0, 0.6, 0.2])
    gloss, both = cooktorrance([0, 0, 0], specular, r, distribution), cooktorrance(diffuse, specular, r, distribution)
    bound = np.pi * diffuse + 4 * specular
    assert np.isclose(bound.max(), 1)
    for angle in (0, 30, 60, 80, 88, 89.9, 90.5, 92):
        o = direction(angle, 110)
        i, area = mirrored(np.repeat(o[None], n * n, 0), r, distribution, grid(n))
        si = interaction(np.repeat(o[None], n * n, 0))
        si.n = mi.Normal3f(*(o + direction(0, 0)).tolist())  # a face that looks at the viewer
        reflected = (np.array(gloss.eval(CONTEXT, si, vectors(i))).T * area[:, None]).mean(0)
        assert (reflected <= 4 * specular * (1 + 1e-5)).all()
        if angle < 90:
            weight = np.array(draw(both, o, 40_000)[1]).T
            rounding = 0 if machine.device().type == "cpu" else 1e-6
            assert (weight.mean(0) <= (bound + 4 * weight.std(0) / 200) * (1 + rounding)).all()
        if angle == 0 and r < 0.1:
            assert (reflected >= 4 * specular * 0.99).all()


# Sampling.


@every_viewer
@every_distribution
@every_material
def test_samples_follow_the_density(material, distribution, viewer):
    """Chi-squared at a significance of 1 % over the whole table (Šidák); the sharp lobes need the fine cells."""
    diffuse, specular, r = material
    xml = f"""<rgb name="diffuse" value="{diffuse[0]}, {diffuse[1]}, {diffuse[2]}"/>
              <float name="specular" value="{specular}"/> <float name="roughness" value="{r}"/>
              <string name="distribution" value="{distribution}"/>"""
    sample, pdf = mi.chi2.BSDFAdapter("cooktorrance", xml, wi=viewer.tolist())
    test = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=1_000_000, res=201, ires=16
    )
    count = len(MATERIALS) * len(DISTRIBUTIONS) * len(VIEWERS)
    assert test.run(significance_level=0.01, test_count=count, quiet=True), test.messages


@every_viewer
@every_distribution
@every_material
def test_sampling_gives_the_albedo(material, distribution, viewer):
    count = 40_000
    bs, weight = draw(cooktorrance(*material, distribution), viewer, count)
    weight = np.array(weight).T
    assert np.isfinite(weight).all()
    expected, noise = albedo(viewer, *material, distribution), weight.std(0) / np.sqrt(count)
    # 5e-3: the tail of GGX at 300 x 300 points; Mitsuba draws exact Beckmann normals, but masks them by the fit.
    assert (np.abs(weight.mean(0) - expected) < 4 * noise + 5e-3 * expected).all()
    assert set(np.array(bs.sampled_component)[np.array(bs.pdf) > 0]) <= {0, 1}


@every_distribution
@every_material
def test_sample_and_eval_pdf_agree_with_eval_and_pdf(material, distribution, monkeypatch):
    bsdf, o, count = cooktorrance(*material, distribution), VIEWERS["oblique"], 5000
    bs, weight = draw(bsdf, o, count)
    si, seen = interaction(np.repeat(o[None], count, 0)), np.array(bs.pdf) > 0
    value, pdf = bsdf.eval(CONTEXT, si, bs.wo), bsdf.pdf(CONTEXT, si, bs.wo)
    np.testing.assert_allclose(np.array(bs.pdf)[seen], np.array(pdf)[seen], rtol=1e-5)
    np.testing.assert_allclose(np.array(weight * bs.pdf)[:, seen], np.array(value)[:, seen], rtol=1e-5, atol=1e-7)
    own = type(bsdf)  # another variant in a test before makes the classes of the plugins anew
    calls, parameters = [], own.parameters
    monkeypatch.setattr(own, "parameters", lambda *args: calls.append(args) or parameters(*args))
    both = bsdf.eval_pdf(CONTEXT, si, bs.wo)
    assert len(calls) == 1  # textures are looked up once
    np.testing.assert_array_equal(np.array(both[0]), np.array(value))
    np.testing.assert_array_equal(np.array(both[1]), np.array(pdf))


# A rough diffuse part.


def rough_cosine(i, o, sigma):
    """The rough diffuse term with ρᵈ = 1, times n·i, by angles as Oren and Nayar write it: (N,)."""
    theta_i, theta_o = np.arccos(i[:, 2]), np.arccos(o[:, 2])
    azimuth = np.arctan2(i[:, 1], i[:, 0]) - np.arctan2(o[:, 1], o[:, 0])
    across = np.cos(azimuth) * np.sin(theta_i) * np.sin(theta_o)
    back = np.where(across > 0, across / np.cos(np.minimum(theta_i, theta_o)), across)
    return np.cos(theta_i) * (1 + sigma * back) / (1 + (1 / 2 - 2 / (3 * np.pi)) * sigma)


@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0])
def test_rough_matte_surfaces_are_those_of_oren_and_nayar(sigma):
    i, o = directions(300, 21), directions(300, 22)
    bsdf = cooktorrance([0.3, 0.1, 0.02], 0, 0.4, diffuse_roughness=sigma)
    expected = rough_cosine(i, o, sigma)[:, None] * [0.3, 0.1, 0.02]
    np.testing.assert_allclose(evaluate(bsdf, i, o), expected, rtol=2e-5)
    np.testing.assert_allclose(evaluate(bsdf, o, i) * i[:, 2:], expected * o[:, 2:], rtol=3e-5)  # reciprocal


@every_viewer
def test_albedo_of_a_rough_matte_surface(viewer):
    """By sampling; of a surface that is white to a grazing viewer."""
    bsdf = cooktorrance([1 / np.pi] * 3, 0, 0.4, diffuse_roughness=0.7)
    weight = np.array(draw(bsdf, viewer, 200_000)[1])[0]
    assert weight.mean() == pytest.approx(float(rough_lobe(mi.Float(viewer[2]), 0.7)[0][0]), abs=2e-3)


def test_albedo_of_a_rough_matte_surface_at_its_limits():
    """Closed form: 1 / (1 + σ (1/2 − 2/(3π))) toward the normal, 1 from aside."""
    sigma = 0.8
    seen, aside = (float(rough_lobe(mi.Float(cosine), sigma)[0][0]) for cosine in (1.0, 1e-3))
    assert seen == pytest.approx(1 / (1 + sigma * (1 / 2 - 2 / (3 * np.pi))), rel=1e-5)
    assert aside == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("sigma", [0.0, 0.6])
def test_diffuse_reflectance_leaves_highlights_out(sigma):
    """It is the mean albedo over all viewing directions, whoever looks and however glossy the surface is."""
    u = np.random.default_rng(4).random((2, 200_000, 2)).astype(np.float32)
    i, o = (np.array(mi.warp.square_to_cosine_hemisphere(mi.Point2f(*part.T))).T for part in u)
    i, o = (part[np.minimum(i[:, 2], o[:, 2]) > 0.02] for part in (i, o))
    matte = cooktorrance([0.2, 0.1, 0.05], 0.0, 0.2, diffuse_roughness=sigma)
    expected = np.pi * (evaluate(matte, i, o) / i[:, 2:]).mean(0)
    bsdf = cooktorrance([0.2, 0.1, 0.05], 0.3, 0.2, diffuse_roughness=sigma)
    for viewer in VIEWERS.values():
        found = np.array(bsdf.eval_diffuse_reflectance(interaction(viewer[None]))).ravel()
        np.testing.assert_allclose(found, expected, rtol=0.01)


def test_gradient_of_the_diffuse_roughness():
    i, o = directions(300, 25), directions(300, 26)
    bsdf = cooktorrance([0.3, 0.1, 0.02], 0.05, 0.4, diffuse_roughness=0.3)
    params = mi.traverse(bsdf)
    leaf = params["diffuse_roughness.value"]
    dr.enable_grad(leaf)
    params.update()
    dr.backward(dr.sum(dr.sum(bsdf.eval(CONTEXT, interaction(o), vectors(i)))))
    high, low = (0.42 * rough_cosine(i, o, sigma).sum() for sigma in (0.301, 0.299))
    assert float(dr.grad(leaf)[0]) == pytest.approx((high - low) / 0.002, rel=1e-3)


# Gradients.


def gradients(bsdf, result):
    """Of a scalar function of the BSDF with respect to (diffuse rgb, specular, roughness), (5,)."""
    params = mi.traverse(bsdf)
    leaves = [params[key] for key in ("diffuse.value", "specular.value", "roughness.value")]
    dr.enable_grad(leaves)
    params.update()
    dr.backward(result(bsdf))
    return np.concatenate([np.array(dr.grad(leaf)).ravel() for leaf in leaves])


def differences(function, material, step=1e-4):
    """The same by central differences of `function(diffuse, specular, roughness)`, relative step."""
    values = np.array([*material[0], material[1], material[2]])
    result = []
    for k in range(5):
        high, low = values.copy(), values.copy()
        high[k] += step * values[k]
        low[k] -= step * values[k]
        result.append((function(high[:3], *high[3:]) - function(low[:3], *low[3:])) / (high[k] - low[k]))
    return np.array(result)


LIT = {name: MATERIALS[name] for name in ("mixed", "rough")} | {"sharp": ([0.02, 0.01, 0.03], 0.2, 0.05)}
every_lit_material = pytest.mark.parametrize("material", LIT.values(), ids=LIT)


@every_distribution
@every_lit_material
def test_gradients_are_the_differences_of_equation_1(material, distribution):
    i, o = pairs(material[2], distribution, 12)
    w = np.random.default_rng(13).uniform(0.1, 1, (len(i), 3))

    def loss(bsdf):
        return dr.sum(dr.dot(bsdf.eval(CONTEXT, interaction(o), vectors(i)), vectors(w)))

    found = gradients(cooktorrance(*material, distribution), loss)
    expected = differences(lambda *m: (w * twin(i, o, *m, distribution)).sum(), material)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@every_distribution
@every_lit_material
def test_gradients_through_sampling_are_those_of_the_albedo(material, distribution):
    """Integrators that differentiate their samples must not be misled by the choice of a lobe."""
    count, o = 400_000, VIEWERS["oblique"]
    found = gradients(cooktorrance(*material, distribution), lambda b: dr.mean(dr.mean(draw(b, o, count)[1])))
    expected = differences(lambda *m: albedo(o, *m, distribution).mean(), material, 1e-2)
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)


# The rim, where the interpolated normal turns away before the face does.


def seen_at(slope, face_slope, i, bsdf):
    """BSDF · n·i where n·o is `slope`, and `face_slope` for the normal of the face."""
    si = interaction(np.array([[np.sqrt(1 - slope**2), 0, slope]]))
    turn = np.arcsin(face_slope) - np.arcsin(slope)
    si.n = mi.Normal3f(vectors(np.array([[np.sin(turn), 0, np.cos(turn)]])))
    return np.array(bsdf.eval(CONTEXT, si, vectors(i))).T[0]


def test_rim_is_lit_where_the_face_still_looks_at_the_viewer():
    bsdf, i = cooktorrance(*MATERIALS["mixed"]), np.array([[0.6, 0.0, 0.8]])
    value = seen_at(-0.01, 0.04, i, bsdf)
    assert np.isfinite(value).all()
    assert (value >= np.array(MATERIALS["mixed"][0]) * 0.8).all()  # at least the diffuse part
    assert (seen_at(-0.01, -0.04, i, bsdf) == 0).all()


@every_distribution
@every_material
def test_brightness_does_not_jump_across_the_rim(material, distribution):
    bsdf = cooktorrance(*material, distribution)
    for i in (direction(37, 0), direction(80, 175), direction(20, -60)):
        inside, outside = seen_at(1e-4, 0.04, i[None], bsdf), seen_at(-1e-4, 0.04, i[None], bsdf)
        # The half vector turns by 1e-4, of which D, at a roughness of 0.05, makes at most 2 %.
        np.testing.assert_allclose(inside, outside, rtol=0.02, atol=1e-7)


@every_distribution
@every_material
def test_brightness_does_not_jump_where_the_half_vector_dips_below_the_surface(material, distribution):
    """It does if the light grazes the rim: n·i < -n·o."""
    bsdf, slope = cooktorrance(*material, distribution), -0.02
    above, below = (np.array([[np.sqrt(0.75 - z**2), 0.5, z]]) for z in (0.0201, 0.0199))
    inside, outside = (seen_at(slope, 0.04, i, bsdf) for i in (above, below))
    np.testing.assert_allclose(inside, outside, rtol=0.02, atol=1e-7)


# Attributes: Mitsuba renders black without a word where they are missing.


def reading(**attributes):
    """A `cooktorrance` whose textures read these mesh attributes; the others are constant."""
    constant = {"diffuse": {"type": "rgb", "value": [0.2, 0.1, 0.1]}, "specular": 0.1, "roughness": 0.4}
    named = {key: {"type": "mesh_attribute", "name": name} for key, name in attributes.items()}
    return {"type": "cooktorrance", **constant, **named}


WRONG = {
    "unknown": (reading(diffuse="vertex_colour"), 'reads the mesh attribute "vertex_colour", which the shape does not'),
    "three for one": (reading(roughness="vertex_diffuse"), "needs a mesh attribute of 1 channel.*has 3"),
    "one for three": (reading(diffuse="vertex_roughness"), "needs a mesh attribute of 3 channel.*has 1"),
    "of another BSDF": (
        {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_colour"}},
        'reads the mesh attribute "vertex_colour"',
    ),
}  # fmt: skip


@pytest.mark.parametrize("bsdf, message", WRONG.values(), ids=WRONG)
def test_shapenet_refuses_attributes_that_it_does_not_carry(bsdf, message):
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "shapenet", "subdivisions": 0, "bsdf": bsdf})


@pytest.fixture
def tetrahedron(tmp_path):
    """A PLY file with two vertex attributes, `vertex_diffuse` (3) and `vertex_roughness` (1), and `face_shine` (1)."""
    mesh = mi.Mesh("tetrahedron", 4, 4)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 3])
    params["faces"] = mi.UInt32([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    params.update()
    mesh.add_attribute("vertex_diffuse", 3, np.linspace(0.1, 0.6, 12, dtype=np.float32))
    mesh.add_attribute("vertex_roughness", 1, np.linspace(0.3, 0.6, 4, dtype=np.float32))
    mesh.add_attribute("face_shine", 1, np.linspace(0.1, 0.4, 4, dtype=np.float32))
    path = tmp_path / "tetrahedron.ply"
    mesh.write_ply(str(path))
    return str(path)


def scene_of(shape):
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "photometric"},
        "shape": shape,
        "sensor": {
            "type": "photograph", "filename": "nowhere.png", "fx": 9.0, "fy": 8.0,
            "to_world": mi.ScalarTransform4f().look_at([4, 5, 6], [0.3, 0.4, 0.5], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 7, "height": 5},
        },
    })  # fmt: skip


@contextmanager
def raises_inside(message):
    """`mi.render` wraps the errors of integrators: look at what caused them."""
    with pytest.raises(Exception) as caught:
        yield
    assert re.search(message, str(caught.value.__cause__))


@pytest.mark.parametrize("bsdf, message", WRONG.values(), ids=WRONG)
def test_photometric_refuses_a_stock_mesh_without_the_attributes(tetrahedron, bsdf, message):
    with raises_inside(message):
        mi.render(scene_of({"type": "ply", "filename": tetrahedron, "bsdf": bsdf}), spp=1)


def test_photometric_refuses_a_shape_that_is_no_mesh():
    with raises_inside('reads the mesh attribute "vertex_diffuse"'):
        mi.render(scene_of({"type": "sphere", "bsdf": {"type": "cooktorrance"}}), spp=1)


def test_attributes_of_a_stock_mesh_are_accepted(tetrahedron):
    bsdf = reading(diffuse="vertex_diffuse", specular="face_shine", roughness="vertex_roughness")
    scene = scene_of({"type": "ply", "filename": tetrahedron, "bsdf": bsdf})
    require_attributes(scene.shapes()[0])
    mi.render(scene, spp=1)


def test_a_mesh_may_tell_how_rough_it_is(tetrahedron):
    """By its attribute. Without it the surface is Lambert's, and who renders it need not know which."""
    constant = {"diffuse": {"type": "rgb", "value": [0.2, 0.1, 0.1]}, "specular": 0.1, "roughness": 0.4}

    def rendered(sigma=None, **more):
        scene = scene_of({"type": "ply", "filename": tetrahedron, "bsdf": {"type": "cooktorrance", **constant, **more}})
        (mesh,) = scene.shapes()
        if sigma is not None:
            mesh.add_attribute("vertex_diffuse_roughness", 1, [sigma] * mesh.vertex_count())
        require_attributes(mesh)
        return np.array(mi.render(scene, spp=4, seed=1))

    for sigma in (0.0, 0.4):
        np.testing.assert_allclose(rendered(sigma), rendered(diffuse_roughness=sigma), rtol=1e-5)
    np.testing.assert_allclose(rendered(), rendered(0.0), rtol=1e-6)
    assert not np.allclose(rendered(0.4), rendered(), rtol=1e-2)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.8])
@pytest.mark.parametrize(("cosine", "rough"), [(0.97, 0.0), (0.4, 0.0), (0.4, 0.3)])
def test_lobes_reflect_harmonics_as_samples_do(distribution, roughness, cosine, rough):
    """Of each degree the nearest that a round lobe comes: exactly for l = 0 and 1, if its direction is the mean one."""
    diffuse = {"type": "rgb", "value": [0.1, 0.05, 0.2]}
    bsdf = mi.load_dict({"type": "cooktorrance", "diffuse": diffuse, "specular": 0.06, "roughness": roughness,
                         "distribution": distribution, "diffuse_roughness": rough})  # fmt: skip
    count, sine = 2**18, float(np.sqrt(1 - cosine**2))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi = mi.Vector3f(0.6 * sine, -0.8 * sine, cosine)
    random = mi.PCG32(count)
    two = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = bsdf.sample(mi.BSDFContext(), si, random.next_float32(), two, True)

    def harmonics(direction):
        return np.stack([np.broadcast_to(np.array(y), count) for y in dr.sh_eval(direction, 4)])

    sampled = np.array(weight) @ harmonics(sample.wo).T / count
    by_lobes = np.zeros((3, 25))
    for toward, shares in bsdf.lobes(si, 4):
        for k, y in enumerate(harmonics(toward)):
            by_lobes[:, k] += (np.array(mi.Color3f(shares[int(k**0.5)])) * y).mean(1)
    error = np.abs(by_lobes - sampled)
    assert error[:, :4].max() < 0.01 * np.abs(sampled).max()
    assert error[:, 4:].max() < 0.1 * np.abs(sampled).max()


def test_a_matte_surface_reflects_harmonics_by_the_known_factors():
    """Ramamoorthi and Hanrahan 2001, table of A_l: π, 2π/3, π/4, 0, −π/24, 0, π/64."""
    shares = cosine_factors(6)
    np.testing.assert_allclose(shares, np.pi * np.array([1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64]), atol=1e-12)
