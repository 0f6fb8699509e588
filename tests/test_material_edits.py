"""`mi_ring.objects.material_edits`: one run's BRDF on another's shape, edited, against networks evaluated by hand."""

import math

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh

from mi_ring import export, render
from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.nets.brdf_net import Parameter
from mi_ring.nets.shape_net import ShapeNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions, edit_material
from mi_ring.objects.ring_file import ring_state

PRINCIPLED = """<bsdf type="principled">
  <texture name="base_color" type="mesh_attribute"><string name="name" value="vertex_base_color"/></texture>
  <texture name="roughness" type="mesh_attribute"><string name="name" value="vertex_roughness"/></texture>
  <float name="specular" value="0.5"/></bsdf>"""
PREDICTED = (Parameter("base_color", 3, 0.0, 0.9), Parameter("roughness", 1, 0.2, 0.8))
METAL = """<bsdf type="roughconductor">
  <texture name="specular_reflectance" type="mesh_attribute">
    <string name="name" value="vertex_specular_reflectance"/></texture>
  <float name="alpha" value="0.2"/></bsdf>"""


def wild(seed, **properties):
    """A ring whose shape and material are uneven."""
    torch.manual_seed(seed)
    ring = FittedObject(**{"center": [40.0, -15.0, 9.0], "radius": 3.0, "steps": 6, "subdivisions": 3} | properties)
    ring.shape_net.output.weight.data.normal_(0, 0.03)
    for parameter in ring.brdf_net.parameters():
        parameter.data.mul_(3)
    return ring


def mesh_domain(stretch=1.0):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    return Domain(ring.vertices * [1, 1, stretch], ring.faces)


def save(ring, path):
    torch.save(ring_state(ring, {"subdivisions": ring.subdivisions}), path)
    return path


S = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)))


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# Exchange


def test_its_own_material_changes_nothing(tmp_path):
    ring = wild(1)
    edit_material(ring, MaterialOptions(material=save(ring, tmp_path / "ring.pt")))
    again = wild(1)
    assert torch.equal(ring.surface(S), again.surface(S)) and equal(ring.brdf_net(S), again.brdf_net(S))


@pytest.mark.parametrize("mesh", [False, True])
def test_anothers_material_is_on_this_shape(tmp_path, mesh):
    def domain():
        return mesh_domain() if mesh else None

    ring, other = wild(1, domain=domain()), wild(2, domain=domain(), center=[0.0, 0, 0], radius=70.0, scale=12.0)
    (tmp_path / "other").mkdir()
    save(other, tmp_path / "other" / "ring.pt")
    edit_material(ring, MaterialOptions(material=tmp_path / "other"))
    before = wild(1, domain=domain())
    assert torch.equal(ring.surface(S), before.surface(S)) and not torch.equal(ring.surface(S), other.surface(S))
    assert equal(ring.brdf_net(S), other.brdf_net(S)) and not equal(ring.brdf_net(S), before.brdf_net(S))


def test_another_bsdf_comes_along(tmp_path):
    save(wild(1, indirect=True), tmp_path / "shape.pt")
    other = wild(2, parameters=PREDICTED, bsdf=PRINCIPLED)
    save(other, tmp_path / "other.pt")
    export.main([str(tmp_path / "shape.pt"), str(tmp_path / "a.ply"), "--material", str(tmp_path / "other.pt")])
    ply = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "a.ply")}))
    s, _ = other.domain.sample(3)
    np.testing.assert_allclose(np.array(ply["vertex_positions"]).reshape(-1, 3), wild(1).surface(s).detach(), rtol=1e-6)
    for name, value in other.brdf_net(s).items():
        np.testing.assert_allclose(np.array(ply[f"vertex_{name}"]), value.detach().ravel(), rtol=1e-6)
    assert "vertex_diffuse" not in ply
    ring = wild(1, indirect=True)
    edit_material(ring, MaterialOptions(material=tmp_path / "other.pt"))
    assert ring.bsdf == PRINCIPLED and not ring.indirect


