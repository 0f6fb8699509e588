"""Synthetic captures: radiance by closed forms, what scene files say, what is wrong on purpose, what is refused."""

import os
import shutil
import struct

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.merl_tables import closed_form, directions, evaluate, networks, nodes, write
from PIL import Image
from scipy.spatial.transform import Rotation

import mi_ring
from mi_ring import check, synthesize
from mi_ring.capture.decoding import decode
from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera
from mi_ring.geometry.sphere_map import even_directions
from mi_ring.images import read_image
from mi_ring.metrics.surfaces import compare_surfaces, load_true_mesh
from mi_ring.photogrammetry.marker_sheet import MarkerSheet
from mi_ring.rendering.photograph_lights import Lights
from mi_ring.rendering.spherical_harmonics import PER_FRAME
from mi_ring.scene.lights import Light
from mi_ring.scene.plain_mesh import mesh_of, scene_of
from mi_ring.scene.shot import Shot
from mi_ring.synthesis import light_sources
from mi_ring.synthesis.degradation import encode, exposures, miscalibrated, with_noise
from mi_ring.synthesis.materials import COLOURS, load_material, parse_plugin
from mi_ring.synthesis.object_on_table import ObjectOnTable, load_object
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.path_traced_capture import Studio, write_scenes
from mi_ring.synthesis.tracing import LensCamera
from mi_ring.synthesis.viewpoints import look_at, poses

SMALL = ["--views", "9", "--size", "56", "40", "--spp", "16", "--novel", "2"]
ALBEDO = np.array([0.6, 0.3, 0.2])


