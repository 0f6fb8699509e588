"""The `shapenet` shape: any domain, any resolution, any place; always closed, and the same surface as its networks."""

import re

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh

import mi_ring
from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.system.files import write_state

CENTER, RADIUS = [40.0, -15.0, 9.0], 12.5

ATTRIBUTES = {"vertex_diffuse": 3, "vertex_specular": 1, "vertex_roughness": 1}  #: of a fit with cooktorrance


def shapenet(**properties):
    return mi.load_dict({"type": "shapenet", "id": "object", "bsdf": {"type": "cooktorrance"}, **properties})


def mesh_of(shape):
    """The shape as trimesh sees it, vertices as they are."""
    params = mi.traverse(shape)
    vertices = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
    return trimesh.Trimesh(vertices, np.array(params["faces"]).reshape(-1, 3), process=False)


def rows(points, digits=5):
    """Points as a set of rounded rows."""
    return set(map(tuple, (np.round(points, digits) + 0.0).tolist()))


def ring_file(path, domain=None, center=CENTER, radius=RADIUS):
    """A saved fit whose output layers are perturbed, so that neither shape nor material is trivial."""
    torch.manual_seed(11)
    ring = FittedObject(center, radius, scale=2.5, domain=domain)
    with torch.no_grad():
        ring.shape_net.output.weight.normal_(std=0.02)
        ring.shape_net.output.bias.normal_(std=0.05)
        ring.brdf_net.output.weight.normal_(std=0.5)
    torch.save(ring_state(ring), path)
    return ring


# Where the surface is. Tolerances: float32 of the coordinates' size.


def test_default_is_the_unit_sphere():
    mesh = mesh_of(shapenet(subdivisions=3))
    assert len(mesh.vertices) == 10 * 4**3 + 2
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1, atol=1e-6)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.02)  # an inscribed polyhedron of 1,280 faces


def test_default_resolution_is_level_five():
    assert shapenet().vertex_count() == 10_242


def test_center_and_radius_move_the_sphere_and_are_kept_for_the_fit():
    shape = shapenet(subdivisions=2, center=CENTER, radius=RADIUS)
    mesh = mesh_of(shape)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTER, axis=1), RADIUS, rtol=1e-6)
    np.testing.assert_allclose(shape.center, CENTER)
    assert shape.radius == RADIUS
    assert shapenet(subdivisions=0).center is None and shapenet(subdivisions=0).radius is None


def test_to_world_comes_last():
    to_world = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0.3, 1, -0.2], 70).scale([1, 2.5, 0.5])
    plain = mesh_of(shapenet(subdivisions=2, center=CENTER, radius=RADIUS))
    moved = mesh_of(shapenet(subdivisions=2, center=CENTER, radius=RADIUS, to_world=to_world))
    matrix = np.array(to_world.matrix)
    expected = plain.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(moved.vertices, expected, atol=1e-4)  # coordinates of about 100


def test_coarse_vertices_are_among_the_fine_ones():
    levels = [rows(mesh_of(shapenet(subdivisions=n, center=CENTER, radius=RADIUS)).vertices, 4) for n in (0, 1, 2, 3)]
    for coarse, fine in zip(levels, levels[1:]):
        assert coarse < fine


# What it is made of.


@pytest.mark.parametrize("mirror", [False, True])
def test_is_closed_and_oriented_outward(tmp_path, mirror):
    ring_file(tmp_path / "ring.pt")
    to_world = mi.ScalarTransform4f().rotate([1, 2, 3], 40).scale([-1 if mirror else 1, 1, 1])
    for properties in ({}, {"center": CENTER, "radius": RADIUS}, {"weights": str(tmp_path / "ring.pt")}):
        mesh = mesh_of(shapenet(subdivisions=3, to_world=to_world, **properties))
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.euler_number == 2
        assert mesh.volume > 0  # signed: positive where the faces look outward


