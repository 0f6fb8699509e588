"""The commands `fit` and `render` from end to end on a small capture."""

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import AXES, CENTER
from helpers.quick_fits import QUICK, SPHERE, TABLE, distance
from PIL import Image

from mi_ring import __main__, fit, render
from mi_ring.capture import capture
from mi_ring.capture.capture import Observation
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import checkpoint, session, start, terms
from mi_ring.fitting.config import PRESETS, Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.muon import Muon
from mi_ring.fitting.nan_guard import NanGuard
from mi_ring.fitting.optimisation import network_steppers
from mi_ring.fitting.regulariser_strength import RegulariserStrength
from mi_ring.fitting.schedule import Schedule
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit
from mi_ring.output import results
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.system import files, machine

FILES = [
    "scene.xml",
    "ring.pt",
    "mesh.ply",
    "config.json",
    "log.jsonl",
    "inputs.png",
    "report.html",
    "checkpoint.before.pt",
    "checkpoint.pt",
    "calibration.json",
]


@pytest.fixture(scope="module")
def finished(small_capture, tmp_path_factory):
    """The results folder of a quick fit."""
    folder = tmp_path_factory.mktemp("fit") / "small"
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "90", *SPHERE]) == 0
    return folder


def test_fit_writes_all_results_and_no_other_files(finished):
    assert sorted(p.name for p in finished.iterdir()) == sorted(FILES)


def test_logged_loss_is_the_weighted_sum_of_its_terms(finished):
    log = [json.loads(line) for line in (finished / "log.jsonl").read_text().splitlines()]
    for entry in log:
        done = (entry["iteration"] - 1) / 90
        velocity = entry["weights"]["velocity"]  # as planned, or stronger
        assert 0.01 * 0.03**done <= velocity * (1 + 1e-9) <= 0.01 * (1 + 2e-9)
        weights = {"rgb": 1.0, "mask": 5.0, "velocity": velocity, "calibration": 1e-3}
        assert entry["weights"] == pytest.approx(weights)
        assert entry["loss"] == pytest.approx(sum(w * entry[term] for term, w in weights.items()), rel=1e-4)
        assert entry["learning_rate"] == pytest.approx(3e-3 * 0.1**done)
    assert log[-1]["iteration"] == 90


def test_muon_has_the_hidden_weights_and_adam_all_the_others():
    ring = FittedObject([0, 0, 0], 1.0)
    adam, muon = (stepper.optimizer for stepper in network_steppers(ring, Config(), torch.device("cpu")))
    assert isinstance(adam, torch.optim.Adam) and isinstance(muon, Muon)
    ours, theirs = ([p for group in o.param_groups for p in group["params"]] for o in (muon, adam))
    assert [tuple(p.shape) for p in ours] == 2 * [(256, 96), (256, 256), (256, 256)] + 2 * [(256, 256)]
    assert sorted(map(id, ours + theirs)) == sorted(map(id, ring.parameters()))
    (alone,) = network_steppers(ring, Config(optimizer="adam"), torch.device("cpu"))
    assert len(alone.optimizer.param_groups[0]["params"]) == len(list(ring.parameters()))


def test_regulariser_does_not_suffer_from_bfloat16(small_capture):
    s, _ = Sphere().sample(3)

    def value(precision):
        running = Fit(load_capture(small_capture), fit.parse_options([str(small_capture), "--precision", precision]))
        running.ring.shape_net.output.weight.data.mul_(30)
        batch = SimpleNamespace(points=s, seeds={"regulariser": 3})
        it = SimpleNamespace(batch=batch, context=running.context(), stage=running.schedule.stages[0])
        return terms.velocity(it).item()

    assert value("bfloat16") == pytest.approx(value("float32"), rel=0.01)


def test_steps_of_the_flow_are_part_of_the_result(finished):
    assert load_fit(finished).shape_net.steps == Config().steps != 20


def test_of_very_many_photographs_some_are_shown(small_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(capture.Capture.spread, "__defaults__", (5,))
    assert fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "1", *SPHERE]) == 0
    page = (tmp_path / "run" / "report.html").read_text()
    assert "12; below are 5 of them" in page and page.count('class="photograph"') == 5
    assert Image.open(tmp_path / "run" / "inputs.png").size == (5 * 160, 16 + 160)  # a line says what is green


def test_fit_finds_the_ellipsoid(finished):
    # A pixel is about 2 of the ellipsoid's 25 units; the start sphere is off by a fifth.
    assert distance(finished / "mesh.ply") < 0.04


def test_mesh_is_closed_outward_and_carries_the_material(finished):
    mesh = trimesh.load(finished / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.volume > 0 and len(mesh.vertices) == 642
    ply = mi.load_dict({"type": "ply", "filename": str(finished / "mesh.ply")})
    for name, channels in (("vertex_diffuse", 3), ("vertex_specular", 1), ("vertex_roughness", 1)):
        assert len(mi.traverse(ply)[name]) == 642 * channels


def test_log_and_configuration_tell_what_happened(finished):
    log = results.read_log(finished)
    assert [entry["iteration"] for entry in log] == list(range(5, 95, 5))
    assert {"seconds", "loss", "rgb", "mask", "velocity", "learning_rate", "vertices"} <= set(log[0])
    assert log[0]["vertices"] == 162 and log[-1]["vertices"] == 642
    assert log[-1]["rgb"] < 0.5 * log[0]["rgb"]
    assert json.loads((finished / "config.json").read_text())["iterations"] == 90


def test_scene_opens_in_mitsuba_and_path_shows_the_object(finished, small_capture):
    scene = mi.load_file(str(finished / "scene.xml"), parallel=False)
    for k in (1, 8):
        photograph = np.array(mi.Bitmap(str(small_capture.parent / f"images/{k:03}.png"))) / 255.0
        linear = mi.render(scene, integrator=mi.load_dict({"type": "path"}), sensor=k, spp=16)
        picture = np.array(mi.Bitmap(linear).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)) / 255.0
        assert -10 * np.log10(np.mean((picture - photograph) ** 2)) > 20


