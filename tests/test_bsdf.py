"""The `cooktorrance` BSDF: equation 1 of the paper, its sampling, and the attributes that it reads."""

import re
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ring.bsdf import check_attributes

CONTEXT = mi.BSDFContext()

#: (diffuse, specular, roughness): dull, shiny, a mixture, one that is brighter than energy allows.
MATERIALS = {
    "dull": ([0.3, 0.1, 0.02], 0.0, 0.7),
    "shiny": ([0.0, 0.0, 0.0], 0.2, 0.15),
    "mixed": ([0.25, 0.2, 0.05], 0.1, 0.35),
    "bright": ([3.0, 2.0, 1.0], 1.5, 0.9),
}


def cooktorrance(diffuse, specular, roughness):
    return mi.load_dict({
        "type": "cooktorrance",
        "diffuse": {"type": "rgb", "value": list(diffuse)},
        "specular": float(specular),
        "roughness": float(roughness),
    })  # fmt: skip


def twin(i, o, diffuse, specular, r):
    """Equation 1 times n·i, slow and obvious: (N, 3) for directions (N, 3) in the frame of n = z."""
    n = np.array([0.0, 0.0, 1.0])
    h = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)

    def tan2(a):
        return 1 / (a @ n) ** 2 - 1

    def distribution(h):  # Walter et al. 2007, equation 33, without its 1 / π
        return r**2 / ((h @ n) ** 4 * (r**2 + tan2(h)) ** 2)

    def masking(a):  # equation 34
        return 2 / (1 + np.sqrt(1 + r**2 * tan2(a)))

    specular = specular * distribution(h) * masking(i) * masking(o) / (np.pi * (i @ n) * (o @ n))
    return (np.array(diffuse) + specular[:, None]) * (i @ n)[:, None]


def directions(count, seed, lowest=0.05):
    """Unit vectors (N, 3) of the upper hemisphere, none so grazing that equation 1 loses digits."""
    random = np.random.default_rng(seed)
    z, phi = random.uniform(lowest, 1, count), random.uniform(0, 2 * np.pi, count)
    return np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1)


def vectors(a):
    return mi.Vector3f(*a.T.astype(np.float32))


