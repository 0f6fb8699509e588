"""Unknown light: what a fit takes it to be, finds, and writes."""

import html
import re
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.unknown_light import TINY, TOWARD

import mi_ring
from mi_ring import export
from mi_ring.calibration.rig import Rig
from mi_ring.capture.pixels import Pixels
from mi_ring.errors import InputError
from mi_ring.fitting import priors
from mi_ring.fitting.lighting import Lighting, with_lighting
from mi_ring.fitting.refinement import refined_of
from mi_ring.images import read_image, write_image
from mi_ring.metrics.capture_findings import measure, quality_table
from mi_ring.output.ambiguity import ambiguity, ambiguity_of
from mi_ring.rendering import prediction
from mi_ring.rendering.spherical_harmonics import BASIS, frames_of, room_envmap
from mi_ring.scene.lights import is_room, shared_emitters

pytestmark = pytest.mark.usefixtures("short_trials")


def test_an_environment_is_found_and_written(in_an_environment, tmp_path):
    """Where it is brightest, and as if the albedo were a half; beside the scene, and as its only light."""
    capture = mi_ring.load_capture(in_an_environment)
    assert capture.photographs.dark
    with pytest.raises(InputError, match="nothing lights the object; give lights, or --light auto"):
        mi_ring.Fit(capture, mi_ring.Config.preset("fast", **TINY))
    config = mi_ring.Config.preset("fast", **TINY, light="environment")
    with pytest.raises(InputError, match="light: is environment, which coarse fits have to find; give Fit what"):
        mi_ring.Fit(capture, config)
    fit = mi_ring.Fit(capture, config, lighting=mi_ring.choose_lighting(capture, config))
    losses = [it.terms["rgb"] for it in fit]
    assert np.mean(losses[-5:]) < 0.3 * losses[0]
    fit.save(tmp_path)
    seen = read_image(tmp_path / "environment.exr").astype(float).mean(-1)
    rows, columns = seen.shape
    polar, azimuth = np.pi * (np.arange(rows)[:, None] + 0.5) / rows, 2 * np.pi * (np.arange(columns) + 0.5) / columns
    away = np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)
    # The middle of the brightest fifth: the lobe is flat at its top.
    power = np.sin(polar) * np.where(seen > np.quantile(seen, 0.8), seen, 0)
    found = np.array([(power * axis).sum() for axis in away])
    assert np.degrees(np.arccos(found @ TOWARD / np.linalg.norm(found))) < 10
    again = mi_ring.load_capture(tmp_path / "scene.xml")
    assert again.photographs.dark and sum(map(is_room, again.scene.emitters())) == 1
    np.testing.assert_allclose(again.photographs.room, fit.calibrated().photographs.room, atol=1e-5)
    albedo = np.pi * fit.ring.material(fit.ring.domain.sample(3)[0])["diffuse"].mean().item()
    assert 0.3 < albedo < 0.8


def test_exposures_are_found_where_the_light_is_unknown(in_an_environment, tmp_path):
    """For the most part: neighbours alone tell them from light of another strength. What lights say is not lost."""
    exposed = in_an_environment.parent.parent / "exposed"
    shutil.copytree(in_an_environment.parent, exposed)
    random = np.random.default_rng(2)
    true = random.uniform(0.7, 1.4, (10, 1)) * random.uniform(0.85, 1.15, (10, 3))
    for k, path in enumerate(sorted((exposed / "images").iterdir())):
        write_image((read_image(path) * true[k]).astype(np.float32), path)
    text = (exposed / "scene.xml").read_text()
    capture = mi_ring.load_capture(exposed / "scene.xml")
    changes = TINY | {"iterations": 50, "light": "environment", "small_lights": 0, "refine": ("gain",)}
    config = mi_ring.Config.preset("fast", **changes)
    fit = mi_ring.Fit(capture, config, lighting=Lighting("environment"))
    for _ in fit:
        pass
    gains = np.log([shot.response.gain for shot in fit.calibrated().shots]), np.log(true)
    off = (gains[0] - gains[0].mean(0)) - (gains[1] - gains[1].mean(0))
    assert np.abs(off).mean() < 0.5 * np.abs(gains[1] - gains[1].mean(0)).mean()

    values = iter(true)
    said = re.sub(r'(name="intensity" value=)"0 0 0"', lambda _: '{}"{} {} {}"'.format(_[1], *next(values)), text)
    (exposed / "said.xml").write_text(said)
    told = with_lighting(mi_ring.load_capture(exposed / "said.xml"), Lighting("environment"))
    np.testing.assert_allclose([shot.response.gain for shot in told.shots], true / true.mean(0), rtol=1e-5)
    with pytest.raises(InputError, match="--refine: is power gain, must be without power or without gain"):
        mi_ring.Config(refine=("power", "gain"))


