"""Files and pictures of an object with fine relief and a fine texture, which no mesh of its file has."""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.exported import bilinear, chunks, normals_at
from PIL import Image
from scipy.spatial import cKDTree

from mi_ring import evaluate, export, render
from mi_ring.capture.scenefile import photograph_element, scene_bytes, scene_element
from mi_ring.fitting.detail_stage import add_detail
from mi_ring.geometry.camera import Camera
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.objects.detail import Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.output import ply
from mi_ring.scene.lights import Light
from mi_ring.scene.shot import Files, Shot

CENTER, RADIUS, LEVEL = np.array([40.0, -15.0, 9.0]), 25.0, 5
HIGH = 0.008  #: amplitude of the relief, as a share of the radius
EDGE = 192  #: of the photograph [px]: the waves of the texture are 9 px long


def waves(grid, octave, length):
    """Waves (N, 1) of a length, between -1 and 1, at the corners of an octave of a grid."""
    keys = grid.keys(octave)
    corners = torch.stack([keys >> 42, (keys >> 21) % 2**21, keys % 2**21], 1) - 2**20
    phase = 2 * math.pi / length * grid.cells[octave] * corners
    return (torch.sin(phase[:, :1] + phase[:, 2:]) * torch.cos(phase[:, 1:2])).float()


