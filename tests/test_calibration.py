"""Cameras, lights and curve as unknowns: their gradients, what they do to a capture, and whether fits find them."""

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.bumpy_ball import HEIGHT, OFF_CAMERA, WIDTH, Setting, tensor
from helpers.quick_fits import posed
from scipy.spatial.transform import Rotation

import mi_ring
from mi_ring import InputError, fit
from mi_ring.calibration.calibration import OPTIONS, Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.calibration.unknowns import UNKNOWNS
from mi_ring.capture.decoding import decode, has_open_curve, recorded
from mi_ring.capture.pixels import Pixels
from mi_ring.capture.scenefile import recalibrated_xml
from mi_ring.fitting import validation
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.refinement import refined_of
from mi_ring.fitting.schedule import Stage
from mi_ring.geometry.rotations import rotations
from mi_ring.images import linear_to_srgb
from mi_ring.output.calibration_panel import held_out_text
from mi_ring.rendering import prediction
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.rendering.views import Views
from mi_ring.scene.tone_curve import ToneCurve

CENTER = np.array([400.0, -150.0, 90.0])  #: of the object of `small_capture`
FLASH = np.array([15.0, 10.0, 0.0])  #: of its flash, in the cameras' axes


def edited(scene, folder, edit):
    """A copy of a scene whose photographs, as XML, `edit` has changed."""
    shutil.copytree(scene.parent, folder)
    path = folder / scene.name
    tree = ElementTree.parse(path)
    for element in tree.getroot().iter("sensor"):
        edit(element)
    tree.write(path)
    return path


def unknowns_of(capture, refined, power=1.0, fitted=None):
    """The calibration of a fit of the small capture that refines these options."""
    return Calibration(capture, refined, Rig(capture, CENTER, 0.3, fitted, power))


def one(array):
    """What a capture has of a single photograph."""
    return Pixels.of([None if array is None else array.astype(np.float32)])


def move_light(element, offset):
    """The light of a photograph, as XML, `offset` farther along the camera's axes."""
    matrix = np.array(element.find(".//matrix").get("value").split(), float).reshape(4, 4)
    point = element.find("emitter/point")
    for axis, value in zip("xyz", matrix[:3, :3] @ offset):
        point.set(axis, str(float(point.get(axis)) + value))


def losses(setting, calibration, vertices, spp=16, seed=5):
    rgb, alpha = prediction.render(
        setting.surface, setting.photographs, vertices, setting.material, spp, seed, setting.shadows, calibration
    )
    return (setting.radiance_weight * rgb).sum(), (setting.coverage_weight * alpha).sum()


def calibration_of(setting):
    views, count = setting.photographs.views, len(setting.photographs)
    shapes = {"cameras": (-1, 3, 4), "intrinsics": (-1, 4), "places": (-1, 3), "strengths": (-1, 3)}
    tensors = {name: tensor(np.array(getattr(views, name))).reshape(shape) for name, shape in shapes.items()}
    zeros = {"cone": torch.zeros(count, 3), "distortion": torch.zeros(count)}
    return Views(**{name: t.requires_grad_() for name, t in (tensors | zeros).items()})


def detached(views, **changed):
    return Views(*(t.detach() for t in views))._replace(**changed)


def test_pictures_are_those_of_the_photographs_own_cameras_and_lights():
    setting = Setting(OFF_CAMERA, shadows=True)
    given = prediction.render(setting.surface, setting.photographs, setting.vertices, setting.material, 4, 3)
    same = prediction.render(setting.surface, setting.photographs, setting.vertices, setting.material, 4, 3,
                         views=detached(calibration_of(setting)))  # fmt: skip
    for a, b in zip(given, same):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["places", "strengths"])
def test_gradients_of_lights_equal_finite_differences(name):
    """The same rays hit the same points, and there are no shadows that move."""
    setting = Setting(OFF_CAMERA, shadows=False)
    calibration = calibration_of(setting)
    losses(setting, calibration, setting.vertices)[0].backward()
    step = tensor(np.random.default_rng(2).uniform(0.2, 1, (2, 3))) * (0.01 if name == "places" else 0.1)
    if name == "places":  # the direction toward a distant light stays a unit vector
        away = calibration.places[1].detach()
        step[1] -= away * (step[1] @ away)
    sides = []
    for sign in (1, -1):
        moved = detached(calibration, **{name: getattr(calibration, name).detach() + sign * step})
        sides.append(losses(setting, moved, setting.vertices)[0])
    difference = ((sides[0] - sides[1]) / 2).item()
    assert (getattr(calibration, name).grad * step).sum().item() == pytest.approx(difference, rel=0.01)