def test_normals_look_outward_and_are_smooth():
    shape = shapenet(subdivisions=4, center=CENTER, radius=RADIUS)
    scene = mi.load_dict({"type": "scene", "shape": shape})
    direction = np.random.default_rng(3).normal(size=(100, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    start = np.array(CENTER) + 3 * RADIUS * direction
    si = scene.ray_intersect(
        mi.Ray3f(mi.Point3f(*start.T.astype(np.float32)), mi.Vector3f(*-direction.T.astype(np.float32)))
    )
    # The faces of level 4 turn by 4 degrees; normals interpolated between true ones are much closer than that.
    assert (np.array(si.sh_frame.n).T * direction).sum(1).min() > np.cos(np.radians(0.5))
    assert (np.array(si.n).T * direction).sum(1).min() < np.cos(np.radians(1))


def test_material_without_weights_is_grey_and_dull():
    params = mi.traverse(shapenet(subdivisions=1))
    for name, value in zip(ATTRIBUTES, (0.5, 0.0, 0.5)):
        attribute = np.array(params[name])
        assert attribute.shape == (42 * ATTRIBUTES[name],)
        assert (attribute == value).all()


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_weights_give_the_surface_and_material_of_the_networks(tmp_path, subdivisions):
    ring = ring_file(tmp_path / "ring.pt")
    shape = shapenet(weights=str(tmp_path / "ring.pt"), subdivisions=subdivisions)
    params = mi.traverse(shape)
    s, faces = ring.domain.sample(subdivisions)
    with torch.no_grad():
        expected, material = ring.surface(s), ring.brdf_net(s)
    spread = (expected - torch.tensor(CENTER)).norm(dim=1) / RADIUS
    assert spread.max() - spread.min() > 0.05  # no sphere
    np.testing.assert_allclose(mesh_of(shape).vertices, expected, atol=1e-4)  # coordinates of about 50
    np.testing.assert_array_equal(mesh_of(shape).faces, faces)
    assert {f"vertex_{name}" for name in material} == set(ATTRIBUTES)
    for name, value in material.items():
        assert value.std() > 1e-3
        np.testing.assert_allclose(np.array(params[f"vertex_{name}"]), value.numpy().ravel(), rtol=1e-4, atol=1e-6)


# Other domains.


@pytest.fixture
def torus(tmp_path):
    """A ring of radii 3 and 1 about an axis of its own, away from the origin: [file, mesh]."""
    mesh = trimesh.creation.torus(3.0, 1.0, major_sections=16, minor_sections=8)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 0.5], [0, 0, 0]))
    mesh.apply_translation(CENTER)
    mesh.export(tmp_path / "torus.ply")
    return str(tmp_path / "torus.ply"), mesh


def test_domain_file_keeps_its_place_and_its_genus(torus):
    pytest.importorskip("gpytoolbox")
    path, original = torus
    shape = shapenet(domain=path, center=CENTER, radius=4.0, subdivisions=3)
    mesh = mesh_of(shape)
    assert len(mesh.faces) == pytest.approx(20 * 4**3, rel=0.25)
    assert mesh.is_watertight and mesh.euler_number == 0
    assert mesh.volume == pytest.approx(original.volume, rel=0.05)
    np.testing.assert_allclose(mesh.bounds, original.bounds, atol=0.15)
    assert np.linalg.norm(shape.domain[0].points, axis=1).max() == pytest.approx(1, abs=1e-5)  # (3 + 1) / 4


def test_domain_file_that_is_inside_out_is_turned(torus):
    pytest.importorskip("gpytoolbox")
    path, original = torus
    original.invert()
    original.export(path)
    assert mesh_of(shapenet(domain=path, subdivisions=2)).volume > 0


def test_saved_fit_of_another_domain_loads(torus, tmp_path):
    pytest.importorskip("gpytoolbox")
    _, mesh = torus
    domain = Domain((mesh.vertices - CENTER) / 4.0, mesh.faces)
    ring = ring_file(tmp_path / "ring.pt", domain=domain, radius=4.0)
    shape = mesh_of(shapenet(weights=str(tmp_path / "ring.pt"), subdivisions=2))
    with torch.no_grad():
        expected = ring.surface(domain.sample(2)[0])
    np.testing.assert_allclose(shape.vertices, expected, atol=1e-4)
    assert shape.is_watertight and shape.euler_number == 0


# What is refused, in one clear message.


