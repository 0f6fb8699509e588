"""What the photographs show of a surface, against closed forms; and the files that tell it."""

import json

import mitsuba as mi
import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from conftest import CENTER
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.creation import icosphere

from mi_ring import evaluate, export, fit
from mi_ring.capture import loading, scenefile
from mi_ring.errors import InputError
from mi_ring.fitting.fit import Fit
from mi_ring.geometry.camera import Camera
from mi_ring.metrics import surfaces
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import gltf, ply
from mi_ring.scene.visibility import MaskedCamera, Visibility, visible_points

RADIUS, DISTANCE = 25.0, 70.0
LEAST = 0.2  #: cosine between normal and direction to the camera of what counts as seen


def turned(seed, distance=DISTANCE):
    """Camera-to-world of a camera somewhere around CENTER, turned at random, that looks at it."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    matrix[:3, 3] = CENTER - distance * matrix[:3, 2]
    return matrix


def view(seed=0, distance=DISTANCE, focal=(40.0, 47.0), centre=(31.5, 40.25), size=(70, 75), valid=None):
    """All of a ball of RADIUS at CENTER is within its frame, which is neither square nor centred."""
    return MaskedCamera(Camera(turned(seed, distance), np.array(focal), np.array(centre), size), valid)


def ball(level=5, scale=1.0):
    return CENTER + scale * RADIUS * icosphere(level).vertices, icosphere(level).faces


def height(view):
    """Cosine (V,) between the normals of the ball and the way to the camera."""
    away = view.camera.position - CENTER
    return icosphere(5).vertices @ away / np.linalg.norm(away)


def meets_ball(start, end, center, radius):
    """Do segments (n, 3) to a point (3,) meet a ball?"""
    along = end - start
    t = np.clip(((center - start) * along).sum(1) / (along**2).sum(1), 0, 1)
    return np.linalg.norm(start + t[:, None] * along - center, axis=1) < radius


def slant(seen_by):
    """Of each vertex of the ball: cosine between its normal and the direction to the camera."""
    toward = seen_by.camera.position - ball()[0]
    return (icosphere(5).vertices * toward).sum(1) / np.linalg.norm(toward, axis=1)


@pytest.mark.parametrize("seed, distance", [(0, 70.0), (1, 26.0), (2, 5000.0)])
def test_of_a_sphere_the_cap_is_seen_from_where_the_camera_is(seed, distance):
    seen_by = view(seed, distance, focal=(5.0, 6.0) if distance < 50 else (40.0, 47.0))
    cosine, seen = slant(seen_by), Visibility(*ball(), [seen_by]).of_vertices()
    clear = np.abs(cosine - LEAST) > 1e-3  # those at the edge itself are as the rounding has it
    assert clear.mean() > 0.99 and 0 < seen.sum() < len(seen)
    np.testing.assert_array_equal(seen[clear], (cosine > LEAST)[clear])


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_it_does_not_depend_on_the_unit(scale):
    camera = view(3).camera
    matrix = camera.to_world.copy()
    matrix[:3, 3] *= scale
    seen = Visibility(
        scale * ball()[0], ball()[1], [MaskedCamera(camera._replace(to_world=matrix), None)]
    ).of_vertices()
    cosine = slant(view(3))
    clear = np.abs(cosine - LEAST) > 1e-3
    np.testing.assert_array_equal(seen[clear], (cosine > LEAST)[clear])


def test_what_one_ball_hides_of_another():
    seen_by = view(4)
    camera = seen_by.camera
    aside = camera.to_world[:3, :3] @ [6, -4, 0]
    at, radius = CENTER - 38 * camera.forward + aside, 7.0
    vertices = np.concatenate([ball()[0], at + radius * icosphere(5).vertices])
    faces = np.concatenate([ball()[1], ball()[1] + len(ball()[0])])
    seen = Visibility(vertices, faces, [seen_by]).of_vertices()[: len(ball()[0])]
    facing = slant(seen_by) > LEAST
    hidden, never = (facing & meets_ball(ball()[0], camera.position, at, r) for r in (radius - 0.05, radius + 0.05))
    assert hidden.sum() > 100 and (facing & ~never).sum() > 100
    assert not seen[hidden].any()
    clear = facing & ~never & (slant(seen_by) > LEAST + 1e-3)
    assert seen[clear].all()
    # Somebody who stands elsewhere sees more, and never less.
    both = Visibility(vertices, faces, [seen_by, view(5)]).of_vertices()[: len(ball()[0])]
    assert (both >= seen).all() and both.sum() > seen.sum()


def test_a_point_lies_where_the_ray_through_its_pixel_goes():
    camera = view(6, size=(5, 7), centre=(1.25, 4.5), focal=(3.0, 4.0)).camera
    pixels = np.random.default_rng(0).uniform(-3, 9, (50, 2))
    depths = np.random.default_rng(1).uniform(1, 30, 50)
    directions = camera.directions(pixels)
    points = camera.position + directions * (depths / (directions @ camera.forward))[:, None]
    found, depth = camera.project(points)
    np.testing.assert_allclose(found, pixels, atol=1e-9)
    np.testing.assert_allclose(depth, depths, rtol=1e-9)


def places(view):
    """Pixel coordinates of the ball's vertices from `view`, by similar triangles."""
    matrix = view.camera.to_world
    left, up, forward = ((ball()[0] - matrix[:3, 3]) @ matrix[:3, :3]).T
    (fx, fy), (cx, cy) = view.camera.focal, view.camera.centre
    return cx - fx * left / forward, cy - fy * up / forward


