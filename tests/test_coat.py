"""The coat of `cooktorrance`, a second lobe; fits that find one, and files that keep it."""

import dataclasses
import re
import shutil

import drjit as dr
import mitsuba as mi
import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from conftest import AXES, CENTER
from helpers.ellipsoid_points import ellipsoid_points
from helpers.microfacets import CONTEXT, direction, directions, draw, evaluate, interaction, twin, vectors
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ring import export
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.fitting import schedule
from mi_ring.fitting.coat_selection import ENOUGH
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.nets.brdf_net import COAT as COAT_PARAMETERS
from mi_ring.nets.brdf_net import COOK_TORRANCE, BRDFNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions, edit_material
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import gltf
from mi_ring.scene.mesh_attributes import attributes_of, require_attributes
from mi_ring.system import machine

BASE, COAT = ([0.2, 0.12, 0.05], 0.04, 0.5), (0.03, 0.12)  #: (diffuse, specular, roughness), (strength, roughness)
BLACK = [0.0, 0.0, 0.0]
VIEWERS = {"normal": direction(0, 0), "oblique": direction(50, -37), "grazing": direction(80, 110)}
DISTRIBUTIONS = ["ggx", "beckmann"]

every_distribution = pytest.mark.parametrize("distribution", DISTRIBUTIONS)
every_viewer = pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)


def coated(diffuse=BASE[0], specular=BASE[1], roughness=BASE[2], coat=COAT[0], coat_roughness=COAT[1], **more):
    colour = {"type": "rgb", "value": list(diffuse)}
    return mi.load_dict({"type": "cooktorrance", "diffuse": colour, "specular": specular, "roughness": roughness,
                         "coat": coat, "coat_roughness": coat_roughness, **more})  # fmt: skip


def expected(i, o, diffuse, specular, roughness, coat, coat_roughness, distribution="ggx"):
    """The base and the coat, each by equation 1."""
    base = twin(i, o, diffuse, specular, roughness, distribution)
    return base + twin(i, o, BLACK, coat, coat_roughness, distribution)


def near_mirror(o, seed, spread=0.15):
    """Directions (N, 3) near those that mirror `o`: the coat's highlight; float32, above the surface."""
    i = o * [-1, -1, 1] + np.random.default_rng(seed).normal(0, spread, o.shape)
    i[:, 2] = np.abs(i[:, 2]) + 0.05
    return (i / np.linalg.norm(i, axis=1, keepdims=True)).astype(np.float32).astype(float)


@every_distribution
def test_it_is_a_second_lobe_on_top_of_equation_1(distribution):
    o = directions(600, 31)
    for i in (directions(600, 32), near_mirror(o, 33)):
        bsdf = coated(distribution=distribution)
        value = evaluate(bsdf, i, o)
        np.testing.assert_allclose(value, expected(i, o, *BASE, *COAT, distribution), rtol=3e-5, atol=1e-7)
        np.testing.assert_allclose(value / i[:, 2:], evaluate(bsdf, o, i) / o[:, 2:], rtol=2e-5, atol=1e-7)


def test_a_coat_of_no_strength_changes_nothing():
    i, o = directions(300, 34), directions(300, 35)
    colour = {"type": "rgb", "value": BASE[0]}
    plain = mi.load_dict({"type": "cooktorrance", "diffuse": colour, "specular": BASE[1], "roughness": BASE[2]})
    np.testing.assert_array_equal(evaluate(coated(coat=0.0), i, o), evaluate(plain, i, o))
    assert not any("coat" in key for key, _ in mi.traverse(plain))


def test_with_fresnel_both_lobes_together_grow_up_to_a_mirror():
    """By Schlick's formula with F₀ = 4 (0.01 + 0.03), a quarter of which is the first lobe's."""
    o = directions(300, 36)
    i = near_mirror(o, 37)
    h = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)
    value = evaluate(coated(BLACK, 0.01, 0.5, 0.03, 0.3, fresnel=True), i, o)
    schlick = 0.16 + 0.84 * (1 - (h * o).sum(1, keepdims=True)) ** 5
    mirror = twin(i, o, BLACK, 0.25 / 4, 0.5) + twin(i, o, BLACK, 0.75 / 4, 0.3)
    np.testing.assert_allclose(value, schlick * mirror, rtol=2e-4)
    coat_alone = evaluate(coated(BLACK, 0.0, 0.5, 0.04, 0.3, fresnel=True), i, o)
    np.testing.assert_allclose(coat_alone, schlick * twin(i, o, BLACK, 0.25, 0.3), rtol=2e-4)


