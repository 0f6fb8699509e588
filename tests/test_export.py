"""Files for other programs: what they say of the surface and of its material, read by others than their writer."""

import errno
import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.exported import bilinear, chunks, normals_at
from helpers.microfacets import directions, evaluate, twin
from PIL import Image
from scipy.spatial import cKDTree

from mi_ring import export
from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain
from mi_ring.nets.brdf_net import Parameter
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import atlas, gltf, mitsuba_scene, results

CENTER, RADIUS = np.array([400.0, -150.0, 90.0]), 25.0
RESOLUTION = 256


def wild(domain=None, bsdf='<bsdf type="cooktorrance"/>', subdivisions=4, **properties) -> FittedObject:
    """A ring whose surface is no sphere and whose material is not the same everywhere."""
    torch.manual_seed(7)
    ring = FittedObject(CENTER, RADIUS, 0.1, domain, bsdf=bsdf, steps=4, subdivisions=subdivisions, **properties)
    with torch.no_grad():
        ring.shape_net.output.weight *= 8
        ring.brdf_net.output.weight *= 60
    return ring


@pytest.fixture(scope="module")
def ring():
    return wild()


@pytest.fixture(scope="module")
def run(ring, small_capture, tmp_path_factory):
    """A results folder with what export reads of it."""
    folder = tmp_path_factory.mktemp("run")
    torch.save(ring_state(ring, {"subdivisions": 4}), folder / "ring.pt")
    (folder / "scene.xml").write_text(small_capture.read_text())
    return folder


@pytest.fixture(scope="module")
def baked(ring):
    """(atlas, texels) of a mesh coarser than the surface."""
    opened = atlas.unwrap(ring, 3, RESOLUTION)
    return opened, atlas.rasterise(ring, opened, RESOLUTION)


@pytest.fixture(scope="module")
def glb_file(run, tmp_path_factory):
    file = tmp_path_factory.mktemp("glb") / "object.glb"
    export.main([str(run), str(file), "--subdivisions", "3", "--resolution", str(RESOLUTION), "--metres", "0.001"])
    return file


def test_a_glb_is_in_metres_and_upright_where_the_capture_says_so(run, ring, tmp_path, capsys):
    """Up is -x and a unit is a centimetre: as glTF has it, with y up, in metres."""
    state = ring_state(ring)
    torch.save(state | {"up": [-1.0, 0.0, 0.0], "metres": 0.01}, tmp_path / "ring.pt")
    sizes = []
    for source, name in ((run, "plain.glb"), (tmp_path / "ring.pt", "upright.glb")):
        export.main([str(source), str(tmp_path / name), "--subdivisions", "3", "--resolution", "64"])
        sizes.append(trimesh.load(tmp_path / name).bounds)  # with the node's transform
    told = capsys.readouterr().err
    plain, upright = sizes
    np.testing.assert_allclose(upright[:, 1], -0.01 * plain[::-1, 0], rtol=1e-4)
    np.testing.assert_allclose(upright[:, 2], 0.01 * plain[:, 2], rtol=1e-4)
    assert told.count("The length of a scene unit is not known") == 1


def complaint(*arguments) -> str:
    with pytest.raises(InputError) as error:
        export.main([str(a) for a in arguments])
    assert "\n" not in str(error.value)
    return str(error.value)


def attributes(file) -> dict:
    """The attributes of a PLY file, as Mitsuba reads them."""
    params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(file)}))
    return {key: np.array(value) for key, value in params if key.startswith("vertex_")}


def closed(opened) -> trimesh.Trimesh:
    """The mesh of an atlas before it was cut."""
    vertices = np.zeros((opened.uncut.max() + 1, 3))
    vertices[opened.uncut] = opened.vertices
    return trimesh.Trimesh(vertices, opened.uncut[opened.faces], process=False)


# ---------------------------------------------------------------------------------------------------------------------
# The material in glTF's terms


