"""The light of a room beside a flash, from the joint equations of all unknowns."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

import mi_ring
from mi_ring.fitting import joint_equations, optimisation
from mi_ring.fitting.comparison import ROOM
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.joint_solver import DOUBT, doubt, solve_jointly, with_learnt_width
from mi_ring.fitting.normal_equations import Layout
from mi_ring.fitting.summary import summary
from mi_ring.rendering.spherical_harmonics import BASIS, PER_FRAME


def fit_of(small_capture, given=None, **settings):
    """A fit of a flash and of a room's light; `given` (BASIS, 3): the room that the scene file tells of."""
    capture = mi_ring.load_capture(small_capture)
    capture = capture if given is None else replace(capture, room=given)
    settings = {"refine": ("power", "ambient"), "domain": "sphere", "indirect": False} | settings
    return Fit(capture, mi_ring.Config(**settings))


def room_like(fit, *shares):
    """Harmonics (BASIS, 3) of a room whose colours are these shares of the flash, brighter from one side."""
    room = np.zeros((BASIS, 3))
    room[0] = 1.0
    room[1:4, :] = [[0.3], [-0.2], [0.1]]
    return room * shares / fit.model.calibration.room_share(torch.from_numpy(room)).numpy()


def told(fit, room, monkeypatch, information=1e6):
    """What is found of a `room` if the equations are those of a linear problem that tells this much of each unknown."""
    layout = Layout(fit.model.calibration)
    random = np.random.default_rng(3)
    slopes = random.normal(size=(4 * layout.count, layout.count))
    matrix = information * slopes.T @ slopes / len(slopes)
    given = fit.model.calibration.room.given.numpy(force=True)
    truth = layout.values()
    truth[layout.first["ambient"] :] = ((room - given)[layout.room] / (ROOM * fit.problem.exposure)).ravel()
    equations = JointEquations(layout, matrix, matrix @ (truth - layout.values()))
    monkeypatch.setattr(JointEquations, "of", lambda *_: equations)
    return solve_jointly(fit.problem, fit.model, fit.renderer, 2)["ambient"].numpy()


def test_a_room_is_believed_by_its_share_and_by_its_colours(small_capture, monkeypatch):
    """A factor of 1 − error² / share²: of a faint room nothing is left, nor of one that colours contradict."""
    fit = fit_of(small_capture)
    for shares in ([0.3] * 3, [0.3, 0.25, 0.2]):
        room = room_like(fit, *shares)
        variance = DOUBT**2 + np.var(shares, ddof=1) / 3
        found = told(fit, room, monkeypatch)
        np.testing.assert_allclose(found, (1 - variance / np.mean(shares) ** 2) * room, rtol=2e-3, atol=1e-5)
    assert np.abs(told(fit, room, monkeypatch, 1.0)).max() < 0.8 * room.max()  # hardly told
    for shares in (0.01, 0.015, 0.02), (-0.1, -0.05, 0.15), (-0.1, -0.1, -0.1):
        assert not told(fit, room_like(fit, *shares), monkeypatch).any()
    found = told(fit, room_like(fit, 0.5, 0.4, -0.02), monkeypatch)
    assert found[0, :2].all() and not found[:, 2].any()  # no colour of a room is darker than black


def test_all_else_is_found_beside_the_room_that_is_believed(small_capture, monkeypatch):
    """By the formula of a conditional mean, where a faint room and the powers look alike."""
    fit = fit_of(small_capture)
    layout = Layout(fit.model.calibration)
    random = np.random.default_rng(5)
    slopes = random.normal(size=(3 * layout.count, layout.count))
    slopes[:, layout.places("power")] += 2 * slopes[:, layout.places("ambient")[:1]]
    matrix = 1e5 * slopes.T @ slopes
    truth = 1.5 * random.normal(size=layout.count)  # of 10 % each
    faint = room_like(fit, 0.02, 0.02, 0.02)[layout.room]
    truth[layout.places("ambient")] = faint.ravel() / (ROOM * fit.problem.exposure)
    monkeypatch.setattr(JointEquations, "of", lambda *_: JointEquations(layout, matrix, matrix @ truth))
    found = solve_jointly(fit.problem, fit.model, fit.renderer, 2)
    assert not found["ambient"].any()
    power, room = layout.places("power"), layout.places("ambient")
    expected = truth.copy()
    expected[power] = np.linalg.solve(matrix[np.ix_(power, power)], (matrix @ truth)[power])  # the room is 0
    expected = (layout.centring() @ expected)[power]
    assert np.abs(expected - (layout.centring() @ truth)[power]).max() > 1e-4
    expected *= 1 - (0.4 / expected.std()) ** 2  # from 0 nearer to it, the more the powers differ
    np.testing.assert_allclose(found["power"].ravel(), expected, atol=1e-5)
    assert len(room) + len(power) == layout.count
    truth[power] *= 0.2  # powers that hardly differ are left to the quarters of photographs
    monkeypatch.setattr(JointEquations, "of", lambda *_: JointEquations(layout, matrix, matrix @ truth))
    assert [*solve_jointly(fit.problem, fit.model, fit.renderer, 2)] == ["ambient"]