def test_light_that_turns_with_the_camera_is_written_so(in_an_environment, tmp_path, capsys):
    """And the report and what is made of the fit say what cannot be known of such light."""
    capture = mi_ring.load_capture(in_an_environment)
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 3}, light="turntable")
    fit = mi_ring.Fit(capture, config, lighting=Lighting("turntable"))
    list(fit)
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    assert frames_of(again.scene) == {"camera"}
    assert "cannot be separated from those of the object" in html.unescape((tmp_path / "report.html").read_text())
    export.main([str(tmp_path / "ring.pt"), str(tmp_path / "object.ply")])
    assert "smooth variations of light and reflectance can hardly be separated" in capsys.readouterr().err
    np.testing.assert_allclose(again.photographs.room, fit.calibrated().photographs.room, atol=1e-5)

    # Found anew as fixed in the world, nothing is left in the camera's axes.
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 3}, light="environment")
    capture = mi_ring.load_capture(tmp_path / "scene.xml")
    fit = mi_ring.Fit(capture, config, lighting=Lighting("environment"))
    list(fit)
    fit.save(tmp_path / "again")
    assert frames_of(mi_ring.load_capture(tmp_path / "again/scene.xml", images=False).scene) == {"world"}


def test_cameras_are_refined_under_unknown_light(in_an_environment, tmp_path):
    """And photographs without any light are black."""
    capture = mi_ring.load_capture(in_an_environment)
    changes = TINY | {"iterations": 3, "light": "environment", "refine": ("cameras",)}
    config = mi_ring.Config.preset("fast", **changes)
    fit = mi_ring.Fit(capture, config, lighting=Lighting("environment"))
    list(fit)
    summary = fit.result().calibration
    assert summary["refined"] == ["cameras", "ambient"]
    spread = [entry["std"]["turned_degrees"] for entry in summary["photographs"].values()]
    assert np.isfinite(spread).all() and min(spread) > 0
    dark = replace(capture.photograph(0), room=None)
    rgb, coverage = prediction.draw(fit.renderer.surface, dark, 1)
    assert not rgb.any() and coverage.any()


def test_a_known_environment_lights_photographs_that_have_no_light(in_an_environment, tmp_path):
    """As harmonics, which by hand are 1 + 2 · 1/4 in the mean and 2 · 2π/3 · √(3/4π) about its brightest direction.

    It says how much the object reflects, which is a half; and stays in the scene file as it is.
    """
    scene = in_an_environment.with_name("known.xml")
    exact = ElementTree.parse(scene.parent / "truth/exact.xml").getroot()
    scale = exact.find("emitter[@type='envmap']/float[@name='scale']").get("value")
    lamp = f'<string name="filename" value="../lobe.exr"/><float name="scale" value="{scale}"/>'
    lamp = f'<emitter type="envmap">{lamp}</emitter></scene>'
    scene.write_text(in_an_environment.read_text().replace("</scene>", lamp))
    capture = mi_ring.load_capture(scene)
    fit = mi_ring.Fit(capture, mi_ring.Config.preset("fast", **TINY))
    assert fit.model.calibration.refined == ("gain",)
    environment = fit.problem.environment.mean(1) / float(scale)
    assert environment[0] == pytest.approx(1.5 * np.sqrt(4 * np.pi), rel=1e-2)
    y, z, x = environment[1:4] / (4 * np.pi / 3 * np.sqrt(3 / 4 / np.pi))
    np.testing.assert_allclose([-x, -y, z], TOWARD, atol=2e-2)  # Dr.Jit's harmonics of degree 1 are as −y, z, −x
    losses = [it.terms["rgb"] for it in fit]
    assert np.mean(losses[-5:]) < 0.4 * losses[0]  # where the light is right from the beginning
    material = fit.ring.material(fit.ring.domain.sample(3)[0])
    assert (np.pi * material["diffuse"].mean() + 4 * material["specular"].mean()).item() == pytest.approx(0.5, abs=0.05)
    fit.save(tmp_path)
    again = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    assert [lamp.class_name() for lamp in shared_emitters(again.scene)] == ["EnvironmentMapEmitter"]
    assert again.photographs.room is None and not (tmp_path / "environment.exr").exists()

    # Without masks it may be what is seen beside the object.
    bare = replace(capture, masks=Pixels([None] * len(capture)))
    fit = mi_ring.Fit(bare, mi_ring.Config.preset("fast", **TINY))
    assert fit.problem.environment is None and np.isfinite(fit.step().loss)
    with pytest.raises(InputError, match="--refine power: is of the photographs' own lights, of which there are none"):
        mi_ring.Fit(capture, mi_ring.Config.preset("fast", **TINY, refine=("power",)))
    with pytest.raises(InputError, match="take the lamps of the scene out"):
        mi_ring.choose_lighting(capture, mi_ring.Config.preset("fast", **TINY, light="environment"))