def edge(view):
    """Which of the ball's vertices face the camera enough, and which are not at the edge itself."""
    return slant(view) > LEAST, np.abs(slant(view) - LEAST) > 1e-3


def unseen_share(radius):
    """Of the area of a ball: all but the cap in which the cosine is above `LEAST`."""
    angle = np.arccos(LEAST)
    return (1 + np.cos(angle - np.arcsin(radius / DISTANCE * np.sin(angle)))) / 2


@pytest.mark.parametrize("seed", [7, 8])
def test_what_the_frame_cuts_off_is_not_seen(seed):
    """5 × 7 pixels; they begin at the optical axis and cut off the top."""
    seen_by = view(seed, focal=(6.0, 9.0), centre=(0.0, 3.0), size=(5, 7))
    (x, y), (facing, clear) = places(seen_by), edge(seen_by)
    inside = (x >= 0) & (x < 5) & (y >= 0) & (y < 7)
    assert (facing & (x < 0)).sum() > 500 and (facing & (y < 0)).sum() > 50
    seen = Visibility(*ball(), [seen_by]).of_vertices()
    np.testing.assert_array_equal(seen[clear], (facing & inside)[clear])


def test_pixels_that_show_nothing_do_not_show_it():
    valid = np.full((75, 70), 255, np.uint8)
    valid[:, :29], valid[50:, :], valid[44, 33], valid[20:25, 40:] = 0, 127, 0, 128
    seen_by = view(9, valid=valid)
    (x, y), (facing, clear) = places(seen_by), edge(seen_by)
    hidden = (x < 29) | (y >= 50) | ((x >= 33) & (x < 34) & (y >= 44) & (y < 45))
    assert (facing & hidden).sum() > 500
    seen = Visibility(*ball(), [seen_by]).of_vertices()
    np.testing.assert_array_equal(seen[clear], (facing & ~hidden)[clear])
    # The same camera without: not taken for the same photograph.
    both = Visibility(*ball(), [seen_by, seen_by._replace(valid=None)]).of_vertices()
    np.testing.assert_array_equal(both[clear], facing[clear])