def test_gradient_of_the_flashs_cone_equals_finite_differences_and_its_picture_is_the_cosines_power():
    setting = Setting([OFF_CAMERA[0], OFF_CAMERA[0]], shadows=False)
    cone = tensor([[1.3, 0.4, -0.7], [0.0, 0.0, 0.0]]).requires_grad_()
    calibration = detached(calibration_of(setting), cone=cone)
    losses(setting, calibration, setting.vertices)[0].backward()

    def picture(cone):
        return prediction.render(setting.surface, setting.photographs, setting.vertices, setting.material, 4, 3, False,
                             detached(calibration, cone=cone))[0]  # fmt: skip

    for step in (tensor([[0.02, 0, 0], [-0.03, 0, 0]]), tensor([[0, 0.03, 0], [0, -0.02, 0]]),
                 tensor([[0, 0, 0.03], [0, 0, 0.02]])):  # fmt: skip
        moved = [(cone + sign * step).detach() for sign in (1, -1)]
        high, low = (losses(setting, calibration._replace(cone=value), setting.vertices)[0] for value in moved)
        assert (cone.grad * step).sum().item() == pytest.approx(((high - low) / 2).item(), rel=0.01)
    # Exponent 2: the squared cosine between where the camera looks and where the ray from the light ends.
    pictures = [picture(tensor([numbers, [0.0, 0, 0]])) for numbers in ([0.0, 0, 0], [2.0, 0, 0], [2.0, 0.8, -0.5])]
    camera = setting.scene.sensors()[0].camera
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    directions = camera.directions(np.stack([u.ravel(), v.ravel()], 1))
    si = setting.surface.scene.ray_intersect(
        mi.Ray3f(mi.Point3f(*map(float, camera.position)), mi.Vector3f(*directions.T))
    )
    points = np.array(si.p).T
    away = points - np.array(OFF_CAMERA[0]["position"])
    cosines = away @ camera.forward / np.linalg.norm(away, axis=1)
    # The camera's axes are x to the left and y up.
    tilt = np.exp(away @ (0.8 * camera.to_world[:3, 0] - 0.5 * camera.to_world[:3, 1]) / np.linalg.norm(away, axis=1))
    plain, conical, tilted = (picture[0][..., 1].numpy().ravel() for picture in pictures)
    lit = (plain > 0.05) & np.array(si.is_valid())
    assert lit.sum() > 50 and np.ptp(cosines[lit]) > 0.05 and np.ptp(tilt[lit]) > 0.2
    # Where the surface bends away within a pixel, its central ray is not its mean.
    for after, before, factor in ((conical, plain, cosines**2), (tilted, conical, tilt)):
        error = np.abs(after[lit] / before[lit] / factor[lit] - 1)
        assert np.median(error) < 0.01 and np.quantile(error, 0.9) < 0.03
    torch.testing.assert_close(pictures[1][1], pictures[0][1], rtol=1e-4, atol=1e-5)


def test_path_tracer_sees_the_flashs_cone_as_photometric_does():
    sensor = Setting(OFF_CAMERA[:1], False).photograph(0, OFF_CAMERA[0]) | {"falloff": 2.5, "tilt": "1.5 -0.5"}
    ball = {"type": "shapenet", "id": "ball", "subdivisions": 3, "bsdf": {"type": "cooktorrance"}}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sensor": sensor | {"to_world": mi.ScalarTransform4f().look_at(
        [1.4, 0.5, 3.2], [0.4, 0.2, 0], [0, 1, 0])}})  # fmt: skip
    params = mi.traverse(scene)
    pictures = {}
    for falloff in (0.0, 2.5):
        params["000.falloff"], params["000.tilt"] = mi.Float(falloff), mi.Point2f(0.6 * falloff, -0.2 * falloff)
        params.update()
        for integrator in ({"type": "photometric"}, {"type": "path", "max_depth": 2}):
            picture = mi.render(scene, spp=64, seed=2, integrator=mi.load_dict(integrator))
            pictures[falloff, integrator["type"]] = np.array(picture)[..., :3]
    for falloff in (0.0, 2.5):
        a, b = (pictures[falloff, name] for name in ("photometric", "path"))
        assert a.mean() > 0.01 and np.abs(a - b).mean() < 0.01 * a.mean()
    assert pictures[2.5, "path"].mean() != pytest.approx(pictures[0.0, "path"].mean(), rel=0.05)


@pytest.mark.parametrize(("tilt", "limit"), [("1", "2 numbers"), ("nan 1", "2 numbers"), ("0 -51", "from -50 to 50")])
def test_a_tilt_that_is_none_is_refused(small_capture, tmp_path, tilt, limit):
    scene = edited(small_capture, tmp_path / "tilted", lambda element: ElementTree.SubElement(
        element, "string", name="tilt", value=tilt))  # fmt: skip
    with pytest.raises(InputError, match=f'photograph "000": tilt is "{tilt}", must be {limit}'):
        mi_ring.load_capture(scene)