def detailed():
    """Waves of 0.25 in its relief; waves of 0.12 in its texture."""
    torch.manual_seed(7)
    ring = FittedObject(CENTER, RADIUS, 0.12, steps=2)
    with torch.no_grad():
        ring.shape_net.output.weight *= 4
        add_detail(ring, LEVEL, 30)
        grid = ring.shape_net.grid
        grid.values[-1].copy_(HIGH / grid.cells[-1] * waves(grid, 3, 0.25))
        texture = Grid.around(ring.domain.sample(7)[0], 0.015, 1, 3)
        texture.values[0].copy_(waves(texture, 0, 0.12) * torch.tensor([0.5, 0.3, -0.4]))
    ring.brdf_net = SharpenedMaterial.of(ring.brdf_net, texture)
    return ring


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A results folder, with a photograph that is not there yet."""
    folder = tmp_path_factory.mktemp("run")
    torch.save(ring_state(detailed()), folder / "ring.pt")
    ply.write_mesh(load_fit(folder), LEVEL, folder / "mesh.ply")
    eye = CENTER + np.array([0, 20, 90])
    pose = np.array(mi.ScalarTransform4f().look_at(eye.tolist(), CENTER.tolist(), [0.1, 0.2, 0.9]).matrix)
    camera = Camera(pose, np.full(2, 270.0), np.full(2, EDGE / 2), (EDGE, EDGE))
    light = Light("point", eye + 9 * pose[:3, 0], np.full(3, 20_000.0))
    shot = Shot("one", camera, light, files=Files(folder / "one.png"))
    (folder / "scene.xml").write_bytes(scene_bytes(scene_element([photograph_element(shot)], CENTER, RADIUS)))
    return folder


def inside(mesh, uv, s, count=4000):
    """Points of triangles: (texture coordinates (N, 2), points of the sphere (N, 3), triangles, barycentric)."""
    random = np.random.default_rng(2)
    triangles = random.integers(len(mesh), size=count)
    shares = random.dirichlet([1, 1, 1], count)
    at, points = ((values[mesh[triangles]] * shares[..., None]).sum(1) for values in (uv, s))
    return at, points / np.linalg.norm(points, axis=1, keepdims=True), triangles, shares


def colours_of(ring, s, fine):
    """What a glTF base colour should be at points of the sphere, sRGB in [0, 1]: with or without the texture."""
    s = torch.from_numpy(s.astype(np.float32))
    with torch.no_grad():
        found = {name: value.numpy() for name, value in (ring.brdf_net.fine(s) if fine else ring.material(s)).items()}
    return linear_to_srgb(math.pi * found["diffuse"] / (1 - 4 * found["specular"][:, None]))


def domain_points(ring, vertices, level, time=1.0):
    """The points of the sphere at vertices of a file, whose mesh has this level."""
    s = ring.domain.sample(level)[0]
    with torch.no_grad():
        distance, nearest = cKDTree(ring.surface(s, time).numpy()).query(vertices)
    assert distance.max() < 1e-4
    return s.numpy()[nearest]


def has_the_print(ring, image, at, s):
    """Does an image show the texture at these texture coordinates, which are at points of the sphere?"""
    shown = bilinear(np.asarray(image.convert("RGB")), at) / 255
    error, without = (np.abs(shown - colours_of(ring, s, fine)).mean() for fine in (True, False))
    return error < 0.1 * without and without > 0.03  # measured: 0.0012 of 0.035


@pytest.mark.parametrize("time", [1.0, 0.5])
def test_a_glb_has_print_and_relief_in_its_textures(run, tmp_path, time):
    file = tmp_path / "o.glb"
    export.main([str(run), str(file), "--subdivisions", "3", "--resolution", "768", "--time", str(time)])
    ring, mesh = load_fit(run), next(iter(trimesh.load(file, process=False).geometry.values()))
    uv = mesh.visual.uv * [1, -1] + [0, 1]  # trimesh turns v over
    at, s, triangles, shares = inside(mesh.faces, uv, domain_points(ring, mesh.vertices, 3, time))
    assert has_the_print(ring, mesh.visual.material.baseColorTexture, at, s)
    content, data = chunks(file)

    def attribute(name):
        accessor = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"][name]]
        place = content["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(data, np.float32, place["byteLength"] // 4, place["byteOffset"])
        return (values.reshape(accessor["count"], -1)[mesh.faces[triangles]] * shares[..., None]).sum(1)

    normal, tangent = attribute("NORMAL"), attribute("TANGENT")
    bitangent = np.sign(tangent[:, 3:]) * np.cross(normal, tangent[:, :3])
    x, y, z = (bilinear(np.asarray(mesh.visual.material.normalTexture), at) / 127.5 - 1).T[..., None]
    shown, truth = x * tangent[:, :3] + y * bitangent + z * normal, normals_at(ring, s, time)
    error, without = (np.degrees(np.arccos((n * truth).sum(1) / np.linalg.norm(n, axis=1))).mean()
                      for n in (shown, normal))  # fmt: skip
    assert error < 0.6 * without and without > 5 * time  # measured: 2.6 of 5.9, 1.3 of 3.0 degrees


def test_an_obj_has_the_print(run, tmp_path):
    export.main([str(run), str(tmp_path / "o.obj"), "--resolution", "768"])
    lines = [line.split() for line in (tmp_path / "o.obj").read_text().splitlines()]
    vertices, uv = (np.array([line[1:] for line in lines if line[:1] == [kind]], float) for kind in ("v", "vt"))
    corners = np.array([[corner.split("/") for corner in line[1:]] for line in lines if line[:1] == ["f"]], int) - 1
    ring = load_fit(run)
    s = domain_points(ring, vertices, LEVEL)  # with the relief
    at, s, *_ = inside(np.arange(corners[..., 0].size).reshape(-1, 3), (uv * [1, -1] + [0, 1])[corners[..., 1].ravel()],
                       s[corners[..., 0].ravel()])  # fmt: skip
    library = dict(line.split(maxsplit=1) for line in (tmp_path / "o.mtl").read_text().splitlines())
    assert has_the_print(ring, Image.open(tmp_path / library["map_Kd"]), at, s)
    assert "norm" not in library  # the mesh has all of the relief


def test_an_obj_of_a_coarse_mesh_has_a_normal_map(run, tmp_path):
    export.main([str(run), str(tmp_path / "o.obj"), "--subdivisions", "3", "--resolution", "256"])
    library = dict(line.split(maxsplit=1) for line in (tmp_path / "o.mtl").read_text().splitlines())
    across = np.asarray(Image.open(tmp_path / library["norm"]))[..., :2]
    assert np.ptp(across, axis=(0, 1)).min() > 20


@pytest.mark.parametrize("time", [1.0, 0.5])
def test_a_ply_has_the_relief(run, tmp_path, time):
    export.main([str(run), str(tmp_path / "o.ply"), "--time", str(time)])
    ring, mesh = load_fit(run), trimesh.load(tmp_path / "o.ply", process=False)
    s = ring.domain.sample(LEVEL)[0]
    with torch.no_grad():
        smooth = ring.to_scene(ring.shape_net.base.network(s, time)).numpy()
        np.testing.assert_allclose(mesh.vertices, ring.surface(s, time), atol=1e-4)
    relief = np.linalg.norm(mesh.vertices - smooth, axis=1)
    assert 0.75 < relief.max() / (RADIUS * HIGH * time) < 1


def test_mitsuba_without_mi_ring_render_and_evaluate_show_the_same(run, tmp_path, capsys):
    export.main([str(run), str(tmp_path / "stock.xml"), "--resolution", "768"])
    scene = mi.load_file(str(tmp_path / "stock.xml"), parallel=False)
    stock = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64))[..., :3]
    render.main([str(run), str(run / "scene.xml"), str(tmp_path / "ours"), "--format", "exr", "--spp", "64"])
    (picture,) = (tmp_path / "ours").iterdir()
    ours = np.array(mi.Bitmap(str(picture)))[..., :3]
    lit = (stock > 0.1 * stock.max()).all(-1)
    assert lit.mean() > 0.2 and np.abs(np.log(ours[lit] / stock[lit])).mean() < 0.03  # measured: 0.015
    write_image(to_bytes(linear_to_srgb(stock)), run / "one.png")
    capsys.readouterr()
    evaluate.main([str(run), "--mesh", str(run / "mesh.ply"), "--out", str(tmp_path / "e.json"), "--spp", "16"])
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["chamfer"] < 0.01 and numbers["iou"] > 0.999
    assert numbers["psnr_input"] > 40  # measured: 45
