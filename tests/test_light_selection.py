"""Light selection: coarse fits find out what lights the photographs."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.unknown_light import TINY

import mi_ring
from mi_ring.errors import InputError
from mi_ring.fitting import light_selection
from mi_ring.fitting.light_selection import CoarseFits, brightest
from mi_ring.fitting.lighting import Lighting, with_found_lamps, with_lighting
from mi_ring.rendering.spherical_harmonics import BASIS, world_harmonics

pytestmark = pytest.mark.usefixtures("short_trials")

#: What coarse fits leave (None: they fail), by how lightings are called; what is believed, and until when plain.
DECISIONS = [
    ("lamps", {"1 lamp": 0.083, "2 lamps": 0.069, "3 lamps": 0.0685, "2 distant lamps": 0.074,
               "2 lamps on one material": 0.077}, "2 lamps on one material", 0.35),
    ("lamps", {"1 lamp": 0.086, "2 lamps": 0.081, "3 lamps": 0.07, "3 distant lamps": 0.074,
               "3 lamps on one material": 0.09}, "3 lamps", 0),
    ("lamps", {"1 lamp": 0.08, "2 lamps": 0.079, "3 lamps": 0.09, "1 distant lamp": 0.07,
               "1 distant lamp on one material": 0.09}, "1 distant lamp", 0),
    ("lamps", {"1 lamp": 0.08, "2 lamps": None, "3 lamps": 0.079, "1 distant lamp": 0.09,
               "1 lamp on one material": None}, "1 lamp", 0),
    ("lamps", {"1 lamp": 0.06, "2 lamps": 0.05, "3 lamps": 0.058, "together": ("2 lamps", "3 lamps"),
               "1 distant lamp": 0.07, "1 lamp on one material": 0.08}, "1 lamp", 0),
    ("environment", {"environment": 0.1, "environment on one material": 0.11}, "environment on one material", 0.35),
    ("environment", {"environment": 0.1, "environment on one material": 0.13}, "environment", 0),
    ("turntable", {"turntable": 0.1, "turntable on one material": 0.13}, "turntable", 0),
    ("auto", {"environment": 0.095, "1 lamp": 0.094, "turntable": 0.092, "capture": 0.1}, "capture", 0),
    ("auto", {"environment": None, "turntable": 0.05, "capture": 0.1, "turntable on one material": 0.09},
     "turntable", 0),
    ("auto", {"environment": 0.08, "1 lamp": 0.085, "turntable": 0.085, "capture": 0.1, "2 lamps": 0.06,
              "3 lamps": 0.06, "2 distant lamps": 0.09, "2 lamps on one material": 0.08}, "2 lamps", 0),
    ("auto", {"environment": 0.08, "1 lamp": 0.095, "turntable": 0.085, "capture": 0.1, "2 lamps": 0.09,
              "3 lamps": 0.09, "1 distant lamp": 0.09, "2 distant lamps": 0.09, "environment on one material": 0.09},
     "environment on one material", 0.35),
]  # fmt: skip


def test_coarse_fits_find_that_it_is_an_environment(in_an_environment, monkeypatch):
    monkeypatch.setattr(light_selection, "MOST", 1)
    capture = mi_ring.load_capture(in_an_environment)
    config = mi_ring.Config.preset("fast", **TINY, light="auto")
    assert mi_ring.choose_lighting(capture, config).kind == "environment"


@pytest.mark.parametrize(("light", "errors", "believed", "plain"), DECISIONS)
def test_coarse_fits_decide(light, errors, believed, plain, small_capture, monkeypatch):
    """Nothing else is tried than what is to be decided, and the fit goes on where the trial of it has ended."""
    tried, ended, together = [], {}, errors.get("together", ())

    class Trial:
        schedule = SimpleNamespace(iterations=60)
        harmonics = torch.zeros(BASIS, 3)
        harmonics[:25] = torch.from_numpy(
            world_harmonics(np.eye(3)) @ np.diag([3.0, 2.0, 1.0]).sum(1, keepdims=True)
        ).float()
        room = SimpleNamespace(harmonics=harmonics, matrix=torch.eye(BASIS).expand(3, -1, -1))
        model = SimpleNamespace(calibration=SimpleNamespace(room=room))

        def __init__(self, capture, config, lighting):
            tried.append(name := str(lighting))
            begun = lighting
            assert config.light == lighting.kind and config.widths == (64,)
            self.error = errors.get(name, 0.1)
            if self.error is None:
                raise InputError("diverged at iteration 9")
            if lighting.one_material_until and lighting.lamps:  # which has found the first lamp farther away
                (vector, rgb), *others = lighting.lamps
                lighting = lighting._replace(lamps=((tuple(2 * x for x in vector), rgb), *others))
            if name in together:  # its second lamp has moved to the first
                (vector, rgb), _, *others = lighting.lamps
                near = tuple((np.array(vector) + 0.2 * np.linalg.norm(vector) * np.array([0.6, 0.8, 0])).tolist())
                lighting = lighting._replace(lamps=((vector, rgb), (near, rgb), *others))
            self.capture = with_lighting(capture, lighting)
            ended[name] = with_found_lamps(begun, self.capture, center)

        def calibrated(self):
            return self.capture

        def __iter__(self):
            before, last = (SimpleNamespace(terms={"rgb": error}) for error in (9.0, self.error))
            return iter([before] * (60 - light_selection.LAST) + [last] * light_selection.LAST)

    config, capture = mi_ring.Config.preset("fast", light=light), mi_ring.load_capture(small_capture)
    center, _ = capture.sphere()
    monkeypatch.setattr(light_selection, "Fit", Trial)
    monkeypatch.setattr(light_selection, "object_turned", lambda capture: None)
    found = mi_ring.choose_lighting(capture, config)
    assert str(found) == believed and found.one_material_until == plain and found.lamps == ended[believed].lamps
    assert len(tried) == len(set(tried)) and set(tried) <= {*errors, "environment"}


@pytest.mark.parametrize(("turned", "environment", "own", "believed"), [
    (True, 0.082, 0.12, "turntable"), (True, 0.082, 0.096, "capture"), (True, 0.082, None, "turntable"),
    (None, 0.082, 0.12, "environment"), (None, 0.082, None, "environment"), (None, 0.09, None, "turntable"),
    (False, 0.09, None, "environment"),
])  # fmt: skip
def test_whether_the_object_turned_says_in_which_axes_light_is_fixed(
    turned, environment, own, believed, small_capture, monkeypatch
):
    errors = {"turntable": 0.087, "environment": environment, "1 lamp": 0.106, "capture": own}
    capture = mi_ring.load_capture(small_capture)
    trials = CoarseFits(capture, mi_ring.Config.preset("fast", light="auto"))
    monkeypatch.setattr(trials, "error", lambda lighting: errors[str(lighting)])
    monkeypatch.setattr(trials, "brightest", lambda count: Lighting("lamps", (((0, 0, 9), (1, 1, 1)),)))
    monkeypatch.setattr(light_selection, "is_unlit", lambda capture: own is None)
    assert str(trials.likeliest(turned)) == believed


@pytest.mark.parametrize(("errors", "believed"), [
    ({"turntable": 0.08, "capture": 0.1, "turntable on one material": 0.1}, "turntable"),
    ({"turntable": None, "capture": 0.1, "environment": 0.08, "1 lamp": 0.2, "2 lamps": 0.2, "3 lamps": 0.2,
      "1 distant lamp": 0.2, "environment on one material": 0.1}, "environment"),
])  # fmt: skip
def test_for_an_object_that_turned_a_turntable_is_tried_first(errors, believed, small_capture, monkeypatch, capsys):
    def error(trials, lighting):
        value = errors[str(lighting)]
        trials.errors[lighting] = np.inf if value is None else value
        trials.found[lighting] = lighting
        return trials.errors[lighting]

    monkeypatch.setattr(light_selection, "object_turned", lambda capture: True)
    monkeypatch.setattr(CoarseFits, "error", error)
    lamp = (0.0, 0.0, 9.0), (1.0, 1.0, 1.0)
    monkeypatch.setattr(CoarseFits, "brightest", lambda _, n, distant=False: Lighting("lamps", (lamp,) * n, distant))
    monkeypatch.setattr(CoarseFits, "are_apart", lambda trials, lamps: True)
    capture = mi_ring.load_capture(small_capture)
    assert str(mi_ring.choose_lighting(capture, mi_ring.Config.preset("fast", light="auto"))) == believed
    said = capsys.readouterr().out
    assert "the object turned" in said and "at most 0.9 of their error" in said


def test_a_flash_capture_is_found_to_be_one(small_capture):
    capture = mi_ring.load_capture(small_capture)
    config = mi_ring.Config.preset("fast", **TINY, light="auto")
    assert mi_ring.choose_lighting(capture, config) == Lighting("capture")


@pytest.mark.parametrize(("wrong", "ends"), [(1, False), (60, True)])
def test_errors_that_are_no_numbers_are_left_out(wrong, ends, small_capture, monkeypatch):
    class Trial:
        schedule, model = SimpleNamespace(iterations=60), SimpleNamespace(calibration=None)

        def __init__(self, capture, config, lighting):
            self.capture = with_lighting(capture, lighting)

        def calibrated(self):
            return self.capture

        def __iter__(self):
            errors = [0.1] * (60 - wrong) + [np.nan] * wrong
            return iter([SimpleNamespace(terms={"rgb": error}) for error in errors])

    config, capture = mi_ring.Config.preset("fast", light="environment"), mi_ring.load_capture(small_capture)
    monkeypatch.setattr(light_selection, "Fit", Trial)
    monkeypatch.setattr(light_selection, "object_turned", lambda capture: None)
    if ends:
        with pytest.raises(InputError, match="small.xml: a coarse fit .* has no finite error"):
            mi_ring.choose_lighting(capture, config)
    else:
        assert mi_ring.choose_lighting(capture, config).one_material_until > 0


@pytest.mark.parametrize("count", [1, 2, 3])
def test_lamps_begin_where_the_environment_is_brightest(count):
    """Harmonics of light from a single direction are their values there."""
    toward = np.array([[0.48, 0.6, -0.64], [-0.6, 0.64, 0.48], [0.36, -0.8, 0.48]])[:count]
    colours = np.array([[1.0, 0.8, 0.5], [0.6, 0.6, 0.2], [0.3, 0.1, 0.2]])[:count]
    harmonics = np.stack(
        [np.ravel(v) + np.zeros(count) for v in dr.sh_eval(mi.Vector3f(*toward.T.astype(np.float32)), 4)]
    )
    room = harmonics @ colours
    room[0] += 0.2  # and as much from all sides
    found = brightest(room, np.repeat([1, 4 / 9, 1 / 16, 0, 0], [1, 3, 5, 7, 9]), count)  # as a diffuse surface tells
    assert len(found[0]) == count
    for direction, colour, true, strength in zip(*found, toward, colours):
        assert np.degrees(np.arccos(np.dot(direction, true))) < 10
        np.testing.assert_allclose(colour, strength / colours[0], rtol=0.35, atol=0.05)


@pytest.mark.parametrize("distant", [False, True])
def test_lamps_begin_as_strong_as_makes_the_albedo_a_half(distant, small_capture):
    """As far away as the cameras, in the directions that the environment has, by its colours."""
    capture = mi_ring.load_capture(small_capture)
    trials = CoarseFits(capture, mi_ring.Config())
    toward, colour = np.array([0.48, 0.6, -0.64]), np.array([1.0, 0.8, 0.5])
    values = dr.sh_eval(mi.Vector3f(*toward.tolist()), 4)
    trials.environment = np.stack([np.ravel(v)[0] for v in values])[:, None] * colour, np.ones(25)
    trials.errors[Lighting("environment")] = 0.1
    under = with_lighting(capture, trials.brightest(1, distant))
    center = capture.sphere()[0]
    own = under.photographs.lights[0]
    away = -own.vector if distant else own.vector - center
    distances = [np.linalg.norm(shot.camera.position - center) for shot in capture.shots]
    assert np.linalg.norm(away) == pytest.approx(1.0 if distant else np.median(distances), rel=1e-4)
    assert np.degrees(np.arccos(away @ toward / np.linalg.norm(away))) < 8
    assert np.pi * under.reflectance(center, capture.exposure()) == pytest.approx(0.5, rel=1e-4)