@pytest.mark.parametrize("truth", [0.4, -0.25, 0.15])  # in the unit of the prior, a tenth of the distance
def test_how_far_the_flash_is_ahead_is_believed_as_far_as_it_is_told(small_capture, monkeypatch, truth):
    """By 1 − error² / offset²; the error has a doubt of 2 % of the distance. Powers that are equal stay so."""
    fit = fit_of(small_capture, refine=("auto",))
    layout = Layout(fit.model.calibration)
    place, spread = layout.places("light")[2], 0.06
    matrix = 1e6 * np.eye(layout.count)
    matrix[place, place] = spread**-2 - 1
    right = np.zeros(layout.count)
    right[place] = truth * spread**-2  # of which the prior leaves `truth`
    monkeypatch.setattr(JointEquations, "of", lambda *_: JointEquations(layout, matrix, right))
    found = solve_jointly(fit.problem, fit.model, fit.renderer, 2)
    share = max(0, 1 - (spread**2 + 0.2**2) / truth**2)
    assert "power" not in found and ("light" in found) == (share > 0)
    if share:
        np.testing.assert_allclose(found["light"], [[0, 0, share * truth]], atol=1e-6)


def test_powers_are_those_beside_the_distance_that_is_believed(small_capture, monkeypatch):
    """Where the flash's distance and the powers look alike, and a small distance is not believed."""
    fit = fit_of(small_capture, refine=("light", "power"))
    fit.model.calibration.rig.free[2] = 0.0  # as by default
    layout, random = Layout(fit.model.calibration), np.random.default_rng(7)
    slopes = random.normal(size=(3 * layout.count, layout.count))
    power, ahead = layout.places("power"), layout.places("light")[2]
    slopes[:, ahead] += slopes[:, power] @ random.normal(size=len(power))
    truth = 2 * layout.centring() @ random.normal(size=layout.count)
    truth[ahead] = 0.05
    matrix = 1e4 * slopes.T @ slopes
    monkeypatch.setattr(JointEquations, "of", lambda *_: JointEquations(layout, matrix, matrix @ truth))
    found = solve_jointly(fit.problem, fit.model, fit.renderer, 2)
    own = np.setdiff1d(np.arange(layout.count), [ahead])
    expected = np.zeros(layout.count)
    expected[own] = np.linalg.solve(matrix[np.ix_(own, own)], (matrix @ truth)[own])  # beside a distance of 0
    expected = (layout.centring() @ expected)[power]
    expected *= 1 - (0.4 / expected.std()) ** 2
    assert found["light"][0, 2] == 0
    np.testing.assert_allclose(found["power"].ravel(), expected, atol=1e-3)


@pytest.mark.parametrize("spread", [0.3, 2.5])
def test_the_width_of_the_powers_prior_is_that_of_the_largest_evidence(small_capture, spread):
    """By a search over the logarithm of the marginal likelihood, in units of the prior that is written down."""
    layout = Layout(fit_of(small_capture, refine=("power",)).model.calibration)
    random, count = np.random.default_rng(6), layout.count
    slopes = random.normal(size=(3 * count, count))
    truth = layout.centring() @ (spread * random.normal(size=count))
    matrix, right = slopes.T @ slopes, slopes.T @ (slopes @ truth + 2 * random.normal(size=len(slopes)))
    matrix, right = matrix / 4, right / 4
    found, width = with_learnt_width(layout, "power", np.arange(count), matrix, right)

    def evidence(width):
        system = matrix + np.eye(count) / width**2
        return right @ np.linalg.solve(system, right) / 2 - np.linalg.slogdet(np.eye(count) + width**2 * matrix)[1] / 2

    best = minimize_scalar(lambda log: -evidence(np.exp(log)), (-3.0, 3.0)).x
    assert width / 0.1 == pytest.approx(np.exp(best), rel=0.05)
    solved = layout.centring() @ np.linalg.solve(matrix + np.eye(count) / np.exp(2 * best), right)
    np.testing.assert_allclose(found, solved, atol=0.03 * spread)


def test_what_the_scene_file_tells_of_a_room_may_be_more_or_less(small_capture, monkeypatch):
    given = np.zeros((BASIS, 3))
    given[0] = 1.0
    fit = fit_of(small_capture, given)
    for factor in 0.97, 1.02:
        found = told(fit, factor * given, monkeypatch)
        np.testing.assert_allclose(found[0], factor * given[0], atol=2e-3)


