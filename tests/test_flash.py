"""What white squares of the printed sheet tell of the flash, its cone and the room, against a scene by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_ring.photogrammetry.flash import PAPER, Ball, find_flash

OFFSET, CONE = np.array([-20.0, -15.0, 1.0]), 2.0
ROOM = np.array([0.03, 0.025, 0.02]) / 350**2
BALL = Ball(np.array([4.0, -7.0, 40.0]), 40.0)
UP = np.array([0.0, 0, 1])
ALIKE = {str(k): 1.0 for k in range(20)} | {"none": 1.0}  # EXIF says that all were exposed alike


def photographs(count=20, held=()):
    """Squares as a sheet has them, under a flash beside the lens of cameras around it; those `held` are on their side.

    By name: squares (places, colours), poses, axes, intensities.
    """
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(-60, 61, 20.0), np.arange(-100, 101, 20.0), [0.0]), -1).reshape(-1, 3)
    squares, poses, axes, intensities = {}, {}, {}, {}
    for k in range(count):
        name, azimuth, elevation = str(k), 2.4 * k, np.radians((22, 43, 66)[k % 3] + random.uniform(-4, 4))
        away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        position = random.uniform(300, 400) * away + [0, 0, 35]
        forward = np.array([0, 0, 35]) + random.uniform(-12, 12, 3) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
        axes[name] = Rotation.from_euler("z", 90 * (k in held), degrees=True).as_matrix()
        pose = np.eye(4)
        upright = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, :3], pose[:3, 3] = upright @ axes[name].T, position
        poses[name], intensities[name] = pose, 1e5 * random.uniform(0.95, 1.05, 3)
        places = grid[np.linalg.norm(grid - [*BALL.center[:2], 0], axis=1) > 45]
        way = position + upright @ OFFSET - places
        distance = np.linalg.norm(way, axis=1)
        light = (-(way / distance[:, None]) @ forward) ** CONE * way[:, 2] / distance**3
        squares[name] = places, PAPER / np.pi * intensities[name] * (light[:, None] + ROOM)
    return squares, poses, axes, intensities


def test_flash_cone_and_room_are_found():
    squares, poses, axes, intensities = photographs(held=(4, 11))
    random = np.random.default_rng(5)
    for name, (places, colours) in squares.items():
        colours = colours * random.normal(1, 0.01, colours.shape)
        colours[random.uniform(size=len(colours)) < 0.1] *= 0.1  # in a shadow
        squares[name] = places, colours
    squares["not placed"] = squares["0"]
    squares["none"], poses["none"] = (np.zeros((0, 3)), np.zeros((0, 3))), poses["0"]
    found = find_flash(squares, poses, axes, ALIKE, np.zeros(3))
    np.testing.assert_array_less(np.abs(found.offset - OFFSET), [1, 1, 4])
    assert found.falloff == pytest.approx(CONE, abs=0.2)
    np.testing.assert_allclose(found.room, ROOM, atol=0.008 / 350**2)
    assert found.intensities.keys() == intensities.keys()
    ratios = np.array([found.intensities[name] / intensity for name, intensity in intensities.items()])
    np.testing.assert_allclose(ratios, ratios.mean(), rtol=0.01)
    assert ratios.mean() == pytest.approx(1, abs=0.04)  # on its axis, and by how far off it is
    ambient = np.median(list(intensities.values()), 0) * ROOM / np.pi
    np.testing.assert_allclose(found.ambient, ambient, atol=0.008 / 350**2 * 1e5 / np.pi)


def test_light_that_the_object_sends_to_the_paper_and_hides_from_it_is_part_of_it():
    squares, poses, axes, intensities = photographs()
    for name, (places, colours) in squares.items():
        lights = np.broadcast_to(poses[name][:3, 3] + poses[name][:3, :3] @ OFFSET, places.shape)
        more = 0.8 * BALL.bounce(places, lights)[:, None] - ROOM * BALL.share(places)[:, None]
        squares[name] = places, colours + PAPER / np.pi * intensities[name] * more
    found, without = (find_flash(squares, poses, axes, ALIKE, np.zeros(3), ball) for ball in (BALL, None))
    np.testing.assert_array_less(np.abs(found.offset - OFFSET), [1, 1, 4])
    np.testing.assert_allclose(found.room, ROOM, atol=0.008 / 350**2)
    assert abs(found.falloff - CONE) < 0.1 and (without.room < 0.5 * ROOM).all()


def test_a_ball_sends_back_what_its_surface_does():
    """By an integral over the surface of a small sphere."""
    ball, light = Ball(np.array([3.0, -5, 60]), 0.5), np.array([150.0, 90, 260])
    places = np.array([[70.0, 30, 0], [-60, 20, 0], [10, -90, 0]])
    normals = np.random.default_rng(0).normal(size=(400_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, area = ball.center + ball.radius * normals, 4 * np.pi * ball.radius**2
    toward = light - points
    lit = np.maximum((toward * normals).sum(1), 0) / np.linalg.norm(toward, axis=1) ** 3
    for place, found in zip(places, ball.bounce(places, np.broadcast_to(light, places.shape))):
        way = place - points
        away = np.linalg.norm(way, axis=1)
        seen = np.maximum((way * normals).sum(1), 0) / away * -way[:, 2] / away
        assert found == pytest.approx(area * np.mean(lit / np.pi * seen / away**2), rel=0.04)


def test_little_is_told_by_few_squares():
    """The guess stays where nothing says otherwise; without squares there is no flash."""
    squares, poses, axes, _ = photographs(1)
    places, colours = squares["0"]
    found = find_flash({"0": (places[:1], colours[:1])}, poses, axes, ALIKE, OFFSET)
    np.testing.assert_allclose(found.offset, OFFSET, atol=4)
    assert 0 <= found.falloff < 1
    assert find_flash({"0": (places[:0], colours[:0])}, poses, axes, ALIKE, OFFSET) is None
    assert find_flash({"elsewhere": squares["0"]}, poses, axes, ALIKE, OFFSET) is None