@pytest.mark.parametrize(("light", "refine"), [("environment", "power"), ("auto", "scale"), ("lamps", "falloff")])
def test_what_does_not_go_together_is_said(light, refine, in_an_environment):
    capture = mi_ring.load_capture(in_an_environment)
    config = mi_ring.Config.preset("fast", light=light, refine=(refine,))
    for start in (mi_ring.choose_lighting, mi_ring.Fit):
        with pytest.raises(InputError, match=f"--refine {refine}: is of the photographs' own lights, in the place of"):
            start(capture, config)


def test_a_flash_that_pairs_tell_is_no_unknown_light(in_an_environment):
    """And nothing of the room is left to be refined."""
    pairs = in_an_environment.with_name("pairs.xml")
    text = re.sub(r'(<string name="filename" value="(images/\d+.exr)"\s*/>)', r'\1<string name="ambient" value="\2"/>',
                  in_an_environment.read_text())  # fmt: skip
    pairs.write_text(text.replace('"0 0 0"', '"1 1 1"'))
    capture = mi_ring.load_capture(pairs)
    assert refined_of(capture, mi_ring.Config(), "capture", 0.5) == ("light", "power")
    with pytest.raises(InputError, match="ambient: is subtracted"):
        mi_ring.choose_lighting(capture, mi_ring.Config.preset("fast", light="auto"))


def test_what_is_refined_is_what_the_capture_leaves_open(small_capture, in_an_environment):
    flashed, dark = mi_ring.load_capture(small_capture), mi_ring.load_capture(in_an_environment)
    for capture, refine, light, refined in (
        (flashed, ("auto", "gain"), "capture", ("light", "gain", "ambient")),
        (flashed, ("auto", "power"), "lamps", ("light", "power", "ambient")),
        (dark, ("auto",), "capture", ("gain", "ambient")),
    ):
        assert refined_of(capture, mi_ring.Config(refine=refine), light, 0.5) == refined
    exact = tuple(replace(shot, calibrated=True) for shot in dark.shots)
    said = with_lighting(replace(dark, shots=exact), Lighting("environment"))
    assert said.known and refined_of(said, mi_ring.Config(), "environment", 0.5) == ("ambient",)


def test_a_dark_room_that_stays_as_it_is_does_not_matter(small_capture, tmp_path):
    """mi-ring photos writes one, of nothing, for a turntable."""
    shutil.copytree(small_capture.parent, tmp_path / "capture")
    scene = tmp_path / "capture/small.xml"
    room = '<emitter type="room"><string name="frame" value="camera"/><string name="harmonics" value="{}"/></emitter>'
    scene.write_text(scene.read_text().replace("</scene>", room.format(" ".join(["0"] * 27)) + "</scene>"))
    changes = TINY | {"iterations": 1, "refine": ("none",), "indirect": True}
    fit = mi_ring.Fit(mi_ring.load_capture(scene), mi_ring.Config.preset("fast", **changes))
    assert fit.ring.indirect and np.isfinite(fit.step().loss)