@pytest.fixture(scope="module")
def lump(tmp_path_factory):
    """A closed mesh without any symmetry, away from the origin."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = ball.vertices.T
    ball.vertices *= (1 + 0.2 * np.sin(2 * x + 1) + 0.15 * np.cos(3 * y - 2 * z))[:, None] * [1.3, 0.8, 1.0]
    ball.vertices += [7, -3, 2]
    path = tmp_path_factory.mktemp("lump") / "lump.obj"
    ball.export(path)
    return path


@pytest.fixture(scope="module")
def matt(lump, tmp_path_factory):
    """A Lambertian capture without interreflection, under free lights."""
    out = tmp_path_factory.mktemp("captures") / "matt"
    synthesize.main([str(lump), str(out), *SMALL, "--material", "diffuse reflectance=0.6,0.3,0.2", "--light", "point",
                     "--depth", "2"])  # fmt: skip
    return out


def lambert(shape, albedo):
    shape.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo.tolist()}}))
    return shape


def camera_at(position, target, size=(7, 5)):
    """A camera whose axes and pixels are those of nobody else."""
    to_world = look_at(np.array(position), np.array(target), np.array([0.2, 1.0, 0.1]), roll=0.3)
    return Camera(to_world, np.array([60.0, 66.0]), np.array([3.1, 2.7]), size)


def rays(camera):
    """Directions (H, W, 3) through the middle of pixels, by the words of the contract: x left, y up, z forward."""
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.centre, camera.size
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    own = np.stack([-(x - cx) / fx, -(y - cy) / fy, np.ones_like(x)], -1) @ camera.to_world[:3, :3].T
    return own / np.linalg.norm(own, axis=-1, keepdims=True)


def hits(camera, mesh):
    """Points (n, 3) of a mesh that pixels show in their middle, smooth normals there, and which pixels (n,)."""
    d = rays(camera).reshape(-1, 3).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*camera.position.tolist()), mi.Vector3f(*d.T))
    si = scene_of(mesh.vertices, mesh.faces).ray_intersect(ray)
    index = np.flatnonzero(np.array(si.is_valid()))
    return np.array(si.p).T[index], np.array(si.sh_frame.n).T[index], index


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_a_lambertian_plane_is_as_bright_as_it_must_be(kind):
    """ρ / π cos θ I / d²."""
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    square = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]) @ turn.T + [3, -2, 5]
    scene = ObjectOnTable(lambert(mesh_of(square, [[0, 1, 2], [0, 2, 3]]), ALBEDO), square)
    n, middle = turn[:, 2], square.mean(0)
    camera = camera_at(middle + turn @ [4, 3, 20], middle + turn @ [1, -1, 0])
    rgb, place = np.array([900.0, 500.0, 700.0]), middle + turn @ [-6, 2, 11]
    light = Light("point", place, rgb) if kind == "point" else Light("directional", -turn @ [0.3, 0.5, 0.8], rgb / 900)
    found = scene.radiance(LensCamera(camera), light, 64, 3, 2)
    d = rays(camera)
    p = camera.position + ((middle - camera.position) @ n / (d @ n))[..., None] * d
    to_light = place - p if kind == "point" else np.broadcast_to(turn @ [0.3, 0.5, 0.8], p.shape)
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    cosine = (to_light @ n)[..., None] / distance
    np.testing.assert_allclose(found, ALBEDO / np.pi * cosine * light.rgb / (distance**2 if kind == "point" else 1),
                               rtol=5e-3)  # fmt: skip


@pytest.mark.parametrize("in_camera", [False, True])
@pytest.mark.parametrize("kind", ["harmonics", "windows"])
def test_a_sphere_in_a_room_is_as_bright_as_it_must_be(kind, in_camera):
    """Order l of the room's radiance brings π, 2π/3, π/4 times as much irradiance (Ramamoorthi and Hanrahan 2001).

    That of windows is a sum over directions.
    """
    ball = trimesh.creation.icosphere(subdivisions=5)
    scene = ObjectOnTable(lambert(mesh_of(ball.vertices, ball.faces), ALBEDO), ball.vertices)
    camera = camera_at([5, 9, -14], [0.05, 0.02, 0], (27, 21))
    camera = camera._replace(focal=np.array([150.0, 165.0]), centre=np.array([13.1, 10.7]))
    room, windows = light_sources.random_room(kind, in_camera, np.random.default_rng(4))
    seen = mi.Bitmap(light_sources.room_envmap(room, camera.to_world, lobes=windows).astype(np.float32))
    lamp = mi.load_dict({"type": "envmap", "bitmap": seen})
    found = scene.radiance(LensCamera(camera), lamp, 1024, 5, 2)
    d = rays(camera)
    half = -(d @ camera.position)
    root = half**2 - camera.position @ camera.position + 1
    hit = root > 0.25
    n = camera.position + (half - np.sqrt(np.maximum(root, 0)))[..., None] * d
    own = n @ camera.to_world[:3, :3] if in_camera else n
    direction = mi.Vector3f(*own.reshape(-1, 3).T.astype(np.float32))
    basis = [np.array(h) + np.zeros(hit.size) for h in dr.sh_eval(direction, 2)]
    order = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4], [1, 3, 5])
    harmonics = np.vstack([room[:1], room[PER_FRAME : PER_FRAME + 8]]) if in_camera else room[:9]
    irradiance = (np.array(basis).T @ (order[:, None] * harmonics)).reshape(*hit.shape, 3)
    if windows is not None:
        toward = even_directions(20_000)
        radiance = windows.radiance(toward, camera.to_world) * 4 * np.pi / len(toward)
        irradiance += np.maximum(n @ toward.T, 0) @ radiance
        assert np.linalg.norm(windows.mean_radiance()) > 1.3 * np.linalg.norm(harmonics[0]) / np.sqrt(4 * np.pi)
    assert hit.sum() > 100
    error = (found / np.maximum(ALBEDO / np.pi * irradiance, 1e-9) - 1)[hit]  # of 1024 paths: 1 % each
    assert np.abs(error).max() < 0.1 and np.abs(error.mean(0)).max() < 0.004


def test_the_scene_file_says_how_bright_every_pixel_is(matt):
    """Exposure, intensity, cameras and the surface, by rays of numpy."""
    capture = mi_ring.load_capture(matt / "scene.xml")
    mesh = trimesh.load(matt / "truth/mesh.ply")
    for k in (1, 6):
        camera, light = capture.shots[k].camera, Lights.of(capture.shots)[k]
        p, n, index = hits(camera, mesh)
        to_light = light.vector - p
        distance = np.linalg.norm(to_light, axis=1)
        cosine = (n * to_light).sum(1) / distance
        lit = cosine > 0.2
        expected = ALBEDO / np.pi * (cosine / distance**2)[:, None] * light.rgb
        found = np.array(capture.images[k]).reshape(-1, 3)[index]
        error = np.abs(found / expected - 1)[lit]  # but for shadows, and pixels across an outline
        assert lit.sum() > 150 and np.median(error) < 0.01 and np.quantile(error, 0.85) < 0.03


def test_masks_and_the_surface_agree_and_nothing_is_to_be_mended(matt, tmp_path):
    assert check.main([str(matt / "scene.xml"), "--out", str(tmp_path / "sheet.png")]) == 0
    capture = mi_ring.load_capture(matt / "scene.xml")
    mesh, truth = load_true_mesh(matt / "truth/mesh.ply")
    numbers, _ = compare_surfaces(capture, truth, truth, float(np.linalg.norm(mesh.extents)))
    assert numbers["normal_mean"] < 0.05 and numbers["depth_mean"] < 1e-3 and numbers["flipped"] == 0
    assert np.abs(mesh.bounds.mean(0)).max() < 1e-4 and abs(np.linalg.norm(mesh.vertices, axis=1).max() - 50) < 1e-3
    for shot, mask in zip(capture.shots, capture.masks):  # a mesh's outline is that of its vertices
        pixels, _ = shot.camera.project(mesh.vertices)
        rows, columns = np.nonzero(mask)
        np.testing.assert_allclose([columns.min(), rows.min()], pixels.min(0), atol=1.1)
        np.testing.assert_allclose([columns.max() + 1, rows.max() + 1], pixels.max(0), atol=1.1)
        assert pixels.min() > 0 and (pixels.max(0) < shot.size).all()


def test_a_mesh_is_known_by_what_it_holds(lump, matt, tmp_path, capsys):
    """The same command goes on from another folder, or when all of it has moved."""
    other = tmp_path / "moved.obj"
    shutil.copy(lump, other)
    options = [*SMALL, "--material", "diffuse reflectance=0.6,0.3,0.2", "--light", "point", "--depth", "2"]
    before = (matt / "images/000.exr").stat().st_mtime_ns
    synthesize.main([str(other), str(matt), *options])
    assert (matt / "images/000.exr").stat().st_mtime_ns == before
    other.write_text(other.read_text() + "# another\n")
    with pytest.raises(InputError, match=r"with other options \(digests\)"):
        synthesize.main([str(other), str(matt), *options])


def test_what_no_pixel_shows_alone_needs_an_exposure(lump, tmp_path):
    options = ["--views", "2", "--size", "32", "32", "--novel", "0", "--distance", "900"]
    with pytest.raises(InputError, match="no pixel shows only the object, .* give --exposure"):
        synthesize.main([str(lump), str(tmp_path / "far"), *options])


def test_a_pair_tells_the_flash_from_the_room(lump, tmp_path):
    """Their difference is what the flash shows where there is no room; novel views have the room's light."""
    size = ["--views", "3", "--size", "56", "40", "--spp", "9", "--novel", "1", "--exposure", "0.5"]
    alone, paired = tmp_path / "alone", tmp_path / "paired"
    synthesize.main([str(lump), str(alone), *size])
    synthesize.main([str(lump), str(paired), *size, "--room", "0.4", "--room-kind", "harmonics", "--pairs"])
    alone, both = mi_ring.load_capture(alone / "scene.xml"), mi_ring.load_capture(paired / "scene.xml")
    assert both.photographs.room is None and mi_ring.load_capture(paired / "truth/scene.xml").photographs.room.any()
    for k in range(3):
        lit = read_image(paired / f"images/{k:03}.exr")
        room = lit - alone.images[k]
        assert room[both.masks[k] > 0].min() > 0.01  # what would be missing
        np.testing.assert_allclose(both.images[k], alone.images[k], atol=1e-3 * lit.max())