def test_render_takes_every_photograph_under_its_name(finished, small_capture, tmp_path):
    render.main([str(finished), str(small_capture), str(tmp_path), "--subdivisions", "4", "--spp", "16"])
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{k:03}.png" for k in range(12)]
    errors = []
    for k in range(12):
        folders = (tmp_path, small_capture.parent / "images")
        a, b = (np.array(mi.Bitmap(str(folder / f"{k:03}.png"))) / 255.0 for folder in folders)
        errors.append(np.mean((a - b) ** 2))
    assert -10 * np.log10(np.mean(errors)) > 22


def test_a_second_fit_moves_the_first_result_aside(finished, small_capture):
    before = (finished / "mesh.ply").read_bytes()
    assert fit.main([str(small_capture), "--out", str(finished), "--iterations", "2", *SPHERE]) == 0
    aside = finished.with_name("small.1")
    assert (aside / "mesh.ply").read_bytes() == before != (finished / "mesh.ply").read_bytes()
    for name in FILES:
        (aside / name).replace(finished / name)


@pytest.mark.parametrize("table", [False, True])
def test_deterministic_fits_are_equal_bit_by_bit_also_when_resumed(broken_capture, tmp_path, table):
    small_capture, edit = broken_capture
    if table:
        edit("</scene>", TABLE)
    start = SPHERE if table else QUICK
    arguments = [str(small_capture), "--iterations", "14", "--deterministic", "--seed", "4", *start]
    assert fit.main([*arguments, "--out", str(tmp_path / "a")]) == 0

    interrupted = fit.parse_options([*arguments, "--out", str(tmp_path / "b")])
    with machine.threads_of(1):
        first = Fit(load_capture(small_capture), interrupted)
        results.prepare_folder(tmp_path / "b", small_capture, interrupted.settings())
        keeper = session.Keeper(first, tmp_path / "b", lambda: None)
        session.train(first, keeper, lambda: first.iteration == 9, None)  # in the second stage
    assert fit.main([*arguments, "--out", str(tmp_path / "b"), "--resume"]) == 0

    rings = [torch.load(tmp_path / name / "ring.pt")["networks"] for name in ("a", "b")]
    assert all(torch.equal(rings[0][key], rings[1][key]) for key in rings[0])
    assert (tmp_path / "a" / "mesh.ply").read_bytes() == (tmp_path / "b" / "mesh.ply").read_bytes()
    logs = [[{**e, "seconds": 0} for e in results.read_log(tmp_path / name)] for name in ("a", "b")]
    assert logs[0] == logs[1]


@pytest.mark.parametrize(("table", "indirect"), [(True, True), (True, False), (False, True)])
def test_interreflection_is_averaged_beside_a_table(broken_capture, table, indirect):
    path, edit = broken_capture
    if table:
        edit("</scene>", TABLE)
    one_stage = {"levels": (2,), "widths": (28,), "shares": (1.0,), "batch": 4, "domain": "sphere"}
    running = Fit(load_capture(path), Config(iterations=7, indirect=indirect, **one_stage))
    seen = np.zeros(len(running.capture), int)
    for it in running:
        seen[it.batch.photographs] += 1
    assert seen.sum() == 7 * 4
    counts = {k: count for k, (count, _) in running.renderer.average.pictures.items()}
    assert counts == ({k: count for k, count in enumerate(seen) if count} if table and indirect else {})


def test_deterministic_fits_see_the_same_normals_of_other_meshes(broken_capture):
    path, edit = broken_capture
    ball = trimesh.creation.icosphere(subdivisions=6)  # so many vertices that threads share the work
    ball.vertices *= [1, 1.3, 0.7]
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(path.parent / "none.ply", vertex_normal=False)
    triangle = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], vertex_normals=[[0.6, 0, 0.8]] * 3)
    triangle.export(path.parent / "own.ply", vertex_normal=True)
    others = "".join(f'<shape type="ply"><string name="filename" value="{n}.ply"/></shape>' for n in ("none", "own"))
    edit("</scene>", others + "</scene>")
    config = fit.parse_options([str(path), "--deterministic"])
    seen = set()
    for _ in range(3):
        scene = load_capture(path)
        with machine.threads_of(1):
            shapes = Fit(scene, config).capture.scene.shapes()
        none, own = (np.array(s.vertex_normals_buffer()) for s in shapes if type(s) is mi.Mesh)
        np.testing.assert_allclose(own, [0.6, 0, 0.8] * 3, rtol=1e-6)
        seen.add(none.tobytes())
    assert len(seen) == 1


@pytest.mark.parametrize("moment", ["write_inputs", "write"])
def test_ctrl_c_outside_the_loop_loses_nothing(moment, small_capture, tmp_path, monkeypatch, capsys):
    genuine = getattr(results, moment)

    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        genuine(*arguments)

    monkeypatch.setattr(results, moment, interrupted)
    status = fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "2", *SPHERE])
    never = {"checkpoint.before.pt"} if moment == "write_inputs" else set()  # before the first iteration
    assert {p.name for p in (tmp_path / "run").iterdir()} == set(FILES) - never
    assert status == (130 if moment == "write_inputs" else 0)  # at the end there is nothing left to resume
    assert ("--resume" in capsys.readouterr().out) == (status == 130)


def test_the_second_ctrl_c_says_how_to_go_on(small_capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(results, "write", lambda *_: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "2", *SPHERE])
    assert capsys.readouterr().out.endswith("has a checkpoint: go on with the same command and --resume\n")