def gltf_brdf(c, m, roughness, weight, color, n, i, o, v):
    """The BRDF of glTF 2.0 (appendix B) with KHR_materials_specular, of a dielectric; `v`: the visibility of α."""
    assert not m.any()
    h = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)
    alpha = roughness**2
    noh, voh = (n * h).sum(1), (o * h).sum(1)
    d = alpha**2 / (math.pi * (noh**2 * (alpha**2 - 1) + 1) ** 2)
    f0, f90 = np.minimum(0.04 * color, 1) * weight, weight
    f = f0 + (f90 - f0) * (1 - voh) ** 5
    return (1 - f)[:, None] * c / math.pi + (f * d * v(alpha, (n * i).sum(1), (n * o).sum(1)))[:, None]


def uncorrelated(alpha, ni, no):
    """Smith's G as a product, divided by 4 (n·i)(n·o): that of `cooktorrance`."""

    def g(cosine):
        return 2 * cosine / (cosine + np.sqrt(alpha**2 + (1 - alpha**2) * cosine**2))

    return g(ni) * g(no) / (4 * ni * no)


def correlated(alpha, ni, no):
    """glTF's, of appendix B.3.2."""

    def part(a, b):
        return a * np.sqrt(b**2 * (1 - alpha**2) + alpha**2)

    return 0.5 / (part(ni, no) + part(no, ni))


def test_the_mapping_is_exact_but_for_the_visibility():
    random = np.random.default_rng(3)
    values = {"diffuse": random.uniform(0, 0.2, (40, 3)), "specular": random.uniform(0, 0.08, 40),
              "roughness": random.uniform(0.05, 0.9, 40)}  # fmt: skip
    i, o, n = directions(40, 1), directions(40, 2), np.array([[0.0, 0.0, 1.0]])
    material = gltf.metallic_roughness('<bsdf type="cooktorrance"/>', values)
    assert material.scale == 1 and material.base_color.max() <= 1 and material.specular.max() <= 1
    ours = [twin(a[None], b[None], *v)[0] / a[2] for a, b, *v in zip(i, o, *values.values())]
    np.testing.assert_allclose(gltf_brdf(*material[:5], n, i, o, uncorrelated), ours, rtol=2e-4)
    theirs = gltf_brdf(*material[:5], n, i, o, correlated)
    assert (theirs > (1 - 1e-6) * gltf_brdf(*material[:5], n, i, o, uncorrelated)).all()  # G is larger if correlated
    assert not np.allclose(theirs, ours, rtol=1e-3)


def test_reflectances_beyond_one_are_scaled_and_the_scale_is_told():
    values = {"diffuse": np.full((200, 3), [0.5, 0.3, 0.1], np.float32), "specular": np.full(200, 0.2, np.float32),
              "roughness": np.full(200, 0.25, np.float32)}  # fmt: skip
    material = gltf.metallic_roughness('<bsdf type="cooktorrance"/>', values)
    albedo = math.pi * 0.5 + 0.8
    np.testing.assert_allclose(material.scale, 1 / albedo, rtol=1e-5)
    np.testing.assert_allclose(material.specular, 0.8 / albedo, rtol=1e-5)
    np.testing.assert_allclose(material.base_color[0], [1, 0.6, 0.2], rtol=1e-4)
    np.testing.assert_allclose(material.roughness, 0.5)


