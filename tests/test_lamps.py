"""Lamps that light all photographs: their gradients, where they begin, and what a fit finds of them."""

import json
import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from conftest import photographed_ellipsoid
from helpers.bumpy_ball import OFF_CAMERA, Setting, tensor

import mi_ring
from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.fitting.joint_equations import JointEquations
from mi_ring.fitting.lighting import Lighting, with_found_lamps, with_lighting
from mi_ring.fitting.refinement import refined_of
from mi_ring.rendering import prediction
from mi_ring.scene.assembly import lamp_lights, lamps_of, with_lamps
from mi_ring.scene.lights import Light, emitter_of, light_of, move_lamp, position_of

LAMPS = [
    Light("point", np.array([-1.9, 2.4, 1.8]), np.array([9.0, 12.0, 7.0])),
    Light("directional", np.array([0.48, -0.6, -0.64]), np.array([1.5, 0.7, 1.1])),
]
TINY = {
    "levels": (3,), "widths": (32,), "shares": (1.0,), "iterations": 40, "subdivisions": 3, "domain": "sphere",
    "indirect": False,  # of a convex object there is none
}  # fmt: skip


@pytest.fixture(scope="session")
def under_two_lamps(tmp_path_factory):
    """Path of a capture of an ellipsoid by two lamps; scene.xml says nothing of the second, truth/exact.xml all."""
    folder = tmp_path_factory.mktemp("lamps")
    lamps = ["--light", "lamp", "--lamps", "2", "--wrong-room", "--depth", "2", "--seed", "4"]
    return photographed_ellipsoid(folder, *lamps)


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
    move_lamp(emitter, place, mi.Color3f(3, 4, 5))
    moved = light_of(emitter)
    np.testing.assert_allclose(
        moved.vector, np.array([0.36, -0.48, 0.8]) * (1 if light.kind == "point" else -1), rtol=1e-5
    )
    np.testing.assert_allclose(moved.rgb, [3, 4, 5])
    where, _ = position_of(emitter)
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
        rgb, _ = prediction.render(
            setting.surface, setting.photographs, ball, setting.material, 16, 3, False, lamps=lamps
        )
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
            largest = float(lamps[which].grad.abs().max())  # terminators move, which no finite step sees alike
            assert lamps[which].grad.ravel()[k].item() == pytest.approx(slope, rel=2e-2, abs=1e-2 * largest), (which, k)
    np.testing.assert_allclose(light_of(lamps_of(given)[0]).vector, LAMPS[0].vector, rtol=1e-6)  # left as it was


def test_the_first_lamp_is_the_photographs_own(small_capture):
    """The others are the scene's; a fit under them begins there, and says where they have gone."""
    capture = mi_ring.load_capture(small_capture)
    center, exposure = capture.sphere()[0], capture.exposure()
    said = (((30.0, 40.0, -20.0), (900.0, 900.0, 900.0)), ((-0.6, 0.0, 0.8), (450.0, 100.0, 1800.0)))
    for distant in (False, True):
        lighting = Lighting("lamps", said, distant)
        under = with_lighting(capture, lighting)
        (lamp,) = lamp_lights(under.scene)
        own = under.photographs.lights[3]
        assert own.kind == lamp.kind == ("directional" if distant else "point")
        for light, (vector, rgb) in zip((own, lamp), said):
            scale = np.linalg.norm(vector) if distant else 1.0
            np.testing.assert_allclose(light.vector, np.array(vector) / scale, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(light.rgb, rgb, rtol=1e-5)
        assert with_found_lamps(lighting, under, center)._replace(lamps=()) == lighting._replace(lamps=())
        for found, light in zip(with_found_lamps(lighting, under, center).lamps, (own, lamp)):
            np.testing.assert_allclose(found, light[1:], rtol=1e-5, atol=1e-6)
        assert not lamps_of(capture.scene)
    near = Lighting("lamps", said)
    away = tuple((center + 3 * (np.array(said[0][0]) - center)).tolist())
    gone = with_lighting(capture, Lighting("lamps", ((away, said[0][1]), said[1])))  # where a coarse fit has moved it
    far = with_found_lamps(near, gone, center)
    np.testing.assert_allclose(far.lamps[0], (away, np.multiply(9, said[0][1])), rtol=1e-4)
    np.testing.assert_allclose(far.lamps[1][1], np.multiply(9, said[1][1]), rtol=1e-4)
    seen, said_first = (with_lighting(capture, lighting).reflectance(center, exposure) for lighting in (far, near))
    assert seen == pytest.approx(said_first)  # the albedo's gauge
    assert [str(Lighting("lamps", said[:1])), str(Lighting("lamps", said, True)), str(Lighting("environment"))] == [
        "1 lamp", "2 distant lamps", "environment",
    ]  # fmt: skip


def test_one_material_is_the_mean_of_all_until_it_may_vary():
    material = {"diffuse": torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.4, 0.9]]), "roughness": torch.tensor([0.2, 0.6])}
    plain = Lighting("environment", one_material_until=0.6)
    shared = plain.material_at(0.59, material)
    torch.testing.assert_close(shared["diffuse"], torch.tensor([[0.3, 0.3, 0.6]]).expand(2, 3))
    torch.testing.assert_close(shared["roughness"], torch.tensor([0.4, 0.4]))
    assert plain.material_at(0.6, material) is material
    assert Lighting("environment").material_at(0.0, material) is material