def test_what_is_behind_the_camera_is_not_seen():
    """Though straight lines through the camera meet the frame."""
    seen_by = view(10)
    behind = ball()[0] - 2 * DISTANCE * seen_by.camera.forward
    vertices = np.concatenate([ball()[0], behind])
    seen = Visibility(vertices, np.concatenate([ball()[1], ball()[1] + len(behind)]), [seen_by]).of_vertices()
    assert seen[: len(behind)].any() and not seen[len(behind) :].any()


def test_no_view_shows_nothing():
    assert not Visibility(*ball(2), []).of_vertices().any()


# ---------------------------------------------------------------------------------------------------------------------
# A fit's files


@pytest.fixture(scope="module")
def ring():
    """The start of a fit, which is a ball, nearly."""
    torch.manual_seed(3)
    return FittedObject(CENTER, RADIUS, scale=0.5, subdivisions=4)


@pytest.fixture(scope="module")
def run(ring, small_capture, tmp_path_factory):
    """A results folder of a fit of one photograph, whose mesh is wrong where that does not show it; and the truth."""
    folder = tmp_path_factory.mktemp("run")
    text = small_capture.read_text()
    first, last = text.index('  <sensor type="photograph" id="001">'), text.index("\n</scene>")
    source = small_capture.with_name("one.xml")
    source.write_text(text[:first] + text[last:])
    torch.save(ring_state(ring), folder / "ring.pt")
    (folder / "scene.xml").write_bytes(scenefile.fitted_scene_xml(source, folder, 4, ring.bsdf))
    (only,) = loading.load_views(folder / "scene.xml")
    trimesh.Trimesh(*ball()).export(folder / "truth.ply")
    trimesh.Trimesh(longer(only), ball()[1]).export(folder / "mesh.ply")
    return folder


def longer(view):
    """The ball's vertices, its half away from the camera drawn out to three times its depth."""
    away = view.camera.position - CENTER
    away /= np.linalg.norm(away)
    return ball()[0] + 2 * RADIUS * np.minimum(height(view), 0)[:, None] * away


def expected(ring, s, view):
    """Which points of the ball the camera sees, and which are far enough from the edge to say."""
    points = ring.surface(torch.as_tensor(s)).detach().numpy()
    away = view.camera.position - points
    away, normals = away / np.linalg.norm(away, axis=1, keepdims=True), (points - CENTER) / RADIUS
    cosine = (away * normals).sum(1)
    return cosine > LEAST, np.abs(cosine - LEAST) > 0.1


def test_the_share_of_the_area_is_that_of_the_cap(ring):
    seen_by = view(11)
    s, faces = ring.domain.sample(4)
    seen, unseen = visible_points(ring, s, faces, [seen_by])
    radius = np.linalg.norm(ring.surface(s).detach().numpy() - CENTER, axis=1).mean()
    assert unseen == pytest.approx(unseen_share(radius), abs=0.01)
    uneven = visible_points(ring, s, np.concatenate([faces, faces[seen[faces].all(1)]]), [seen_by])[1]
    assert uneven < 0.9 * unseen  # it is the area that counts, not the vertices


def test_ply_has_it(ring, run, tmp_path):
    (only,) = loading.load_views(run / "scene.xml")
    s, _ = ring.domain.sample(4)
    unseen = ply.write_mesh(ring, 4, tmp_path / "written.ply", views=[only])
    export.main([str(run), str(tmp_path / "exported.ply")])
    seen, clear = expected(ring, s, only)
    for name in ("written.ply", "exported.ply"):
        params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / name)}))
        by_mitsuba = np.array(params["vertex_seen"])
        vertices = trimesh.load(tmp_path / name, process=False).metadata["_ply_raw"]["vertex"]["data"]
        np.testing.assert_array_equal(by_mitsuba, np.ravel(vertices["seen_0"]))
        assert set(by_mitsuba) == {0, 1}
        np.testing.assert_array_equal(by_mitsuba[clear], seen[clear])
    assert unseen == pytest.approx(1 - by_mitsuba.mean(), abs=0.02)
    # On its way the surface is elsewhere; what the photographs show of the object stays what it is.
    export.main([str(run), str(tmp_path / "early.ply"), "--time", "0"])
    params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "early.ply")}))
    np.testing.assert_array_equal(np.array(params["vertex_seen"]), by_mitsuba)


