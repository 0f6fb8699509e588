"""The plugin `fine_attribute`: factors on lattices in triangles, in Mitsuba's own integrators and in ours."""

import gc
import xml.etree.ElementTree as ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_ring.geometry.camera import Camera
from mi_ring.nets.brdf_net import COOK_TORRANCE, MaterialNet, Parameter
from mi_ring.objects.detail import Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.plugins import fine_attribute
from mi_ring.scene import mesh_texture
from mi_ring.scene.lights import Light
from mi_ring.scene.mesh_attributes import fine_textures
from mi_ring.scene.mesh_texture import Lattice, divisions_for, factors_at, lattice_points, write_texture
from mi_ring.scene.xml_elements import with_fine_attribute
from mi_ring.system.files import write_state

COLOUR = {"type": "fine_attribute", "name": "vertex_diffuse"}
KINDS = {
    "cooktorrance": {"type": "cooktorrance"},
    "principled": {"type": "principled", "base_color": COLOUR, "roughness": 0.8},
    "nested": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": COLOUR}},
}
SIZE = 48


@pytest.fixture(autouse=True)
def no_scenes_left():
    """Some of these tests leave a scene, but take too little time for conftest.py to look for it."""
    yield
    gc.collect()


def sphere(bsdf, level=1):
    return mi.load_dict({"type": "shapenet", "subdivisions": level, "flash": False, "bsdf": bsdf})


def triangles(shape):
    params = mi.traverse(shape)
    points, faces = (np.array(params[name]).reshape(-1, 3) for name in ("vertex_positions", "faces"))
    return torch.from_numpy(points.astype(np.float32)), faces


class Coloured(MaterialNet):
    """A material whose texture is a function of the point."""

    def __init__(self, texture, cell, parameters=COOK_TORRANCE):
        super().__init__(parameters)
        self.function, self.cell = texture, cell

    def texture(self, s):
        return self.function(s)

    def texture_cell(self):
        return self.cell


def waves(s):
    return 1 + 0.3 * torch.sin(5 * s + torch.tensor([0.0, 1.0, 2.0]))


def picture(shape, spp=64, **integrator):
    camera = {"type": "perspective", "fov": 40, "sampler": {"type": "independent", "seed": 3},
              "to_world": mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0]),
              "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}}  # fmt: skip
    lights = {"type": "point", "position": [2, 2, 3], "intensity": 20.0}
    scene = {"type": "scene", "shape": shape, "camera": camera, "light": lights,
             "integrator": integrator or {"type": "path", "max_depth": 2}}  # fmt: skip
    return np.array(mi.render(mi.load_dict(scene), spp=spp))[..., :3]


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_of_stock_integrators_have_the_texture(kind):
    """The ratio of pictures with and without it is its value where the ray meets the surface: here at most 2 % off."""
    shape = sphere(KINDS[kind], 3)
    plain = picture(shape)
    write_texture(shape, Coloured(waves, 0.02), *triangles(shape))
    ratio = picture(shape) / np.maximum(plain, 1e-6)
    where = picture(sphere({"type": "diffuse"}, 3), spp=1, type="aov", aovs="p:position")
    solid = (plain.min(-1) > 0.3 * plain.max()) & (np.linalg.norm(where, axis=-1) > 0.9)
    expected = waves(torch.from_numpy(where[solid])).numpy()
    assert solid.sum() > 400
    assert np.ptp(expected, 0).min() > 0.4
    tolerance = 0.1 if kind == "principled" else 0.05  # it has highlights, and pixels show more than one point
    assert np.abs(ratio[solid] - expected).mean() < tolerance / 3
    assert np.quantile(np.abs(ratio[solid] - expected), 0.95) < tolerance


