"""Lamps that light all photographs: their gradients, where they begin, and what a fit finds of them."""

import json
import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import AXES
from test_bridge import OFF_CAMERA, Setting, tensor

import mi_ring
from mi_ring import synthesize
from mi_ring.fitting.calibration import Calibration, refined_of
from mi_ring.fitting.lighting import Lighting, lit
from mi_ring.fitting.trials import brightest
from mi_ring.rendering import bridge
from mi_ring.rendering.lights import Light, emitter_of, light_of, place_of, put
from mi_ring.rendering.scenes import lamps_of, with_lamps

LAMPS = [
    Light("point", np.array([-1.9, 2.4, 1.8]), np.array([9.0, 12.0, 7.0])),
    Light("directional", np.array([0.48, -0.6, -0.64]), np.array([1.5, 0.7, 1.1])),
]
TINY = {
    "levels": (3,), "widths": (32,), "shares": (1.0,), "iterations": 40, "subdivisions": 3, "domain": "sphere",
}  # fmt: skip


@pytest.fixture(scope="module")
def under_two_lamps(tmp_path_factory):
    """Path of a capture of an ellipsoid by two lamps; scene.xml says nothing of the second, truth/exact.xml all."""
    folder = tmp_path_factory.mktemp("lamps")
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.vertices = ball.vertices * AXES
    ball.export(folder / "ball.ply")
    small = ["--views", "10", "--novel", "0", "--size", "40", "32", "--spp", "16", "--depth", "2", "--seed", "4"]
    lamps = ["--light", "lamp", "--lamps", "2", "--wrong-room", "--material", "diffuse reflectance=0.5"]
    synthesize.main([str(folder / "ball.ply"), str(folder / "capture"), *small, *lamps])
    return folder / "capture/scene.xml"


def lamps_in(capture):
    return [light_of(lamp) for lamp in lamps_of(capture.scene)]


@pytest.mark.parametrize("light", LAMPS)
def test_an_emitter_is_what_its_numbers_say(light):
    """Also after it was put elsewhere, with the gradient of its place."""
    emitter = emitter_of(light)
    found = light_of(emitter)
    assert found.kind == light.kind
    np.testing.assert_allclose(found.vector, light.vector, rtol=1e-5)
    np.testing.assert_allclose(found.rgb, light.rgb, rtol=1e-5)
    place = mi.Vector3f(mi.Float(0.36), mi.Float(-0.48), mi.Float(0.8))
    dr.enable_grad(place)
    put(emitter, place, mi.Color3f(3, 4, 5))
    moved = light_of(emitter)
    np.testing.assert_allclose(
        moved.vector, np.array([0.36, -0.48, 0.8]) * (1 if light.kind == "point" else -1), rtol=1e-5
    )
    np.testing.assert_allclose(moved.rgb, [3, 4, 5])
    where, _ = place_of(emitter)
    dr.backward(dr.dot(where, mi.Vector3f(1, 2, 3)))
    np.testing.assert_allclose(np.ravel(dr.grad(place)), [1, 2, 3], atol=1e-5)


def test_gradients_of_lamps_equal_finite_differences():
    """Of places and strengths, with the same samples; without shadows, whose edges would be noisy."""
    setting = Setting(OFF_CAMERA, shadows=False)
    setting.surface.scene = with_lamps(setting.scene, LAMPS)
    setting.surface.params = mi.traverse(setting.surface.scene)
    given = setting.surface.scene
    now = [tensor(np.stack([LAMPS[0].vector, -LAMPS[1].vector])), tensor(np.stack([lamp.rgb for lamp in LAMPS]))]
    ball = tensor(np.array([0.3, -0.2, 0.15]) + 0.8 * setting.s)  # convex: nothing is in its own shadow

    def loss(lamps):
        rgb, _ = bridge.render(setting.surface, setting.photographs, ball, setting.material, 16, 3, False, lamps=lamps)
        return (setting.radiance_weight * rgb).sum()

    lamps = [t.clone().requires_grad_() for t in now]
    loss(lamps).backward()
    for which, step in ((0, 2e-3), (1, 1e-2)):
        for k in range(6):
            sides = []
            for sign in (1, -1):
                moved = [t.clone() for t in now]
                moved[which].view(-1)[k] += sign * step
                with torch.no_grad():
                    sides.append(loss(moved).item())
            slope = (sides[0] - sides[1]) / (2 * step)
            # Terminators move, which no finite step sees alike.
            assert lamps[which].grad.ravel()[k].item() == pytest.approx(slope, rel=2e-2, abs=0.5), (which, k)
    np.testing.assert_allclose(light_of(lamps_of(given)[0]).vector, LAMPS[0].vector, rtol=1e-6)  # left as it was


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
    assert len(found) == count
    for (direction, colour), true, strength in zip(found, toward, colours):
        assert np.degrees(np.arccos(np.dot(direction, true))) < 10
        np.testing.assert_allclose(colour, strength / colours[0], rtol=0.35, atol=0.05)