def test_a_fit_that_diverges_says_so_and_keeps_what_there_is(small_capture, tmp_path, monkeypatch):
    genuine = terms.rgb_loss
    monkeypatch.setattr(terms, "rgb_loss", lambda *a: genuine(*a) * float("nan"))
    with pytest.raises(InputError, match="diverged at iteration 17"):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "40", "--no-indirect", *SPHERE])
    ring = torch.load(tmp_path / "run" / "ring.pt")["networks"]
    assert all(tensor.isfinite().all() for tensor in ring.values())


def test_a_fit_goes_back_from_numbers_that_are_none_and_on_with_smaller_steps(small_capture, monkeypatch):
    """Of weights at once, of losses when there are three in a row; a single one is left out."""
    changes = {"levels": (2,), "widths": (28,), "shares": (1,), "indirect": False, "refine": ("none",)}
    broken = Fit(load_capture(small_capture), Config(iterations=40, domain="sphere", **changes))
    genuine = terms.rgb_loss
    wrong = {3, 20, 21, 22}
    monkeypatch.setattr(terms, "rgb_loss", lambda *a: genuine(*a) * (np.nan if broken.iteration in wrong else 1))
    weights = broken.ring.brdf_net.output.weight
    for it in broken:
        if it.number == 12:
            kept = weights.detach().clone()
            with torch.no_grad():
                weights[0, 0] = np.inf
        if it.number == 13:  # as it was after the tenth step
            assert weights.isfinite().all() and 0 < (weights - kept).norm() < 0.1 * kept.norm()
        expected = 0.3 ** (broken.optimisation.guard.retreats)
        if it.number in (1, 5, 13, 24, 30):
            assert broken.optimisation.guard.retreats == {1: 0, 5: 0, 13: 1, 24: 2, 30: 2}[it.number]
        assert broken.optimisation.guard.factor == pytest.approx(expected)
    config = broken.problem.config
    rate = broken.optimisation.learning_rate
    assert rate == pytest.approx(0.09 * config.learning_rate * config.decay ** (39 / 40))
    assert Fit(broken.capture, config, state=broken.state()).optimisation.guard.retreats == 2


def test_what_optimisers_remember_and_modules_keep_must_be_numbers_too():
    module = torch.nn.BatchNorm1d(3)
    adam = torch.optim.Adam(module.parameters())
    module(torch.ones(2, 3)).sum().backward()
    adam.step()
    guard = NanGuard(module, [adam])
    assert guard.finite()
    for number in (module.running_var, adam.state[module.weight]["exp_avg_sq"]):
        before = float(number[1])
        number[1] = np.inf
        assert not guard.finite()
        number[1] = before
    assert guard.finite()


def test_gradients_of_unknowns_that_are_none_make_no_step(small_capture, monkeypatch):
    settings = {"levels": (1,), "widths": (28,), "shares": (1,), "domain": "sphere", "indirect": False}
    running = Fit(load_capture(small_capture), Config(iterations=30, refine=("light",), **settings))
    for _ in range(10):
        running.step()
    running.model.calibration.light.register_hook(lambda gradient: gradient * np.nan)
    before = running.ring.brdf_net.output.weight.detach().clone()
    running.step()
    assert torch.equal(running.ring.brdf_net.output.weight, before) and running.optimisation.guard.failures == 1


def test_interreflection_is_added_unless_switched_off(small_capture, monkeypatch):
    monkeypatch.setattr(GlobalIllumination, "interreflection", property(lambda it: 1000 * it.coverage[..., None]))
    for options, bright in (([], True), (["--no-indirect"], False)):
        first = Fit(load_capture(small_capture), fit.parse_options([str(small_capture), *SPHERE, *options]))
        assert (first.step().terms["rgb"] > 100) == bright