def test_a_rough_matte_surface_becomes_a_smooth_one_of_the_same_mean_albedo():
    """∫∫ B (n·i)(n·o) di do, by directions of known density."""
    sigma = np.array([0.0, 0.3, 1.0])
    values = {"diffuse": np.full((3, 3), 0.2), "specular": np.zeros(3), "roughness": np.full(3, 0.5),
              "diffuse_roughness": sigma}  # fmt: skip
    material = gltf.metallic_roughness('<bsdf type="cooktorrance"/>', values)
    i, o = directions(300_000, 5, 1e-3), directions(300_000, 6, 1e-3)
    for k in range(3):
        bsdf = mi.load_dict({"type": "cooktorrance", "diffuse": {"type": "rgb", "value": 0.2}, "specular": 0.0,
                             "roughness": 0.5, "diffuse_roughness": float(sigma[k])})  # fmt: skip
        albedo = 4 * np.pi * (evaluate(bsdf, i, o)[:, 0] * o[:, 2]).mean()
        assert material.base_color[k, 0] == pytest.approx(albedo, rel=0.01)


def test_constants_of_the_bsdf_count():
    numbers = '<float name="specular" value="0.05"/><float name="roughness" value="0.36"/>'
    bsdf = f'<bsdf type="cooktorrance">{numbers}</bsdf>'
    material = gltf.metallic_roughness(bsdf, {"diffuse": np.full((5, 3), 0.1, np.float32)})
    np.testing.assert_allclose(material.specular, 0.2, rtol=1e-6)
    np.testing.assert_allclose(material.roughness, 0.6, rtol=1e-6)
    np.testing.assert_allclose(material.base_color, 0.1 * math.pi / 0.8, rtol=1e-5)


@pytest.mark.parametrize("inner, color", [("", 1.0), ('<float name="specular" value="0.25"/>', 0.5),
                                          ('<float name="eta" value="2"/>', 1 / 9 / 0.04)])  # fmt: skip
def test_principled_keeps_its_numbers(inner, color):
    bsdf = f'<bsdf type="principled"><float name="metallic" value="0.3"/>{inner}</bsdf>'
    values = {"base_color": np.full((5, 3), [0.1, 0.5, 0.9], np.float32), "roughness": np.full(5, 0.4, np.float32)}
    material = gltf.metallic_roughness(bsdf, values)
    np.testing.assert_allclose(material.base_color, values["base_color"])
    np.testing.assert_allclose(material.roughness, 0.4)
    np.testing.assert_allclose(material.metallic, 0.3)
    np.testing.assert_allclose(material.specular_color, color, rtol=1e-5)


@pytest.mark.parametrize("bsdf, named", [
    ('<bsdf type="plastic"/>', "plastic"),
    ('<bsdf type="principled"><float name="clearcoat" value="0.5"/></bsdf>', "clearcoat"),
])  # fmt: skip
def test_what_gltf_cannot_tell_is_refused(bsdf, named):
    with pytest.raises(InputError, match=f"{named}.*PLY"):
        gltf.metallic_roughness(bsdf, {"diffuse_reflectance": np.zeros((5, 3), np.float32)})


# ---------------------------------------------------------------------------------------------------------------------
# The atlas


def test_charts_do_not_overlap_and_lose_nothing(ring, baked):
    opened, texels = baked
    assert opened.uv.min() >= 0 and opened.uv.max() <= 1
    corners = opened.uv[opened.faces]
    area = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 2
    assert abs(len(texels.s) / RESOLUTION**2 - area) < 0.01 * area  # a texel in two triangles would count once
    assert len(opened.faces) == 20 * 4**3 and opened.uncut.max() + 1 == 10 * 4**3 + 2
    assert closed(opened).is_watertight and closed(opened).euler_number == 2


def test_texels_show_the_point_of_the_surface_that_is_there(ring, baked):
    opened, texels = baked
    s = texels.s / np.linalg.norm(texels.s, axis=1, keepdims=True)
    where = bilinear(s[texels.index], opened.uv)
    away = np.linalg.norm(where - opened.s, axis=1)
    assert np.median(away) < 0.01 and away.max() < 0.05  # a triangle's edge is 0.16 long