def test_the_first_lamp_is_the_photographs_own(small_capture):
    """As strong as makes the albedo a half; the others are the scene's, by their ratio to it."""
    capture = mi_ring.load_capture(small_capture)
    center = capture.sphere()[0]
    away = np.median([np.linalg.norm(sensor.camera.position - center) for sensor in capture.sensors])
    said = (((0.48, 0.6, -0.64), (1.0, 1.0, 1.0)), ((0.0, -0.6, 0.8), (0.5, 0.25, 2.0)))
    for distant in (False, True):
        under = lit(capture, Lighting("lamps", said, distant))
        (lamp,) = lamps_in(under)
        own = under.photographs.lights[3]
        expected = [np.array(direction) * (-1 if distant else away) for direction, _ in said]
        expected = expected if distant else [center + place for place in expected]
        np.testing.assert_allclose([own.vector, lamp.vector], expected, rtol=1e-5)
        np.testing.assert_allclose(lamp.rgb / own.rgb, said[1][1], rtol=1e-5)
        assert np.pi * under.reflectance(center, capture.exposure()) == pytest.approx(0.5, rel=1e-5)
        assert not lamps_of(capture.scene)
    assert [str(Lighting("lamps", said[:1])), str(Lighting("lamps", said, True)), str(Lighting("environment"))] == [
        "1 lamp", "2 distant lamps", "environment",
    ]  # fmt: skip


def test_lamps_that_the_scene_says_roughly_are_refined(under_two_lamps, tmp_path):
    """Moved by a tenth of its distance and a quarter less bright, a lamp comes back; it is written, how surely, too."""
    exact = under_two_lamps.parent / "truth/exact.xml"
    true = mi_ring.load_capture(exact, images=False)
    (lamp,) = lamps_in(true)
    center = true.sphere()[0]
    wrong = lamp._replace(vector=lamp.vector + 0.1 * np.linalg.norm(lamp.vector - center) * np.array([0.6, 0, -0.8]))
    text = re.sub(r"</sensor>\s*<emitter.*</emitter>", "</sensor>{}", exact.read_text(), flags=re.DOTALL)
    said = '<emitter type="point"><point name="position" x="{}" y="{}" z="{}"/><rgb name="intensity" value="{} {} {}"/>'
    scene = under_two_lamps.parent / "rough.xml"
    text = text.replace("{}", said.format(*wrong.vector, *(0.75 * lamp.rgb)) + "</emitter>").replace('"../', '"')
    scene.write_text(text)
    capture = mi_ring.load_capture(scene)
    fit = mi_ring.Fit(capture, mi_ring.Config.preset("fast", **TINY, refine=("lamps",)))
    assert fit.calibration.refined == ("lamps",)
    list(fit)
    refined = fit.calibrated()
    (found,) = lamps_in(refined)
    off = [np.linalg.norm(side.vector - lamp.vector) for side in (found, wrong)]
    assert off[0] < 0.6 * off[1]  # how far it is, few photographs of a ball hardly tell from how strong it is
    assert (found.rgb / lamp.rgb).mean() == pytest.approx(1, abs=0.15)
    np.testing.assert_allclose(lamps_in(capture)[0].vector, wrong.vector, rtol=1e-5)  # the capture is left as it was

    state, config = fit.state(), fit.config
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    (written,) = lamps_in(again)
    np.testing.assert_allclose(written.vector, found.vector, rtol=1e-5)
    unknowns = json.loads((tmp_path / "calibration.json").read_text())["unknowns"]
    np.testing.assert_allclose(unknowns["lamp"]["after"], [found.vector], rtol=1e-5)
    np.testing.assert_allclose(unknowns["lamp"]["before"], [wrong.vector], rtol=1e-5)
    assert np.shape(unknowns["strength"]["std"]) == (1, 3) and (np.array(unknowns["lamp"]["std"]) > 0).all()
    resumed = mi_ring.Fit(capture, config, state=state)
    np.testing.assert_allclose(lamps_in(resumed.calibrated())[0].vector, found.vector, rtol=1e-6)


def test_a_fit_under_two_unknown_lamps(under_two_lamps, tmp_path):
    """It begins with two where it is told so, refines both, and writes the second as the scene's."""
    capture = mi_ring.load_capture(under_two_lamps)
    true = mi_ring.load_capture(under_two_lamps.parent / "truth/exact.xml", images=False)
    said = [true.photographs.lights[0], *lamps_in(true)]
    begun = tuple((tuple(light.vector / np.linalg.norm(light.vector)), (1.0, 1.0, 1.0)) for light in said)
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 12}, light="lamps")
    fit = mi_ring.Fit(capture, config, lighting=Lighting("lamps", begun))
    assert fit.calibration.refined == ("light", "gain", "ambient", "lamps")
    assert fit.calibration.widths["light"] == fit.calibration.widths["lamp"] == pytest.approx(0.3)  # nobody measured them
    errors = [it.terms["rgb"] for it in fit]
    assert np.mean(errors[-4:]) < 0.8 * errors[0]
    resumed = mi_ring.Fit(capture, config, state=fit.state())
    assert resumed.lighting == fit.lighting and len(resumed.calibration.lamp) == 1
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    assert len(lamps_of(again.scene)) == 1
    assert refined_of(again, mi_ring.Config(), 0.5) == ("light", "power", "ambient")  # the second is known now


def test_lamps_are_refined_where_there_are_some(small_capture):
    capture = mi_ring.load_capture(small_capture)
    with pytest.raises(mi_ring.InputError, match="emitter: --refine lamps: the scene has none, point or directional"):
        mi_ring.Fit(capture, mi_ring.Config.preset("fast", refine=("lamps",)))
    lamp = Light("point", np.array([30.0, 40, 50]), np.ones(3))
    under = replace(capture, scene=with_lamps(capture.scene, [lamp]))
    calibration = Calibration(under, ["lamps", "scale"], np.zeros(3), 0.5, power=3.0)
    with torch.no_grad():
        calibration.scale += 1
        ratio = float(calibration.value("scale").exp())
        np.testing.assert_allclose(calibration.lamps_now().strengths, np.full((1, 3), 3 * ratio), rtol=1e-5)