def test_lens_gain_and_curve_are_undone_in_a_file_that_they_made(small_capture):
    """v = (R · g · cosⁿ)^γ, cosine by hand, logarithms of g of mean 0. What a fit predicts is what such a
    file says, decoded without.
    """
    capture = mi_ring.load_capture(small_capture)
    calibration = unknowns_of(capture, ("curve", "vignetting", "gain"))
    with torch.no_grad():
        calibration.curve.fill_(0.8)
        calibration.vignetting.fill_(2.0)
        calibration.gain[:, 1] = torch.linspace(-2, 3, len(capture))
    gain = np.exp([0, 0.1 * (calibration.gain[4, 1].item() - 0.5), 0])
    shot = calibration.applied(capture).shots[4]
    gamma, n, (width, height) = np.exp(0.8 * 0.2), 2.0, shot.size
    assert (shot.response.curve.gamma, shot.response.vignetting) == (pytest.approx(gamma), pytest.approx(n))
    radiance = np.random.default_rng(3).uniform(0.05, 0.9, (height, width, 3)).astype(np.float32)
    (fx, fy), (cx, cy) = shot.camera.focal, shot.camera.centre
    cosine = np.array([[1 / np.sqrt(1 + ((u + 0.5 - cx) / fx) ** 2 + ((v + 0.5 - cy) / fy) ** 2)
                        for u in range(width)] for v in range(height)])[..., None]  # fmt: skip
    file = (radiance * gain * cosine**n) ** gamma
    np.testing.assert_allclose(recorded(radiance, shot), file, rtol=1e-4)
    changed = replace(capture, shots=(shot,), images=one(file), masks=one(None), valid=one(None))
    np.testing.assert_allclose(changed.observe([0]).rgb[0], radiance, rtol=1e-4)
    relative = 0.3 * (radiance * gain * cosine**n / 0.3) ** gamma
    mean = calibration.recorded(torch.from_numpy(radiance)[None], [4], 1)
    np.testing.assert_allclose(mean[0].detach(), relative, rtol=1e-4)
    np.testing.assert_allclose(calibration.linear(mean.detach(), [4], 1)[0], radiance, rtol=1e-4)
    half = calibration.recorded(torch.ones(1, height // 2, width // 2, 3), [4], 2)
    assert half.min() < half.max()


@pytest.mark.parametrize("shadows", [False, True])
def test_gradients_of_cameras_and_lights_balance_those_of_the_surface(shadows):
    """The world may be moved and turned as a whole: nothing is to be seen of it."""
    setting = Setting(OFF_CAMERA, shadows=shadows)
    vertices = setting.vertices.clone().requires_grad_()
    calibration = calibration_of(setting)
    sum(losses(setting, calibration, vertices)).backward()
    cameras, places = calibration.cameras, calibration.places
    axis = tensor([0.4, -0.7, 0.5])
    motions = {
        "shift": (axis.expand_as(vertices), torch.cat([torch.zeros(2, 3, 3), axis.expand(2, 3)[..., None]], -1),
                  torch.stack([axis, torch.zeros(3)])),
        "turn": (torch.cross(axis.expand_as(vertices), vertices.detach(), dim=-1),
                 torch.cross(axis[None, :, None].expand(2, 3, 4), cameras.detach(), dim=1),
                 torch.cross(axis.expand(2, 3), places.detach(), dim=-1)),
    }  # fmt: skip
    for steps in motions.values():
        parts = [(t.grad * step).sum().item() for t, step in zip((vertices, cameras, places), steps)]
        assert sum(parts) == pytest.approx(0, abs=2e-3 * max(map(abs, parts)))
        assert max(map(abs, parts)) > 10


def test_gradient_of_the_focal_length_is_that_of_a_surface_that_comes_nearer():
    """Of coverage, which depends on x / z alone: in one photograph depths are divided by what f is multiplied by."""
    setting = Setting(OFF_CAMERA, shadows=False)
    vertices, calibration = setting.vertices.clone().requires_grad_(), calibration_of(setting)
    setting.coverage_weight[1] = 0
    losses(setting, calibration, vertices)[1].backward()
    camera = calibration.cameras[0].detach()
    depth = (vertices.detach() - camera[:, 3]) @ camera[:, 2]
    nearer = (vertices.grad * (-depth[:, None] * camera[:, 2])).sum().item()
    lens = calibration.intrinsics
    focal = (lens.grad[0, :2] * lens[0, :2].detach()).sum().item()
    assert focal == pytest.approx(nearer, rel=2e-3) and abs(focal) > 1
    assert (lens.grad[1] == 0).all()


def test_rotations_are_scipys():
    vectors = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(rotations(tensor(vectors)).numpy(), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-6)


def test_power_of_all_lights_is_told_by_light_that_bounces_alone(small_capture):
    calibration = unknowns_of(mi_ring.load_capture(small_capture), ("scale", "power"), power=7.0)
    given = 7 * mi_ring.load_capture(small_capture).photographs.lights.rgb()
    with torch.no_grad():
        calibration.scale.fill_(1.3)
    factor = np.exp(1.3 * UNKNOWNS["scale"].width)
    np.testing.assert_allclose(calibration().strengths.detach(), given * factor, rtol=1e-5)
    assert calibration.albedo_factor == pytest.approx(1 / factor)  # direct light stays as it is
    assert calibration.power_factor == pytest.approx(7 * factor)
    light = tensor([[0.2, 0.3, 0.5]])
    bounced = calibration.indirect(light)
    np.testing.assert_array_equal(bounced.detach(), light)  # it has been rendered with the reflectance as it is by now
    (bounced.sum() + calibration().strengths.sum()).backward()
    # A surface lit by ρL reflects ρ²L to its other side: with ρL as it is, that goes like 1/L.
    assert calibration.scale.grad == pytest.approx(-UNKNOWNS["scale"].width, rel=1e-5)


def test_the_power_that_is_refined_begins_with_a_usual_albedo(broken_capture):
    path, _ = broken_capture
    path.write_text(re.sub(r'name="intensity" value="[^"]*"', 'name="intensity" value="1"', path.read_text()))
    capture = mi_ring.load_capture(path)
    fit = Fit(capture, Config.preset("fast", domain="sphere"))
    assert fit.model.albedo > 1 and "scale" in fit.model.calibration.refined and fit.ring.indirect
    lights = fit.calibrated().photographs.lights
    center = fit.ring.center.numpy()
    assert np.pi * fit.problem.exposure / np.median(lights.irradiance(center).mean(1)) == pytest.approx(0.5, rel=1e-4)
    assert np.pi * float(fit.ring.brdf_net.scale) == pytest.approx(0.5, rel=1e-4)
    with torch.no_grad():
        fit.model.calibration.scale.fill_(-1)
    fit.model.update_albedo()
    factor = np.exp(UNKNOWNS["scale"].width)
    assert np.pi * float(fit.ring.brdf_net.scale) == pytest.approx(0.5 * factor, rel=1e-4)


def test_what_is_refined_on_demand_goes_with_auto(small_capture, tmp_path):
    capture = mi_ring.load_capture(small_capture)
    assert refined_of(capture, Config(refine=("auto", "contrast")), "capture", 0.5, {"falloff"}) == (
        "light", "power", "falloff", "contrast", "ambient")  # fmt: skip
    assert refined_of(capture, Config(), "capture", 0.5) == ("light", "power", "ambient")
    known = edited(small_capture, tmp_path / "known", lambda element: ElementTree.SubElement(
        element, "string", name="tilt", value="0 -1"))  # fmt: skip
    for scene, refined in ((small_capture, True), (known, False)):  # a cone that the scene file tells is known
        fit = Fit(mi_ring.load_capture(scene), Config(domain="sphere"))
        assert ("falloff" in fit.model.calibration.refined) == refined
        assert "contrast" in fit.model.calibration.refined  # of files in sRGB
    assert "scale" in refined_of(capture, Config(), "capture", 1.5)
    assert "scale" not in refined_of(capture, Config(), "capture", 0.5)
    with pytest.raises(InputError, match="none alone"):
        Config(refine=("none", "light"))


def test_the_contrast_is_refined_by_default_if_nothing_tells_the_curve(small_capture, tmp_path):
    def with_field(kind, name, value):
        path = edited(small_capture, tmp_path / name / value, lambda element: ElementTree.SubElement(
            element, kind, name=name, value=value))  # fmt: skip
        return mi_ring.load_capture(path)

    capture = mi_ring.load_capture(small_capture)
    assert has_open_curve(capture.shots) and has_open_curve(with_field("string", "encoding", "srgb").shots)
    assert not has_open_curve([capture.shots[0], *(replace(shot, encoding="linear") for shot in capture.shots[1:])])
    for name in ("gamma", "contrast"):
        assert not has_open_curve(with_field("float", name, "1.1").shots)


@pytest.mark.parametrize("option", ["falloff", "contrast"])
def test_few_photographs_do_not_tell_cone_and_contrast(small_capture, option):
    capture = mi_ring.load_capture(small_capture)
    few = replace(capture, shots=capture.shots[:9])
    with pytest.raises(mi_ring.InputError, match=f"--refine {option}: the fit has 9 photographs.*at least 10"):
        Fit(few, Config(domain="sphere", refine=("auto", option)))
    assert option not in Fit(few, Config(domain="sphere")).model.calibration.refined


def test_what_is_known_of_lens_and_gain_dims_what_the_curve_records(small_capture, tmp_path):
    def dim(element):
        ElementTree.SubElement(element, "float", name="vignetting", value="3.5")
        ElementTree.SubElement(element, "string", name="gain", value="1.2 0.8 0.9")

    capture = mi_ring.load_capture(edited(small_capture, tmp_path / "dim", dim))
    calibration = unknowns_of(capture, ("curve",))
    with torch.no_grad():
        calibration.curve.fill_(1)
    gamma, shot = np.exp(0.2), calibration.applied(capture).shots[4]
    width, height = shot.size
    radiance = np.random.default_rng(6).uniform(0.1, 0.6, size=(height, width, 3)).astype(np.float32)
    file = recorded(radiance * 0.3 ** ((1 - gamma) / gamma), shot)  # under the lights of that scene
    before = replace(capture, shots=(capture.shots[4],), images=one(file), masks=one(None), valid=one(None))
    predicted = calibration.recorded(torch.from_numpy(radiance)[None], [4], 1)
    np.testing.assert_allclose(predicted[0].detach(), before.observe([0]).rgb[0], rtol=1e-4)


def test_power_of_all_lights_is_not_refined_where_nothing_tells_it(small_capture):
    with pytest.raises(InputError, match="--refine scale.*--no-indirect"):
        Fit(mi_ring.load_capture(small_capture), Config.preset("fast", refine=("scale",), indirect=False))


def test_unknowns_are_in_the_cameras_axes_and_the_flash_moves_with_its_camera(small_capture):
    capture = mi_ring.load_capture(small_capture)
    calibration = unknowns_of(capture, OPTIONS)
    np.testing.assert_allclose(calibration.rig.flash.mean(0).numpy(), FLASH, atol=1e-3)
    same = calibration()
    for got, shot, light in zip(zip(*same), capture.shots, capture.photographs.lights):
        camera = shot.camera
        np.testing.assert_allclose(got[0].detach().numpy(), camera.to_world[:3], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(got[2].detach().numpy(), light.vector, rtol=1e-5)
        np.testing.assert_allclose(got[3].detach().numpy(), light.rgb, rtol=1e-5)
    distance = np.median([np.linalg.norm(s.camera.position - CENTER) for s in capture.shots])
    assert calibration.rig.distance == pytest.approx(distance, rel=1e-5)
    widths = {name: unknown.width for name, unknown in UNKNOWNS.items()}
    with torch.no_grad():
        calibration.turn[3] = tensor([0, 0, np.pi / 2 / widths["turn"]])  # about the optical axis
        calibration.move[3] = tensor([0, 0, 2])
        calibration.light[0] = tensor([0.5, 0, 0])
        calibration.focal[0] = 3
        calibration.power[:] = tensor(np.random.default_rng(2).normal(size=(12, 3)))
        calibration.falloff.fill_(2)
        calibration.tilt[:] = tensor([0.3, -0.4])
        calibration.distortion.fill_(-1.5)
    cameras, intrinsics, places, strengths, cone, distortion = (t.detach().numpy() for t in calibration())
    old = capture.shots[3].camera.to_world[:3]
    x, y, z, position = old.T
    moved = position + 2 * widths["move"] * distance * z
    np.testing.assert_allclose(cameras[3].T, [y, -x, z, moved], atol=1e-4)
    offset = FLASH + np.array([0.5 * widths["light"] * distance, 0, 0])
    np.testing.assert_allclose(places[3], moved + offset @ [y, -x, z], rtol=1e-5)
    np.testing.assert_allclose(intrinsics[:, 0], 60 * np.exp(3 * widths["focal"]), rtol=1e-5)
    factors = np.log(strengths / np.stack([light.rgb for light in capture.photographs.lights]))
    np.testing.assert_allclose(factors.mean(0), 0, atol=1e-5)  # brightness against albedo
    assert factors.std() == pytest.approx(widths["power"], rel=0.3)
    expected = [2 * widths["falloff"], 0.3 * widths["tilt"], -0.4 * widths["tilt"]]
    np.testing.assert_allclose(cone, [expected] * 12, rtol=1e-5)
    np.testing.assert_allclose(distortion, -1.5 * widths["distortion"], rtol=1e-5)


def test_a_flash_is_one_though_some_photographs_were_held_on_their_side(small_capture, tmp_path):
    """Their axes are turned against the camera's, as `photos` turns them: what moves the flash moves all alike."""
    quarters = iter([0, 1, 0, 0, 3, 2] + [0] * 6)

    def turn(element):
        matrix = element.find(".//matrix")
        pose = np.array(matrix.get("value").split(), float).reshape(4, 4)
        pose[:3, :3] @= Rotation.from_euler("z", 90 * next(quarters), degrees=True).as_matrix()
        matrix.set("value", " ".join(map(repr, pose.ravel().tolist())))

    captures = [mi_ring.load_capture(path) for path in (small_capture, edited(small_capture, tmp_path / "held", turn))]
    both = [unknowns_of(capture, ("light", "falloff")) for capture in captures]
    for calibration in both:
        assert calibration.rig.flash is not None
        with torch.no_grad():
            calibration.light[0] = tensor([0.5, -0.3, 0.2])
            calibration.tilt[:] = tensor([0.5, -0.3])
    upright, held = (calibration().places.detach().numpy() for calibration in both)
    np.testing.assert_allclose(held, upright, rtol=1e-5, atol=1e-4)
    brighter = [
        torch.einsum("pij,pj->pi", views.cameras[:, :, :2], views.cone[:, 1:])
        for views in (calibration() for calibration in both)
    ]  # in the world
    torch.testing.assert_close(*brighter, rtol=1e-5, atol=1e-5)
    for calibration in both:  # where the flash is said to be
        np.testing.assert_allclose(calibration.rig.upright, FLASH, atol=1e-3)


def test_gradients_move_a_flash_beside_the_lens_alone_by_default(small_capture):
    """How far ahead it is photographs hardly tell from how dark the surface is; `light` by name asks for that, too."""
    capture = mi_ring.load_capture(small_capture)
    by_default = Fit(capture, Config(domain="sphere")).model.calibration
    for calibration, free in ((by_default, [True, True, False]), (unknowns_of(capture, ("light",)), [True] * 3)):
        before = calibration().places
        with torch.no_grad():
            calibration.light[0] = tensor([0.5, -0.3, 0.2])
        cameras = calibration.rig.views.cameras[:, :, :3]
        moves = torch.einsum("pij,pi->pj", cameras, calibration().places - before) / calibration.rig.distance
        expected = tensor([0.5, -0.3, 0.2]) * UNKNOWNS["light"].width
        torch.testing.assert_close(moves, expected.expand(len(capture), 3), rtol=1e-4, atol=1e-5)
        (calibration().places * tensor(np.arange(3 * len(capture)).reshape(-1, 3))).sum().backward()
        assert (calibration.light.grad[0] != 0).tolist() == free


def test_powers_of_the_photographs_that_are_fitted_have_the_mean_one(small_capture):
    """Of the others nobody knows: they must not take part in what keeps brightness and albedo apart."""
    capture, fitted = mi_ring.load_capture(small_capture), np.array([0, 1, 3, 4, 5, 6, 8, 9, 10, 11])
    calibration, random = unknowns_of(capture, ("power",), fitted=fitted), np.random.default_rng(2)
    found = random.normal(2, 1, (12, 3))
    found[[2, 7]] = 0  # as without a gradient
    with torch.no_grad():
        calibration.power.copy_(tensor(found))
    factors = (calibration().strengths / calibration.rig.views.strengths).detach().numpy()
    np.testing.assert_allclose(np.exp(np.log(factors[fitted]).mean(0)), 1, rtol=1e-5)
    np.testing.assert_allclose(factors[[2, 7]], 1, rtol=1e-6)
    np.testing.assert_allclose(factors[3] / factors[0], np.exp(0.1 * (found[3] - found[0])), rtol=1e-4)


def test_names_of_unknowns_are_checked_from_python_too():
    for wrong in (("pose",), "cameras", ("none", "light"), ()):
        with pytest.raises(InputError, match=r"--refine: is .*, must be "):
            Config(refine=wrong)


def test_a_light_that_is_referred_to_is_replaced(small_capture):
    """Also one that has all of it in attributes of its own, which as XML has no children."""
    capture = mi_ring.load_capture(small_capture, images=False)
    root = ElementTree.fromstring(small_capture.read_bytes())
    sensor = root.find("sensor")
    sensor.remove(sensor.find("emitter"))
    ElementTree.SubElement(root, "emitter", type="flash", id="lamp")
    ElementTree.SubElement(sensor, "ref", id="lamp")
    written = ElementTree.fromstring(recalibrated_xml(ElementTree.tostring(root), capture.shots)).find("sensor")
    assert len(written.findall("emitter")) == 1 and written.find("ref") is None


def test_prior_expects_one_half_of_each_unknown(small_capture):
    calibration = unknowns_of(mi_ring.load_capture(small_capture), ("cameras",))
    with torch.no_grad():
        for unknown in calibration.parameters():
            unknown.fill_(1)  # a standard deviation, each of six
    assert calibration.prior().item() == pytest.approx(6 / 2)


@pytest.mark.parametrize(("domain", "start"), [("hull", 0.2), ("sphere", 0.4)])
def test_rates_of_cameras_and_lights_rise_once_there_is_a_shape_and_fall(small_capture, domain, start):
    changes = {"levels": (2,), "widths": (28,), "shares": (1.0,), "refine": ("cameras", "light"), "domain": domain}
    fit = mi_ring.Fit(mi_ring.load_capture(small_capture), mi_ring.Config(**changes))
    calibration, fit.optimisation.solvers = fit.model.calibration, []  # which would look at an iteration

    def rates(progress):
        unlit = SimpleNamespace(other_light=None)
        it = SimpleNamespace(terms={"calibration": 0.0}, loss=0.0, progress=progress, prediction=unlit,
                             observation=None, batch=None, stage=Stage(2, 28, 0, 9))  # fmt: skip
        fit.optimisation.step(lambda: (sum(p.sum() for p in calibration.parameters()) * 0.0, it))
        groups = [g for o in fit.optimisation.optimizers for g in o.param_groups]
        return [next(g["lr"] for g in groups if any(p is unknown for p in g["params"]))
                for unknown in (calibration.turn, calibration.light)]  # fmt: skip

    assert rates(start - 0.01)[0] == 0 < rates(start + 0.01)[0] < rates(start + 0.05)[0]
    assert rates(0.7) == pytest.approx([0.5**0.7, 0.1 * 0.1**0.7])


def test_distant_lights_keep_their_length_and_each_place_has_one_unknown(small_capture, tmp_path):
    def lamp(element):
        emitter = element.find("emitter")
        element.remove(emitter)
        k = int(element.get("id"))
        new = ElementTree.SubElement(element, "emitter", type="directional" if k % 2 else "point")
        tag, name = ("vector", "direction") if k % 2 else ("point", "position")
        ElementTree.SubElement(new, tag, name=name, x="0.6", y=f"{0.8 if k % 4 == 1 else 8}", z="0")

    capture = mi_ring.load_capture(edited(small_capture, tmp_path / "lamps", lamp), images=False)
    calibration = unknowns_of(capture, ("light", "cameras"))
    assert calibration.rig.flash is None and calibration.light.shape == (3, 3)
    with torch.no_grad():
        calibration.light[:] = 1
        calibration.move[:] = 1  # which moves no lamp
    moved = calibration().places.detach().numpy()
    np.testing.assert_allclose(moved[0] - [0.6, 8, 0], 0.1 * calibration.rig.distance, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(moved[1::2], axis=1), 1, rtol=1e-6)
    toward = -np.array([0.6, 0.8, 0])
    np.testing.assert_allclose(moved[1], (toward + 0.1) / np.linalg.norm(toward + 0.1), rtol=1e-5)


def test_curve_leaves_the_exposure_alone_and_a_file_decoded_with_it_is_radiance(small_capture):
    capture = mi_ring.load_capture(small_capture)
    calibration = unknowns_of(capture, ("curve",))
    radiance, ones = torch.tensor([[0.0, 1e-6, 0.01, 0.3, 0.7]], requires_grad=True), torch.ones(1)
    np.testing.assert_allclose(calibration.response().with_curve(radiance, ones).detach(), radiance.detach())
    with torch.no_grad():
        calibration.curve.fill_(-1.5)
    gamma = np.exp(-1.5 * 0.2)
    expected = 0.3 * (np.array([0.01, 0.3, 0.7]) / 0.3) ** gamma
    recorded = calibration.response().with_curve(radiance, ones)
    np.testing.assert_allclose(recorded[0, 2:].detach(), expected, rtol=1e-5)
    recorded.sum().backward()
    assert radiance.grad.isfinite().all()
    shot = calibration.applied(capture).shots[4]
    assert shot.response.curve.gamma == pytest.approx(gamma, rel=1e-5)
    # What the photograph then says of a lit surface, by the strength of its light then.
    factor = shot.light.rgb[0] / capture.shots[4].light.rgb[0]
    decoded, _ = decode(expected.astype(np.float32), True, 2.0, ToneCurve(shot.response.curve.gamma))
    np.testing.assert_allclose(decoded, factor * np.array([0.01, 0.3, 0.7]), rtol=1e-4)


def test_a_curve_with_an_s_is_that_of_the_scene_that_it_makes(small_capture, tmp_path):
    def curve(element):
        for name, value in (("gamma", "1.3"), ("contrast", "1.2"), ("toe", "-0.4")):
            ElementTree.SubElement(element, "float", name=name, value=value)

    capture = mi_ring.load_capture(edited(small_capture, tmp_path / "curve", curve))
    exposure = 0.3
    calibration = unknowns_of(capture, ("curve", "contrast"))
    with torch.no_grad():
        calibration.curve.fill_(0.8)
        calibration.contrast.fill_(-1.5)
        calibration.toe.fill_(0.7)
    shot, radiance = calibration.applied(capture).shots[4], np.array([0.02, 0.11, 0.3, 0.71])
    gamma, contrast = np.exp(0.8 * 0.2), np.exp(-1.5 * 0.2)
    assert shot.response.curve.gamma == pytest.approx(1.3 * gamma, rel=1e-6)
    assert shot.response.curve.contrast == pytest.approx(1.2 * contrast, rel=1e-6)
    toe = 0.7 * 0.3
    assert shot.response.curve.toe == pytest.approx(toe - 0.4 / contrast, rel=1e-6)
    stronger = exposure ** ((1 - gamma) / gamma)  # the lights of that scene
    file = recorded(stronger * radiance, shot)
    v = linear_to_srgb((stronger * radiance) ** (1.3 * gamma))
    odds = (np.exp(0.4) * (np.exp(-toe) * v / (1 - v)) ** contrast) ** 1.2  # first the one that the fit finds
    np.testing.assert_allclose(linear_to_srgb(file), odds / (1 + odds), rtol=1e-4)
    as_given, _ = decode(file.astype(np.float32), True, 2.0, ToneCurve(1.3, 1.2, -0.4))
    curved = calibration.response().with_curve(tensor(radiance)[None], torch.tensor([1.3]))
    np.testing.assert_allclose(curved[0].detach(), as_given, rtol=1e-4)
    straight = calibration.response().without_curve(curved.detach(), torch.tensor([1.3]))
    np.testing.assert_allclose(straight[0], radiance, rtol=1e-4)
    many = torch.tensor([[0.0, 1e-8, 1e-3, 0.4, 0.99, 1.0, 1.7]], requires_grad=True)
    calibration.response().with_curve(many, torch.tensor([1.3])).sum().backward()
    assert many.grad.isfinite().all() and (many.grad > 0).all()


@pytest.mark.parametrize("name", ["curve", "toe", "vignetting"])
def test_gradients_of_what_is_recorded_equal_finite_differences(small_capture, name):
    calibration = unknowns_of(mi_ring.load_capture(small_capture), (UNKNOWNS[name].option,))
    random = np.random.default_rng(4)
    radiance, weights = (tensor(random.uniform(0.02, 0.9, (2, 40, 56, 3))) for _ in range(2))
    unknown = getattr(calibration, name)

    def loss(value):
        with torch.no_grad():
            unknown.fill_(value)
        return (weights * calibration.recorded(radiance, [3, 1], 1)).double().sum()

    loss(0.4).backward()
    difference = (loss(0.5) - loss(0.3)).item() / 0.2
    assert abs(difference) > 1 and unknown.grad.item() == pytest.approx(difference, rel=5e-3)


def test_calibration_survives_the_scene_file(small_capture, tmp_path):
    capture = mi_ring.load_capture(small_capture)
    calibration = unknowns_of(capture, OPTIONS)
    with torch.no_grad():
        for unknown in calibration.parameters():
            unknown.copy_(tensor(np.random.default_rng(3).normal(size=unknown.shape)))
        calibration.room.harmonics.copy_(tensor(np.random.default_rng(4).normal(size=(BASIS, 3))))
    applied = calibration.applied(capture)
    assert capture.photographs.room is None and np.abs(applied.photographs.room).min() > 0
    path = small_capture.parent / "recalibrated.xml"
    scene = recalibrated_xml(small_capture.read_bytes(), applied.shots, applied.photographs.room / 2)
    path.write_bytes(recalibrated_xml(scene, applied.shots, applied.photographs.room))  # in the place of the former
    read = mi_ring.load_capture(path)
    path.unlink()
    np.testing.assert_allclose(read.photographs.room, applied.photographs.room, rtol=1e-5)
    np.testing.assert_allclose(read.part([3, 1]).photographs.room, applied.photographs.room, rtol=1e-5)
    for a, b in zip(applied.photographs.views, read.photographs.views):
        np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-5, atol=1e-5)
    for a, b in zip(read.shots, applied.shots):
        np.testing.assert_allclose(a.response.gain, b.response.gain, rtol=1e-6)
        np.testing.assert_allclose(a.response.curve, b.response.curve, rtol=1e-6)
    assert [s.files for s in read.shots] == [s.files for s in capture.shots]


def test_a_light_without_a_colour_has_a_room_beside_it(small_capture):
    """Of the missing colour the share is relative to the mean of the others."""
    capture = mi_ring.load_capture(small_capture)
    shots = tuple(replace(s, light=s.own_light._replace(rgb=np.array([4.0, 2.0, 0.0]))) for s in capture.shots)
    calibration = unknowns_of(replace(capture, shots=shots), ("ambient",))
    room = torch.zeros(BASIS, 3)
    room[0] = 1.0
    red, green, blue = calibration.room_share(room).tolist()
    assert green == pytest.approx(2 * red) and blue == pytest.approx(green)


def test_photographs_without_ids_keep_their_own_cameras(small_capture, tmp_path):
    scene = ElementTree.fromstring(small_capture.read_bytes())
    for sensor in scene.findall("sensor"):
        del sensor.attrib["id"]
    path = small_capture.parent / "nameless.xml"
    path.write_bytes(ElementTree.tostring(scene))
    capture = mi_ring.load_capture(path, images=False)
    path.write_bytes(recalibrated_xml(path.read_bytes(), capture.shots, None))
    again = mi_ring.load_capture(path, images=False)
    path.unlink()
    assert len({shot.camera.key for shot in again.shots}) == len(again.shots) == 12
    for one, other in zip(again.shots, capture.shots):
        np.testing.assert_allclose(one.camera.to_world, other.camera.to_world, atol=1e-4)


def test_a_fit_finds_a_flash_that_is_not_where_it_is_said_to_be(small_capture, tmp_path):
    wrong = np.array([-6.0, -16.0, 4.0])  # beyond a tenth of the distance
    scene = edited(small_capture, tmp_path / "wrong", lambda element: move_light(element, wrong))
    config = Config(iterations=80, levels=(2,), widths=(56,), shares=(1,), refine=("light",), velocity_decay=0.3,
                    batch=4, subdivisions=3, indirect=False, detail="none", diffuse="lambert")  # fmt: skip
    running = Fit(mi_ring.load_capture(scene), config)
    for _ in running:
        pass
    calibration = running.model.calibration
    off = calibration.rig.flash.mean(0) + calibration.value("light")[0] * calibration.rig.distance
    assert np.linalg.norm(off.detach().numpy() - FLASH) < 0.35 * np.linalg.norm(wrong)


def test_distortion_goes_where_the_lens_has_it(small_capture):
    fit, _ = posed(small_capture, refine=("distortion",), subdivisions=3)
    with torch.no_grad():
        fit.model.calibration.distortion.fill_(1)  # 0.05: a tenth of a pixel where the object ends
    for _ in range(45):
        fit.step()
    found = [shot.camera.distortion for shot in fit.calibrated().shots]
    assert np.abs(found).max() < 0.3 * 0.05
    summary = fit.result().calibration["unknowns"]["distortion"]
    assert summary["before"] == [0] and summary["after"] == pytest.approx(found[:1], abs=1e-6)
    assert 0 < summary["std"][0] < 0.05


def test_photographs_kept_out_are_not_fitted_and_judge_what_was_refined(small_capture, monkeypatch):
    capture = mi_ring.load_capture(small_capture)
    config = Config(iterations=4, levels=(2,), widths=(56,), shares=(1,), refine=("light", "curve"), holdout=5,
                    domain="sphere")  # fmt: skip
    running = Fit(capture, config)
    assert running.problem.held_out.tolist() == [2, 7]
    for every, out in ((24, 0), (1000, 0)):
        words = f"--holdout: is {every}, which keeps {out} of 12 photographs out; give 2 to 23"
        with pytest.raises(InputError, match=words):
            Fit(capture, Config(holdout=every))
    drawn = {k for _ in range(20) for k in running.sampler.draw_photographs(config.batch)[0]}
    assert drawn == set(range(12)) - {2, 7}
    with torch.no_grad():
        running.model.calibration.light.fill_(1)
        running.model.calibration.curve.fill_(1)
    shares = {(1.0, 1.0): 0.3, (0.0, 1.0): 0.4, (1.0, 0.0): 0.2, (0.0, 0.0): 0.5}

    def state():
        found = (getattr(running.model.calibration, name).detach() for name in ("light", "curve"))
        return tuple(float(value.flatten()[0]) for value in found)

    def unexplained(*parts):
        return shares[state()]

    def validate():
        return validation.validate(running.problem, running.model, running.renderer, 2)

    monkeypatch.setattr(validation, "unexplained", unexplained)
    assert validate() == {"unexplained": 0.2, "before": 0.5, "put_back": ["curve"]}
    assert state() == (1.0, 0.0)
    # Nothing is where they show nothing of the object, and that is said in words.
    monkeypatch.setattr(validation, "unexplained", lambda *parts: float("nan"))
    assert "no pixel in them is surely of the object" in held_out_text(validate())
    monkeypatch.setattr(validation, "unexplained", unexplained)
    # What was not found is not put back.
    assert validate() == {"unexplained": 0.2, "before": 0.5, "put_back": []}


def test_a_fit_says_what_photographs_that_are_kept_out_say(small_capture, tmp_path):
    """To its end, with what is shared, what is of each photograph, and what is solved for; and without any of it."""
    tiny = ["--iterations", "4", "--levels", "2", "--widths", "28", "--shares", "1", "--subdivisions", "2",
            "--holdout", "5", "--domain", "sphere"]  # fmt: skip
    for refine in (["light", "power", "scale", "ambient"], ["none"]):
        out = tmp_path / refine[0]
        assert fit.main([str(small_capture), "--out", str(out), *tiny, "--refine", *refine]) == 0
        record = json.loads((out / "calibration.json").read_text())
        assert 0 < record["held_out"]["unexplained"] < 1
        assert set(record["held_out"]["put_back"]) <= {"light", "scale", "ambient"}
        assert ("before" in record["held_out"]) == (refine != ["none"])
        assert "of the object&#39;s light in them is unexplained" in (out / "report.html").read_text()
        lit = [name for name, entry in record["photographs"].items() if "power" in entry]
        assert len(lit) == (10 if "power" in refine else 0) and not {"002", "007"} & set(lit)


def test_cameras_are_refined_if_enough_of_them_differ(small_capture):
    """Not where one camera took several photographs under different lights, nor of fewer than ten."""
    capture = mi_ring.load_capture(small_capture)
    first = capture.shots[0].camera
    same = [replace(shot, camera=first) if k in (3, 5) else shot for k, shot in enumerate(capture.shots)]
    for of, refined in (
        (capture, True), (capture.part(np.arange(10)), True), (capture.part(np.arange(9)), False),
        (replace(capture, shots=tuple(same)), False),
    ):  # fmt: skip
        fitted = Fit(of, Config(refine=("auto",), domain="sphere")).model.calibration
        assert ("cameras" in fitted.refined) == refined


def test_scenes_that_are_calibrated_are_left_alone_unless_told_otherwise(small_capture, tmp_path):
    def declare(element):
        ElementTree.SubElement(element, "boolean", name="calibrated", value="true")

    capture = mi_ring.load_capture(edited(small_capture, tmp_path / "known", declare))
    unknown = mi_ring.load_capture(small_capture)
    for of, refine, refined in (
        (capture, ("auto",), None), (capture, ("cameras",), ("cameras",)),
        (unknown, ("auto",), ("cameras", "light", "power", "falloff", "contrast", "ambient")),
        (unknown, ("none",), None),
    ):  # fmt: skip
        calibration = Fit(of, Config(refine=refine, domain="sphere")).model.calibration
        assert (calibration and calibration.refined) == refined
    # In whatever order: it is the same fit, which may be resumed.
    for words in ("light cameras", "cameras light", "cameras light cameras"):
        assert fit.parse_options(["scene.xml", "--refine", *words.split()]).refine == ("cameras", "light")