def test_photographs_without_a_light_of_their_own_show_the_room_alone(lump, tmp_path):
    """As a pair does; the exact scene file has the windows, in the axes of the camera."""
    size = ["--views", "2", "--size", "28", "20", "--spp", "9", "--novel", "0", "--cameras", "turntable"]
    room = ["--room", "1", "--room-kind", "windows"]
    synthesize.main([str(lump), str(tmp_path / "pair"), *size, *room, "--pairs", "--exposure", "0.5"])
    synthesize.main([
        str(lump), str(tmp_path / "dark"), *size, *room, "--light", "none", "--wrong-room", "--exposure", "0.5",
    ])  # fmt: skip
    for k in range(2):
        np.testing.assert_array_equal(*(read_image(tmp_path / folder / f"{k:03}.exr")
                                        for folder in ("pair/ambient", "dark/images")))  # fmt: skip
    given, exact = (mi_ring.load_capture(tmp_path / "dark" / name) for name in ("scene.xml", "truth/exact.xml"))
    assert given.photographs.room is None and given.photographs.dark
    assert len(exact.photographs.lobes) == 3 and all(exact.photographs.lobes.in_camera)


def test_an_interrupted_capture_goes_on(matt, lump, tmp_path):
    missing, kept = matt / "images/004.exr", matt / "images/005.exr"
    before, time = missing.read_bytes(), kept.stat().st_mtime_ns
    missing.unlink()
    (matt / "scene.xml").unlink()
    options = ["--material", "diffuse reflectance=0.6,0.3,0.2", "--light", "point", "--depth", "2"]
    synthesize.main([str(lump), str(matt), *SMALL, *options])
    (tmp_path / "before.exr").write_bytes(before)
    pictures = (np.array(mi.Bitmap(str(path)), np.float32) for path in (tmp_path / "before.exr", missing))
    np.testing.assert_allclose(*pictures, rtol=2e-3, atol=1e-4)
    assert kept.stat().st_mtime_ns == time and (matt / "scene.xml").is_file()
    with pytest.raises(mi_ring.InputError, match=r"with other options \(fov, seed\)"):
        synthesize.main([str(lump), str(matt), *SMALL, *options, "--fov", "50", "--seed", "3"])
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").touch()
    with pytest.raises(mi_ring.InputError, match="OUT: exists already"):
        synthesize.main([str(lump), str(tmp_path / "other")])