def test_interreflection_is_left_out_where_intensities_cannot_be_true_nor_be_refined(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    path.write_text(re.sub(r'name="intensity" value="[^"]*"', 'name="intensity" value="1"', path.read_text()))
    for options, said in (("--refine none", True), ("--refine none --no-indirect", False), ("", False)):
        command = [str(path), "--out", str(tmp_path / "run"), "--iterations", "1", *SPHERE, *options.split()]
        assert fit.main(command) == 0
        assert ("Interreflection is left out" in capsys.readouterr().out) == said


def test_shadows_of_scene_and_command_line_must_agree(broken_capture, monkeypatch):
    path, edit = broken_capture
    genuine, used = prediction.render, []
    monkeypatch.setattr(prediction, "render", lambda *a, **k: used.append(k["shadows"]) or genuine(*a, **k))

    def step(*options):
        Fit(load_capture(path), fit.parse_options([str(path), *SPHERE, *options])).step()

    step()
    step("--no-shadows")
    edit('<integrator type="photometric"/>',
         '<integrator type="photometric"><boolean name="shadows" value="false"/></integrator>')  # fmt: skip
    step()
    assert used == [True, False, False]


def masks_on_some(path):
    text = path.read_text()
    for k in range(0, 12, 2):
        text = text.replace(f'<string name="mask" value="masks/{k:03}.png"/>', "")
    path.write_text(text)


def no_masks(path):
    path.write_text(re.sub(r'<string name="mask" value="[^"]*"/>', "", path.read_text()))


def two_sizes(path):
    """The first photograph loses its last 3 columns and 5 rows, film and mask as well."""
    for folder in ("images", "masks"):
        file = path.parent / folder / "000.png"
        mi.Bitmap(np.ascontiguousarray(np.array(mi.Bitmap(str(file)))[:-5, :-3])).write(str(file))
    film = '<integer name="width" value="56"/><integer name="height" value="40"/>'
    path.write_text(path.read_text().replace(film, film.replace("56", "53").replace("40", "35"), 1))


def torus_domain(path):
    trimesh.creation.torus(20, 8).apply_translation(CENTER).export(path.parent / "torus.ply")
    bsdf = '<bsdf type="cooktorrance"/>'
    path.write_text(path.read_text().replace(bsdf, '<string name="domain" value="torus.ply"/>' + bsdf))


def distant_lights(path):
    light = '<emitter type="directional"><vector name="direction" x="1" y="0.2" z="-2"/></emitter>'
    path.write_text(re.sub(r"<emitter.*?</emitter>", light, path.read_text()))


@pytest.mark.parametrize("change", [masks_on_some, no_masks, two_sizes, torus_domain, distant_lights])
def test_captures_of_every_kind_are_fitted(change, broken_capture, tmp_path):
    path, _ = broken_capture
    change(path)
    assert fit.main([str(path), "--out", str(tmp_path / "run"), "--iterations", "12", *QUICK]) == 0
    log = results.read_log(tmp_path / "run")
    assert all(np.isfinite(entry["loss"]) for entry in log)
    mesh = trimesh.load(tmp_path / "run" / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.euler_number == (0 if change is torus_domain else 2)


def test_start_from_the_visual_hull(small_capture, tmp_path):
    run = tmp_path / "run"
    assert fit.main([str(small_capture), "--out", str(run), "--iterations", "12", "--domain", "hull", *QUICK]) == 0
    assert distance(run / "mesh.ply") < 0.04  # hardly a fit: it is the start that is near
    mesh = trimesh.load(run / "mesh.ply", process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    domain = load_fit(run).domain
    assert type(domain) is Domain and np.linalg.norm(domain.points, axis=1).mean() == pytest.approx(1, abs=0.01)
    again = mi.load_dict({"type": "shapenet", "weights": str(run / "ring.pt"), "subdivisions": 3})
    vertices = np.array(mi.traverse(again)["vertex_positions"]).reshape(-1, 3)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-3)


def test_fits_from_a_hull_go_on_from_the_same_hull(small_capture, tmp_path, monkeypatch):
    config = fit.parse_options(
        [str(small_capture), "--out", str(tmp_path), "--domain", "hull", "--iterations", "6", *QUICK]
    )
    before = Fit(load_capture(small_capture), config)
    assert before.iterations == 5  # of six: 3.6 of the first stage become 1.2, 2.4 of the second 3.4
    for _ in range(3):
        before.step()
    checkpoint.write_checkpoint(before, {}, tmp_path)
    monkeypatch.setattr(start, "starting_surface", None)  # the domain is that of the checkpoint
    after = Fit(load_capture(small_capture), config, state=checkpoint.read_checkpoint(tmp_path, config)["fit"])
    for level in (2, 3):
        (s, faces), (again, same) = before.ring.domain.sample(level), after.ring.domain.sample(level)
        assert torch.equal(s, again) and np.array_equal(faces, same)
    with torch.no_grad():
        torch.testing.assert_close(before.ring.surface(s), after.ring.surface(s))
    drawn = [f.ring.domain.sample(2, f.sampler.random["rotations"])[0] for f in (before, after)]
    assert torch.equal(*drawn)


def test_start_from_a_mesh(small_capture, tmp_path):
    trimesh.creation.torus(20, 8).apply_translation(CENTER).export(tmp_path / "torus.ply")
    run = tmp_path / "run"
    domain = ["--domain", "mesh", str(tmp_path / "torus.ply")]
    assert fit.main([str(small_capture), "--out", str(run), "--iterations", "4", *domain, *QUICK]) == 0
    assert trimesh.load(run / "mesh.ply", process=False).euler_number == 0


def test_auto_takes_the_hull(small_capture):
    scene = load_capture(small_capture)
    domain, center, radius = start.starting_surface(scene, "auto")
    assert type(domain) is Domain and trimesh.Trimesh(domain.points, domain.faces).euler_number == 2
    np.testing.assert_allclose(center, CENTER, atol=2)
    assert radius == pytest.approx(AXES.mean(), rel=0.1)
    assert type(start.starting_surface(scene, "sphere")[0]) is Sphere


def test_where_the_scene_says_where_the_object_is_bad_masks_do_not_stop_a_fit(broken_capture):
    path, _ = broken_capture
    mi.Bitmap(np.zeros((40, 56, 1), np.uint8)).write(str(path.parent / "masks/004.png"))
    with pytest.raises(InputError, match="nothing in it"):
        start.starting_surface(load_capture(path), "auto")
    bsdf = '<bsdf type="cooktorrance"/>'
    place = '<point name="center" x="400" y="-150" z="90"/><float name="radius" value="30"/>'
    path.write_text(path.read_text().replace(bsdf, bsdf + place))
    domain, center, radius = start.starting_surface(load_capture(path), "auto")
    assert type(domain) is Sphere and center.tolist() == CENTER.tolist() and radius == 30
    with pytest.raises(InputError, match="nothing in it"):
        start.starting_surface(load_capture(path), "hull")


def test_a_domain_of_the_scene_does_not_normalise_another(broken_capture):
    path, _ = broken_capture
    torus_domain(path)
    scene = load_capture(path)
    assert start.starting_surface(scene, "auto")[0] is scene.shape.domain[0]
    domain, _, radius = start.starting_surface(scene, "sphere")
    assert type(domain) is Sphere and radius == pytest.approx(scene.sphere()[1]) != scene.shape.domain[2]


def test_without_masks_the_object_is_what_is_bright(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    no_masks(path)
    run = tmp_path / "run"
    assert fit.main([str(path), "--out", str(run), "--iterations", "90", *QUICK]) == 0
    assert '"mask"' in (run / "log.jsonl").read_text() and distance(run / "mesh.ply") < 0.05
    with pytest.raises(InputError, match="--domain hull: there are no masks of the whole object"):
        fit.main([str(path), "--out", str(run), "--domain", "hull", "--masks", "given", *QUICK])
    for file in path.parent.glob("images/*.png"):
        mi.Bitmap(np.maximum(np.array(mi.Bitmap(str(file))), 90)).write(str(file))
    assert fit.main([str(path), "--out", str(tmp_path / "bright"), "--iterations", "1", *QUICK]) == 0
    assert "the room was not dark enough" in capsys.readouterr().out


def test_results_never_go_onto_the_scene_itself(finished, broken_capture):
    path, _ = broken_capture
    before = path.read_bytes()
    with pytest.raises(InputError, match="holds the scene file"):
        fit.main([str(path), "--out", str(path.parent), "--iterations", "1", *QUICK])
    with pytest.raises(InputError, match="own photographs"):
        render.main([str(finished), str(path), str(path.parent / "images")])
    assert path.read_bytes() == before


def test_a_finished_fit_is_fitted_anew_and_not_silently(finished, tmp_path, capsys):
    assert fit.main([str(finished / "scene.xml"), "--out", str(tmp_path / "run"), "--iterations", "1", *QUICK]) == 0
    said = "surface and material of the fit that it holds are not taken, but found anew"
    assert f"{finished / 'scene.xml'}: {said}" in capsys.readouterr().out
    weights = ElementTree.parse(tmp_path / "run" / "scene.xml").findall("shape/string[@name='weights']")
    assert [element.get("value") for element in weights] == ["ring.pt"]


@pytest.fixture
def begun():
    """A function that gives the process of a fit which has done some iterations; it does not outlive the test."""
    processes = []

    def begin(call, folder, iteration=1):
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        if os.name == "posix":  # as if these tests did not run under nohup
            options["preexec_fn"] = lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)
        processes.append(subprocess.Popen(call, **options))
        reach(processes[-1], folder, iteration)
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.wait()


def reach(process, folder, iteration):
    """Wait until a fit has done so many iterations."""
    deadline = time.monotonic() + 240

    def reached():
        return (folder / "log.jsonl").exists() and any(e["iteration"] >= iteration for e in results.read_log(folder))

    while not reached():
        assert process.poll() is None, "it has ended"
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.skipif(os.name != "posix", reason="Windows has other signals")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_of_schedulers_and_terminals_lose_nothing(name, small_capture, tmp_path, begun):
    """However often they come; nor does a reader of the output that is gone, of which nobody hears then."""
    folder, end = tmp_path / "run", getattr(signal, name)
    options = ["--out", str(folder), "--iterations", "900", *SPHERE]
    process = begun([sys.executable, "-m", "mi_ring.fit", str(small_capture), *options], folder)
    process.stdout.close()
    reach(process, folder, results.read_log(folder)[-1]["iteration"] + 10)
    for _ in range(3):
        process.send_signal(end)
        time.sleep(0.01)
    assert process.wait(240) == 128 + end
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    assert load_fit(folder) and 0 < results.read_log(folder)[-1]["iteration"] < 600


def test_a_folder_that_is_removed_comes_back(small_capture, tmp_path, monkeypatch):
    folder, genuine = tmp_path / "run", results.add_to_log

    def removed(*arguments):
        monkeypatch.setattr(results, "add_to_log", genuine)
        shutil.rmtree(folder)

    monkeypatch.setattr(results, "add_to_log", removed)
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0)
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "10", *SPHERE]) == 0
    assert sorted(p.name for p in folder.iterdir()) == sorted(set(FILES) - {"inputs.png"})
    assert [entry["iteration"] for entry in results.read_log(folder)] == [5, 10]