@pytest.mark.parametrize("divisions", [1, 2, 5])
def test_linear_functions_are_reproduced(divisions):
    """Anywhere in a triangle; with random factors of the corners, which no symmetry helps."""
    shape = sphere(KINDS["cooktorrance"], 0)
    rng = np.random.default_rng(divisions)
    _, faces = triangles(shape)
    corners = rng.uniform(0.5, 2, (len(faces), 3, 3)).astype(np.float32)
    factors = np.einsum("nk,fkc->fnc", lattice_points(divisions).numpy(), corners)
    own = Lattice(mi.Float(factors.ravel()), divisions, 0.0, np.inf)
    triangle, place = rng.integers(len(faces), size=500), rng.uniform(size=(500, 2)).astype(np.float32)
    place = np.where(place.sum(1, keepdims=True) > 1, 1 - place, place)
    place[:200, 1] = 1 - place[:200, 0]  # at the edge, where rounding decides
    triangle[:100] = len(faces) - 1
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    si.prim_index, si.uv = mi.UInt32(triangle.astype(np.uint32)), mi.Point2f(place.T)
    padded = Lattice(mi.Float([*factors.ravel(), *[np.nan] * 300]), divisions, 0.0, np.inf)
    assert np.isfinite(np.array(fine_attribute.factor(padded, si, mi.Bool(True)))).all()  # none is read beside them
    found = np.array(fine_attribute.factor(own, si, mi.Bool(True))).T
    shares = np.column_stack([1 - place.sum(1), place])
    np.testing.assert_allclose(found, np.einsum("nk,nkc->nc", shares, corners[triangle]), rtol=1e-4)


def test_gradients_reach_the_factors():
    """By `mi.render`: factors times gradients are the matte light, the difference to the picture of a black object."""
    shape = sphere(KINDS["nested"], 0)
    write_texture(shape, Coloured(waves, 0.5), *triangles(shape))
    scene = mi.load_dict({
        "type": "scene", "shape": shape, "light": {"type": "constant"}, "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
    })  # fmt: skip
    params = mi.traverse(scene)
    (key,) = [name for name, _ in params if name.endswith("factors")]
    factors = np.array(params[key]).reshape(-1, 3)
    dr.enable_grad(params[key])
    params.update()
    light = mi.render(scene, params, spp=256, seed=1)
    dr.backward(dr.mean(light[..., 1], axis=None))
    gradient = np.array(dr.grad(params[key])).reshape(-1, 3)
    params[key] = 0 * factors.ravel()
    params.update()
    matte = np.array(light - mi.render(scene, spp=256, seed=1))[..., 1].mean()
    assert (gradient[:, 1] * factors[:, 1]).sum() == pytest.approx(matte, rel=0.02)
    assert (gradient[:, 1] != 0).sum() > 0.3 * len(gradient)
    assert not gradient[:, [0, 2]].any()


@pytest.fixture(scope="module")
def textured(tmp_path_factory):
    """A saved sphere with a random texture."""
    ring = FittedObject(np.zeros(3), 1.0, subdivisions=4)
    with torch.no_grad():
        for parameter in ring.parameters():
            parameter.zero_()
    s, _ = ring.domain.sample(4)
    grid = Grid.around(s, 0.1, 1, 3)
    grid.values[0].data = torch.rand(grid.values[0].shape, generator=torch.Generator().manual_seed(1)) - 0.5
    ring.brdf_net = SharpenedMaterial.of(ring.brdf_net, grid)
    file = tmp_path_factory.mktemp("textured") / "ring.pt"
    write_state(ring_state(ring), file)
    return file


def test_a_saved_fit_shows_its_texture_in_a_scene_of_ones_own(textured):
    """In `<shape type="shapenet">` by the path tracer, as `mi_ring.rendering` draws it."""
    ring = load_fit(textured)
    options = {"type": "shapenet", "weights": str(textured), "subdivisions": 4, "flash": False}
    shape = mi.load_dict(options | {"bsdf": {"type": "cooktorrance"}})
    (texture,) = fine_textures(shape.bsdf())
    (lattice,) = texture.lattices.values()
    assert lattice.divisions == divisions_for(*ring.domain.sample(4), 0.1)
    values = np.array(lattice.factors).reshape(len(triangles(shape)[1]), -1, 3)
    points, faces = ring.domain.sample(4)
    with torch.no_grad():
        np.testing.assert_allclose(values[:, 0], ring.brdf_net.texture(points)[faces[:, 0]], rtol=1e-4)

    pose = np.array(mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0]).matrix)
    focal = SIZE / 2 / np.tan(np.radians(20))
    camera = Camera(pose, np.full(2, focal), np.full(2, SIZE / 2), (SIZE, SIZE))
    light = Light("point", np.array([2.0, 2, 3]), np.full(3, 20.0))
    expected = ring.render(camera, light, spp=256).detach().numpy()
    fine = picture(shape, 256)
    ring.brdf_net = ring.brdf_net.base
    smooth = ring.render(camera, light, spp=256).detach().numpy()
    lit = smooth > 0.2 * smooth.max()
    assert np.abs(fine - expected)[lit].mean() < 0.02 * smooth[lit].mean()
    assert np.abs(smooth - expected)[lit].mean() > 0.08 * smooth[lit].mean()


