"""Fits with other BSDFs than `cooktorrance`: which parameters are predicted, and what becomes of the scene."""

import math
import shutil

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.ellipsoid_points import ellipsoid_points
from PIL import Image

from mi_ring import fit
from mi_ring.capture import reflectance
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.nets.brdf_net import COOK_TORRANCE, ROUGH, BRDFNet
from mi_ring.nets.shape_net import ShapeNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface
from mi_ring.scene import xml_elements

QUICK = ["--levels", "3", "--widths", "56", "--shares", "1", "--iterations", "6", "--subdivisions", "3",
         "--domain", "sphere", "--refine", "none", "--no-indirect", "--detail", "none"]  # fmt: skip
PRINCIPLED = """<bsdf type="principled"><rgb name="base_color" value="0.3, 0.4, 0.5"/>
  <float name="roughness" value="0.6"/><float name="spec_tint" value="0.2"/><float name="eta" value="1.4"/></bsdf>"""
PREDICT = {"base_color": (0.0, 0.9), "roughness": (0.2, 1.0)}


@pytest.fixture
def scene(broken_capture):
    """The small capture with an object of a `principled` BSDF, and a function that edits it."""
    path, edit = broken_capture
    edit('<bsdf type="cooktorrance"/>', PRINCIPLED)
    return path, edit


def arguments(path, out):
    ranges = [str(v) for name, (low, high) in PREDICT.items() for v in (name, low, high)]
    return [str(path), "--out", str(out), *QUICK, "--parameters", *ranges]


def test_parameters_have_the_channels_of_their_constants_and_start_there(scene):
    loaded = load_capture(scene[0])
    (colour, rough), xml = reflectance.predicted_parameters(loaded, PREDICT)
    assert colour[:4] == ("base_color", 3, 0.0, 0.9) and rough[:4] == ("roughness", 1, 0.2, 1.0)
    assert 0.9 / (1 + math.exp(-colour.start)) == pytest.approx(0.4)  # the mean of the colour
    assert 0.2 + 0.8 / (1 + math.exp(-rough.start)) == pytest.approx(0.6)
    text = str(xml_elements.load_bsdf(xml))
    assert '"vertex_base_color"' in text and '"vertex_roughness"' in text and "vertex_spec_tint" not in text