def test_a_log_that_was_cut_off_by_a_full_disk_is_whole_again(small_capture, tmp_path, monkeypatch, capsys):
    folder, genuine = tmp_path / "run", results.add_to_log

    def cut_off(folder, entry):
        monkeypatch.setattr(results, "add_to_log", genuine)
        with (folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(entry)[:20])
        raise InputError("log.jsonl: cannot be written (No space left on device); make room")

    monkeypatch.setattr(results, "add_to_log", cut_off)
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "10", *SPHERE]) == 0
    assert [entry["iteration"] for entry in results.read_log(folder)] == [5, 10]
    said = "log.jsonl: cannot be written (No space left on device); the fit goes on and tries again"
    assert said in "".join(capsys.readouterr())


def test_results_that_cannot_go_where_they_should_go_elsewhere(small_capture, tmp_path, monkeypatch):
    folder, genuine = tmp_path / "run", files.write_file
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def refused(path, *arguments, **options):
        if path == folder / "ring.pt":
            raise InputError(f"{path}: cannot be written (as if); choose another place")
        genuine(path, *arguments, **options)

    for module in (files, results):
        monkeypatch.setattr(module, "write_file", refused)
    with pytest.raises(InputError, match="as if") as told:
        fit.main([str(small_capture), "--out", str(folder), "--iterations", "2", *SPHERE])
    (elsewhere,) = tmp_path.glob("mi_ring-run-*/run")
    assert str(told.value) == f"{folder}/ring.pt: cannot be written (as if); the results are in {elsewhere} instead"
    assert {p.name for p in elsewhere.iterdir()} == set(FILES) - {"inputs.png", "checkpoint.before.pt"}
    assert load_fit(elsewhere)

    # Nor does what is left depend on the scene, which may have been on the same drive, nor on the report.
    running = Fit(load_capture(small_capture), Config(iterations=2, levels=(1,), widths=(28,), shares=(1,)))
    keeper = session.Keeper(running, folder, lambda: None)
    scene = results.fitted_scene(running.problem.given, running.ring, folder)
    result = running.result()
    result = replace(result, given=replace(result.given, path=tmp_path / "gone.xml"))
    said = keeper.rescue(result, scene)
    where = Path(re.fullmatch("the results are in (.*) instead", said)[1])
    assert where != elsewhere and load_fit(where) and (where / "report.html").exists()
    monkeypatch.setattr(results.report, "report_html", Mock(side_effect=OSError("full")))
    said = keeper.rescue(result, scene)
    where = Path(re.fullmatch("what could be written is in (.*) instead, with a checkpoint", said)[1])
    assert load_fit(where) and (where / "checkpoint.pt").exists() and not (where / "report.html").exists()


