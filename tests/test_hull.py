"""The visual hull against bodies whose silhouettes are known in closed form."""

import numpy as np
import pytest
import torch
from helpers.silhouettes import CENTER, CENTRE, FOCAL, H, W, ball, cameras, silhouettes

from mi_ring.errors import InputError
from mi_ring.geometry.camera import Camera
from mi_ring.geometry.hull import Hull, Silhouette, signed_distance
from mi_ring.geometry.meshes import genus
from mi_ring.system import cache


def ring(major, minor):
    """A torus in the plane x, y, by small steps along the rays."""

    def hit(origin, rays):
        t = np.linspace(12, 28, 400)
        p = origin - CENTER + rays[:, None] * t[:, None]
        return (np.hypot(np.hypot(p[..., 0], p[..., 1]) - major, p[..., 2]) < minor).any(1)

    return hit


def test_signed_distance_of_a_half_plane():
    mask = np.zeros((5, 7), np.uint8)
    mask[:, 3:] = 255
    np.testing.assert_allclose(signed_distance(mask)[2], [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5])


@pytest.mark.parametrize("distortion", [0.0, 2.0])  # which moves the outline by two pixels
def test_depth_in_a_ball_is_that_of_the_ball(distortion):
    hull = Hull(list(silhouettes(ball(4.0), distortion=distortion)), "scene.xml")
    np.testing.assert_allclose(hull.center, CENTER, atol=0.1)
    assert 4 <= hull.reach < 4.5
    away = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)))
    radii, center = torch.linspace(0.5, 3.9, 200), torch.tensor(CENTER, dtype=torch.float32)
    depth = hull.depth(center + radii[:, None] * away)
    # A pixel is 0.15 wide there; between the views the hull is a little larger than the ball.
    assert (depth - (4 - radii) > -0.25).all() and (depth - (4 - radii)).mean() < 0.4
    assert (hull.depth(center + 5 * away) < 0).all()


def test_ball_and_surface_have_the_bodys_place_and_volume():
    hull = Hull(list(silhouettes(ball(4.0))), "scene.xml")
    center, radius = hull.ball()
    np.testing.assert_allclose(center, CENTER, atol=0.15)
    assert 3.95 < radius < 4.3
    mesh = hull.surface(48)
    assert mesh.is_watertight and genus(mesh) == 0
    assert (3 * mesh.volume / (4 * np.pi)) ** (1 / 3) == pytest.approx(radius, rel=0.02)
    assert np.linalg.norm(mesh.vertices - CENTER, axis=1).min() > 3.7


def test_the_surface_is_kept_for_the_next_fit(tmp_path, monkeypatch):
    """Equal silhouettes give the mesh of the cache folder, unless it is damaged."""
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    first = Hull(list(silhouettes(ball(4.0))), "scene.xml").surface(32)
    with monkeypatch.context() as known:
        known.setattr(Hull, "march", lambda *_: pytest.fail("is computed again"))
        again = Hull(list(silhouettes(ball(4.0))), "elsewhere.xml").surface(32)
    assert np.array_equal(again.vertices, first.vertices) and np.array_equal(again.faces, first.faces)
    (file,) = cache.cache_folder().iterdir()
    content = file.read_bytes()
    shape = f"({len(first.faces)}, 3)".encode()
    Hull(list(silhouettes(ball(3.0))), "scene.xml").surface(32)
    (other,) = (own.read_bytes() for own in cache.cache_folder().iterdir() if own != file)
    for damaged in (content[:-100], b"", content.replace(shape, shape.replace(b"3)", b"2)")), other):
        assert damaged != content
        file.write_bytes(damaged)
        made = Hull(list(silhouettes(ball(4.0))), "scene.xml").surface(32)
        assert np.array_equal(made.vertices, first.vertices) and np.array_equal(made.faces, first.faces)


@pytest.mark.parametrize("part", ["mask", "valid", "frame", "centre", "distortion", "outliers", "resolution"])
def test_another_hull_is_not_that_of_the_cache_folder(tmp_path, monkeypatch, part):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    views, outliers, resolution = list(silhouettes(ball(4.0))), 0.02, 32
    Hull(views, "scene.xml", outliers).surface(resolution)
    mask, camera = views[3].mask.copy(), views[3].camera
    mask[0, 0] = 1  # not even a pixel of the object
    others = {
        "mask": {"mask": mask}, "valid": {"valid": np.full_like(mask, 255)},
        "frame": {"frame": np.array([[0.0, 0.0], [W, H]])}, "distortion": {"camera": camera._replace(distortion=0.1)},
        "centre": {"camera": camera._replace(centre=camera.centre + 1)},
    }  # fmt: skip
    views[3] = views[3]._replace(**others.get(part, {}))
    Hull(views, "scene.xml", outliers + 0.03 * (part == "outliers")).surface(resolution + (part == "resolution"))
    assert len(list(cache.cache_folder().iterdir())) == 2


def test_a_ring_stays_open():
    mesh = Hull(list(silhouettes(ring(3.0, 0.9))), "scene.xml").surface(64)
    assert mesh.is_watertight and mesh.body_count == 1 and genus(mesh) == 1
    p = mesh.vertices - CENTER
    assert np.hypot(np.hypot(p[:, 0], p[:, 1]) - 3.0, p[:, 2]).mean() == pytest.approx(0.95, abs=0.15)


def test_one_faulty_mask_among_many_does_no_harm():
    views = list(silhouettes(ball(4.0), 60))
    whole = Hull(views, "scene.xml").ball()[1]
    half = views[7].mask.copy()
    half[:, : W // 2] = 0
    views[7] = views[7]._replace(mask=half)
    assert Hull(views, "scene.xml").ball()[1] == pytest.approx(whole, rel=0.02)


def test_only_the_largest_piece_is_the_object():
    large, small = ball(3.0), ball(0.5, np.add(CENTER, [0, 0, 5]))
    mesh = Hull(list(silhouettes(lambda *ray: large(*ray) | small(*ray))), "scene.xml").surface(64)
    assert mesh.body_count == 1 and np.linalg.norm(mesh.centroid - CENTER) < 0.3


def test_what_photographs_do_not_show_is_not_cut_off():
    """A camera so near that the ball is larger than its photograph says nothing of what is beyond the frame."""
    near = next(cameras(1, distance=6.0))
    all_of_it = Silhouette(np.full((H, W), 255, np.uint8), Camera(near, FOCAL, CENTRE, (W, H)), "near")
    views = list(silhouettes(ball(4.0)))
    alone = Hull(views, "scene.xml").ball()[1]
    assert Hull([*views, all_of_it], "scene.xml").ball()[1] == pytest.approx(alone, rel=0.02)


def test_mistakes():
    views = list(silhouettes(ball(4.0)))
    with pytest.raises(InputError, match="mask 3: mask: is empty, or nearly"):
        Hull([*views[:3], views[3]._replace(mask=np.zeros_like(views[3].mask))], "scene.xml")
    with pytest.raises(InputError, match="scene.xml: to_world: all cameras are in one place or look along one l"):
        Hull(views[:1], "scene.xml")
    apart = list(silhouettes(ball(2.0)))
    for view in apart[::2]:
        view.camera.to_world[:3, 3] += 3
    with pytest.raises(InputError, match="scene.xml: mask: no point in space is inside all masks"):
        Hull(apart, "scene.xml").ball()