def test_a_wrong_calibration_is_kept_apart_from_the_truth(lump, tmp_path):
    out = tmp_path / "wrong"
    (out / "truth").mkdir(parents=True)
    config = SynthesizeConfig(lump, out, views=30, novel=0, room=0.1, wrong_cameras=0.5, wrong_light=3, wrong_power=10,
                       wrong_room=True, light="flash")  # fmt: skip
    studio = Studio(config)
    write_scenes(studio, studio.photographs(30), [], exposure=7.0)
    said, true = (mi_ring.load_capture(out / name, images=False) for name in ("scene.xml", "truth/exact.xml"))
    assert said.photographs.room is None and not said.shots[0].calibrated and true.shots[0].calibrated
    a, b = ([s.camera.to_world for s in c.shots] for c in (said, true))
    turns = [Rotation.from_matrix(x[:3, :3] @ y[:3, :3].T).as_rotvec(degrees=True) for x, y in zip(a, b)]
    assert 0.4 < np.std(turns) < 0.6
    distance = np.linalg.norm(np.array(b)[:, :3, 3], axis=1)
    np.testing.assert_allclose(np.std((np.array(a) - b)[:, :3, 3] / distance[:, None]), 0.005, rtol=0.25)
    lights, truths = Lights.of(said.shots), Lights.of(true.shots)
    own = [x[:3, :3].T @ (place - x[:3, 3]) for x, place in zip(a, lights.positions())]  # of flashes at the lens
    np.testing.assert_allclose(np.linalg.norm(own, axis=1), 0.03 * distance, rtol=0.02)
    assert np.std(own, axis=0).max() < 0.02 * np.abs(own).max()
    np.testing.assert_allclose(np.log(lights.rgb() / truths.rgb()).std(), 0.1, rtol=0.35)
    # 0.1 / π of the light in the middle, from all sides
    middle = truths.irradiance(np.zeros(3)).mean()
    np.testing.assert_allclose(middle, 7, rtol=1e-5)
    np.testing.assert_allclose(true.photographs.room[0].mean() / np.sqrt(4 * np.pi), 0.1 / np.pi * middle, rtol=0.13)