def test_a_damaged_checkpoint_is_made_good_by_the_one_before(small_capture, tmp_path, monkeypatch, capsys):
    """As in a deterministic fit that nobody disturbed. What is damaged does not take the place of what is not."""
    quick = [*SPHERE, "--iterations", "6", "--deterministic"]
    folder, path = tmp_path / "run", tmp_path / "run/checkpoint.pt"
    monkeypatch.setattr(session, "CHECKPOINT_SECONDS", 0)
    assert fit.main([str(small_capture), "--out", str(folder), *quick]) == 0
    mesh = (folder / "mesh.ply").read_bytes()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    (folder / "mesh.ply").unlink()
    before = (folder / "checkpoint.before.pt").read_bytes()
    assert fit.main([str(small_capture), "--out", str(folder), *quick, "--resume"]) == 0
    assert f"{path}: is damaged or gone; going on from the one before" in capsys.readouterr().out
    assert (folder / "mesh.ply").read_bytes() == mesh
    assert (folder / "checkpoint.before.pt").read_bytes() == before
    assert torch.load(folder / "checkpoint.before.pt", weights_only=False)["fit"]["course"]["iteration"] == 5


def test_ctrl_c_leaves_a_usable_folder_and_resume_finishes(small_capture, tmp_path, begun):
    folder = tmp_path / "run"
    options = ["--out", str(folder), "--iterations", "80", *SPHERE]
    call = [sys.executable, "-m", "mi_ring.fit", str(small_capture), *options]
    process = begun(call, folder)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert "--resume" in output and "Traceback" not in output
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    stopped = results.read_log(folder)[-1]["iteration"]
    assert stopped < 80

    subprocess.run([*call, "--resume"], check=True, timeout=300, capture_output=True)
    assert [e["iteration"] for e in results.read_log(folder)][-1] == 80
    assert distance(folder / "mesh.ply") < 0.04


def test_resume_refuses_other_settings_and_missing_checkpoints(finished, small_capture, broken_capture, tmp_path):
    (broken_capture[0].parent / "images/007.png").unlink()  # nobody has looked for the photographs yet
    with pytest.raises(InputError, match="checkpoint.pt: no such file; run without --resume"):
        fit.main([str(broken_capture[0]), "--out", str(tmp_path), "--resume"])
    with pytest.raises(InputError, match="gone.xml: no such file"):
        fit.main([str(tmp_path / "gone.xml"), "--out", str(tmp_path), "--resume"])
    with pytest.raises(InputError, match="--iterations: was 90 before, is 80 now; --batch: was 4 before, is 8 now, the "
                       "default; give the same"):  # fmt: skip
        fit.main(
            [str(small_capture), "--out", str(finished), "--resume", "--iterations", "80", *SPHERE, "--batch", "8"]
        )
    state = torch.load(finished / "checkpoint.pt", weights_only=False)
    files.write_state(state | {"format": state["format"] - 1}, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match="checkpoint.pt: is a checkpoint of format 4, mi_ring .* goes on from 5"):
        fit.main([str(small_capture), "--out", str(tmp_path), "--resume"])
    (tmp_path / "checkpoint.pt").write_bytes(b"PK")
    with pytest.raises(InputError, match="checkpoint.pt: not a checkpoint"):
        fit.main([str(small_capture), "--out", str(tmp_path), "--resume"])


@pytest.mark.parametrize(("part", "change"), [
    ("course", {"iteration": -5}), ("course", {"iteration": 10**9}), ("course", {"iteration": "5"}),
    ("course", {"seconds": math.nan}), ("course", {"log": [{}]}), ("course", {"log": 3}), ("course", {"unknown": 1}),
    ("sampler", {"random": torch.zeros(3)}), ("sampler", {"waiting": {(56, 40): [12]}}),
    ("optimisation", {"optimizers": []}), (None, {"regulariser": 1}), (None, {"ring": None}),
])  # fmt: skip
def test_a_checkpoint_that_no_fit_has_written_is_refused(part, change, finished, small_capture, tmp_path):
    state = torch.load(finished / "checkpoint.pt", weights_only=False)
    change = {part: state["fit"][part] | change} if part else change
    files.write_state(state | {"fit": state["fit"] | change}, tmp_path / "checkpoint.pt")
    options = ["--out", str(tmp_path), "--resume", "--iterations", "90", *SPHERE]
    with pytest.raises(InputError, match=r"checkpoint\.pt: holds no fit that could go on"):
        fit.main([str(small_capture), *options])


def test_resume_notices_files_that_changed(small_capture, broken_capture, tmp_path):
    path, edit = broken_capture
    trimesh.creation.icosphere(subdivisions=2, radius=30).apply_translation(CENTER).export(path.parent / "ball.ply")
    edit('<bsdf type="cooktorrance"/>', '<string name="domain" value="ball.ply"/><bsdf type="cooktorrance"/>')
    arguments = [str(path), "--out", str(tmp_path / "run"), "--iterations", "2", *SPHERE]
    assert fit.main(arguments) == 0
    assert fit.main([*arguments, "--resume"]) == 0  # there is nothing left to do
    for name in ("images/004.png", "masks/005.png", "ball.ply", path.name):
        file = path.parent / name
        before = file.read_bytes()
        if name.endswith(".png"):
            pixels = np.array(mi.Bitmap(str(file)))
            pixels[17, 23] ^= 255
            mi.Bitmap(pixels).write(str(file))
        elif name.endswith(".ply"):
            trimesh.load(file, process=False).apply_scale(1.001).export(file)
        else:
            file.write_bytes(before + b"\n")
        with pytest.raises(InputError, match=f"--resume: {name} has changed since"):
            fit.main([*arguments, "--resume"])
        file.write_bytes(before)
    assert fit.main([*arguments, "--resume"]) == 0