@pytest.mark.parametrize(
    "properties, message",
    [
        ({"subdivisions": -1}, "subdivisions is -1, must be 0 to 8"),
        ({"subdivisions": 9}, "subdivisions is 9, must be 0 to 8"),
        ({"subdivision": 3}, "subdivision"),
        ({"weights": "ring.pt", "center": CENTER}, "weights carry their own center"),
        ({"weights": "ring.pt", "radius": 2.0}, "weights carry their own radius"),
        ({"weights": "ring.pt", "domain": "torus.ply"}, "weights carry their own domain"),
        ({"weights": "missing.pt"}, "missing.pt: no such file"),
        ({"weights": "garbage.pt"}, "garbage.pt: not a saved fit"),
        ({"weights": "list.pt"}, "list.pt: not a saved fit"),
        ({"weights": "older.pt"}, "older.pt: format version 0"),
        ({"weights": "half.pt"}, "half.pt: damaged, or its networks do not match their names"),
        ({"domain": "open.ply"}, "open.ply.* is not a closed surface"),
        ({"domain": "missing.ply"}, "missing.ply"),
        ({"subdivisions": "fine"}, "subdivisions is fine, must be 0 to 8"),
        ({"radius": 0.0}, "radius is 0"),
        ({"radius": "large"}, "radius is large, must be a positive number"),
        ({"center": "here"}, "center is here, must be a <point>"),
        ({"to_world": "there"}, "to_world is there, must be a <transform>"),
        ({"radius": -2.0}, "radius is -2"),
        ({"weights": "ring.pt", "ground": CENTER}, "weights carry their own ground"),
        ({"ground": CENTER, "up": [0.0, 0.0, 0.0]}, "up is .* must be a <vector> that is not 0"),
        ({"up": 1.0}, "up is 1.0, must be a <vector>"),
        ({"ground": "there"}, "ground is there, must be a <point>"),
        ({"metres": -1.0}, "metres is -1.0, must be a positive number"),
        ({"weights": "ring.pt", "metres": 1.0}, "weights carry their own metres"),
    ],
    ids=lambda value: None if isinstance(value, str) else "-".join(f"{k}={v}" for k, v in value.items()),
)
def test_refuses(tmp_path, properties, message):
    ring = ring_file(tmp_path / "ring.pt")
    (tmp_path / "garbage.pt").write_bytes(b"no torch file")
    torch.save([1, 2], tmp_path / "list.pt")
    torch.save(ring_state(ring) | {"format": 0}, tmp_path / "older.pt")
    torch.save(ring_state(ring) | {"networks": {}}, tmp_path / "half.pt")
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.export(tmp_path / "torus.ply")
    trimesh.Trimesh(ball.vertices, ball.faces[3:], process=False).export(tmp_path / "open.ply")
    files = {key: str(tmp_path / value) for key, value in properties.items() if key in ("weights", "domain")}
    with pytest.raises(Exception) as caught:
        mi.load_dict({"type": "scene", "shape": {"type": "shapenet", "id": "pot", **properties, **files}})
    assert re.search(message, str(caught.value).splitlines()[-1])  # below Mitsuba's own words and a traceback


# Out and in again.


def test_write_ply_is_read_by_trimesh_and_by_mitsuba(tmp_path):
    ring_file(tmp_path / "ring.pt")
    shape = shapenet(weights=str(tmp_path / "ring.pt"), subdivisions=2)
    shape.write_ply(str(tmp_path / "mesh.ply"))
    loaded = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert loaded.is_watertight and loaded.volume > 0
    np.testing.assert_allclose(loaded.vertices, mesh_of(shape).vertices, atol=1e-5)
    again = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "mesh.ply")}))
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(np.array(again[name]), np.array(mi.traverse(shape)[name]))


def test_flash_can_be_left_out():
    """A fit placed into a scene of one's own brings no emitter."""
    kinds = [
        mi.load_dict({"type": "scene", "o": shapenet(subdivisions=0, flash=on)}).emitters() for on in (True, False)
    ]
    assert [len(emitters) for emitters in kinds] == [1, 0]


# Files of other versions.