def test_photographs_that_are_exposed_differently(lump, tmp_path):
    options = ["--views", "3", "--novel", "1", "--size", "20", "16", "--spp", "4", "--exposure", "0.5"]
    pictures = {}
    for name, more in (("alike", []), ("apart", ["--wrong-exposure", "30"])):
        synthesize.main([str(lump), str(tmp_path / name), *options, *more])
        pictures[name] = [read_image(path).astype(float) for path in sorted((tmp_path / name).rglob("*.exr"))]
    said, true = (mi_ring.load_capture(tmp_path / "apart" / name) for name in ("scene.xml", "truth/exact.xml"))
    assert not said.shots[0].calibrated and all(shot.response.gain == (1, 1, 1) for shot in said.shots)
    for k, (alike, apart) in enumerate(zip(pictures["alike"], pictures["apart"])):
        gain = true.shots[k].response.gain if k < 3 else 1.0  # the last shows a view that no fit sees
        np.testing.assert_allclose(apart, alike * gain, rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(true.observe([1]).rgb[0], pictures["alike"][1], rtol=2e-3, atol=1e-6)
    many = exposures(20_000, 30, np.random.default_rng(1))
    assert np.log(many).std() == pytest.approx(np.hypot(0.3, 0.1), rel=0.05)
    assert np.log(many[:, 0] / many[:, 1]).std() == pytest.approx(0.1 * 2**0.5, rel=0.05)


def test_stripes_are_where_they_are_said_to_be(lump, tmp_path):
    """Red and blue, by the height of what each pixel shows."""
    out = tmp_path / "stripes"
    synthesize.main([
        str(lump), str(out), "--views", "2", "--novel", "0", "--size", "70", "50", "--spp", "9", "--bands", "5",
        "--up", "z", "--depth", "2", "--material", "diffuse reflectance=0.6,0.02,0.02",
        "--second", "diffuse reflectance=0.02,0.02,0.6",
    ])  # fmt: skip
    capture = mi_ring.load_capture(out / "scene.xml")
    mesh = trimesh.load(out / "truth/mesh.ply")
    low, high = mesh.bounds[:, 2]
    for k, shot in enumerate(capture.shots):
        p, _, index = hits(shot.camera, mesh)
        band = 5 * (p[:, 2] - low) / (high - low)
        picture = np.array(capture.images[k]).reshape(-1, 3)[index]
        inside = np.abs(band - np.round(band)) > 0.25
        blue = (picture[:, 2] > picture[:, 0])[inside]
        assert len(np.unique(np.floor(band[inside]))) >= 3 and 0.1 < blue.mean() < 0.9
        assert (blue == (np.floor(band[inside]) % 2 == 1)).mean() > 0.97


def test_the_sheet_is_printed_true_to_scale(lump, tmp_path):
    """The board's detector finds its corners where cameras and millimetres say."""
    out = tmp_path / "sheet"
    synthesize.main([
        str(lump), str(out), "--views", "1", "--novel", "0", "--size", "800", "600", "--spp", "4", "--depth", "2",
        "--table", "sheet", "--cameras", "turntable", "--elevations", "60", "--up", "y", "--radius", "35",
        "--distance", "11", "--fov", "45", "--offset", "0.1", "0.1", "0", "--format", "png8", "--material", "diffuse",
    ])  # fmt: skip
    capture = mi_ring.load_capture(out / "scene.xml")
    sighting = MarkerSheet().detect(np.array(capture.images[0]))
    ground = trimesh.load(out / "truth/mesh.ply").bounds[0, 1]
    # Seen from above, y up: x of the page is z of the world, and y is x.
    world = np.stack([sighting.points[:, 1], np.full(len(sighting.points), ground), sighting.points[:, 0]], 1)
    pixels, _ = capture.shots[0].camera.project(world)
    assert len(pixels) > 20 and np.abs(pixels - sighting.pixels).max() < 0.5
    text = (out / "scene.xml").read_text()
    assert text.count('type="table"') == 2 and 'name="metres" value="0.001"' in text


def test_noise_is_that_of_counted_electrons():
    random = np.random.default_rng(1)
    found = with_noise(np.full((200, 300, 3), 0.25), 2000, 12, random)
    np.testing.assert_allclose(found.mean(), 0.25, rtol=1e-3)
    np.testing.assert_allclose(found.std(), np.sqrt(0.25 * 2000 + 12**2) / 2000, rtol=0.02)
    np.testing.assert_allclose(with_noise(np.zeros((200, 300, 3)), 0, 30, random).std(), 0.003, rtol=0.02)


@pytest.mark.parametrize("kind, linear, step", [("exr", True, 5e-4), ("png16", True, 8e-6), ("png8", False, 5e-3)])
def test_files_hold_what_was_seen(kind, linear, step):
    seen = np.random.default_rng(2).uniform(0, 1, (5, 7, 3))
    pixels = encode(seen, kind)
    found, _ = decode(pixels.astype(np.float32) if kind == "exr" else pixels, linear, 1.0)
    np.testing.assert_allclose(found, seen, atol=step)


def test_lights_bring_as_much_to_the_middle_and_stay_near_their_cameras():
    random = np.random.default_rng(7)
    up = np.array([0.0, 0.0, 1.0])
    cameras = [Camera(pose, np.ones(2), np.ones(2), (2, 2)) for pose in poses("free", 40, 2.0, 9.0, up, random)]
    flash = light_sources.lights_of("flash", cameras, (0.1, -0.2, 0.05), 40, random)
    for camera, light in zip(cameras, flash):  # left, up, forward of the lens
        away = np.linalg.norm(camera.position)
        expected = away * np.array([0.1, -0.2, 0.05])
        np.testing.assert_allclose(camera.to_world[:3, :3].T @ (light.vector - camera.position), expected, atol=1e-9)
    assert len({light.rgb[0] for light in flash}) == 1
    brought = [light.rgb[0] / (light.vector @ light.vector) for light in flash]
    assert abs(np.median(brought) - 1) < 0.05
    for kind in ("point", "distant"):
        lights = light_sources.lights_of(kind, cameras, (0, 0, 0), 40, random)
        toward = [(light.vector if kind == "point" else -light.vector) for light in lights]
        angles = [np.degrees(np.arccos(camera.position @ t / np.linalg.norm(camera.position) / np.linalg.norm(t)))
                  for camera, t in zip(cameras, toward)]  # fmt: skip
        assert 25 < max(angles) <= 40 and np.ptp(angles) > 20


def test_cameras_of_a_turntable_go_round_in_rings_and_none_is_below_a_table():
    up, random = np.array([1.0, 0.0, 0.0]), np.random.default_rng(3)
    rings = np.array(poses("turntable", 10, 1.0, 4.0, up, random, (15.0, 50.0)))[:, :3, 3]
    heights = np.degrees(np.arcsin(rings[:, 0] / 4))
    np.testing.assert_allclose(heights, [15] * 5 + [50] * 5)
    turns = np.sort(np.degrees(np.arctan2(rings[:5, 1], rings[:5, 2])) % 360)
    np.testing.assert_allclose(np.diff(turns), 72)
    for kind in ("around", "free"):
        standing = np.array(poses(kind, 50, 1.0, 4.0, up, random, standing=True))
        assert standing[:, 0, 3].min() > 0.3
        np.testing.assert_allclose(np.linalg.det(standing[:, :3, :3]), 1)
    everywhere = np.array(poses("around", 200, 1.0, 4.0, up, random))[:, :3, 3] / 4
    np.testing.assert_allclose(everywhere.T @ everywhere / 200, np.eye(3) / 3, atol=0.02)  # even


def test_lights_that_are_said_to_be_elsewhere_are_as_seeds_say():
    cameras = [camera_at([5.0, 2, 1], [0, 0, 0]), camera_at([-3.0, 2, 4], [0, 0, 0])]
    shots = [Shot(str(k), camera) for k, camera in enumerate(cameras)]
    one, other = (miscalibrated(shots, np.zeros(3), np.random.default_rng(5), shifted=2) for _ in range(2))
    np.testing.assert_array_equal([a.light.vector for a in one], [b.light.vector for b in other])
    places = [camera.position for camera in cameras]
    far = [np.linalg.norm(a.light.vector - b) / np.linalg.norm(b) for a, b in zip(one, places)]
    np.testing.assert_allclose(far, 0.02)


def test_materials_of_every_form(tmp_path):
    networks(tmp_path / "nets.npz")
    write(tmp_path / "table.binary", closed_form(*nodes()))
    (tmp_path / "glaze.xml").write_text('<bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
                                        '<string name="filename" value="dot.exr"/></texture></bsdf>')  # fmt: skip
    mi.Bitmap(np.full((2, 2, 3), 0.4, np.float32)).write(str(tmp_path / "dot.exr"))
    rough = {"type": "roughconductor", "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
    wi, wo = directions(20, 1), directions(20, 2)
    for text, meant in (
        (f"{tmp_path}/nets.npz:other", {"type": "merl", "filename": f"{tmp_path}/nets.npz", "material": "other"}),
        (f"{tmp_path}/table.binary", {"type": "merl", "filename": f"{tmp_path}/table.binary"}),
        (f"{tmp_path}/glaze.xml", {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.4, 0.4]}}),
        ("roughconductor alpha=0.3 specular_reflectance=0.9,0.5,0.2", rough),
    ):
        found = evaluate(load_material(text, "--material", coloured=False), wi, wo)
        np.testing.assert_allclose(found, evaluate(mi.load_dict(meant), wi, wo), rtol=1e-5)