def test_there_are_as_many_points_as_the_detail_needs_and_memory_allows(monkeypatch):
    """An icosahedron in the unit sphere has edges of 1.0515."""
    points, faces = triangles(sphere(KINDS["cooktorrance"], 0))
    assert divisions_for(points, faces, 0.1) == 11
    assert divisions_for(points, faces, 5.0) == 1
    monkeypatch.setattr("mi_ring.scene.mesh_texture.MOST", 200)  # for 20 triangles
    n = divisions_for(points, faces, 0.1)
    assert 20 * (n + 1) * (n + 2) / 2 == 200


def test_factors_of_another_number_are_refused():
    shape = sphere({"type": "cooktorrance"})
    s, faces = triangles(shape)
    write_texture(shape, Coloured(lambda s: 1 + 0 * s, 0.1), s, faces)
    params = mi.traverse(shape)
    (key,) = (name for name, _ in params if name.endswith("factors"))
    needed = len(params[key])
    params[key] = mi.Float(np.ones(needed - 3, np.float32))
    with pytest.raises(ValueError, match=f"factors: has {needed - 3} numbers, must have {needed}: three"):
        params.update()
    assert needed == 3 * len(faces) * len(lattice_points(fine_textures(shape.bsdf())[0].lattices[shape].divisions))


def test_a_name_is_needed():
    with pytest.raises(RuntimeError, match="name is missing"):
        mi.load_dict({"type": "fine_attribute"})


def test_a_mirrored_fit_shows_its_texture_mirrored(textured):
    """The mirror turns the corners of triangles around."""
    options = {"type": "shapenet", "weights": str(textured), "subdivisions": 4, "flash": False}
    options["bsdf"] = {"type": "cooktorrance"}
    flip = mi.ScalarTransform4f().scale([-1, 1, 1])
    plain, mirrored = (mi.load_dict(options | more) for more in ({}, {"to_world": flip}))
    places = mi.Point3f([0.3, -0.5, 0.1], [0.2, 0.4, -0.8], [4.0, 4.0, 4.0])
    colours = []
    for shape, sign in ((plain, 1), (mirrored, -1)):
        scene = mi.load_dict({"type": "scene", "shape": shape})
        ray = mi.Ray3f(mi.Point3f(sign * places.x, places.y, places.z), mi.Vector3f(0, 0, -1))
        (texture,) = fine_textures(shape.bsdf())
        colours.append(np.array(texture.eval_3(scene.ray_intersect(ray), mi.Bool(True))))
    np.testing.assert_allclose(colours[1], colours[0], rtol=1e-4)
    assert np.ptp(colours[0], 1).min() > 0.01


def test_shapes_that_share_a_bsdf_have_their_own_textures():
    """Mitsuba gives equal BSDFs of a scene to all shapes, also to those without a fit."""
    scene = mi.load_dict({
        "type": "scene", "a": {"type": "shapenet", "subdivisions": 2, "flash": False, "bsdf": {"type": "cooktorrance"}},
        "b": {"type": "shapenet", "subdivisions": 1, "flash": False, "center": [3, 0, 0],
              "bsdf": {"type": "cooktorrance"}},
        "c": {"type": "shapenet", "subdivisions": 1, "flash": False, "center": [6, 0, 0],
              "bsdf": {"type": "cooktorrance"}},
    })  # fmt: skip
    a, b, c = scene.shapes()
    assert a.bsdf() is b.bsdf() is c.bsdf()
    for shape, factor in ((a, 0.5), (b, 1.5)):
        write_texture(shape, Coloured(lambda s, f=factor: torch.full_like(s, f), 0.1), *triangles(shape))
    ray = mi.Ray3f(mi.Point3f([0.2, 3.2, 6.2], 0.1, 4), mi.Vector3f(0, 0, -1))
    (texture,) = fine_textures(a.bsdf())
    colours = np.array(texture.eval_3(scene.ray_intersect(ray), mi.Bool(True)))
    np.testing.assert_allclose(colours, np.tile([0.25, 0.75, 0.5], (3, 1)), rtol=1e-5)
    names = {name.rpartition(".")[2] for name, _ in mi.traverse(scene) if "factors" in name}
    assert names == {"factors_a", "factors_b"}
    write_texture(a, MaterialNet(), *triangles(a))
    colours = np.array(texture.eval_3(scene.ray_intersect(ray), mi.Bool(True)))
    np.testing.assert_allclose(colours, np.tile([0.5, 0.75, 0.5], (3, 1)), rtol=1e-5)