def test_lamps_that_the_scene_says_roughly_are_refined(under_two_lamps, tmp_path):
    """Moved by a tenth of its distance and a quarter less bright, a lamp comes back; it is written, how surely, too."""
    exact = under_two_lamps.parent / "truth/exact.xml"
    true = mi_ring.load_capture(exact, images=False)
    (lamp,) = lamp_lights(true.scene)
    center = true.sphere()[0]
    wrong = lamp._replace(vector=lamp.vector + 0.1 * np.linalg.norm(lamp.vector - center) * np.array([0.6, 0, -0.8]))
    text = re.sub(r"</sensor>\s*<emitter.*</emitter>", "</sensor>{}", exact.read_text(), flags=re.DOTALL)
    said = '<emitter type="point"><point name="position" x="{}" y="{}" z="{}"/><rgb name="intensity" value="{} {} {}"/>'
    scene = under_two_lamps.parent / "rough.xml"
    text = text.replace("{}", said.format(*wrong.vector, *(0.75 * lamp.rgb)) + "</emitter>").replace('"../', '"')
    scene.write_text(text)
    capture = mi_ring.load_capture(scene)
    fit = mi_ring.Fit(capture, mi_ring.Config.preset("fast", **TINY, refine=("lamps",)))
    assert fit.model.calibration.refined == ("lamps",)
    list(fit)
    refined = fit.calibrated()
    (found,) = lamp_lights(refined.scene)
    off = [np.linalg.norm(side.vector - lamp.vector) for side in (found, wrong)]
    assert off[0] < 0.6 * off[1]  # how far it is, few photographs of a ball hardly tell from how strong it is
    assert (found.rgb / lamp.rgb).mean() == pytest.approx(1, abs=0.15)
    np.testing.assert_allclose(
        lamp_lights(capture.scene)[0].vector, wrong.vector, rtol=1e-5
    )  # the capture is left as it was

    state, config = fit.state(), fit.problem.config
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    (written,) = lamp_lights(again.scene)
    np.testing.assert_allclose(written.vector, found.vector, rtol=1e-5)
    unknowns = json.loads((tmp_path / "calibration.json").read_text())["unknowns"]
    np.testing.assert_allclose(unknowns["lamp"]["after"], [found.vector], rtol=1e-5)
    np.testing.assert_allclose(unknowns["lamp"]["before"], [wrong.vector], rtol=1e-5)
    assert np.shape(unknowns["strength"]["std"]) == (1, 3) and (np.array(unknowns["lamp"]["std"]) > 0).all()
    resumed = mi_ring.Fit(capture, config, state=state)
    np.testing.assert_allclose(lamp_lights(resumed.calibrated().scene)[0].vector, found.vector, rtol=1e-6)


def test_a_fit_under_two_unknown_lamps(under_two_lamps, tmp_path):
    """It begins with two where it is told so, refines both, and writes the second as the scene's."""
    capture = mi_ring.load_capture(under_two_lamps)
    true = mi_ring.load_capture(under_two_lamps.parent / "truth/exact.xml", images=False)
    said = [true.photographs.lights[0], *lamp_lights(true.scene)]
    begun = tuple((tuple(light.vector), tuple(said[0].rgb)) for light in said)
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 12}, light="lamps", holdout=5)
    fit = mi_ring.Fit(capture, config, lighting=Lighting("lamps", begun))
    assert fit.model.calibration.refined == ("light", "gain", "ambient", "lamps")
    widths = fit.model.calibration.widths
    assert widths["light"] == widths["lamp"] == pytest.approx(0.3)  # nobody has measured where they are
    errors = [it.terms["rgb"] for it in fit]
    assert np.mean(errors[-4:]) < 0.8 * errors[0]
    validation = fit.course.validation
    assert validation["unexplained"] > 0 and validation["before"] > 0  # of those that are kept out
    (before,) = lamp_lights(fit.calibrated().scene)
    JointEquations.of(fit.problem, fit.model, fit.renderer, 3)
    after = light_of(lamps_of(fit.renderer.surface.scene)[0])
    np.testing.assert_allclose(after.rgb, before.rgb, rtol=1e-6)
    np.testing.assert_allclose(after.vector, before.vector, rtol=1e-6)
    resumed = mi_ring.Fit(capture, config, state=fit.state())
    assert resumed.problem.lighting == fit.problem.lighting and len(resumed.model.calibration.lamp) == 1
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    assert len(lamps_of(again.scene)) == 1
    refined = refined_of(again, mi_ring.Config(), "capture", 0.5)
    assert refined == ("light", "power", "ambient")  # the second is known now


def test_lamps_are_refined_where_there_are_some(small_capture):
    capture = mi_ring.load_capture(small_capture)
    for light in ("capture", "environment", "auto"):
        with pytest.raises(mi_ring.InputError, match="emitter: --refine lamps: the scene has none, point or direction"):
            mi_ring.Fit(capture, mi_ring.Config.preset("fast", light=light, refine=("lamps",)))
    one = mi_ring.Config.preset("fast", light="lamps", refine=("auto", "lamps"))
    assert "lamps" not in refined_of(capture, one, "lamps", 0.5)
    lamp = Light("point", np.array([30.0, 40, 50]), np.ones(3))
    under = replace(capture, scene=with_lamps(capture.scene, [lamp]))
    calibration = Calibration(under, ["lamps", "scale"], Rig(under, np.zeros(3), 0.5, power=3.0, lamps=True))
    with torch.no_grad():
        calibration.scale += 1
        ratio = float(calibration.value("scale").exp())
        np.testing.assert_allclose(calibration.lamps().strengths, np.full((1, 3), 3 * ratio), rtol=1e-5)