@every_viewer
@every_distribution
@pytest.mark.parametrize("fresnel", [False, True])
def test_samples_follow_the_density(distribution, viewer, fresnel):
    xml = (f'<rgb name="diffuse" value="{", ".join(map(str, BASE[0]))}"/><float name="specular" value="{BASE[1]}"/>'
           f'<float name="roughness" value="{BASE[2]}"/><float name="coat" value="{COAT[0]}"/>'
           f'<float name="coat_roughness" value="{COAT[1]}"/><string name="distribution" value="{distribution}"/>'
           f'<boolean name="fresnel" value="{str(fresnel).lower()}"/>')  # fmt: skip
    sample, pdf = mi.chi2.BSDFAdapter("cooktorrance", xml, wi=viewer.tolist())
    test = mi.chi2.ChiSquareTest(
        mi.chi2.SphericalDomain(), sample, pdf, sample_dim=3, sample_count=400_000, res=101, ires=16
    )
    assert test.run(significance_level=0.01, test_count=12, quiet=True), test.messages


@every_viewer
@every_distribution
def test_sampling_gives_the_sum_of_the_albedos(distribution, viewer):
    """Those of bases without a coat, which other tests compare with integrals. It is at most π ρᵈ + 4 ρᵞ + 4 ρᶜ."""
    count = 200_000

    def albedo(bsdf):
        weight = np.array(draw(bsdf, viewer, count)[1]).T
        return weight.mean(0), weight.std(0) / np.sqrt(count)

    colour = {"type": "rgb", "value": BASE[0]}
    kind = {"type": "cooktorrance", "distribution": distribution}
    base = mi.load_dict({**kind, "diffuse": colour, "specular": BASE[1], "roughness": BASE[2]})
    coat = mi.load_dict({**kind, "diffuse": {"type": "rgb", "value": 0}, "specular": COAT[0], "roughness": COAT[1]})
    (both, noise), (one, _), (other, _) = (albedo(b) for b in (coated(distribution=distribution), base, coat))
    np.testing.assert_allclose(both, one + other, atol=float(5 * noise.max()))
    assert (both - 4 * noise <= np.pi * np.array(BASE[0]) + 4 * BASE[1] + 4 * COAT[0]).all()


def test_sample_and_eval_pdf_agree_with_eval_and_pdf():
    bsdf, o, count = coated(), VIEWERS["oblique"], 5000
    bs, weight = draw(bsdf, o, count)
    si, seen = interaction(np.repeat(o[None], count, 0)), np.array(bs.pdf) > 0
    value, pdf = bsdf.eval_pdf(CONTEXT, si, bs.wo)
    np.testing.assert_array_equal(np.array(value), np.array(bsdf.eval(CONTEXT, si, bs.wo)))
    np.testing.assert_array_equal(np.array(pdf), np.array(bsdf.pdf(CONTEXT, si, bs.wo)))
    np.testing.assert_allclose(np.array(bs.pdf)[seen], np.array(pdf)[seen], rtol=1e-5)
    np.testing.assert_allclose(np.array(weight * bs.pdf)[:, seen], np.array(value)[:, seen], rtol=1e-5, atol=1e-7)


@every_distribution
def test_gradients_are_the_differences_of_both_lobes(distribution):
    o = directions(400, 38)
    i = near_mirror(o, 39)
    w = np.random.default_rng(40).uniform(0.1, 1, (400, 3))
    bsdf = coated(distribution=distribution)
    names = "specular", "roughness", "coat", "coat_roughness"
    params = mi.traverse(bsdf)
    leaves = [params[f"{name}.value"] for name in names]
    dr.enable_grad(leaves)
    params.update()
    dr.backward(dr.sum(dr.dot(bsdf.eval(CONTEXT, interaction(o), vectors(i)), vectors(w))))
    for k, leaf in enumerate(leaves):
        high, low = ([*BASE[1:], *COAT] for _ in range(2))
        step = 1e-4 * high[k]
        high[k] += step
        low[k] -= step
        ends = [(w * expected(i, o, BASE[0], *values, distribution)).sum() for values in (high, low)]
        assert float(dr.grad(leaf)[0]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-4), names[k]


