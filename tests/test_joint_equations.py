"""Standard deviations of what is refined: least squares in closed form, and of a fit's unknowns."""

import json
import re

import numpy as np
import pytest
import torch

import mi_ring
from mi_ring.fitting.comparison import ROOM
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.normal_equations import BLOCK, Equations, Layout
from mi_ring.metrics.capture_findings import moved_far
from mi_ring.output.ambiguity import hardly_told, hardly_told_apart
from mi_ring.output.calibration_panel import panel


def known_surface(height, width, channels=3):
    """Derivatives with respect to the unknowns of patches, of which there are none, and the patch of each pixel."""
    return torch.zeros(0, height, width, channels), np.zeros((height, width), int)


@pytest.mark.parametrize("block", [1, BLOCK])
def test_deviation_of_a_slope_is_that_of_linear_regression(block):
    random = np.random.default_rng(4)
    slopes, sigma = random.normal(size=(2, 200, 256, 3)), 0.3
    noise = sigma * random.normal(size=(200 // block, 256 // block, 3))
    noise = np.kron(noise, np.ones((block, block, 1)))  # errors that go together count as one
    equations = Equations(5, 1, 0)
    telling = torch.ones(200, 256, dtype=torch.bool)
    telling[:, 248:] = False
    equations.add(torch.tensor(slopes), torch.tensor(noise), telling, np.array([3, 1]), *known_surface(200, 256))
    nowhere = torch.zeros_like(telling)
    equations.add(torch.tensor(slopes), torch.tensor(noise), nowhere, np.array([3, 1]), *known_surface(200, 256))
    x = slopes[:, :, :248].reshape(2, -1)
    expected = x @ x.T / (sigma * block) ** 2
    got = equations.without_patches()[0][np.ix_([3, 1], [3, 1])]
    np.testing.assert_allclose(got, expected, rtol=0.1, atol=0.02 * expected.max())
    assert not equations.without_patches()[0][[0, 2, 4]].any()


def test_photographs_share_the_unknowns_of_their_lens_and_flash(small_capture):
    config = Config(refine=("cameras", "focal", "light", "power", "curve"), domain="sphere")
    layout = Layout(Fit(mi_ring.load_capture(small_capture), config).model.calibration)
    first, other = (layout.of(np.array([k])) for k in (2, 7))
    shared = {name for (name, _, a), (_, _, b) in zip(first, other) if a == b}
    assert shared == {"focal", "light", "curve", "toe"}
    own = [int(place[0]) for entry in (first, other) for name, _, place in entry if name not in shared]
    assert len(own) == len(set(own)) == 2 * 9
    assert layout.count == 12 * 9 + 1 + 3 + 2


def test_photographs_tell_unknowns_and_keep_them_as_they_are(small_capture):
    refined = "cameras", "light", "power", "curve"
    config = Config(iterations=30, levels=(3,), widths=(56,), shares=(1,), subdivisions=3, refine=refined)
    running = Fit(mi_ring.load_capture(small_capture), config)
    for _ in running:
        pass
    calibration = running.model.calibration
    before = {name: value.clone() for name, value in calibration.state_dict().items()}
    surface = running.renderer.show(running.model, 3)
    mesh = {name: np.array(surface.params[surface.prefix + name]) for name in ("vertex_positions", "vertex_normals",
                                                                              "vertex_roughness")}  # fmt: skip
    joint = JointEquations.of(running.problem, running.model, running.renderer, 3)
    found = joint.deviations(running.problem.exposure)
    for name, value in mesh.items():
        np.testing.assert_allclose(np.array(surface.params[surface.prefix + name]), value, atol=1e-6)
    for name, value in calibration.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0)
    for name, width in calibration.widths.items():
        assert found[name].shape == getattr(calibration, name).shape
        assert (found[name] > 0).all() and (found[name] <= width * (1 + 1e-6)).all()  # a photograph cannot know less

    summary = running.result().calibration
    assert json.loads(json.dumps(summary)) == summary
    light, unit = summary["unknowns"]["light"], calibration.rig.distance
    np.testing.assert_allclose(light["before"], [15, 10, 0], atol=1e-3)
    moved = np.subtract(light["after"], light["before"])
    np.testing.assert_allclose(moved, unit * calibration.value("light")[0].detach(), atol=1e-4)
    np.testing.assert_allclose(light["std"], unit * found["light"][0], rtol=1e-6)
    photograph = summary["photographs"]["003.png"]
    turn = calibration.value("turn")[3].detach().norm()
    assert photograph["turned_degrees"] == pytest.approx(np.degrees(float(turn)), rel=1e-5)
    np.testing.assert_allclose(photograph["std"]["power"], found["power"][3] * photograph["power"], rtol=1e-5)
    page = panel(running.capture, running.calibrated(), summary)
    assert [row[0].split()[0] for row in page.rows] == ["place", "exponent", "toe", "cameras", "and", "power"]
    assert page.chart.startswith("data:image/svg")

    assert found["light"][:, :2].max() < 0.3 * calibration.widths["light"]
    assert found["light"].max() < 0.6 * calibration.widths["light"]  # the toe of the curve hides how far it is ahead
    assert found["power"].max() < 0.75 * calibration.widths["power"]


def test_pixels_beside_the_blocks_count_as_well():
    random = np.random.default_rng(8)
    slopes, noise = random.normal(size=(1, 213, 301, 1)), 0.2 * random.normal(size=(213, 301, 1))
    equations = Equations(1, 1, 0)
    everywhere = torch.ones(213, 301, dtype=torch.bool)
    equations.add(torch.tensor(slopes), torch.tensor(noise), everywhere, np.array([0]), *known_surface(213, 301, 1))
    assert equations.without_patches()[0][0, 0] == pytest.approx((slopes**2).sum() / 0.2**2, rel=0.15)


def test_photographs_tell_of_the_room(small_capture):
    """Much more than its prior does."""
    running = Fit(mi_ring.load_capture(small_capture), Config(refine=("ambient",), domain="sphere"))
    joint = JointEquations.of(running.problem, running.model, running.renderer, 3)
    found = joint.deviations(running.problem.exposure)
    assert list(found) == ["ambient"] and found["ambient"].shape == (3,) and (found["ambient"] > 0).all()
    assert (found["ambient"] < 0.3 * ROOM * running.problem.exposure).all()


def test_unknowns_of_patches_are_eliminated():
    """Information and solution are those of all unknowns together, of which the others' are not asked."""
    random = np.random.default_rng(5)
    slopes, local = random.normal(size=(2, 40, 48, 3)), random.normal(size=(2, 40, 48, 3))
    patch = random.integers(0, 3, (40, 48))
    local[1] += slopes[0]
    noise = 0.1 * random.normal(size=(40, 48, 3)) - 0.3 * slopes[1] + 0.2 * local[1]
    equations = Equations(2, 3, 2)
    counted = torch.from_numpy(random.random((40, 48)) < 0.7)
    equations.add(*map(torch.from_numpy, (slopes, noise)), counted, np.array([0, 1]), torch.from_numpy(local), patch)
    weight = equations.pixels / equations.squares
    columns = [part[counted.numpy()].ravel() for part in slopes]
    for k in range(3):
        columns += [(part * (patch == k)[..., None])[counted.numpy()].ravel() for part in local]
    whole = weight * np.array(columns) @ np.array(columns).T + np.diag([0.0] * 2 + [1.0] * 6)
    expected = np.linalg.inv(np.linalg.inv(whole)[:2, :2])
    matrix, vector = equations.without_patches()
    np.testing.assert_allclose(matrix, expected, rtol=1e-3)
    whole_vector = -weight * np.array(columns) @ noise[counted.numpy()].ravel()
    np.testing.assert_allclose(np.linalg.solve(matrix, vector), np.linalg.solve(whole, whole_vector)[:2], rtol=1e-3)
    assert matrix[0, 0] < 0.7 * weight * (columns[0] @ columns[0])


def test_what_photographs_hardly_tell_apart_is_said(small_capture):
    """Of three unknowns two, whose correlation is given; of several components the best combination counts."""
    config = Config(refine=("light", "curve", "ambient"), domain="sphere")
    layout = Layout(Fit(mi_ring.load_capture(small_capture), config).model.calibration)
    light, curve, room = layout.places("light"), layout.places("curve")[0], layout.places("ambient")
    covariance = np.eye(layout.count)
    across = np.array([0.6, 0.0, 0.8])  # with a combination of the flash's axes, with none of them so much
    covariance[curve, light] = covariance[light, curve] = 0.97 * across
    covariance[curve, room[5]] = covariance[room[5], curve] = 0.2  # not of the first harmonic
    width = np.array([1.0, 0.1, 3.0, *[0.5] * (layout.count - 3)])[: layout.count] / 4
    matrix = np.linalg.inv(covariance * np.outer(width, width)) - np.eye(layout.count)
    found = JointEquations(layout, matrix, np.zeros(layout.count)).correlations()
    values = {frozenset(pair[:2]): pair[2] for pair in found}
    assert len(found) == len(values) == 3 and values.pop(frozenset(["light", "curve"])) == pytest.approx(0.97)
    assert max(values.values()) < 1e-6
    joint = JointEquations(layout, np.diag([40.0, 0.0, 0.0, 0.9, 0.8, *[0.0] * (layout.count - 5)]), np.zeros(5))
    assert joint.untold() == ["curve"]  # of the flash one axis is told
    assert hardly_told(["curve", "scale"]) == "The photographs hardly tell curve and scale: the prior does."
    told = [{"options": [one, other], "value": value} for one, other, value in found]
    assert re.fullmatch(
        r"The photographs hardly tell apart \w+ and \w+ \(correlation 0.97\)\.", hardly_told_apart(told)
    )
    assert hardly_told_apart([]) == ""


def test_photographs_that_moved_far_are_told_from_those_that_all_moved():
    moved = {f"{k}.png": {"moved_px": 3.0 + 0.1 * k} for k in range(9)}
    assert moved_far(moved) == moved_far({}) == ""
    moved["4.png"] = {"moved_px": 17.0}
    assert moved_far(moved) == "4.png (17.0 px)"