def test_a_fit_goes_on_under_the_light_that_it_has_found(in_an_environment):
    capture = mi_ring.load_capture(in_an_environment)
    config = mi_ring.Config.preset("fast", **TINY | {"indirect": True}, light="environment")
    fit = mi_ring.Fit(capture, config, lighting=Lighting("environment", one_material_until=0.6))
    fit.step(), fit.step()
    resumed = mi_ring.Fit(capture, config, state=fit.state())
    assert resumed.problem.lighting == fit.problem.lighting
    rooms = [one.model.calibration.room.harmonics for one in (resumed, fit)]
    torch.testing.assert_close(*rooms)
    assert resumed.step().loss == pytest.approx(fit.step().loss, rel=1e-4)


def test_a_lamp_is_one_for_all(small_capture):
    one = Lighting("lamps", (((30.0, -40.0, 20.0), (500.0, 500.0, 500.0)),))
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 2}, light="lamps")
    capture = mi_ring.load_capture(small_capture)
    fit = mi_ring.Fit(capture, config, lighting=one)
    assert fit.model.calibration.refined == ("light", "gain", "ambient")
    assert len(fit.model.calibration.light) == 1  # one place for all photographs
    alone = with_lighting(capture.part(np.array([0])), one)  # in which it might be a flash that moves with the camera
    assert Rig(alone, np.zeros(3), 0.5, guessed=True).flash is None


def test_other_reflectances_than_cooktorrance_are_refused(small_capture, tmp_path):
    scene = small_capture.with_name("diffuse.xml")
    scene.write_text(small_capture.read_text().replace('<bsdf type="cooktorrance"/>', '<bsdf type="diffuse"/>'))
    capture = mi_ring.load_capture(scene)
    with pytest.raises(InputError, match="bsdf: --light environment is for cooktorrance alone"):
        mi_ring.choose_lighting(capture, mi_ring.Config.preset("fast", light="environment"))


def test_a_map_shows_the_radiance_of_harmonics():
    """Of l = 0 the same everywhere; of l = 1 the cosine to an axis."""
    room = np.zeros((BASIS, 3))
    room[0], room[2] = np.sqrt(4 * np.pi) * np.array([1, 2, 3]), np.sqrt(4 * np.pi / 3)  # 1, 2, 3 and z
    seen = room_envmap(room, np.eye(4), 16)
    v, u = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(32) + 0.5) / 32, indexing="ij")
    z = -np.sin(np.pi * v) * np.cos(2 * np.pi * u)
    np.testing.assert_allclose(seen, np.array([1, 2, 3]) + z[..., None], atol=1e-5)


def test_light_and_material_settle_where_the_surface_is(in_an_environment):
    """At the end under an unknown environment: the surface, which is of one material, stays as it is; the light is what
    photographs say from then on, and the material varies less than it did when it made up for errors of the surface."""

    def variation():
        with torch.no_grad():
            vertices, material = fit.ring(fit.ring.domain.sample(3)[0])
        return vertices, float((material["diffuse"].std(0) / material["diffuse"].mean(0)).mean())

    capture = mi_ring.load_capture(in_an_environment)
    config = mi_ring.Config.preset("fast", **TINY, light="environment", small_lights=0)
    lighting = Lighting("environment", one_material_until=0.01)  # of one material, but not for long
    fit = mi_ring.Fit(capture, config, lighting=lighting)
    *_, shaping, settling = fit.schedule.stages
    assert settling.settles and not shaping.settles
    assert settling.last == fit.iterations > settling.first == fit.schedule.shaping
    while fit.iteration < settling.first:
        told = fit.model.calibration.room.matrix.sum()
        assert fit.step().progress < 1
    surface, varied = variation()
    state = fit.state()
    it = fit.step()
    assert 0 < fit.model.calibration.room.matrix.sum() < 0.5 * told
    assert "velocity" not in it.terms and it.terms["settling"] > 0 and it.weights["settling"] == 0.03
    again = mi_ring.Fit(capture, config, state=state).step()
    assert again.loss == pytest.approx(it.loss, rel=1e-3)  # as if nothing had been in between
    while fit.iteration < fit.iterations:
        fit.step()
    after, varies = variation()
    torch.testing.assert_close(after, surface, rtol=0, atol=0)
    assert varies < 0.9 * varied
    assert all(p.requires_grad for p in fit.ring.shape_net.parameters())  # whoever goes on with it