def test_pictures_of_a_shape_in_anothers_bsdf(small_capture, tmp_path):
    """As the same networks in one file."""
    place = {"center": [400.0, -150.0, 90.0], "radius": 24.0}
    shape, other = wild(1, **place), wild(2, parameters=PREDICTED, bsdf=PRINCIPLED)
    both = wild(2, parameters=PREDICTED, bsdf=PRINCIPLED, **place)
    both.shape_net = shape.shape_net
    paths = [save(ring, tmp_path / f"{k}.pt") for k, ring in enumerate((shape, other, both))]
    common = [str(small_capture), "--spp", "4", "--format", "exr"]
    render.main([str(paths[0]), *common[:1], str(tmp_path / "a"), *common[1:], "--material", str(paths[1])])
    render.main([str(paths[2]), *common[:1], str(tmp_path / "b"), *common[1:]])
    for k in (0, 7):
        a, b = (np.array(mi.Bitmap(str(tmp_path / folder / f"{k:03}.exr"))) for folder in "ab")
        np.testing.assert_array_equal(a, b)
        assert a.max() > 0.01


@pytest.mark.parametrize(
    ("one", "two", "which"),
    [
        (None, mesh_domain(), "1.pt: --material: "),
        (mesh_domain(), None, "--material: the shape"),
        (mesh_domain(), mesh_domain(1.1), "--material: the shape"),
    ],
    ids=["mesh on sphere", "sphere on mesh", "another mesh"],
)
def test_materials_of_other_domains_with_handles_are_refused(tmp_path, one, two, which):
    paths = [save(wild(k, domain=domain), tmp_path / f"{k}.pt") for k, domain in enumerate((one, two))]
    for main, to in ((render.main, "scene.xml out"), (export.main, "file.ply")):
        with pytest.raises(InputError) as error:
            main([str(paths[0]), *to.split(), "--material", str(paths[1])])
        message = str(error.value)
        assert "\n" not in message and which in message and "of 1 handles" in message and "--domain" in message


def test_a_material_of_another_start_is_carried_by_way_of_the_sphere(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=5)
    domains = [Domain(ball.vertices * axes, ball.faces) for axes in ([1, 1, 1.02], [2, 2, 2])]
    ring, other = wild(1, domain=domains[0]), wild(2, domain=domains[1])
    edit_material(ring, MaterialOptions(material=save(other, tmp_path / "other.pt")))
    # Nearly spheres both: each point corresponds to that in the same direction.
    s = domains[0].sample(3)[0]
    for name, value in other.brdf_net(2 * torch.nn.functional.normalize(s)).items():
        assert (ring.brdf_net(s)[name] - value).abs().mean() < 0.03 * value.std(), name


# Edits


def test_edits_are_what_they_say():
    ring, plain = wild(1), wild(1).brdf_net(S)
    edit_material(ring, MaterialOptions(specular_scale=2.0, roughness_add=0.5, tint=(0.5, 1.0, 3.0)))
    edited = ring.brdf_net(S)
    torch.testing.assert_close(edited["diffuse"], plain["diffuse"] * torch.tensor([0.5, 1, 3]))
    torch.testing.assert_close(edited["specular"], 2 * plain["specular"])
    torch.testing.assert_close(edited["roughness"], (plain["roughness"] + 0.5).clamp(max=1))
    assert (edited["roughness"] == 1).any() and (edited["roughness"] < 0.9).any()
    assert edited["specular"].shape == (200,)


def test_edits_stay_in_the_ranges_of_the_fit():
    ring, plain = wild(1, parameters=PREDICTED, bsdf=PRINCIPLED), wild(1, parameters=PREDICTED).brdf_net(S)
    edit_material(ring, MaterialOptions(roughness_add=-0.25, tint=(9.0, 1.0, 0.0)))
    edited = ring.brdf_net(S)
    torch.testing.assert_close(edited["roughness"], (plain["roughness"] - 0.25).clamp(min=0.2))
    assert (edited["roughness"] == 0.2).any() and edited["roughness"].max() > 0.3
    assert edited["base_color"][:, 0].max().item() == pytest.approx(0.9) and (edited["base_color"][:, 2] == 0).all()
    assert torch.equal(edited["base_color"][:, 1], plain["base_color"][:, 1])


def test_two_edits_of_one_parameter_are_both_made():
    """The reflectance of a metal is its highlight and its colour."""
    metal = [Parameter("specular_reflectance", 3, 0.0, math.inf)]
    ring, plain = wild(1, parameters=metal, bsdf=METAL), wild(1, parameters=metal).brdf_net(S)
    edit_material(ring, MaterialOptions(specular_scale=0.5, tint=(1.0, 0.2, 3.0)))
    torch.testing.assert_close(
        ring.brdf_net(S)["specular_reflectance"], plain["specular_reflectance"] * torch.tensor([0.5, 0.1, 1.5])
    )