def test_glb_has_it_on_both_sides_of_seams(ring, run, tmp_path):
    (only,) = loading.load_views(run / "scene.xml")
    file = tmp_path / "object.glb"
    export.main([str(run), str(file), "--subdivisions", "3", "--resolution", "64"])
    (mesh,) = trimesh.load(file).geometry.values()
    seen = np.ravel(mesh.vertex_attributes["_SEEN"])
    away, normals = only.camera.position - mesh.vertices, (mesh.vertices - CENTER) / RADIUS
    cosine = (away * normals).sum(1) / np.linalg.norm(away, axis=1)
    clear = np.abs(cosine - LEAST) > 0.15
    np.testing.assert_array_equal(seen[clear], (cosine > LEAST)[clear])
    _, whole = np.unique(mesh.vertices, axis=0, return_inverse=True)
    assert len(np.unique(np.stack([whole.ravel(), seen], 1), axis=0)) == whole.max() + 1 < len(seen)
    content = pygltflib.GLTF2().load(str(file))
    accessor = content.accessors[content.meshes[0].primitives[0].attributes._SEEN]
    assert (accessor.type, accessor.componentType, accessor.count) == ("SCALAR", pygltflib.FLOAT, len(seen))


@pytest.mark.parametrize("scene", [None, "<scene", "valid"])
def test_without_the_cameras_it_is_left_out(scene, ring, run, tmp_path, capsys):
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    if scene == "valid":
        text = (run / "scene.xml").read_text()
        scene = text.replace('<float name="fx"', '<string name="valid" value="gone.png"/><float name="fx"')
        assert scene != text
    if scene:
        (tmp_path / "scene.xml").write_text(scene)
    export.main([str(tmp_path / "ring.pt"), str(tmp_path / "object.ply"), "--subdivisions", "2"])
    assert capsys.readouterr().err.count("\n") == 1
    assert b"seen" not in (tmp_path / "object.ply").read_bytes()[:1000]
    assert b"_SEEN" not in gltf.glb(ring, 2, 64)


def test_views_of_a_capture_and_of_its_file_are_the_same(broken_capture):
    path, edit = broken_capture
    edit('<string name="filename" value="images/003.png"/>',
         '<string name="filename" value="images/003.png"/><string name="valid" value="valid.png"/>')  # fmt: skip
    valid = np.zeros((40, 56), np.uint8)
    valid[:, 20:] = 255
    Image.fromarray(valid).save(path.parent / "valid.png")
    opened, read = loading.load_capture(path).views, loading.load_views(path)
    for one, other in zip(opened, read, strict=True):
        assert (one.valid is None) == (other.valid is None)
        assert all(np.array_equal(a, b) for a, b in zip(one.camera, other.camera))
    assert [k for k, view in enumerate(read) if view.valid is not None] == [3]
    np.testing.assert_array_equal(read[3].valid, valid)