def test_there_are_no_seams(ring, baked):
    """Along a seam both charts show the same colour: the midpoints of its edges are looked up in both."""
    opened, texels = baked
    material = gltf.metallic_roughness(ring.bsdf, atlas.reflectances(ring, texels.s))
    colour = gltf.textures(material, texels)["baseColorTexture"] / 255
    assert colour.std((0, 1)).min() > 0.02
    sides = {}
    for a, b in np.concatenate([opened.faces[:, [k, (k + 1) % 3]] for k in range(3)]):
        sides.setdefault(frozenset(opened.uncut[[a, b]]), []).append((a, b))
    seams = [pair for pair in sides.values() if len({frozenset(edge) for edge in pair}) > 1]
    assert len(seams) > 20
    one, two = (bilinear(colour, np.array([opened.uv[list(pair[k])].mean(0) for pair in seams])) for k in (0, 1))
    assert np.abs(one - two).mean() < 0.004 and np.abs(one - two).max() < 0.03


def test_the_normal_map_holds_the_normals_of_the_flow():
    """Decoded by the frame of the coarse mesh, as glTF asks, they are the derivatives of the flow."""
    ring = wild(subdivisions=6)
    opened = atlas.unwrap(ring, 3, RESOLUTION)
    texels = atlas.rasterise(ring, opened, RESOLUTION)
    material = gltf.metallic_roughness(ring.bsdf, atlas.reflectances(ring, texels.s))
    image = gltf.textures(material, texels)["normalTexture"] / 127.5 - 1
    triangles = opened.uv[opened.faces]
    inverse = np.linalg.inv((triangles[:, 1:] - triangles[:, :1]).swapaxes(1, 2))
    random, found, coarse, points = np.random.default_rng(1), [], [], []
    while len(points) < 300:
        row, column = random.integers(RESOLUTION, size=2)
        uv = (np.array([column, row]) + 0.5) / RESOLUTION
        b = (inverse @ (uv - triangles[:, 0])[..., None])[..., 0]
        inside = np.flatnonzero((b.min(1) > 0) & (b.sum(1) < 1))
        if len(inside) != 1:
            continue
        w, corner = np.array([1 - b[inside[0]].sum(), *b[inside[0]]]), opened.faces[inside[0]]
        n, t, sign = w @ opened.normals[corner], w @ opened.tangents[corner, :3], opened.tangents[corner[0], 3]
        n, t = n / np.linalg.norm(n), t / np.linalg.norm(t)
        x, y, z = image[row, column]
        found.append(x * t + y * sign * np.cross(n, t) + z * n)
        coarse.append(n)
        points.append(texels.s[texels.index[row, column]])
    truth = normals_at(ring, points / np.linalg.norm(points, axis=1, keepdims=True))
    error, before = (np.degrees(np.arccos(np.clip((m * truth).sum(1) / np.linalg.norm(m, axis=1), -1, 1)))
                     for m in (np.array(found), np.array(coarse)))  # fmt: skip
    assert np.mean(error) < 0.6 < 1.2 < np.mean(before)  # eight bits alone: 0.3 degrees


def test_small_objects_are_cut_open_like_large_ones():
    """A ring as before but of 4 mm, in metres: xatlas itself drops triangles that are small."""
    small = wild()
    small.radius.fill_(0.004)
    opened, large = atlas.unwrap(small, 4, RESOLUTION), atlas.unwrap(wild(), 4, RESOLUTION)
    np.testing.assert_allclose(opened.uv, large.uv)
    texels = atlas.rasterise(small, opened, RESOLUTION)
    assert len(texels.s) > 0.4 * RESOLUTION**2 and np.isfinite(texels.normals).all()