def test_gradients_through_sampling_are_those_of_the_albedo():
    """The albedo grows by 4 with the strength of a narrow coat, seen from above: the choice of lobes does not count."""
    bsdf = coated(coat_roughness=0.05)
    params = mi.traverse(bsdf)
    leaves = params["coat.value"], params["specular.value"]
    dr.enable_grad(*leaves)
    params.update()
    dr.backward(dr.mean(draw(bsdf, VIEWERS["normal"], 400_000)[1].x))
    assert float(dr.grad(leaves[0])[0]) == pytest.approx(4, rel=0.02)
    assert 2 < float(dr.grad(leaves[1])[0]) < 4  # a wide lobe loses light below the horizon, and between microfacets


@pytest.mark.parametrize("cosine", [0.97, 0.4])
def test_its_lobe_reflects_harmonics_as_a_first_lobe_of_its_strength_and_width(cosine):
    sine = float(np.sqrt(1 - cosine**2))
    si = dr.zeros(mi.SurfaceInteraction3f, 1)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi = mi.Vector3f(0.6 * sine, -0.8 * sine, cosine)

    def numbers(lobe):
        return np.concatenate([np.array(lobe[0]).ravel(), *(np.array(factor).ravel() for factor in lobe[1])])

    colour = {"type": "rgb", "value": BASE[0]}
    alone = mi.load_dict({"type": "cooktorrance", "diffuse": colour, "specular": COAT[0], "roughness": COAT[1]})
    base = mi.load_dict({"type": "cooktorrance", "diffuse": colour, "specular": BASE[1], "roughness": BASE[2]})
    matte, gloss, coat = coated().lobes(si, 4)
    np.testing.assert_allclose(numbers(coat), numbers(alone.lobes(si, 4)[1]), rtol=1e-6)
    for ours, theirs in zip((matte, gloss), base.lobes(si, 4)):
        np.testing.assert_array_equal(numbers(ours), numbers(theirs))


def test_it_is_read_from_the_mesh_only_if_the_bsdf_says_so():
    def shape(bsdf):
        return mi.load_dict({"type": "shapenet", "subdivisions": 0, "bsdf": {"type": "cooktorrance", **bsdf}})

    assert not any("coat" in name for name in attributes_of(shape({}).bsdf()))
    with pytest.raises(Exception, match='reads the mesh attribute "vertex_coat_roughness", which the shape does not'):
        shape({"coat": 0.02})
    with pytest.raises(Exception, match='reads the mesh attribute "vertex_coat", which the shape does not'):
        shape({"coat_roughness": 0.2})
    require_attributes(shape({"coat": 0.02, "coat_roughness": 0.2}))


# Fits.

SMALL = Config(iterations=32, levels=(3,), widths=(56,), shares=(1,), batch=4, detail="none", refine=("none",),
               indirect=False, shadows=False, subdivisions=3)  # fmt: skip
BEFORE = SMALL.iterations // 2  #: the iterations before lobes are counted
ONE, TWO = [(0.03, 0.35)], [(0.03, 0.35), (0.004, 0.07)]  #: lobes: (strength, roughness)


def glossy(scene, folder, lobes):
    """A copy of the small capture whose ellipsoid has these lobes as well, by rays and normals in closed form."""
    shutil.copytree(scene.parent, folder)
    for shot in load_capture(scene).shots:
        width, height = shot.size
        inside, toward, n, i, o = ellipsoid_points(shot)
        frames = np.linalg.qr(np.concatenate([n[..., None], np.repeat(np.eye(3)[None], len(n), 0)], -1))[0]
        frames[..., 0] *= np.sign((frames[..., 0] * n).sum(1))[:, None]
        local = [np.einsum("nij,ni->nj", frames, x)[:, [1, 2, 0]] for x in (i, o)]
        local = [x * [1, 1, 0] + np.maximum(x, 0.05) * [0, 0, 1] for x in local]
        irradiance = float(shot.light.rgb[0]) / (toward**2).sum(1)
        gloss = sum(twin(*local, BLACK, *lobe) for lobe in lobes) * irradiance[:, None]
        path = folder / "images" / shot.file_name
        radiance = srgb_to_linear(np.asarray(Image.open(path)) / 255)
        radiance += np.where(inside[:, None], gloss, 0).reshape(height, width, 3)
        Image.fromarray(to_bytes(linear_to_srgb(radiance))).save(path)
    return folder / scene.name