def test_no_edit_is_none():
    ring = wild(1)
    net = ring.brdf_net
    edit_material(ring, MaterialOptions())
    assert ring.brdf_net is net


def test_another_material_is_edited_as_it_is(tmp_path):
    ring, other = wild(1), wild(2)
    edit_material(ring, MaterialOptions(material=save(other, tmp_path / "other.pt"), specular_scale=3.0))
    torch.testing.assert_close(ring.brdf_net(S)["specular"], 3 * other.brdf_net(S)["specular"])
    assert torch.equal(ring.brdf_net(S)["diffuse"], other.brdf_net(S)["diffuse"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"specular_scale": -1.0}, ["--specular-scale", "-1", "0 or more"]),
        ({"specular_scale": math.inf}, ["--specular-scale", "inf"]),
        ({"roughness_add": math.nan}, ["--roughness-add", "nan", "a number"]),
        ({"tint": (1.0, -0.1, 1.0)}, ["--tint", "-0.1", "0 or more"]),
        ({"tint": (1.0, math.nan, 1.0)}, ["--tint", "nan"]),
    ],
)
def test_an_edit_that_is_none_is_one_line(options, words):
    with pytest.raises(InputError) as error:
        edit_material(wild(1), MaterialOptions(**options))
    assert "\n" not in str(error.value) and all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize(
    ("options", "word"),
    [({"specular_scale": 2.0}, "--specular-scale"), ({"roughness_add": 0.1}, "--roughness-add"),
     ({"tint": (1.0, 0.5, 1.0)}, "--tint")],
)  # fmt: skip
def test_an_edit_of_what_a_material_lacks_names_what_it_has(options, word):
    haze = [Parameter("haze", 1, 0.0, 1.0), Parameter("flatness", 1, 0.0, 1.0)]
    with pytest.raises(InputError, match=f"^{word}: .*haze, flatness"):
        edit_material(wild(1, parameters=haze), MaterialOptions(**options))


# The flow at any time, and the domain's nearest points, on which films and exports rest


@pytest.mark.parametrize("steps", [1, 7, 20, 49])
def test_the_flow_at_any_time_is_that_of_its_euler_steps(steps):
    torch.manual_seed(5)
    net = ShapeNet(steps=steps)
    net.output.weight.data.mul_(100)
    with torch.no_grad():
        way = [S]
        for _ in range(steps):
            way.append(way[-1] + net.velocity(way[-1]) / steps)
        assert (way[-1] - way[0]).norm(dim=1).max() > 0.1
        assert torch.equal(net(S, 0.0), S) and torch.equal(net(S, 1.0), net.flow(S, steps))
        assert torch.equal(net(S, 1.0), net(S))
        for k, expected in enumerate(way):
            torch.testing.assert_close(net(S, k / steps), expected, rtol=1e-4, atol=1e-5)
        for k in {0, steps // 2, steps - 1}:
            torch.testing.assert_close(net(S, (k + 0.3) / steps), 0.7 * way[k] + 0.3 * way[k + 1], rtol=1e-4, atol=1e-5)


def test_a_surface_at_a_time_is_in_scene_units():
    ring = wild(1)
    with torch.no_grad():
        expected = torch.tensor([40.0, -15, 9]) + 3 * (S + ring.shape_net.velocity(S) / 12)
        torch.testing.assert_close(ring.surface(S, 1 / 12), expected)


def test_projection_onto_a_domain_is_the_nearest_point():
    """Of all triangles the nearest, one by one."""
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    points = np.random.default_rng(3).uniform(-1.6, 1.6, (40, 3))
    found = Domain(mesh.vertices, mesh.faces).project(points)
    triangles, pairs = np.tile(mesh.triangles, (40, 1, 1)), np.repeat(points, len(mesh.faces), axis=0)
    all_of = trimesh.triangles.closest_point(triangles, pairs).reshape(40, -1, 3)
    distance = np.linalg.norm(all_of - points[:, None], axis=-1)
    np.testing.assert_allclose(found, all_of[np.arange(40), distance.argmin(1)], atol=1e-5)
    np.testing.assert_allclose(Sphere().project(np.array([[3.0, 0, -4]])), [[0.6, 0, -0.8]])