def test_levels_that_are_not_cut_themselves():
    """Beyond level 5 triangles are cut in four within the charts of level 5, their corners on the sphere."""
    ring = wild(subdivisions=6)
    opened = atlas.unwrap(ring, 6, RESOLUTION)
    assert len(opened.faces) == 20 * 4**6 and closed(opened).is_watertight
    np.testing.assert_allclose(np.linalg.norm(opened.s, axis=1), 1, atol=1e-6)
    with torch.no_grad():
        expected = ring.surface(torch.from_numpy(opened.s)).numpy()
    np.testing.assert_allclose(opened.vertices, expected, atol=1e-4)
    normals = normals_at(ring, opened.s[::97])
    assert np.degrees(np.arccos(np.clip((opened.normals[::97] * normals).sum(1), -1, 1))).mean() < 0.5


def test_a_domain_with_a_handle_is_cut_open_too():
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=30, minor_sections=14)
    ring = wild(Domain(torus.vertices, torus.faces))
    opened = atlas.unwrap(ring, 3, RESOLUTION)
    assert closed(opened).is_watertight and closed(opened).euler_number == 0
    x, y, z = ring.domain.project(torus.triangles_center * 1.1).T
    tube = np.hypot(np.hypot(x, y) - 1, z)
    assert tube.min() > 0.38 and tube.max() < 0.4001


# ---------------------------------------------------------------------------------------------------------------------
# Files


def test_khronos_validator_finds_nothing(glb_file):
    modules = gltf.__file__.replace("gltf.py", "viewer/node_modules")
    if not shutil.which("node") or not os.path.isdir(f"{modules}/gltf-validator"):
        pytest.skip("needs the validator of glTF, which `make tools` installs")
    script = f"""const validator = require({json.dumps(modules + "/gltf-validator")});
        validator.validateBytes(new Uint8Array(require("fs").readFileSync({json.dumps(str(glb_file))})))
            .then((report) => console.log(JSON.stringify(report.issues)));"""
    issues = json.loads(subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True).stdout)
    assert (issues["numErrors"], issues["numWarnings"], issues["messages"]) == (0, 0, [])