@pytest.fixture(scope="module")
def fits(small_capture, tmp_path_factory):
    """Fits of the same object with one lobe, just after lobes were counted, and with two. They start from its shape."""
    folder = tmp_path_factory.mktemp("glossy")
    ball = trimesh.creation.icosphere(subdivisions=4)
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    trimesh.Trimesh(CENTER + ball.vertices * AXES @ turn.T, ball.faces).export(folder / "start.ply")
    config = dataclasses.replace(SMALL, domain=("mesh", folder / "start.ply"))
    with machine.threads_of(1), pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "EARLIEST", BEFORE)
        one, two = (Fit(load_capture(glossy(small_capture, folder / name, lobes)), config)
                    for name, lobes in (("one", ONE), ("two", TWO)))  # fmt: skip
        while one.iteration < BEFORE + 2:
            one.step()
        two.run()
    return one, two


def test_a_fit_adds_a_second_lobe_where_photographs_show_one(fits):
    one, two = fits
    assert one.course.coat["gain"] < 0.5 * ENOUGH and two.course.coat["gain"] > 1.3 * ENOUGH
    assert [p.name for p in one.ring.brdf_net.bsdf_parameters][-1] == "diffuse_roughness"
    assert [p.name for p in two.ring.brdf_net.bsdf_parameters][-2:] == ["coat", "coat_roughness"]
    with torch.no_grad():
        found = two.ring.material(two.ring.domain.sample(3)[0])
    assert found["coat"].mean() > 5e-4  # either of the lobes may be the sharp one


def test_a_fit_that_looked_for_a_second_lobe_in_vain_is_the_same_as_without(fits):
    with machine.threads_of(1):
        plain = Fit(fits[0].problem.given, dataclasses.replace(fits[0].problem.config, lobes="1"))
        while plain.iteration < BEFORE + 2:
            plain.step()
    ours, theirs = (fit.ring.state_dict() for fit in (fits[0], plain))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert fits[0].course.coat and not plain.course.coat


def test_a_fit_with_a_second_lobe_goes_on_from_its_state(fits):
    """The network of the state has more outputs than that of a new fit, and so have Adam's moments."""
    two = fits[1]
    again = Fit(two.problem.given, two.problem.config, state=two.state())
    assert again.ring.bsdf == two.ring.bsdf and again.course.coat == two.course.coat
    width = len(again.ring.brdf_net.output.weight)
    moments = again.optimisation.optimizers[0].state[again.ring.brdf_net.output.weight]
    assert width == 8 and moments["exp_avg"].shape == moments["exp_avg_sq"].shape == (8, 256)


# Files.

COATED = """<bsdf type="cooktorrance">
  <texture name="coat" type="mesh_attribute"><string name="name" value="vertex_coat"/></texture>
  <texture name="coat_roughness" type="mesh_attribute"><string name="name" value="vertex_coat_roughness"/></texture>
</bsdf>"""


def test_in_gltf_a_weak_coat_is_exact_from_above_and_a_strong_one_keeps_its_light():
    values = {"diffuse": np.full((2, 3), 0.1), "specular": np.full(2, 0.03), "roughness": np.full(2, 0.5),
              "coat": np.array([0.005, 0.06]), "coat_roughness": np.full(2, 0.2)}  # fmt: skip
    material = gltf.metallic_roughness(COATED, values)
    np.testing.assert_allclose(material.coat, [0.5, 1])
    np.testing.assert_allclose(material.coat_roughness**2, 0.2)
    up = np.array([[0.0, 0.0, 1.0]])

    def peak(width):  # D' V
        return 1 / (np.pi * width**2) / 4

    passed = 1 - 0.04 * material.coat[0]  # KHR_materials_clearcoat, in all that is below the coat
    w = material.specular[0]
    below = (1 - w) * material.base_color[0, 0] / np.pi + w * peak(material.roughness[0] ** 2)
    ours = expected(up, up, [0.1] * 3, 0.03, 0.5, 0.005, 0.2)[0, 0]
    assert passed * below + 0.04 * 0.5 * peak(0.2) == pytest.approx(ours, rel=1e-6)
    assert 0.96 * material.specular[1] + 0.04 == pytest.approx(4 * 0.03 + 4 * 0.06)
    assert 0.2 < material.roughness[1] ** 2 < 0.5