def interaction(o):
    """A surface interaction seen from `o` (N, 3) on the plane with normal z."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(o))
    si.wi = vectors(o)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    return si


def evaluate(bsdf, i, o):
    """BSDF · n·i as (N, 3)."""
    return np.array(bsdf.eval(CONTEXT, interaction(o), vectors(i))).T


# Values. float32 throughout: 1e-4 relative, as D raises small differences to the fourth power.


def test_equals_equation_1():
    random = np.random.default_rng(4)
    for seed in range(20):
        material = random.uniform(0, 2, 3), random.uniform(0, 1), random.uniform(0.05, 1)
        i, o = directions(200, seed), directions(200, 100 + seed)
        np.testing.assert_allclose(evaluate(cooktorrance(*material), i, o), twin(i, o, *material), rtol=5e-4, atol=1e-6)


@pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS)
def test_is_reciprocal_and_not_negative(material):
    i, o = directions(500, 1), directions(500, 2)
    there, back = evaluate(cooktorrance(*material), i, o), evaluate(cooktorrance(*material), o, i)
    np.testing.assert_allclose(there / i[:, 2:], back / o[:, 2:], rtol=1e-4, atol=1e-7)
    assert (there >= 0).all()


def test_is_lambert_without_specular():
    """π ρ is the albedo of the stock plugin."""
    i, o = directions(200, 3), directions(200, 4)
    diffuse = np.array([0.3, 0.1, 0.02])
    stock = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": (np.pi * diffuse).tolist()}})
    np.testing.assert_allclose(evaluate(cooktorrance(diffuse, 0, 0.4), i, o), evaluate(stock, i, o), rtol=1e-5)


@pytest.mark.parametrize("r", [0.08, 0.3, 0.8])
def test_specular_part_is_four_times_roughconductor(r):
    i, o = directions(500, 5), directions(500, 6)
    stock = mi.load_dict({"type": "roughconductor", "distribution": "ggx", "material": "none", "alpha": r})
    expected = 4 * 0.15 * evaluate(stock, i, o)
    np.testing.assert_allclose(evaluate(cooktorrance([0, 0, 0], 0.15, r), i, o), expected, rtol=5e-4, atol=1e-7)


def test_components_can_be_asked_for_one_by_one():
    bsdf, (i, o) = cooktorrance(*MATERIALS["mixed"]), (directions(50, 7), directions(50, 8))
    parts = []
    for component in (0, 1):
        context = mi.BSDFContext()
        context.component = component
        parts.append(np.array(bsdf.eval(context, interaction(o), vectors(i))).T)
    np.testing.assert_allclose(sum(parts), evaluate(bsdf, i, o), rtol=1e-5)
    np.testing.assert_allclose(parts[0], np.array(MATERIALS["mixed"][0]) * i[:, 2:], rtol=1e-5)


def test_is_black_from_below():
    up, down = directions(50, 9), directions(50, 10) * [1, 1, -1]
    bsdf = cooktorrance(*MATERIALS["mixed"])
    for i, o in ((up, down), (down, up), (down, down)):
        assert (evaluate(bsdf, i, o) == 0).all()
        assert (np.array(bsdf.pdf(CONTEXT, interaction(o), vectors(i))) == 0).all()


# Sampling.


@pytest.mark.parametrize("name", MATERIALS)
def test_samples_follow_the_density(name):
    """Chi-squared at a significance of 1 % over all materials (Šidák); the density integrates to 1."""
    diffuse, specular, r = MATERIALS[name]
    xml = f"""<rgb name="diffuse" value="{diffuse[0]}, {diffuse[1]}, {diffuse[2]}"/>
              <float name="specular" value="{specular}"/> <float name="roughness" value="{r}"/>"""
    wi = [0.48, -0.36, 0.8]
    sample, pdf = mi.chi2.BSDFAdapter("cooktorrance", xml, wi=wi)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(), sample_func=sample, pdf_func=pdf, sample_dim=3, sample_count=200_000, res=61
    )
    assert test.run(significance_level=0.01, test_count=len(MATERIALS)), test.messages


@pytest.mark.parametrize("name", MATERIALS)
def test_sampling_gives_the_albedo(name):
    """Mean weight = ∫ BSDF · cos, here by a fine sum over the hemisphere of the numpy twin."""
    count, o = 40_000, np.array([[0.48, -0.36, 0.8]])
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, count)
    bs, weight = cooktorrance(*MATERIALS[name]).sample(
        CONTEXT, interaction(np.repeat(o, count, 0)), sampler.next_1d(), sampler.next_2d()
    )
    weight = np.array(weight).T
    assert np.isfinite(weight).all()
    z, phi = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(800) + 0.5) / 400 * np.pi)
    i = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1).reshape(-1, 3)
    albedo = twin(i, np.repeat(o, len(i), 0), *MATERIALS[name]).mean(0) * 2 * np.pi
    noise = weight.std(0) / np.sqrt(count)
    assert (np.abs(weight.mean(0) - albedo) < 4 * noise + 2e-3 * albedo).all()  # 2e-3: the sum at 400 x 800 points
    component = np.array(bs.sampled_component)
    assert set(component[np.array(bs.pdf) > 0]) <= {0, 1}


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


@pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS)
def test_brightness_does_not_jump_across_the_rim(material):
    bsdf, i = cooktorrance(*material), np.array([[0.6, 0.0, 0.8]])
    inside, outside = seen_at(1e-4, 0.04, i, bsdf), seen_at(-1e-4, 0.04, i, bsdf)
    # The half vector turns by 1e-4, of which D, at a roughness of 0.15, makes at most 1 %.
    np.testing.assert_allclose(inside, outside, rtol=0.01)


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
    check_attributes(scene.shapes()[0])
    mi.render(scene, spp=1)