@pytest.mark.parametrize(
    ("lighting", "settling", "weight"),
    [(Lighting("environment"), 0.03, 0.003), (Lighting("turntable", one_material_until=0.35), 0.02, 0.02),
     (Lighting("environment", one_material_until=0.35), 0.0, None), (Lighting("capture"), 0.03, None),
     (Lighting("lamps", (((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),), distant=True), 0.03, None)],
)  # fmt: skip
def test_what_settles(lighting, settling, weight, small_capture):
    """Light that looks like the material; for less where one material is not enough."""
    config = mi_ring.Config.preset("fast", **TINY, weights={"settling": settling})
    fit = mi_ring.Fit(mi_ring.load_capture(small_capture), config, lighting=lighting)
    assert any(stage.settles for stage in fit.schedule.stages) == (weight is not None)
    if weight:
        fit.course.iteration = fit.iterations - 1
        assert fit.step().weights["settling"] == pytest.approx(weight)


def test_what_settles_does_not_get_darker_for_it(small_capture):
    """What is reflected is compared with its mean: a step of a quarter, however bright. Roughness is a logit."""
    fit = mi_ring.Fit(mi_ring.load_capture(small_capture), mi_ring.Config.preset("fast", **TINY))
    s, faces = fit.ring.domain.sample(3)
    one = torch.ones(len(s))
    step, values = 0.25 * (s[:, 0] > 0).float(), {}
    for name, brightness in (("diffuse", 0.02), ("diffuse", 0.5), ("roughness", -3.0), ("roughness", 0.5)):
        material = {"diffuse": brightness * one[:, None].expand(-1, 3), "specular": one, "roughness": 0.5 * one,
                    "diffuse_roughness": 0.1 * one}  # fmt: skip
        varying = brightness * (1 + step) if name == "diffuse" else torch.sigmoid(brightness + step)
        material[name] = (varying[:, None].expand(-1, 3) if name == "diffuse" else varying).requires_grad_()
        it = SimpleNamespace(batch=SimpleNamespace(faces=faces), context=fit.context(),
                             prediction=SimpleNamespace(vertices=s, material=material))  # fmt: skip
        value = priors.albedo_variation(it)
        (gradient,) = torch.autograd.grad(value, material[name])
        pull = gradient * material[name].detach()
        assert name != "diffuse" or abs(float(pull.sum())) < 1e-4 * float(pull.abs().sum())
        values.setdefault(name, []).append(value.detach())
    for some in values.values():
        torch.testing.assert_close(*some)
        assert some[0] > 0


def test_only_light_that_was_unknown_is_said_to_be(tmp_path):
    assert not ambiguity("capture") and not ambiguity_of(tmp_path)  # and where there is no record
    assert "smooth" in ambiguity("environment on one material") and "smooth" not in ambiguity("2 distant lamps")


def test_unknown_light_needs_given_masks(in_an_environment, small_capture):
    scene = in_an_environment.with_name("unmasked.xml")
    scene.write_text(re.sub(r'<string name="mask"[^>]*>', "", in_an_environment.read_text()))
    capture = mi_ring.load_capture(scene)
    with pytest.raises(InputError, match="unmasked.xml: mask: no photograph has one"):
        mi_ring.choose_lighting(capture, mi_ring.Config.preset("fast", **TINY, light="environment"))
    bright = mi_ring.load_capture(small_capture, masks="none")  # masks by brightness, which lack what is dark
    with pytest.raises(InputError, match="mask: no photograph has one"):
        mi_ring.choose_lighting(bright, mi_ring.Config.preset("fast", **TINY, light="auto"))


def test_photographs_without_lights_of_their_own_have_none_in_the_table(in_an_environment):
    capture = mi_ring.load_capture(in_an_environment)
    rows = measure(capture, *capture.sphere(), {})
    assert {(row.light, row.angle) for row in rows} == {(None, None)}
    assert quality_table(rows).splitlines()[1].split()[2:4] == ["-", "-"]