def call(*arguments, module="fit"):
    """Exit status and standard error of a command in a process of its own."""
    done = subprocess.run([sys.executable, "-m", f"mi_ring.{module}", *map(str, arguments)],
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    return done.returncode, done.stderr


def test_a_users_mistake_is_one_line_and_status_2_before_any_work(broken_capture, tmp_path):
    path, _ = broken_capture
    (path.parent / "images/007.png").unlink()
    status, complaint = call(path, "--out", tmp_path / "out")
    assert status == 2 and complaint.count("\n") == 1
    assert "007.png" in complaint and "filename" in complaint
    assert not (tmp_path / "out").exists()


def test_fits_on_one_thread_read_an_exr_one_after_the_other(broken_capture, tmp_path):
    path, replace = broken_capture
    image = path.parent / "images/000"
    mi.Bitmap(f"{image}.png").convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False).write(f"{image}.exr")
    replace("images/000.png", "images/000.exr")
    code = """
import sys
from mi_ring import fit
for out in "ab":
    assert fit.main([*sys.argv[1:], "--out", out, "--iterations", "1", "--threads", "1"]) == 0
"""
    subprocess.run([sys.executable, "-c", code, path, *SPHERE], check=True, timeout=300, cwd=tmp_path)


def test_on_one_core_an_exr_is_written_and_read(tmp_path):
    code = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import mi_ring, numpy
from mi_ring.images import write_image
from pathlib import Path
write_image(numpy.ones((5, 7, 3), numpy.float32), Path("one.exr"))
import mitsuba as mi
assert tuple(mi.Bitmap("one.exr").size()) == (7, 5)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120, cwd=tmp_path)


def test_render_with_a_missing_run_is_one_line_and_status_2(small_capture, tmp_path):
    status, complaint = call(tmp_path / "nothing", small_capture, tmp_path / "out", module="render")
    assert status == 2 and complaint.count("\n") == 1 and "nothing" in complaint


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--preset", "quick"], ["--preset: is quick; must be one of fast"]),
        (["--preset"], ["--preset: has no value"]),
        (["--weights.mask", "-5"], ["--weights", "0 or more"]),
        (["--seed", str(2**70)], ["--seed", "below 2^63"]),
        (["--iterations", "many"], ["--iterations: is many; must be a whole number"]),
        (["--iterations", "0"], ["--iterations", "0", "at least 1"]),
        (["--steps", "0"], ["--steps: is 0, must be at least 1"]),
        (["--velocity-decay", "0"], ["--velocity-decay", "0", "above 0"]),
        (["--iteration", "5"], ["Unrecognized options: --iteration", "--iterations"]),
        (["--levels", "4", "9"], ["--levels", "0 to 8"]),
        (["--levels", "4"], ["--widths", "as many"]),
        (["--loss", "l3"], ["--loss: is l3; must be one of", "log"]),
        (["--domain", "cube"], ["--domain: is cube; must be auto|sphere|hull|mesh PATH"]),
        (["--domain", "mesh"], ["--domain: is mesh; must be"]),
        (["--learning-rate", "-1"], ["--learning-rate", "above 0"]),
        (["--learning-rate", "fast"], ["--learning-rate: is fast; must be a number"]),
        (["--widths", "128", "wide"], ["--widths: is 128 wide, must be INT [INT ...]"]),
        (["--widths"], ["--widths: is empty, must be as many values as --levels (3)"]),
        (["--parameters", "principled"], ["--parameters: must be STR FLOAT FLOAT [STR FLOAT FLOAT ...]"]),
        (["--refine", "gian"], ["--refine: is gian; must be one of auto, none", "; perhaps you meant gain"]),
        (["--refine", "power", "gain"], ["--refine: is power gain, must be without power or without gain"]),
    ],
)
def test_an_unusable_option_is_one_line_that_names_it(options, words):
    with pytest.raises(InputError) as error:
        fit.parse_options(["scene.xml", *options])
    complaint = str(error.value)
    assert complaint.startswith(words[0]) and "\n" not in complaint and all(word in complaint for word in words)