def test_glb_read_by_another_library(ring, glb_file):
    """Its colours, at its texture coordinates, are those of the network at the vertices."""
    scene = trimesh.load(glb_file)
    mesh = next(iter(scene.geometry.values()))
    with torch.no_grad():
        s = ring.domain.sample(3)[0]
        surface = ring.surface(s).numpy()
        distance, nearest = cKDTree(surface).query(mesh.vertices)
        exact = {name: values.numpy() for name, values in ring.material(s[nearest]).items()}
    assert distance.max() < 1e-5
    uv = mesh.visual.uv * [1, -1] + [0, 1]  # trimesh turns v over
    found = bilinear(np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")), uv) / 255
    expected = math.pi * exact["diffuse"] / (1 - 4 * exact["specular"][:, None])
    expected = np.where(expected <= 0.0031308, 12.92 * expected, 1.055 * expected ** (1 / 2.4) - 0.055)
    assert expected.std(0).min() > 0.02 and np.abs(found - expected).max() < 0.03
    rough = bilinear(np.asarray(mesh.visual.material.metallicRoughnessTexture.convert("RGB")), uv) / 255
    assert np.abs(rough[:, 1] - np.sqrt(exact["roughness"])).max() < 0.03 and (rough[:, 2] == 0).all()
    np.testing.assert_allclose(scene.extents, 0.001 * mesh.extents, rtol=1e-5)
    np.testing.assert_allclose(mesh.bounds, [surface.min(0), surface.max(0)], rtol=1e-6)


def test_glb_says_what_it_holds(glb_file):
    content, _ = chunks(glb_file)
    material, node = content["materials"][0], content["nodes"][0]
    assert node["scale"] == [0.001] * 3 and node["extras"]["unit"] == "0.001 m"
    assert material["extras"]["mi_ring"]["bsdf"] == '<bsdf type="cooktorrance"/>'
    assert material["extensions"]["KHR_materials_specular"]["specularColorFactor"] == [25] * 3
    attributes = set(content["meshes"][0]["primitives"][0]["attributes"])
    assert attributes >= {"POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"}
    assert len(attributes) <= 5, "Blender 5.0 mixes up several attributes of our own"


def test_obj_is_closed_and_wears_its_texture(ring, run, tmp_path):
    export.main([str(run), str(tmp_path / "a b.obj"), "--subdivisions", "3", "--resolution", str(RESOLUTION)])
    text = (tmp_path / "a b.obj").read_text()
    assert text.count("\nv ") == 10 * 4**3 + 2 and text.count("\nf ") == 20 * 4**3
    mesh = trimesh.load(tmp_path / "a b.obj", process=False, maintain_order=True)
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert whole.is_watertight and whole.volume > 0
    library = dict(line.split(maxsplit=1) for line in (tmp_path / "a b.mtl").read_text().splitlines())
    maps = {key: Image.open(tmp_path / library[key]) for key in ("map_Kd", "map_Ks", "map_Pr", "norm")}
    assert all(image.size == (RESOLUTION, RESOLUTION) for image in maps.values())
    uv = mesh.visual.uv * [1, -1] + [0, 1]
    s = ring.domain.sample(3)[0].numpy()
    with torch.no_grad():
        vertices = ring.surface(torch.from_numpy(s)).numpy()
    nearest = np.linalg.norm(mesh.vertices[:, None] - vertices[None], axis=2).argmin(1)
    rough = np.sqrt(atlas.reflectances(ring, s)["roughness"])[nearest]
    found = bilinear(np.asarray(maps["map_Pr"])[..., None], uv)[:, 0] / 255
    assert rough.std() > 0.02 and np.abs(found - rough).max() < 0.03


def test_mitsuba_folder_needs_nothing_of_ours(run, tmp_path):
    """Stock Mitsuba draws from it, in another process, what our plugins draw of the run."""
    export.main([str(run), str(tmp_path / "stock" / "scene.xml"), "--resolution", str(RESOLUTION)])
    script = f"""import sys, drjit as dr, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(2)  # with one Mitsuba waits for ever to read an EXR
scene = mi.load_file({str(tmp_path / "stock" / "scene.xml")!r}, parallel=False)
picture = mi.render(scene, integrator=mi.load_dict({{"type": "direct"}}), spp=64)
assert "mi_ring" not in sys.modules
np.save({str(tmp_path / "stock.npy")!r}, np.array(picture)[..., :3])"""
    subprocess.run([sys.executable, "-c", script], check=True, cwd=tmp_path)
    stock = np.load(tmp_path / "stock.npy")
    shot, *_ = mitsuba_scene.first_photograph(run)
    matrix, (fx, fy), (cx, cy), *_ = shot.camera
    assert fx != fy and stock.shape == (round(40 * fx / fy), 56, 3)
    light = shot.light
    scene = mi.load_dict({
        "type": "scene", "object": {"type": "shapenet", "weights": str(run / "ring.pt"), "subdivisions": 4,
                                    "bsdf": {"type": "cooktorrance"}},
        "sensor": {"type": "photograph", "filename": "none", "fx": float(fx), "fy": float(fx), "cx": float(cx),
                   "cy": float(cy * fx / fy), "to_world": mi.ScalarTransform4f(matrix),
                   "film": {"type": "hdrfilm", "width": 56, "height": stock.shape[0]},
                   "light": {"type": "point", "position": light.vector.tolist(),
                             "intensity": {"type": "rgb", "value": light.rgb.tolist()}}},
    })  # fmt: skip
    ours = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64))[..., :3]
    assert ours.mean() > 0.02 and np.abs(ours - stock).mean() < 0.01 * ours.mean() + 1e-4