def test_a_ring_of_format_3_is_read(tmp_path):
    """What mi_ring 0.1 wrote: steps and parameters by themselves, no names of networks."""
    ring = ring_file(tmp_path / "ring.pt")
    old = {key: value for key, value in ring_state(ring).items() if key in ("networks", "domain", "bsdf", "indirect")}
    parameters = [tuple(p) for p in ring.brdf_net.bsdf_parameters]
    old |= {"format": 3, "config": {"subdivisions": 4}, "parameters": parameters, "steps": 20}
    torch.save(old, tmp_path / "old.pt")
    again = load_fit(tmp_path / "old.pt")
    assert again.subdivisions == 4 and again.shape_net.steps == 20
    s, _ = ring.domain.sample(2)
    with torch.no_grad():
        torch.testing.assert_close(again.surface(s), ring.surface(s))
        torch.testing.assert_close(again.brdf_net(s), ring.brdf_net(s))


def test_files_of_versions_that_are_not_read_are_named(tmp_path):
    ring = ring_file(tmp_path / "ring.pt")
    for state, words in (
        (ring_state(ring) | {"format": 99, "mi_ring": "7.1"}, "format version 99, of mi_ring 7.1; this one"),
        ({"format": 1, "networks": {}}, "format version 1, of mi_ring 0.1 or older"),
        ({"something": 1}, "not a saved fit"),
    ):
        torch.save(state, tmp_path / "other.pt")
        with pytest.raises(InputError, match=words):
            load_fit(tmp_path / "other.pt")
    assert ring_state(ring)["mi_ring"] == mi_ring.__version__


def test_no_bit_of_a_saved_fit_may_change(tmp_path):
    """Those of the zip file's own records, which it does not check itself, included; without a seal it checks some."""
    ring = FittedObject([0.0, 0.0, 0.0], 1.0)
    path = tmp_path / "ring.pt"
    write_state(ring_state(ring), path)
    whole, random = path.read_bytes(), np.random.default_rng(3)
    load_fit(path)
    for place in [*random.integers(0, len(whole), 60), *random.integers(len(whole) - 3000, len(whole), 60)]:
        content = bytearray(whole)
        content[place] ^= 1 << random.integers(8)
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"ring\.pt: not a saved fit, or damaged"):
            load_fit(path)
    path.write_bytes(whole[:-50])
    with pytest.raises(InputError, match=r"ring\.pt: not a saved fit, or damaged"):
        load_fit(path)


BALL = trimesh.creation.icosphere(subdivisions=1)


def changed(*path, to):
    """A function that changes one value in a state."""

    def change(state):
        *folders, last = path
        for key in folders:
            state = state[key]
        state[last] = to

    return change


@pytest.mark.parametrize("change", [
    changed("networks", "radius", to=torch.tensor(float("nan"))), changed("networks", "radius", to=torch.tensor(-1.0)),
    changed("networks", "center", to=torch.tensor([0.0, float("inf"), 0.0])), changed("subdivisions", to=30),
    changed("subdivisions", to=-1), changed("subdivisions", to="6"), changed("shape_net", "arguments", "steps", to=-1),
    changed("shape_net", "arguments", "steps", to=10**9), changed("shape_net", "arguments", to=None),
    changed("brdf_net", "arguments", "parameters", to=[("diffuse", 10**9, 0.0, 1.0)]), changed("metres", to=-1.0),
    changed("domain", to={"points": torch.tensor(BALL.vertices), "faces": torch.tensor(BALL.faces[1:])}),
    changed("domain", to={"points": torch.tensor(BALL.vertices[1:]), "faces": torch.tensor(BALL.faces)}),
    changed("domain", to={"points": torch.tensor(BALL.vertices * np.nan), "faces": torch.tensor(BALL.faces)}),
    changed("domain", "points", to=torch.zeros(5)), changed("domain", to=[1]), changed("up", to=[1.0]),
    changed("networks", "ground", to=torch.zeros(7)), changed("bsdf", to=3), changed("networks", to=None),
    changed("shape_net", "name", to=["shapenet"]),
])  # fmt: skip
def test_what_no_fit_has_is_refused(change, tmp_path):
    domain = Domain(BALL.vertices, BALL.faces)
    state = ring_state(
        FittedObject([0.0, 0.0, 0.0], 1.0, domain=domain, ground=torch.tensor([[0.0, 0, -1], [0, 0, 1]]))
    )
    path = tmp_path / "ring.pt"
    write_state(state, path)
    load_fit(path)
    change(state)
    write_state(state, path)
    with pytest.raises(InputError, match=r"ring\.pt: damaged, or its networks do not match their names"):
        load_fit(path)