def test_colours_of_a_file_are_those_of_the_object(tmp_path):
    """Of vertices, and of a texture where the surface is seamed; also after subdivision."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    red = ball.vertices[:, 0] > 0
    ball.visual.vertex_colors = np.where(red[:, None], [[200, 30, 20, 255]], [[20, 40, 190, 255]])
    ball.export(tmp_path / "ball.ply")
    u = (ball.vertices[:, 0] + 1) / 2
    picture = Image.fromarray(np.repeat(np.array([[[20, 40, 190], [200, 30, 20]]], np.uint8), 2, 0).repeat(64, 1))
    ball.visual = trimesh.visual.TextureVisuals(np.stack([u, u], 1), image=picture)
    ball.export(tmp_path / "ball.glb")
    linear = ((np.array([200, 30, 20]) / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    for name in ("ball.ply", "ball.glb"):
        for smooth in (False, True):
            mesh, colours, _ = load_object(tmp_path / name, 50, smooth)
            assert len(colours) == len(mesh.vertices) and (len(mesh.vertices) > 10_000) == smooth
            seen = colours[mesh.vertices[:, 0] > 20]
            np.testing.assert_allclose(seen, np.broadcast_to(linear, seen.shape), rtol=0.01, err_msg=name)
    assert parse_plugin("diffuse reflectance=vertex_color", "", True)["reflectance"]["name"] == COLOURS


@pytest.mark.parametrize("options, message", [
    (["--views", "0"], "--views: is 0, must be 1 to"),
    (["--size", "4", "9"], "--size: is 4 9"),
    (["--distance", "1"], "--distance: is 1.0"),
    (["--material", "gold"], "^--material: gold: Mitsuba has no plugin gold; give a file .xml"),
    (["--material", "diffuse reflectence=0.5,0.1,0.1 b=c"], "^--material: .*: has no parameter reflectence and b; "),
    (["--second", "principled roughness=low"], "^--second: .*: roughness is a string, must be a number or a colour"),
    (["--material", "roughplastic alpha=true"], "^--material: .*: alpha is a boolean, must be a number$"),
    (["--material", "diffuse reflectance=-1,2,3"], r"^--material: diffuse reflectance=-1,2,3: Invalid RGB"),
    (["--exposure", "2", "--clipped", "0.1"], "^--clipped: determines the exposure"),
    (["--material", "diffuse 0.5"], "found '0.5'; each parameter must be NAME=VALUE"),
    (["--material", "principled base_color=vertex_color"], "the mesh's file has no colours"),
    (["--material", "none.xml"], "none.xml: --material: no such file"),
    (["--material", "none.npz:gold"], "none.npz: --material: no such file"),
    (["--material", "bitmap"], "--material: bitmap: needs nested parts, which only an .xml can give; give a file .xml"),
    (["--second", "perspective"], "--second: perspective: is no BSDF"),
    (["--second", "diffuse", "--pattern", "dots"], "dots: --pattern: no such file; give stripes, checks or"),
    (["--environment", "none.exr"], "none.exr: --environment: no such file"),
    (["--wrong-room"], "--wrong-room: there is no room"),
    (["--pairs"], "--pairs: need a room"),
    (["--pairs", "--room", "0.1", "--wrong-room"], "--pairs: need a room"),
    (["--lamps", "2"], "--lamps: is 2, which is for --light lamp"),
    (["--light", "lamp", "--lamps", "9"], "--lamps: is 9, must be 1 to 8"),
    (["--cameras", "turntable", "--light", "lamp"], "--cameras: is turntable; an --environment"),
    (["--light", "none"], "--light: is none; give --room 1"),
    (["--light", "none", "--room", "1", "--wrong-power", "5"], "--light: is none; leave out .*--wrong-power"),
    (["--room-kind", "windows"], "--room-kind: there is no room; give --room"),
    (["--room-kind", "windows", "--room", "1", "--table", "plain"], "--room-kind: is windows, .* leave out --table"),
    (["--light", "moon"], "--light: is moon; must be one of"),
])  # fmt: skip
def test_mistakes_are_told_in_one_line_before_any_work(options, message, lump, tmp_path):
    with pytest.raises(mi_ring.InputError, match=message):
        synthesize.main([str(lump), str(tmp_path / "out"), *options])
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and not os.path.basename(path).startswith(".")]


@pytest.mark.parametrize("content", ['<texture type="bitmap" name="base_color"/>', '<bsdf type="blendbsdf"/>'])
def test_materials_that_mitsuba_crashes_of(content, lump, tmp_path):
    (tmp_path / "a.xml").write_text(f'<bsdf type="principled">{content}</bsdf>')
    with pytest.raises(mi_ring.InputError, match="--material: .*a.xml: b[a-z]+: (filename is|is empty)"):
        synthesize.main([str(lump), str(tmp_path / "out"), "--material", str(tmp_path / "a.xml")])


def test_an_environment_that_declares_to_be_enormous(lump, tmp_path):
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    content = (tmp_path / "sky.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 7, 3)
    (tmp_path / "sky.exr").write_bytes(content.replace(window, struct.pack("<4i", 0, 0, 59999, 59999)))
    with pytest.raises(mi_ring.InputError, match=r"sky.exr: --environment: .*declares [\d,]+ bytes, in a file of"):
        synthesize.main([str(lump), str(tmp_path / "out"), "--environment", str(tmp_path / "sky.exr")])


def test_what_is_no_mesh_is_told(tmp_path):
    for name, content in (("empty.obj", "v 0 0 0\n"), ("text.ply", "nonsense")):
        (tmp_path / name).write_text(content)
        with pytest.raises(mi_ring.InputError, match=f"{name}: MESH: "):
            synthesize.main([str(tmp_path / name), str(tmp_path / "out")])