def test_scene_for_mitsuba_of_reflectances_beyond_one(small_capture, tmp_path):
    """They are scaled to be within [0, 1], and the light is that much stronger."""
    bright = wild()
    bright.brdf_net.scale.fill_(20.0)
    torch.save(ring_state(bright, {"subdivisions": 4}), tmp_path / "ring.pt")
    (tmp_path / "scene.xml").write_text(small_capture.read_text())
    export.main([str(tmp_path), str(tmp_path / "stock.xml"), "--resolution", str(RESOLUTION)])
    intensity = mitsuba_scene.first_photograph(tmp_path)[0].light.rgb
    stock = mi.load_file(str(tmp_path / "stock.xml"), parallel=False)
    boost = np.ravel(mi.traverse(stock.emitters()[0])["intensity.value"]) / intensity
    assert boost.min() > 20
    values = atlas.reflectances(bright, bright.domain.sample(4)[0].numpy())
    base, weight = (np.array(mi.Bitmap(str(tmp_path / f"stock_{name}.exr"))) for name in ("reflectance", "weight"))
    diffuse = (base * (1 - weight.reshape(*base.shape[:2], 1)) / math.pi).reshape(-1, 3).mean(0) * boost
    np.testing.assert_allclose(diffuse, values["diffuse"].mean(0), rtol=0.1)


def test_obj_of_principled_keeps_metal_and_gloss(tmp_path):
    inner = '<texture name="{0}" type="mesh_attribute"><string name="name" value="vertex_{0}"/></texture>'
    bsdf = f'<bsdf type="principled">{inner.format("base_color")}{inner.format("metallic")}' \
           '<float name="specular" value="0.25"/></bsdf>'  # fmt: skip
    parameters = (Parameter("base_color", 3, 0.0, 1.0), Parameter("metallic", 1, 0.0, 1.0))
    ring = wild(bsdf=bsdf, parameters=parameters)
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    export.main([str(tmp_path / "ring.pt"), str(tmp_path / "o.obj"), "--subdivisions", "3", "--resolution", "64"])
    assert "\nKs 0.02 0.02 0.02\n" in (tmp_path / "o.mtl").read_text()  # F₀ = 0.08 · 0.25
    metal = np.asarray(Image.open(tmp_path / "o_metallic.png")) / 255
    expected = atlas.reflectances(ring, ring.domain.sample(4)[0].numpy())["metallic"]
    assert abs(metal.mean() - expected.mean()) < 0.05 and abs(metal.max() - expected.max()) < 0.05


@pytest.mark.parametrize("kind, fails", [("xml", "f_alpha.exr"), ("obj", "f.obj")])
def test_a_full_disk_leaves_no_part_of_an_export(ring, run, tmp_path, monkeypatch, kind, fails):
    """And what an earlier export has left stays whole: its textures would not suit another mesh."""
    (tmp_path / "f_object.ply").write_text("as before")
    replace = os.replace

    def full(source, target):
        if Path(target).name == fails:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    monkeypatch.setattr("mi_ring.system.files.os.replace", full)
    with pytest.raises(InputError, match=rf"{re.escape(str(tmp_path / fails))}: cannot be written .No space"):
        export.main([str(run), str(tmp_path / f"f.{kind}"), "--subdivisions", "1", "--resolution", "64"])
    assert [file.name for file in tmp_path.iterdir()] == ["f_object.ply"]
    assert (tmp_path / "f_object.ply").read_text() == "as before"


def test_a_folder_in_the_place_of_a_texture_is_named_before_anything_moves(run, tmp_path):
    (tmp_path / "f_normal.png").mkdir()
    with pytest.raises(InputError, match="f_normal.png: is a folder; choose another name for f.obj"):
        export.main([str(run), str(tmp_path / "f.obj"), "--subdivisions", "1", "--resolution", "64"])
    assert [file.name for file in tmp_path.iterdir()] == ["f_normal.png"]


def test_ply_at_time_0_is_the_domain(run, tmp_path):
    export.main([str(run), str(tmp_path / "start.ply"), "--time", "0", "--subdivisions", "2"])
    mesh = trimesh.load(tmp_path / "start.ply")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTER, axis=1), RADIUS, rtol=1e-5)
    assert len(mesh.vertices) == 162


