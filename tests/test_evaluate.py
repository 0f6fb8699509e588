"""`mi_ring.evaluate`: each number against a closed form or a second way to find it, and the command as a whole."""

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import AXES, CENTER
from scipy.spatial.transform import Rotation
from trimesh.creation import box, icosphere, torus

from mi_ring import evaluate, render
from mi_ring.capture import loading, scenefile
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import area_vectors, genus
from mi_ring.metrics import image_errors, surfaces
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import ply
from mi_ring.rendering.photograph_lights import Lights
from mi_ring.scene import plain_mesh
from mi_ring.scene import self_intersections as intersections
from mi_ring.scene.lights import Light
from mi_ring.system.command import run


def rectangle(width, height, z=0.0):
    """In the plane of this z, a corner at the origin."""
    corners = [[0, 0, z], [width, 0, z], [width, height, z], [0, height, z]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def moved(mesh, scale=1.0, to=(400.0, -1500.0, 90.0)):
    """Somewhere else, where coordinates are large."""
    return trimesh.Trimesh(mesh.vertices * scale + to, mesh.faces, process=False)


# Chamfer distance and F-score.


def test_parallel_planes_are_as_far_apart_as_they_are():
    # The diagonal is 5: 0.015 of it is 0.3 %, to both sides.
    numbers = surfaces.compare_shapes(moved(rectangle(3, 4, 0.015)), moved(rectangle(3, 4)))
    assert numbers["chamfer"] == pytest.approx(0.3, abs=1e-9)
    assert numbers["f_score_0.1"] == 0 and numbers["f_score_0.5"] == 1


def test_equal_surfaces_of_other_triangles_have_no_distance():
    numbers = surfaces.compare_shapes(moved(box((3, 4, 5)).subdivide()), moved(box((3, 4, 5))))
    assert numbers["chamfer"] < 1e-9
    assert numbers["f_score_0.1"] == numbers["f_score_0.5"] == 1


@pytest.mark.parametrize("swapped", [False, True])
def test_what_is_missing_or_too_much_counts_half(swapped):
    half, whole = moved(rectangle(1, 1), 7), moved(rectangle(2, 1), 7)
    numbers = surfaces.compare_shapes(*(whole, half) if swapped else (half, whole))
    diagonal = np.sqrt(2 if swapped else 5)
    # A point of the other half is between 0 and 1 away from the first, 1/2 in the mean. Tolerances: 100,000 points.
    assert numbers["chamfer"] == pytest.approx(100 / diagonal * (0 + 1 / 4) / 2, rel=0.02)
    for threshold in (0.1, 0.5):
        share = (1 + threshold / 100 * diagonal) / 2
        assert numbers[f"f_score_{threshold}"] == pytest.approx(2 * share / (1 + share), abs=0.005)


def test_spheres_of_two_radii():
    numbers = surfaces.compare_shapes(moved(icosphere(5, 1.004), 30), moved(icosphere(5), 30))
    assert numbers["chamfer"] == pytest.approx(100 * 0.004 / (2 * np.sqrt(3)), rel=0.01)
    numbers = surfaces.compare_shapes(icosphere(5, 1.004), icosphere(5))
    assert numbers["f_score_0.1"] == 0 and numbers["f_score_0.5"] == 1  # 0.115 %


def test_distances_are_by_the_diagonal_of_the_truth_before_it_is_moved():
    """However a frame is turned, in which the box about the same surface is another."""
    long, chamfer = trimesh.creation.capsule(height=60, radius=20), []
    diagonal = float(np.linalg.norm(long.extents))
    for angle in (0.0, 0.7):
        turned = long.copy().apply_transform(trimesh.transformations.rotation_matrix(angle, [0.48, 0.6, -0.64]))
        larger = turned.copy().apply_transform(trimesh.transformations.scale_matrix(1.02))
        chamfer.append(surfaces.compare_shapes(larger, turned, diagonal=diagonal)["chamfer"])
    assert chamfer[1] == pytest.approx(chamfer[0], rel=0.01)
    assert surfaces.compare_shapes(larger, turned)["chamfer"] != pytest.approx(chamfer[0], rel=0.05)


# Triangles that cross.


def test_alignment_finds_the_motion_between_two_samplings_of_one_surface():
    fine, coarse = trimesh.creation.icosphere(4), trimesh.creation.icosphere(5)
    for ball in (fine, coarse):
        x, y, z = ball.vertices.T
        bumps = 1 + 0.3 * np.sin(2 * x + 1) + 0.2 * np.cos(3 * y - z)
        ball.vertices = ball.vertices * bumps[:, None] * [30, 20, 25] + [400, -150, 90]
    motion = trimesh.transformations.rotation_matrix(np.radians(2), [1, 2, -1], [390, -140, 90])
    motion[:3, 3] += [0.4, -0.3, 0.5]
    scaled = motion @ trimesh.transformations.scale_matrix(1.02, [400, -150, 90])
    for similarity, true in ((False, motion), (True, scaled)):
        found = surfaces.alignment(coarse, fine.copy().apply_transform(true), similarity)
        off = trimesh.transform_points(fine.vertices, found) - trimesh.transform_points(fine.vertices, true)
        assert np.linalg.norm(off, axis=1).max() < 0.15  # of 80; it was 2 off


def test_photographs_move_with_the_truth(small_capture):
    """A point is where it was in each, and as brightly lit."""
    matrix, point = np.eye(4), np.array([[0.3, -0.2, 0.5]]) + CENTER
    turn, shift = Rotation.from_rotvec([0.1, -0.2, 0.3]), np.array([5.0, -7, 2])
    matrix[:3] = np.c_[1.3 * turn.as_matrix(), shift]
    capture = loading.load_capture(small_capture)
    there = capture.moved(1.3, turn.as_matrix(), shift)
    for one, other in zip(capture.shots, there.shots):
        places = [
            shot.camera.project(p) for shot, p in ((one, point), (other, trimesh.transform_points(point, matrix)))
        ]
        np.testing.assert_allclose(places[0][0], places[1][0], atol=1e-3)
        np.testing.assert_allclose(1.3 * places[0][1], places[1][1], rtol=1e-5)
    sun = Light("directional", np.array([0.6, 0.0, -0.8]), np.array([3.0, 2, 1]))
    lit = replace(capture, shots=tuple(replace(shot, light=sun) for shot in capture.shots))
    turned = Lights.of(lit.moved(1.3, turn.as_matrix(), shift).shots)[0]
    np.testing.assert_allclose(turned.vector, turn.apply(sun.vector), atol=1e-6)
    np.testing.assert_allclose(turned.rgb, sun.rgb)
    before, after = Lights.of(capture.shots), Lights.of(there.shots)
    distances = [np.linalg.norm(lights.positions() - p, axis=1, keepdims=True)
                 for lights, p in ((before, point), (after, trimesh.transform_points(point, matrix)))]  # fmt: skip
    np.testing.assert_allclose(before.rgb() / distances[0] ** 2, after.rgb() / distances[1] ** 2, rtol=1e-4)


def self_intersections(mesh):
    return int(intersections.crossing_triangles(mesh.vertices, mesh.faces).sum())


def crossing_triangles(mesh):
    """The obvious way, in double precision: every edge of every triangle against every triangle."""

    def volume(p, q, r, s):
        return np.einsum("...i,...i", np.cross(q - p, r - p), s - p)

    a, b, c = mesh.triangles.transpose(1, 0, 2)
    crossing = np.zeros(len(mesh.faces), bool)
    for face, corners in enumerate(mesh.faces):
        for edge in zip(corners, np.roll(corners, 1)):
            p, q = mesh.vertices[list(edge)]
            sides = np.sign([volume(a, b, p, q), volume(b, c, p, q), volume(c, a, p, q)])
            pierced = (volume(a, b, c, p) * volume(a, b, c, q) < 0) & (np.abs(sides.sum(0)) == 3)
            pierced &= ~np.isin(mesh.faces, edge).any(1)
            crossing |= pierced
            crossing[face] |= pierced.any()
    return int(crossing.sum())


@pytest.mark.parametrize("seed", range(4))
def test_two_spheres_that_interpenetrate(seed):
    random = np.random.default_rng(seed)
    other = icosphere(2, 0.7)
    other.apply_transform(trimesh.transformations.random_rotation_matrix(random.random(3)))
    other.apply_translation(random.uniform(0.3, 0.6, 3))
    both = icosphere(2) + other
    expected = crossing_triangles(both)
    assert expected > 30
    for mesh in (both, moved(both, 30), moved(both, 0.01)):  # at the last, float32 would see nothing
        assert self_intersections(mesh) == expected


def test_a_crumpled_sphere_where_an_edge_pierces_many():
    mesh = icosphere(2)
    mesh = moved(trimesh.Trimesh(mesh.vertices + np.random.default_rng(1).normal(0, 0.3, mesh.vertices.shape),
                                 mesh.faces, process=False), 20)  # fmt: skip
    expected = crossing_triangles(mesh)
    assert expected > 0.5 * len(mesh.faces)
    assert self_intersections(mesh) == expected


def test_one_needle_through_three_sheets():
    sheets = [rectangle(4, 3, z) for z in (0.0, 0.5, 1.0)]
    needle = trimesh.Trimesh([[2.5, 1, -1], [2.5, 1, 2], [9, 1.2, 0.1]], [[0, 1, 2]], process=False)
    mesh = trimesh.util.concatenate([*sheets, needle])
    assert self_intersections(mesh) == crossing_triangles(mesh) >= 4


@pytest.mark.parametrize(
    "mesh", [icosphere(4), torus(1, 0.3), box((1, 2, 3)).subdivide(), icosphere(2) + icosphere(2, 0.9)],
    ids=["sphere", "torus", "box", "nested spheres"],
)  # fmt: skip
def test_what_does_not_cross_itself(mesh):
    for surface in (mesh, moved(mesh, 3)):
        assert self_intersections(surface) == 0


def test_area_vectors_of_a_closed_surface():
    mesh = moved(torus(1, 0.3))
    points = torch.from_numpy(np.array(mesh.vertices))
    faces = torch.from_numpy(np.array(mesh.faces))
    vectors = area_vectors(points, faces)
    assert float(vectors.norm(dim=1).sum() / 2) == pytest.approx(mesh.area)
    assert float((vectors * points[faces].mean(1)).sum() / 6) == pytest.approx(mesh.volume)  # outward, by Gauss


def test_genus_of_all_pieces():
    ring, far = torus(1, 0.3), moved(torus(1, 0.3))
    assert genus(icosphere(2)) == 0 and genus(ring) == 1
    assert genus(ring + far) == 2 and genus(icosphere(2) + far) == 1


# Views.


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_truth_that_is_inside_out_is_turned_with_a_word(tmp_path, capsys, suffix):
    """Also an open one, off the origin, with an asymmetric bump."""
    ball = moved(icosphere(3), 20, CENTER)
    vertices = np.array(ball.vertices)
    vertices[vertices[:, 0] > CENTER[0] + 12] *= 1.2
    for name, faces in (("out", ball.faces), ("in", ball.faces[:, ::-1]), ("open", ball.faces[9:, ::-1])):
        file = tmp_path / f"{name}{suffix}"
        trimesh.Trimesh(vertices, faces, process=False).export(file)
        mesh, _ = surfaces.load_true_mesh(file)
        assert mesh.volume > 0
        assert (f"{file}: is inside out, its faces look inwards; they are turned" in capsys.readouterr().err) == (
            name != "out")  # fmt: skip


def test_a_surface_that_is_inside_out_is_flipped(small_capture):
    scene = loading.load_capture(small_capture)
    ball = moved(icosphere(4), 20, CENTER)
    inverted = trimesh.Trimesh(ball.vertices, ball.faces[:, ::-1], process=False)
    outside, inside = (plain_mesh.scene_of(mesh.vertices, mesh.faces) for mesh in (ball, inverted))
    numbers, views = surfaces.compare_surfaces(scene, outside, outside, 10.0)
    assert numbers["flipped"] == 0 and numbers["normal_mean"] < 0.1
    numbers, _ = surfaces.compare_surfaces(scene, inside, outside, 10.0)
    assert numbers["flipped"] == 1 and numbers["normal_mean"] > 179.9
    numbers, _ = surfaces.compare_surfaces(scene, outside, inside, 10.0)
    assert numbers["flipped"] == 0  # that of the fit, not of the truth
    assert [view["name"] for view in views] == [f"{k:03}.png" for k in range(12)]


def test_ssim_is_that_of_the_paper():
    random = np.random.default_rng(2)
    a = random.random((11, 12, 3))
    b = np.clip(0.7 * a + 0.3 * random.random(a.shape) + 0.05, 0, 1)
    weights = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(weights, weights) / weights.sum() ** 2
    values = []
    for column in (0, 1):  # the window fits in twice
        for channel in range(3):
            x, y = (image[:, column : column + 11, channel] for image in (a, b))
            mx, my = (weights * x).sum(), (weights * y).sum()
            vx, vy, vxy = ((weights * p).sum() for p in ((x - mx) ** 2, (y - my) ** 2, (x - mx) * (y - my)))
            values.append((2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert image_errors.ssim(a, b)["ssim"] == pytest.approx(np.mean(values), abs=1e-9)
    assert image_errors.ssim(a, a)["ssim"] == pytest.approx(1)
    assert image_errors.ssim(a[:10], b[:10]) == {}  # it does not fit in


def test_photographs_in_a_lit_room_are_compared_inside_their_masks(broken_capture):
    """What is beside the object is not predicted."""
    path, _ = broken_capture
    for k in range(12):
        picture, mask = (np.array(mi.Bitmap(str(path.parent / f"{kind}/{k:03}.png"))) for kind in ("images", "masks"))
        if k != 7:  # the room is that of most photographs
            picture[mask.reshape(40, 56) == 0] = [140, 110, 90]
        mi.Bitmap(picture).write(str(path.parent / f"images/{k:03}.png"))
    scene = loading.load_capture(path)
    assert scene.lit_room
    ring = FittedObject(CENTER, 25.0, scale=0.5, subdivisions=3)
    numbers, views = image_errors.compare_photographs(scene, ring, 4)
    surface = image_errors.Surface(scene.scene, scene.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    squares = []
    for k in range(12):
        rgb, _ = image_errors.prediction.draw(surface, scene.photograph(k), spp=4)
        guess = np.clip(rgb[0].numpy(), 0, 1)
        guess = np.where(guess <= 0.0031308, 12.92 * guess, 1.055 * guess ** (1 / 2.4) - 0.055)
        inside = scene.masks[k] == 255
        squares.append(((guess - scene.images[k] / 255)[inside] ** 2).mean())
        assert views[k]["psnr"] == pytest.approx(-10 * np.log10(squares[k]), abs=0.05)  # 8 bits
        assert -1 <= views[k]["ssim"] <= 1
    assert numbers["psnr"] == pytest.approx(-10 * np.log10(np.mean(squares)), abs=0.05)


# The command.


@pytest.fixture(scope="module")
def sphere_run(small_capture, tmp_path_factory):
    """The results folder of a fit that has not begun."""
    folder = tmp_path_factory.mktemp("run")
    ring = FittedObject(CENTER, 25.0, scale=0.5, subdivisions=3)
    torch.save(ring_state(ring), folder / "ring.pt")
    ply.write_mesh(ring, 3, folder / "mesh.ply")
    scene = scenefile.fitted_scene_xml(small_capture, folder, 3, '<bsdf type="cooktorrance"/>')
    (folder / "scene.xml").write_bytes(scene)
    ellipsoid = trimesh.Trimesh(CENTER + icosphere(4).vertices * AXES, icosphere(4).faces)
    ellipsoid.export(folder / "truth.ply")
    return folder


def test_the_command_agrees_with_the_pictures_that_render_writes(sphere_run, small_capture, tmp_path, capsys):
    out = tmp_path / "numbers" / "all.json"
    evaluate.main([str(sphere_run), "--mesh", str(sphere_run / "truth.ply"), "--novel", str(small_capture),
                   "--out", str(out), "--spp", "4"])  # fmt: skip
    printed = capsys.readouterr()
    totals, everything = json.loads(printed.out), json.loads(out.read_text())
    assert printed.out.count("\n") == 1 and str(out) in printed.err
    assert f"{totals['psnr_input']}" in printed.err and f"{totals['chamfer']}" in printed.err
    views, novel = everything.pop("views"), everything.pop("novel_views")
    assert everything == totals
    assert totals["genus"] == totals["genus_true"] == totals["self_intersections"] == totals["flipped"] == 0
    assert np.mean([view["iou"] for view in views]) == pytest.approx(totals["iou"], abs=1e-4)
    assert novel == [{key: view[key] for key in ("name", "psnr", "ssim")} for view in views]  # the same photographs

    render.main([str(sphere_run), str(small_capture), str(tmp_path / "pictures"), "--spp", "4"])
    squares = []
    for view in views:
        names = small_capture.parent / "images" / view["name"], tmp_path / "pictures" / view["name"]
        a, b = (np.array(mi.Bitmap(str(name)))[..., :3] / 255 for name in names)
        squares.append(np.mean((a - b) ** 2))
        assert view["psnr"] == pytest.approx(-10 * np.log10(squares[-1]), abs=1e-4)
    assert totals["psnr_input"] == pytest.approx(-10 * np.log10(np.mean(squares)), abs=1e-4)
    assert totals["ssim_input"] == pytest.approx(np.mean([view["ssim"] for view in views]), abs=1e-4)

    # What the fit has not seen is no input, though its scene has it.
    kept_out, record = [1, 4], sphere_run / "calibration.json"
    record.write_text(json.dumps({"held_out": {"photographs": [views[k]["name"] for k in kept_out]}}))
    parted = evaluate(sphere_run, sphere_run / "truth.ply", spp=4)
    record.unlink()
    assert [view["name"] for view in parted["views"]] == [view["name"] for view in views]
    for name, index in (("held_out", kept_out), ("input", np.setdiff1d(np.arange(len(views)), kept_out))):
        expected = -10 * np.log10(np.mean([squares[k] for k in index]))
        assert parted[f"psnr_{name}"] == pytest.approx(expected, abs=1e-4)


def test_what_cannot_be_done_is_one_line(sphere_run, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    points = tmp_path / "points.ply"
    trimesh.PointCloud(np.eye(3)).export(points)
    truth = str(sphere_run / "truth.ply")
    for options, words in (
        (["--mesh", truth, "--out", str(tmp_path / "file" / "all.json")], ["all.json", "--out", "cannot be written"]),
        (["--mesh", truth, "--out", str(sphere_run / "mesh.ply")], ["mesh.ply", "--out", ".json"]),
        (["--mesh", str(points)], ["points.ply", "mesh", "no triangles"]),
        (["--mesh", truth, "--spp", "0"], ["--spp", "at least 1"]),
        ([], ["mi_ring.evaluate: --mesh is missing"]),
    ):
        with pytest.raises(SystemExit) as stop:
            run("mi_ring.evaluate", evaluate.main, [str(sphere_run), *options])
        complaint = capsys.readouterr().err
        assert stop.value.code == 2 and complaint.count("\n") == 1, complaint
        assert all(word in complaint for word in words), complaint
    with pytest.raises(InputError, match="--align: is affine, must be rigid or similarity"):
        evaluate(sphere_run, truth, align="affine")
    assert not (sphere_run / "evaluation.json").exists()