def test_a_room_is_found_that_material_and_powers_explain(small_capture, monkeypatch):
    """Photographs show another flash than is predicted, by a factor that differs, and a room."""
    fit = fit_of(small_capture, levels=(3,), widths=(56,), shares=(1.0,))
    truth = room_like(fit, 0.2, 0.25, 0.3)
    compare, factors = joint_equations.compare, torch.linspace(0.75, 1.2, 12)

    def with_room(group, *others):
        lit, coverage = group.direct()
        transfer = group.other(lit, coverage)[2]
        flash = factors[group.index, None, None, None] * lit
        layout = others[0]
        shown = flash + torch.einsum("jnhwc,jc->nhwc", transfer, torch.from_numpy(truth[layout.room]).to(lit))
        seen = group.problem.capture.observe(group.index, group.scale)
        seen = seen._replace(rgb=group.calibration.recorded(shown, group.index, group.scale), mask=coverage)
        with monkeypatch.context() as patch:
            patch.setattr(type(group.problem.capture), "observe", lambda *_: seen)
            compare(group, *others)

    monkeypatch.setattr(joint_equations, "compare", with_room)
    for _ in range(2):  # brightness is compared by its logarithm: one solution is not exact
        values = solve_jointly(fit.problem, fit.model, fit.renderer, 3)
        fit.model.calibration.room.harmonics.copy_(values["ambient"])
        fit.model.calibration.power.data.copy_(values["power"])
    found, power = values["ambient"].numpy(), fit.model.calibration.value("power").detach()
    share, true = (fit.model.calibration.room_share(torch.from_numpy(part)) for part in (found, truth))
    np.testing.assert_allclose(share, true, rtol=0.3)  # priors and belief take some of it
    assert np.corrcoef(found[1:4].ravel(), truth[1:4].ravel())[0, 1] > 0.9
    assert not found[PER_FRAME:].any()
    expected = factors.log() - factors.log().mean()
    assert np.corrcoef(power.mean(1), expected)[0, 1] > 0.9 and power.std() > 0.5 * expected.std()


def test_a_fit_solves_for_it_twice(small_capture, monkeypatch):
    """At 0.3 and 0.6 of the iterations that shape the surface, with the masks of then. Not if these are too few.

    Not while the object has one material either. What is no number does not become light.
    """
    fit = fit_of(small_capture, iterations=100, detail="none")
    power = torch.randn(12, 3)
    asked, found = [], [{"ambient": torch.full((BASIS, 3), 0.25), "power": power}, {}]
    monkeypatch.setattr(
        optimisation, "solve_jointly", lambda problem, *_: asked.append(problem) or found[len(asked) - 1]
    )
    fit.optimisation.solvers[0].measured[3] = 1.0
    due = [k for k in range(fit.iterations) if fit.schedule.joint_due(k)]
    assert due == [30, 60]
    masked = copy.copy(fit.capture)
    for k in range(28, 66):
        fit.optimisation.find_light(fit.renderer, fit.schedule, k, masked)
    assert len(asked) == 2 and all(problem.capture is masked for problem in asked)
    assert (fit.model.calibration.room.harmonics == 0.25).all() and torch.equal(fit.model.calibration.power.data, power)
    assert not fit.optimisation.solvers[0].measured.any()
    short = fit_of(small_capture, iterations=33)
    assert not [k for k in range(33) if short.schedule.joint_due(k)]
    known = fit_of(small_capture, refine=("contrast",))
    known.optimisation.find_light(known.renderer, known.schedule, 30, known.capture)
    lighting = fit.problem.lighting._replace(one_material_until=1.0)
    fit.optimisation.problem = replace(fit.problem, lighting=lighting)
    fit.optimisation.find_light(fit.renderer, fit.schedule, 30, fit.capture)
    assert len(asked) == 2


@pytest.mark.parametrize("given", [False, True])
def test_what_cannot_be_told_widens_the_deviation(small_capture, given):
    """By `DOUBT`, unless the scene file tells of a room."""
    room = np.zeros((BASIS, 3))
    room[0] = given
    fit = fit_of(small_capture, room)
    assert doubt(fit.model.calibration) == (0 if given else DOUBT)
    joint = JointEquations.of(fit.problem, fit.model, fit.renderer, 3, most=5)
    told = np.zeros((BASIS, 3))
    told[0] = joint.deviations(fit.problem.exposure)["ambient"]
    share = fit.model.calibration.room_share(torch.from_numpy(told)).numpy()
    stated = summary(fit.problem, fit.model, fit.calibrated(), joint)["unknowns"]["ambient"]["std"]
    np.testing.assert_allclose(stated, np.hypot(share, 0 if given else DOUBT), rtol=1e-5)


def test_of_many_photographs_some_are_compared(small_capture, monkeypatch):
    fit = fit_of(small_capture)
    seen = []
    monkeypatch.setattr(joint_equations, "compare", lambda group, *_: seen.extend(group.index.tolist()))
    JointEquations.of(fit.problem, fit.model, fit.renderer, 3, most=5)
    assert len(seen) == 5 and np.diff(sorted(seen)).max() <= 3
    seen.clear()
    JointEquations.of(fit.problem, fit.model, fit.renderer, 3)
    assert sorted(seen) == fit.problem.fitted.tolist()