def test_a_fit_writes_and_says_it(small_capture, tmp_path):
    quick = ["--iterations", "2", "--levels", "2", "--widths", "56", "--shares", "1", "--batch", "2",
             "--subdivisions", "3", "--no-indirect", "--domain", "sphere"]  # fmt: skip
    two = small_capture.with_name("two.xml")
    text = small_capture.read_text()
    first, last = text.index('  <sensor type="photograph" id="002">'), text.index("\n</scene>")
    two.write_text(text[:first] + text[last:])
    fitted = Fit(loading.load_capture(two), fit.parse_options([str(two), *quick]))
    list(fitted)
    fitted.save(tmp_path / "out")
    vertices = trimesh.load(tmp_path / "out" / "mesh.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    share = visible_points(fitted.ring, *fitted.ring.domain.sample(3), fitted.capture.views)[1]
    assert 0.05 < share < 0.6 and 0 < np.mean(vertices["seen_0"]) < 1
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert f"<th>Seen by no photograph</th><td>{share:.1%} of the surface&#39;s area</td>" in page


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation


def test_what_is_wrong_where_nobody_looks_does_not_count():
    seen_by = view(12)
    truth, guess = trimesh.Trimesh(*ball()), trimesh.Trimesh(longer(seen_by), ball()[1])
    for a, b in ((guess, truth), (truth, guess)):
        assert surfaces.compare_shapes(a, b)["chamfer"] > 5
        numbers = surfaces.compare_shapes(a, b, [seen_by])
        assert numbers["chamfer"] < 1e-6 and numbers["f_score_0.1"] == 1
        shares = unseen_share(RADIUS), numbers["unseen_true" if b is truth else "unseen"]
        assert shares[1] == pytest.approx(shares[0], abs=0.005)  # 100,000 points
    # What is wrong where somebody looks does.
    everywhere = [seen_by, *(view(seed) for seed in range(13, 21))]
    assert surfaces.compare_shapes(guess, truth, everywhere)["chamfer"] > 2


def test_triangles_that_are_partly_hidden_count_in_part():
    """Points are looked at one by one: a plane of two triangles, half of it under a plate."""
    plane = [[-2.0, -1, 0], [2, -1, 0], [2, 1, 0], [-2, 1, 0]]
    plate = [[0.0, -1.5, 0.01], [3, -1.5, 0.01], [3, 1.5, 0.01], [0, 1.5, 0.01]]
    mesh = trimesh.Trimesh(plane + plate, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], process=False)
    matrix = np.diag([-1.0, 1, -1, 1])
    matrix[2, 3] = 100
    above = MaskedCamera(Camera(matrix, np.array([900.0, 900]), np.array([50.0, 50]), (100, 100)), None)
    points = np.random.default_rng(2).uniform([-2, -1, 0], [2, 1, 0], (2000, 3))
    normals = np.tile([0.0, 0, 1], (2000, 1))
    seen, clear = (
        Visibility(mesh.vertices, mesh.faces, [above]).of_points(points, normals),
        np.abs(points[:, 0]) > 0.001,
    )
    np.testing.assert_array_equal(seen[clear], (points[:, 0] < 0)[clear])
    assert not Visibility(mesh.vertices, mesh.faces, [above]).of_points(points, -normals).any()


def test_the_command_leaves_out_what_is_not_seen(run, capsys):
    numbers = []
    for options in ([], ["--seen"]):
        evaluate.main([str(run), "--mesh", str(run / "truth.ply"), "--spp", "1", *options])
        printed = capsys.readouterr()
        numbers.append(json.loads(printed.out))
        assert ("shown by no photograph" in printed.err) == bool(options)
    assert numbers[0]["chamfer"] > 5 and "unseen" not in numbers[0]
    assert numbers[1]["chamfer"] < 0.001 and numbers[1]["f_score_0.1"] == 1
    assert 0.5 < numbers[1]["unseen_true"] < numbers[1]["unseen"] < 0.9
    for key in numbers[0].keys() - {"chamfer", "f_score_0.1", "f_score_0.5"}:
        # The error of normals is that of rounding here, whose last digits vary from run to run without --seen, too.
        assert numbers[0][key] == pytest.approx(numbers[1][key], rel=1e-3, abs=1e-3 if "normal" in key else 2e-4), key


def test_a_surface_inside_out_is_told():
    truth = trimesh.Trimesh(*ball(3))
    with pytest.raises(InputError, match=r"--seen: .*outwards"):
        surfaces.compare_shapes(truth, trimesh.Trimesh(truth.vertices, truth.faces[:, ::-1]), [view()])