def test_exports_have_the_coat(small_capture, tmp_path):
    torch.manual_seed(3)
    ring = FittedObject(CENTER, 30.0, 0.05, parameters=(*COOK_TORRANCE, *COAT_PARAMETERS), bsdf=COATED, steps=2,
                        subdivisions=3)  # fmt: skip
    with torch.no_grad():
        ring.brdf_net.output.weight *= 30
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    (tmp_path / "scene.xml").write_text(small_capture.read_text())
    for name in ("a.glb", "a.obj", "stock/a.xml", "a.ply"):
        export.main([str(tmp_path), str(tmp_path / name), "--resolution", "64"])
    (written,) = pygltflib.GLTF2.load(str(tmp_path / "a.glb")).materials
    extension = written.extensions["KHR_materials_clearcoat"]
    assert extension["clearcoatFactor"] == 1 and extension["clearcoatTexture"] == extension["clearcoatRoughnessTexture"]
    library = (tmp_path / "a.mtl").read_text()
    assert re.search(r"^Pc 0\.\d+$", library, re.M) and re.search(r"^Pcr 0\.\d+$", library, re.M)
    assert b"coat_roughness" in (tmp_path / "a.ply").read_bytes()[:2000]
    stock = (tmp_path / "stock/a.xml").read_text()
    assert stock.count('type="roughconductor"') == 2 and stock.count('type="blendbsdf"') == 2
    assert "cooktorrance" not in stock
    mi.load_file(str(tmp_path / "stock/a.xml"), parallel=False)


def test_the_stock_scene_is_the_same_sum():
    """Two blends of Mitsuba's own BSDFs, with the weights that the file has."""
    values = {"diffuse": np.array([BASE[0]]), "specular": np.array([BASE[1]]), "roughness": np.array([BASE[2]]),
              "coat": np.array([COAT[0]]), "coat_roughness": np.array([COAT[1]])}  # fmt: skip
    matte, gloss, widths, scale = gltf.shares(gltf.Values(COATED, values))
    assert scale == 1
    weight = float(gloss.sum())
    lobes = [
        {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": float(a)} for a in widths[0]
    ]
    both = {"type": "blendbsdf", "weight": float(gloss[0, 1]) / weight, "a": lobes[0], "b": lobes[1]}
    colour = {"type": "rgb", "value": (matte[0] / (1 - weight)).tolist()}
    stock = mi.load_dict({"type": "blendbsdf", "weight": weight, "a": {"type": "diffuse", "reflectance": colour},
                          "b": both})  # fmt: skip
    i, o = directions(300, 41), directions(300, 42)
    np.testing.assert_allclose(evaluate(stock, i, o), evaluate(coated(), i, o), rtol=1e-4, atol=1e-6)


def test_edits_of_highlights_change_both_lobes():
    ring = FittedObject(CENTER, 30.0, 0.05, parameters=(*COOK_TORRANCE, *COAT_PARAMETERS), bsdf=COATED)
    s = ring.domain.sample(1)[0]
    before = {name: value.clone() for name, value in ring.material(s).items()}
    edit_material(ring, MaterialOptions(specular_scale=3.0, roughness_add=0.1))
    after = ring.material(s)
    for name in ("specular", "coat"):
        torch.testing.assert_close(after[name], 3 * before[name])
    for name in ("roughness", "coat_roughness"):
        torch.testing.assert_close(after[name], before[name] + 0.1)


def test_a_network_that_predicts_more_predicts_the_same_of_the_rest():
    torch.manual_seed(5)
    net, s = BRDFNet(0.2), torch.nn.functional.normalize(torch.randn(7, 3), dim=1)
    before = net(s)
    net.add_parameters(COAT_PARAMETERS)
    after = net(s)
    for name, value in before.items():
        torch.testing.assert_close(after[name], value)
    assert (after["coat"] - 0.2 * np.log1p(np.exp(-3))).abs().max() < 1e-6
    assert (after["coat_roughness"] - 1 / (1 + np.exp(1.5))).abs().max() < 1e-6
    assert net.arguments()["parameters"][-1][0] == "coat_roughness"