def test_principled_is_fitted_and_opens_in_mitsuba(scene, tmp_path):
    """The result's own scene, rendered by stock Mitsuba, is what the fit predicts."""
    out = tmp_path / "run"
    assert fit.main(arguments(scene[0], out)) == 0
    ring = load_fit(out)
    assert [p.name for p in ring.brdf_net.bsdf_parameters] == list(PREDICT)
    saved = trimesh.load(out / "mesh.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    assert any("base_color" in name for name in saved.dtype.names)
    loaded = load_capture(out / "scene.xml")
    # As it stands in the file: the shape's own weights, without a ring given
    surface = Surface(loaded.scene, loaded.shape)
    predicted, _ = prediction.draw(surface, loaded.photograph(2), spp=256)
    stock = mi.render(loaded.scene, sensor=2, integrator=mi.load_dict({"type": "direct"}), spp=256)
    assert predicted.mean() > 0.01
    stock = np.maximum(np.array(stock)[..., :3], 0)  # a room that was found may be below 0 in places
    assert predicted.mean().item() == pytest.approx(float(stock.mean()), rel=0.01)


def test_the_material_of_a_run_goes_along_into_other_scenes(scene, small_capture, tmp_path):
    """Shown in a scene whose shape has another BSDF, the fitted object looks the same."""
    out = tmp_path / "run"
    assert fit.main([*arguments(scene[0], out), "--no-indirect", "--refine", "none"]) == 0
    ring, pictures = load_fit(out), []
    for path in (out / "scene.xml", small_capture):
        loaded = load_capture(path)
        surface = Surface(loaded.scene, loaded.shape, ring)
        surface.show(ring, *ring.domain.sample(3))
        pictures.append(prediction.draw(surface, loaded.photograph(4), spp=64)[0])
    torch.testing.assert_close(*pictures, rtol=1e-4, atol=1e-5)
    assert pictures[0].mean() > 0.01


@pytest.mark.parametrize("which", PREDICT)
def test_gradients_of_attributes_equal_finite_differences(scene, which):
    loaded = load_capture(scene[0])
    parameters, xml = reflectance.predicted_parameters(loaded, PREDICT)
    ring = FittedObject(*loaded.sphere(), 1.0, None, parameters, xml)
    surface = Surface(loaded.scene, loaded.shape, ring)
    s, faces = ring.domain.sample(3)
    surface.set_faces(faces)
    vertices = ring.surface(s).detach()
    x, y, _ = s.T
    material = {
        "base_color": torch.stack([0.4 + 0.2 * x, 0.3 + 0.1 * y, 0.5 - 0.2 * x], -1),
        "roughness": 0.5 + 0.2 * torch.sin(2 * y),
    }
    weight = 1 + torch.linspace(0, 1, 56)[:, None]

    def loss(change):
        moved = material | {which: material[which] + change}
        return (weight * prediction.render(surface, loaded.photograph(1), vertices, moved, 16, 3)[0]).sum()

    change = torch.zeros_like(material[which], requires_grad=True)
    loss(change).backward()
    direction = torch.rand(change.shape, generator=torch.Generator().manual_seed(1)) + 0.5
    difference = (loss(0.01 * direction) - loss(-0.01 * direction)) / 0.02
    assert abs(difference) > 0.1
    assert (change.grad * direction).sum().item() == pytest.approx(difference.item(), rel=5e-3)


def test_cooktorrance_keeps_its_distribution(broken_capture, tmp_path):
    path, edit = broken_capture
    given = '<bsdf type="cooktorrance"><string name="distribution" value="beckmann"/></bsdf>'
    edit('<bsdf type="cooktorrance"/>', given)
    assert fit.main([str(path), "--out", str(tmp_path / "run"), *QUICK]) == 0
    assert "beckmann" in load_fit(tmp_path / "run").bsdf
    assert "beckmann" in str(mi.load_file(str(tmp_path / "run" / "scene.xml"), parallel=False).shapes()[0].bsdf())


def test_part_of_cooktorrance(broken_capture):
    """What the XML leaves to mesh attributes needs no starting value."""
    path, edit = broken_capture
    edit('<bsdf type="cooktorrance"/>', '<bsdf type="cooktorrance"><float name="specular" value="0.05"/></bsdf>')
    loaded = load_capture(path)
    parameters, xml = reflectance.predicted_parameters(loaded, {"diffuse": (0, math.inf), "roughness": (0.1, 1)})
    assert [p.channels for p in parameters] == [3, 1]
    assert "vertex_specular" not in str(xml_elements.load_bsdf(xml))
    # Without ranges: all but the constant.
    assert [p.name for p in reflectance.predicted_parameters(loaded, {})[0]] == ["diffuse", "roughness"]
    with pytest.raises(InputError, match="nothing writes vertex_roughness, which cooktorrance reads"):
        reflectance.predicted_parameters(loaded, {"diffuse": (0, 1)})


def test_rough_matte_surfaces_unless_the_scene_says_how_rough(broken_capture):
    path, edit = broken_capture
    parameters, xml = reflectance.predicted_parameters(load_capture(path), {}, rough=True)
    assert [p.name for p in parameters] == ["diffuse", "specular", "roughness", "diffuse_roughness"]
    assert len(reflectance.predicted_parameters(load_capture(path), {})[0]) == 3
    given = '<bsdf type="cooktorrance"><float name="diffuse_roughness" value="0.2"/></bsdf>'
    edit('<bsdf type="cooktorrance"/>', given)
    parameters, xml = reflectance.predicted_parameters(load_capture(path), {}, rough=True)
    assert [p.name for p in parameters] == ["diffuse", "specular", "roughness"]
    assert "0.2" in xml


def test_given_networks_keep_their_parameters(broken_capture):
    """A network of the paper's five numbers is not asked for a sixth, and one of six keeps it."""
    capture, settings = load_capture(broken_capture[0]), Config(domain="sphere")
    assert len(Fit(capture, settings).ring.brdf_net.bsdf_parameters) == 4
    lambert = Fit(capture, Config(domain="sphere", diffuse="lambert"))
    assert len(lambert.ring.brdf_net.bsdf_parameters) == 3
    for parameters in (COOK_TORRANCE, (*COOK_TORRANCE, ROUGH)):
        networks = (ShapeNet(), BRDFNet(1.0, parameters))
        fit = Fit(capture, settings, networks)
        assert [p.name for p in fit.ring.brdf_net.bsdf_parameters] == [p.name for p in parameters]


WRONG = {
    "no parameters": ({}, "--parameters must say which.* of principled to predict.*base_color"),
    "unknown": ({"colour": (0, 1)}, "principled has no texture colour; it has .*base_color"),
    "a plain number": ({"eta": (1, 2)}, "principled has no texture eta"),
    "upside down": ({"roughness": (1, 0)}, "range is 1 to 0, must be from lower to higher"),
    "nan": ({"roughness": (math.nan, 1)}, "range is nan to 1"),
    "nothing to start from": ({"metallic": (0, 1)}, "metallic: has no value"),
}


@pytest.mark.parametrize("ranges, message", WRONG.values(), ids=WRONG)
def test_wrong_parameters_are_refused_in_one_line(scene, ranges, message):
    loaded = load_capture(scene[0])
    with pytest.raises(InputError, match=message) as caught:
        reflectance.predicted_parameters(loaded, ranges)
    assert "\n" not in str(caught.value)


REFUSED = {
    "": "has no <bsdf>",
    """<bsdf type="principled"><rgb name="base_color" value="0.5"/>
    <texture name="roughness" type="bitmap"><string name="filename" value="images/000.png"/></texture></bsdf>""":
        "<string> images/000.png: a fit takes BSDFs without files and references",
    """<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse" name="a"/><bsdf type="diffuse"
    name="b"/></bsdf>""": "blendbsdf has more than one texture reflectance",
    """<bsdf type="cooktorrance"><rgb name="diffuse" value="0.5"/><float name="specular" value="0"/>
    <float name="roughness" value="0.5"/></bsdf>""": "every parameter of cooktorrance is a constant",
    """<include filename="other.xml"/><bsdf type="cooktorrance"/>""": "<include>: a fit needs a scene without it",
}  # fmt: skip


@pytest.mark.parametrize("xml", REFUSED, ids=REFUSED.values())
def test_unfit_bsdfs_are_refused_in_one_line(broken_capture, xml):
    path, edit = broken_capture
    (path.parent / "other.xml").write_text('<scene version="3.0.0"/>')
    edit('<bsdf type="cooktorrance"/>', xml)
    loaded = load_capture(path)
    with pytest.raises(InputError, match=REFUSED[xml]) as caught:
        reflectance.predicted_parameters(loaded, {"reflectance": (0.0, 1.0)} if "blend" in xml else {})
    assert "\n" not in str(caught.value)


def test_bsdf_by_reference(broken_capture, tmp_path):
    """The result opens, though the BSDF is now there twice."""
    path, edit = broken_capture
    edit('<bsdf type="cooktorrance"/>', '<ref id="paint"/>')
    edit('<shape type="shapenet"', PRINCIPLED.replace("<bsdf", '<bsdf id="paint"') + '<shape type="shapenet"')
    assert fit.main(arguments(path, tmp_path / "run")) == 0
    (shape,) = mi.load_file(str(tmp_path / "run" / "scene.xml"), parallel=False).shapes()
    assert '"vertex_base_color"' in str(shape.bsdf())


def roughened(scene, folder, sigma):
    """A copy of the small capture whose ellipsoid is a rough matte surface, by rays and normals in closed form."""
    shutil.copytree(scene.parent, folder)
    for shot in load_capture(scene).shots:
        width, height = shot.size
        _, _, n, i, o = ellipsoid_points(shot)
        n_i, n_o = ((n * x).sum(1).clip(0.02) for x in (i, o))
        beside = (i * o).sum(1) - n_i * n_o
        factor = (1 + sigma * beside / np.where(beside > 0, np.maximum(n_i, n_o), 1)) / (1 + 0.288 * sigma)
        path = folder / "images" / shot.file_name
        radiance = srgb_to_linear(np.asarray(Image.open(path)) / 255) * factor.reshape(height, width, 1)
        Image.fromarray(to_bytes(linear_to_srgb(radiance))).save(path)
    return folder / scene.name


@pytest.mark.parametrize(("sigma", "low", "high"), [(0.0, 0.0, 0.05), (0.4, 0.3, 0.5)], ids=["lambert", "rough"])
def test_a_fit_finds_how_rough_a_matte_surface_is(small_capture, tmp_path, sigma, low, high):
    capture = load_capture(roughened(small_capture, tmp_path / "rough", sigma))
    settings = Config(iterations=60, levels=(3,), widths=(56,), shares=(1,), batch=4, detail="none", refine=("none",),
                      indirect=False, lobes="1")  # fmt: skip
    ring = Fit(capture, settings).run()
    with torch.no_grad():
        found = ring.brdf_net(ring.domain.sample(3)[0])["diffuse_roughness"]
    assert low <= found.mean() <= high