def test_an_output_folder_that_is_a_file_is_one_line(small_capture, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out: cannot be written"):
        fit.main([str(small_capture), "--out", str(tmp_path / "file" / "run"), "--iterations", "1", *SPHERE])


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_valid_and_can_be_overridden(preset):
    config = fit.parse_options(["scene.xml", "--preset", preset, "--seed", "7"])
    assert config.preset == preset and config.seed == 7
    stages = Schedule.of(config).stages
    assert stages[0].first == 0 and stages[-1].last == config.iterations
    assert all(a.last == b.first for a, b in zip(stages, stages[1:]))
    for name, value in PRESETS[preset].items():
        found = getattr(config, name)
        assert found == value or (name == "weights" and value.items() <= found.items())


def test_starts_near_the_object_spend_less_on_the_coarse_stage():
    def lengths(near):
        return [stage.last - stage.first for stage in Schedule.of(config, near).stages]

    config = Config(iterations=100, shares=(0.5, 0.3, 0.2))
    assert lengths(near=False) == [50, 30, 20]
    assert lengths(near=True) == [17, 43, 20]  # 16.7, and 30 + 0.4 · 33.3
    config = Config(iterations=100, levels=(4,), widths=(128,), shares=(1,))
    assert [s.last for s in Schedule.of(config, near=True).stages] == [100]


def test_paper_preset_is_the_papers():
    config = fit.parse_options(["scene.xml", "--preset", "paper"])
    assert config.weights["mask"] == 0.0 and config.weights["velocity"] == 0.01 and config.loss == "l2"
    assert config.refine == ("none",)
    assert config.optimizer == "adam" and config.learning_rate == 1e-4 and config.decay == 1
    assert config.levels == (5, 6) and [s.last - s.first for s in Schedule.of(config).stages] == [2000, 4000]
    assert config.precision == "float32" and config.steps == 20 and not config.shadows and not config.indirect
    assert config.velocity_decay == 1


def test_regulariser_is_relaxed_and_nothing_else():
    regulariser = RegulariserStrength()
    regulariser.weakened, regulariser.unexplained = 0.5, 0.06
    assert regulariser.strength(0.04) == pytest.approx(0.2)
    regulariser.unexplained = 0.18  # photographs that disagree with the model
    assert regulariser.strength(0.04) == pytest.approx(0.9**4)
    regulariser.unexplained = 0.5
    assert regulariser.strength(0.04) == 1
    it = SimpleNamespace(context=SimpleNamespace(regulariser=0.3))
    assert terms.default_terms["velocity"].schedule(it) == 0.3
    scheduled = {name for name, term in terms.default_terms.items() if term.schedule}
    assert scheduled == {"velocity", "settling"}  # the latter in the last stage alone


def test_what_is_unexplained_is_a_share_of_the_objects_light():
    observed = torch.tensor([0.5, 0.25, 0.1, 0.4, 9.0]).reshape(1, 1, 5, 1).expand(1, 1, 5, 3)
    predicted = torch.tensor([0.4, 0.30, 9.0, 0.7, 0.0]).reshape(1, 1, 5, 1).expand(1, 1, 5, 3)
    clipped = torch.zeros(1, 1, 5, 3, dtype=torch.bool)
    clipped[..., 3, :] = True  # brighter than observed: no error
    seen = Observation(observed, clipped, torch.tensor([[[1.0, 1, 1, 1, 0]]]), torch.tensor([True]), None)
    shown = SimpleNamespace(rgb=predicted, coverage=torch.tensor([[[1.0, 1, 0.5, 1, 1]]]))
    batch = SimpleNamespace(total=lambda tensor: tensor)
    found = Iteration(batch, seen, shown, None).unexplained()
    assert found == pytest.approx((0.1 + 0.05) / (0.5 + 0.25 + 0.4))
    seen = seen._replace(masked=torch.tensor([False]))  # then what is predicted to be the object is
    found = Iteration(batch, seen, shown, None).unexplained()
    assert found == pytest.approx((0.1 + 0.05 + 9) / (0.5 + 0.25 + 0.4 + 9))


def test_regulariser_is_held_while_the_surface_crosses_itself_and_catches_up_unless_it_is_late():
    ball = trimesh.creation.icosphere(2)
    two = ball + trimesh.creation.icosphere(2).apply_translation([0.5, 0, 0])
    state = RegulariserStrength()
    state.unexplained = 0.5

    def go(numbers, mesh):
        for number in numbers:
            vertices, faces = torch.from_numpy(np.array(mesh.vertices)), np.array(mesh.faces)
            share = 0.1 if number < 20 else math.nan
            schedule = SimpleNamespace(shaping=200)
            state.note(SimpleNamespace(number=number, progress=(number - 1) / 200, batch=SimpleNamespace(faces=faces),
                                       prediction=SimpleNamespace(vertices=vertices),
                                       context=SimpleNamespace(schedule=schedule),
                                       unexplained=lambda share=share: share))  # fmt: skip

    go(range(1, 20), ball)
    assert state.weakened == pytest.approx(19 / 200)  # as planned
    assert state.unexplained == pytest.approx(0.1 + 0.4 * 0.9**19)
    go(range(20, 80), two)
    assert state.crossing > 0.05 and state.weakened == pytest.approx(-0.3)
    go(range(80, 100), ball)
    assert not state.held and state.weakened == pytest.approx(-0.3 + 20 * 0.015)
    go(range(100, 139), ball)
    assert state.weakened == pytest.approx(39 * 0.015)
    go(range(139, 160), two)
    assert state.held and state.weakened == pytest.approx(40 * 0.015 - 20 * 0.01)
    go(range(160, 180), ball)
    assert state.weakened == pytest.approx(0.4 + 20 * 0.005)


def test_program_lists_its_commands():
    done = subprocess.run([sys.executable, "-c", "import sys; sys.argv[1:] = ['--help']; "
                           "from mi_ring.__main__ import main; main()"], capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0
    assert all(name in done.stdout for name in __main__.COMMANDS)


def test_writes_are_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.pt"
    files.write_state({"iteration": 1}, path)
    monkeypatch.setattr(os, "replace", lambda a, b: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        files.write_state({"iteration": 2}, path)
    assert torch.load(path)["iteration"] == 1


def test_scenes_of_the_same_name_do_not_share_a_folder_by_default(small_capture, broken_capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ["--iterations", "1", *SPHERE]
    assert fit.main([str(small_capture), *quick]) == 0
    assert fit.main([str(small_capture), *quick]) == 0  # the same scene: the first result is moved aside
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["small", "small.1"]
    with pytest.raises(InputError, match="out/small: holds the results of another scene, .*small.xml; say with --out"):
        fit.main([str(broken_capture[0]), *quick])
    assert fit.main([str(broken_capture[0]), "--out", "out/mine", *quick]) == 0


def test_two_fits_into_one_folder_are_refused(small_capture, tmp_path):
    with (
        files.locked(tmp_path / "run"),
        pytest.raises(InputError, match="run: --out: another process is writing there"),
    ):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "1", *SPHERE])
    assert not (tmp_path / "run").exists()