def test_colours_stay_in_their_range_and_only_the_albedo_changes():
    """A base colour of 0.5 times 3 is 1. The other attribute is no albedo."""
    other = {"type": "fine_attribute", "name": "vertex_shine"}
    shape = sphere(KINDS["cooktorrance"], 1)
    shape.add_attribute("vertex_shine", 3, np.full(3 * shape.vertex_count(), 0.5, np.float32))
    shape.set_bsdf(mi.load_dict({
        "type": "blendbsdf", "weight": 0.5, "a": {"type": "diffuse", "reflectance": COLOUR},
        "b": {"type": "conductor", "specular_reflectance": other},
    }))  # fmt: skip
    net = Coloured(lambda s: torch.full_like(s, 3.0), 0.1, (Parameter("diffuse", 3, 0.0, 1.0),))
    write_texture(shape, net, *triangles(shape))
    albedo, shine = sorted(fine_textures(shape.bsdf()), key=lambda texture: texture.attribute)
    scene = mi.load_dict({"type": "scene", "shape": shape})
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.2, 4), mi.Vector3f(0, 0, -1)))
    np.testing.assert_allclose(np.array(albedo.eval_3(si, mi.Bool(True))).ravel(), 1)
    assert not len(shine.lattices)


def test_coarse_meshes_of_the_sphere_have_the_whole_texture(textured):
    """The middle of a large triangle is far below the sphere, where the texture has no values."""
    ring = load_fit(textured)
    s, faces = ring.domain.sample(1)
    with torch.no_grad():
        ring.brdf_net.grid.values[0].fill_(np.log(2))
    found = factors_at(ring.brdf_net, s, faces, 8)
    np.testing.assert_allclose(found, 2, rtol=1e-5)


def test_a_texture_is_computed_once_for_many_pictures(textured, monkeypatch):
    ring, shape, calls = load_fit(textured), sphere(KINDS["cooktorrance"], 2), []
    made = mesh_texture.factors_at
    monkeypatch.setattr(mesh_texture, "factors_at", lambda *args: calls.append(1) or made(*args))
    s, faces = ring.domain.sample(2)
    for _ in range(2):
        write_texture(shape, ring.brdf_net, s, faces)
    assert len(calls) == 1
    with torch.no_grad():
        ring.brdf_net.grid.values[0].mul_(2)
    write_texture(shape, ring.brdf_net, s, faces)
    write_texture(shape, ring.brdf_net, *ring.domain.sample(1))
    assert len(calls) == 3
    for seed in range(4):  # points that are gone leave their memory to others
        write_texture(shape, ring.brdf_net, *ring.domain.sample(2, torch.Generator().manual_seed(seed)))
    assert len(calls) == 7


def test_a_bsdf_with_its_own_mesh_attribute_shows_the_texture():
    """A scene may name the attribute itself; the object that is drawn reads it finely."""
    xml = ('<bsdf type="twosided"><bsdf type="principled"><texture type="mesh_attribute" name="base_color"><string '
           'name="name" value="vertex_base_color"/></texture><texture type="mesh_attribute" name="roughness"><string '
           'name="name" value="vertex_roughness"/></texture></bsdf></bsdf>')  # fmt: skip
    fine = with_fine_attribute(xml, "vertex_base_color")
    kinds = {t.get("name"): t.get("type") for t in ElementTree.fromstring(fine).iter("texture")}
    assert kinds == {"base_color": "fine_attribute", "roughness": "mesh_attribute"}
    assert with_fine_attribute(xml, "vertex_diffuse") == xml


def test_the_scale_of_an_attribute_stays():
    shape = sphere({"type": "diffuse", "reflectance": COLOUR | {"scale": 1.5}}, 1)
    write_texture(shape, Coloured(lambda s: torch.full_like(s, 0.5), 0.1), *triangles(shape))
    scene = mi.load_dict({"type": "scene", "shape": shape})
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.1, 0.2, 4), mi.Vector3f(0, 0, -1)))
    (texture,) = fine_textures(shape.bsdf())
    np.testing.assert_allclose(np.array(texture.eval_3(si, mi.Bool(True))).ravel(), 0.375)


def test_a_mesh_of_mitsuba_has_no_texture_to_remove():
    mesh = mi.load_dict({"type": "rectangle"})
    ball = mi.Mesh("ball", 3, 1)
    ball.set_bsdf(mi.load_dict({"type": "cooktorrance"}))
    for shape in (mesh, ball):
        mesh_texture.remove_texture(shape)
