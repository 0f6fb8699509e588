"""Cameras tell whether the object may have turned in front of one that stood still."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mi_ring
from mi_ring.capture import turntable
from mi_ring.capture.turntable import object_turned, on_rings
from mi_ring.synthesis.viewpoints import poses

UP = np.array([0.3, 0.9, -0.2])


def cameras(kind, count, seed=0, **more):
    """Cameras around an object, in axes that are not those of the object."""
    made = np.stack(poses(kind, count, 1.0, 5.0, UP, np.random.default_rng(seed), **more))
    axes = np.eye(4)
    axes[:3, :3], axes[:3, 3] = Rotation.from_rotvec([0.5, -1.1, 0.4]).as_matrix(), [40, -7, 11]
    return axes @ made


def moved(made, degrees, distance, seed=1):
    """Cameras with errors of their directions and places."""
    random, made = np.random.default_rng(seed), made.copy()
    turns = Rotation.from_rotvec(np.radians(degrees) * random.normal(size=(len(made), 3)) / 3**0.5).as_matrix()
    made[:, :3, :3] = turns @ made[:, :3, :3]
    made[:, :3, 3] += distance * random.normal(size=(len(made), 3))
    return made


@pytest.mark.parametrize("elevations", [(20.0,), (0.0,), (-10.0, 15.0, 45.0)])
@pytest.mark.parametrize("count", [12, 66])
def test_cameras_around_a_turntable_are_on_rings(elevations, count):
    made = cameras("turntable", count, elevations=elevations)
    assert on_rings(made) and on_rings(moved(made, 0.05, 0.005))


@pytest.mark.parametrize("kind", ["free", "around"])
@pytest.mark.parametrize("count", [3, 12, 60])
def test_cameras_that_are_carried_around_the_object_are_not(kind, count):
    assert not on_rings(cameras(kind, count))


def test_a_walk_at_about_one_height_is_no_ring():
    """Directions differ by two degrees, places by a twentieth of the distance."""
    assert not on_rings(moved(cameras("turntable", 40, elevations=(20.0,)), 2, 0.25))


def test_cameras_that_look_the_same_way_from_several_places_are_not_on_rings():
    made = np.tile(np.eye(4), (8, 1, 1))
    made[:, 0, 3] = np.arange(8)
    assert not on_rings(made)


def test_a_few_photographs_from_elsewhere_change_nothing():
    assert on_rings(np.concatenate([cameras("turntable", 40), cameras("free", 4)]))
    made = cameras("turntable", 40, elevations=(20.0,))
    made[[3, 11, 30], :3, 3] += [[0.1, -0.2, 0.1], [0.3, 0, 0.2], [-0.1, 0.1, 0.2]]  # wrong poses of the same ring
    assert on_rings(made)


def test_cameras_of_one_place_tell_nothing():
    assert on_rings(np.tile(cameras("turntable", 3)[0], (9, 1, 1))) is None


@pytest.mark.parametrize(("rings", "moves", "turned"), [
    (True, False, True), (True, True, False), (True, None, None), (False, False, False), (None, False, None),
])  # fmt: skip
def test_an_object_turned_if_cameras_are_on_rings_and_the_background_stands_still(
    rings, moves, turned, small_capture, monkeypatch
):
    monkeypatch.setattr(turntable, "on_rings", lambda poses: rings)
    monkeypatch.setattr(turntable, "background_moves", lambda capture: moves)
    assert object_turned(mi_ring.load_capture(small_capture)) is turned