def test_material_options_reach_the_files(ring, run, tmp_path):
    edit = ["--specular-scale", "2", "--tint", "1", ".5", "0"]
    export.main([str(run), str(tmp_path / "m.ply"), "--subdivisions", "2", *edit])
    found = attributes(tmp_path / "m.ply")
    exact = atlas.reflectances(ring, ring.domain.sample(2)[0].numpy())
    np.testing.assert_allclose(found["vertex_specular"], 2 * exact["specular"], rtol=1e-5)
    np.testing.assert_allclose(found["vertex_diffuse"], (exact["diffuse"] * [1, 0.5, 0]).ravel(), rtol=1e-5)


@pytest.mark.parametrize("arguments, words", [
    (["o.stl"], "o.stl: must end in .ply, .obj, .glb, .xml"),
    (["o.glb", "--resolution", "7"], "--resolution: is 7"),
    (["o.glb", "--subdivisions", "9"], "--subdivisions: is 9, must be 0 to 8; textures"),
    (["o.ply", "--subdivisions", "11"], "--subdivisions: is 11, must be 0 to 10"),
    (["o.ply", "--time", "1.5"], "--time: is 1.5"),
    (["o.glb", "--metres", "-1"], "--metres: is -1"),
    (["o.obj", "--metres", "0.01"], "--metres: is for .glb"),
    (["o.ply", "--tint", "1", "-1", "1"], "--tint"),
])  # fmt: skip
def test_mistakes_are_one_line(arguments, words, run, tmp_path):
    assert words in complaint(run, tmp_path / arguments[0], *arguments[1:])
    assert not list(tmp_path.iterdir())


def test_what_a_fit_and_a_capture_are_made_of_is_not_overwritten(run, small_capture, tmp_path):
    (tmp_path / "copy.xml").write_text(small_capture.read_text())
    for file in (run / "scene.xml", run / "mesh.ply", tmp_path / "copy.xml"):
        assert "choose another name" in complaint(run, file)
    assert (tmp_path / "copy.xml").read_text() == small_capture.read_text()


def test_a_report_goes_without_what_cannot_be_exported(ring, monkeypatch, capsys):
    pytest.importorskip("xatlas")
    assert results.viewed(ring) is not None
    monkeypatch.setattr("xatlas.Atlas", None)
    assert results.viewed(ring) is None
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_a_scene_for_mitsuba_needs_the_results_folder(run, tmp_path):
    assert "give the folder" in complaint(run / "ring.pt", tmp_path / "scene.xml")


def test_a_material_that_gltf_lacks_is_refused_before_the_work(tmp_path, monkeypatch):
    parameters = (Parameter("specular_reflectance", 3, 0.0, 1.0),)
    bsdf = '<bsdf type="conductor"><texture name="specular_reflectance" type="mesh_attribute"><string name="name" ' \
           'value="vertex_specular_reflectance"/></texture></bsdf>'  # fmt: skip
    torch.save(ring_state(wild(bsdf=bsdf, parameters=parameters)), tmp_path / "ring.pt")
    monkeypatch.setattr("xatlas.Atlas", None)
    assert "conductor" in complaint(tmp_path / "ring.pt", tmp_path / "o.glb")
    export.main([str(tmp_path / "ring.pt"), str(tmp_path / "o.ply"), "--subdivisions", "2"])
    assert "vertex_specular_reflectance" in attributes(tmp_path / "o.ply")


@pytest.mark.parametrize("bsdf", ["<bsdf", '<bsdf type="blendbsdf"/>', '<bsdf type="velvet"/>'])
def test_a_material_that_is_none_is_refused(tmp_path, bsdf):
    torch.save(ring_state(wild(bsdf=bsdf)), tmp_path / "ring.pt")
    assert "bsdf: " in complaint(tmp_path / "ring.pt", tmp_path / "o.glb")
