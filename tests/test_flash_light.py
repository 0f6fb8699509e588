"""What white squares of the printed sheet tell of the flash, its cone and the room, against a scene by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_ring.photogrammetry import flash_light
from mi_ring.photogrammetry.flash_light import PAPER_ALBEDO, ObjectSphere, calibrate_flash
from mi_ring.photogrammetry.marker_sheet import PaperSamples

OFFSET, CONE, POWER = np.array([-20.0, -15.0, 1.0]), 2.0, np.array([1.1e5, 1e5, 0.8e5])
ROOM = np.array([0.03, 0.025, 0.02]) / 350**2
BALL = ObjectSphere(np.array([4.0, -7.0, 40.0]), 40.0)
UP = np.array([0.0, 0, 1])


def photographs(count=20, held=(), table=None):
    """Squares as a sheet has them, under a flash beside the lens of cameras around it; those `held` are on their side.

    Exposed unlike. `table`: albedo of what is where the margin was, if that was cut off.
    By name: paper, poses, axes, exposures, intensities.
    """
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(-60, 61, 20.0), np.arange(-100, 101, 20.0), [0.0]), -1).reshape(-1, 3)
    margin = np.array(
        [[x, y, 0.0] for x in (-94, 94) for y in range(-100, 101, 20)] + [[x, 134.0, 0] for x in range(-60, 61, 20)]
    )
    papers, poses, axes, exposures, intensities = {}, {}, {}, {}, {}
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
        exposures[name] = random.uniform(0.5, 2)
        poses[name], intensities[name] = pose, POWER * exposures[name] * random.uniform(0.96, 1.04, 3)
        inner = grid[np.linalg.norm(grid - [*BALL.center[:2], 0], axis=1) > 45]
        places = np.concatenate([inner, margin])
        way = position + upright @ OFFSET - places
        distance = np.linalg.norm(way, axis=1)
        light = (-(way / distance[:, None]) @ forward) ** CONE * way[:, 2] / distance**3
        colours = PAPER_ALBEDO / np.pi * intensities[name] * (light[:, None] + ROOM)
        beside = np.arange(len(places)) >= len(inner)
        if table:
            colours[beside] *= table / PAPER_ALBEDO
        papers[name] = PaperSamples(places, colours, beside)
    return papers, poses, axes, exposures, intensities


def rough(papers):
    """With noise, and some places in a shadow."""
    random = np.random.default_rng(5)
    for name, paper in papers.items():
        colours = paper.colours * random.normal(1, 0.01, paper.colours.shape)
        colours[random.uniform(size=len(colours)) < 0.1] *= 0.1
        papers[name] = paper._replace(colours=colours)
    return papers


def require(found, intensities):
    """Is all of it found?"""
    np.testing.assert_array_less(np.abs(found.offset - OFFSET), [1, 2, 4])
    assert found.falloff == pytest.approx(CONE, abs=0.2)
    np.testing.assert_allclose(found.room, ROOM, atol=0.008 / 350**2)
    ratios = np.array([found.intensities[name] / intensity for name, intensity in intensities.items()])
    np.testing.assert_allclose(ratios, np.broadcast_to(ratios.mean(), ratios.shape), rtol=0.015)
    assert ratios.mean() == pytest.approx(1, abs=0.04)  # on its axis, and by how far off it is


@pytest.mark.parametrize("told", [True, False])
def test_flash_cone_and_room_are_found(told):
    """Whether EXIF tells exposures or not."""
    papers, poses, axes, exposures, intensities = photographs(held=(4, 11))
    papers = rough(papers)
    papers["not placed"] = papers["0"]
    papers["none"], poses["none"] = PaperSamples(*(part[:0] for part in papers["0"])), poses["0"]
    poses["below"] = np.diag([1.0, -1, -1, 1]) @ poses["1"]
    papers["below"], axes["below"] = papers["1"], axes["1"]
    found = calibrate_flash(papers, poses, axes, exposures if told else dict.fromkeys(exposures, np.nan), np.zeros(3))
    assert found.intensities.keys() == intensities.keys()
    require(found, intensities)
    assert found.gamma == 1
    if told:
        np.testing.assert_allclose(found.power, POWER, rtol=0.05)
        np.testing.assert_allclose(found.ambient, POWER * ROOM / np.pi, rtol=0.3)


@pytest.mark.parametrize("gamma", [0.8, 1.25])
def test_the_cameras_curve_is_found(gamma):
    papers, poses, axes, exposures, intensities = photographs()
    for name, paper in rough(papers).items():
        papers[name] = paper._replace(colours=paper.colours**gamma)
    found = calibrate_flash(papers, poses, axes, exposures, np.zeros(3))
    assert found.gamma == pytest.approx(gamma, rel=0.03)
    require(found, intensities)
    straight = calibrate_flash(papers, poses, axes, exposures, np.zeros(3), curved=False)
    assert straight.gamma == 1


@pytest.mark.parametrize("albedo", [0.2, 0.5, 0.68])
def test_a_margin_that_was_cut_off_is_no_paper(albedo):
    papers, poses, axes, exposures, intensities = photographs(table=albedo)
    require(calibrate_flash(rough(papers), poses, axes, exposures, np.zeros(3)), intensities)


def test_a_dark_room_and_a_flash_to_all_sides_are_said_to_be(monkeypatch):
    monkeypatch.setitem(globals(), "ROOM", np.zeros(3))
    monkeypatch.setitem(globals(), "CONE", 0.0)
    papers, poses, axes, exposures, _ = photographs()
    found = calibrate_flash(papers, poses, axes, exposures, np.zeros(3))
    assert not found.room.any() and found.falloff == 0


def test_light_that_the_object_sends_to_the_paper_and_hides_from_it_is_part_of_it():
    papers, poses, axes, exposures, intensities = photographs()
    for name, paper in papers.items():
        lights = np.broadcast_to(poses[name][:3, 3] + poses[name][:3, :3] @ OFFSET, paper.points.shape)
        more = 0.8 * BALL.reflected(paper.points, lights)[:, None] - ROOM * BALL.form_factor(paper.points)[:, None]
        papers[name] = paper._replace(colours=paper.colours + PAPER_ALBEDO / np.pi * intensities[name] * more)
    found, without = (calibrate_flash(papers, poses, axes, exposures, np.zeros(3), ball) for ball in (BALL, None))
    require(found, intensities)
    assert np.abs(found.room - ROOM).max() < 0.5 * np.abs(without.room - ROOM).max()


def test_a_ball_sends_back_what_its_surface_does():
    """By an integral over the surface of a small sphere."""
    ball, light = ObjectSphere(np.array([3.0, -5, 60]), 0.5), np.array([150.0, 90, 260])
    places = np.array([[70.0, 30, 0], [-60, 20, 0], [10, -90, 0]])
    normals = np.random.default_rng(0).normal(size=(400_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, area = ball.center + ball.radius * normals, 4 * np.pi * ball.radius**2
    toward = light - points
    lit = np.maximum((toward * normals).sum(1), 0) / np.linalg.norm(toward, axis=1) ** 3
    for place, found in zip(places, ball.reflected(places, np.broadcast_to(light, places.shape))):
        way = place - points
        away = np.linalg.norm(way, axis=1)
        seen = np.maximum((way * normals).sum(1), 0) / away * -way[:, 2] / away
        assert found == pytest.approx(area * np.mean(lit / np.pi * seen / away**2), rel=0.04)


def test_little_is_told_by_few_squares():
    """The guess stays where nothing says otherwise; without squares there is no flash."""
    papers, poses, axes, exposures, _ = photographs(1)

    def first(count):
        return {"0": PaperSamples(*(part[:count] for part in papers["0"]))}

    found = calibrate_flash(first(1), poses, axes, exposures, OFFSET)
    np.testing.assert_allclose(found.offset, OFFSET, atol=4)
    assert 0 <= found.falloff < 1
    assert calibrate_flash(first(0), poses, axes, exposures, OFFSET) is None
    assert calibrate_flash({"elsewhere": papers["0"]}, poses, axes, exposures, OFFSET) is None


def test_a_photograph_that_shows_one_square_in_a_shadow_is_lit_like_the_others():
    papers, poses, axes, exposures, intensities = photographs()
    papers["7"] = PaperSamples(*(part[:1] for part in papers["7"]))
    papers["7"].colours[:] *= 0.1
    found = calibrate_flash(papers, poses, axes, exposures, np.zeros(3))
    np.testing.assert_allclose(found.intensities["7"], intensities["7"], rtol=0.25)


def test_many_photographs_are_asked_in_part(monkeypatch):
    monkeypatch.setattr(flash_light, "MAX_PHOTOGRAPHS", 15)
    papers, poses, axes, exposures, intensities = photographs(35)
    require(calibrate_flash(papers, poses, axes, exposures, np.zeros(3)), intensities)
