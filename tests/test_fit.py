"""The commands `fit` and `render` from end to end on a small capture."""

import json
import re
import subprocess
import sys
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.quick_fits import BRIEF, FILES, ITERATIONS, SPHERE, TABLE, distance
from PIL import Image

from mi_ring import fit, render
from mi_ring.capture import capture
from mi_ring.capture.loading import load_capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.objects.ring_file import load_fit
from mi_ring.output import results
from mi_ring.rendering import prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.system import machine


def test_fit_writes_all_results_and_no_other_files(finished):
    assert sorted(p.name for p in finished.iterdir()) == sorted(FILES)


def test_logged_loss_is_the_weighted_sum_of_its_terms(finished):
    log = [json.loads(line) for line in (finished / "log.jsonl").read_text().splitlines()]
    for entry in log:
        done = (entry["iteration"] - 1) / ITERATIONS
        velocity = entry["weights"]["velocity"]  # as planned, or stronger
        assert 0.01 * 0.03**done <= velocity * (1 + 1e-9) <= 0.01 * (1 + 2e-9)
        weights = {"rgb": 1.0, "mask": 5.0, "velocity": velocity, "calibration": 1e-3}
        assert entry["weights"] == pytest.approx(weights)
        assert entry["loss"] == pytest.approx(sum(w * entry[term] for term, w in weights.items()), rel=1e-4)
        assert entry["learning_rate"] == pytest.approx(3e-3 * 0.1**done)
    assert log[-1]["iteration"] == ITERATIONS


def test_steps_of_the_flow_are_part_of_the_result(finished):
    assert load_fit(finished).shape_net.steps == Config().steps != 20


def test_of_very_many_photographs_some_are_shown(small_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(capture.Capture.spread, "__defaults__", (5,))
    assert fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "1", *BRIEF]) == 0
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
    assert [entry["iteration"] for entry in log] == list(range(5, ITERATIONS + 5, 5))
    assert {"seconds", "loss", "rgb", "mask", "velocity", "learning_rate", "vertices"} <= set(log[0])
    assert log[0]["vertices"] == 162 and log[-1]["vertices"] == 642
    assert log[-1]["rgb"] < 0.5 * log[0]["rgb"]
    assert json.loads((finished / "config.json").read_text())["iterations"] == ITERATIONS


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
    counts = {k: count for k, (count, _) in running.renderer.averages.items()}
    assert counts == ({k: count for k, count in enumerate(seen) if count} if table and indirect else {})


def test_photographs_of_a_stage_that_has_ended_are_not_kept_in_memory(small_capture):
    config = Config(iterations=6, levels=(2, 2), widths=(14, 28), shares=(0.5, 0.5), batch=4, detail="none",
                    domain="sphere")  # fmt: skip
    fit = Fit(load_capture(small_capture), config)
    kept = [{scale for scale, _ in fit.capture.observations.kept.values()} for _ in fit]
    assert kept[1:] == [{4}, {4}, {2}, {2}, {2}]


def test_deterministic_fits_see_the_same_normals_of_other_meshes(broken_capture):
    path, edit = broken_capture
    ball = trimesh.creation.icosphere(subdivisions=6)  # so many vertices that threads share the work
    ball.vertices *= [1, 1.3, 0.7]
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(path.parent / "none.ply", vertex_normal=False)
    triangle = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], vertex_normals=[[0.6, 0, 0.8]] * 3)
    triangle.export(path.parent / "own.ply", vertex_normal=True)
    others = "".join(f'<shape type="ply"><string name="filename" value="{n}.ply"/></shape>' for n in ("none", "own"))
    edit("</scene>", others + "</scene>")
    config = fit.parse_options([str(path), "--deterministic", *SPHERE])
    seen = set()
    for _ in range(3):
        scene = load_capture(path)
        with machine.threads_of(1):
            shapes = Fit(scene, config).capture.scene.shapes()
        none, own = (np.array(s.vertex_normals_buffer()) for s in shapes if type(s) is mi.Mesh)
        np.testing.assert_allclose(own, [0.6, 0, 0.8] * 3, rtol=1e-6)
        seen.add(none.tobytes())
    assert len(seen) == 1


def test_interreflection_is_added_unless_switched_off(small_capture, monkeypatch):
    monkeypatch.setattr(GlobalIllumination, "interreflection", property(lambda it: 1000 * it.coverage[..., None]))
    for options, bright in (([], True), (["--no-indirect"], False)):
        first = Fit(load_capture(small_capture), fit.parse_options([str(small_capture), *SPHERE, *options]))
        assert (first.step().terms["rgb"] > 100) == bright


def test_interreflection_is_left_out_where_intensities_cannot_be_true_nor_be_refined(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    path.write_text(re.sub(r'name="intensity" value="[^"]*"', 'name="intensity" value="1"', path.read_text()))
    cases = {"--indirect --refine none": True, "--refine none": False, "--indirect --refine auto": False}
    for options, said in cases.items():
        command = [str(path), "--out", str(tmp_path / "run"), "--iterations", "1", *BRIEF, *options.split()]
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


def test_a_finished_fit_is_fitted_anew_and_not_silently(finished, tmp_path, capsys):
    assert fit.main([str(finished / "scene.xml"), "--out", str(tmp_path / "run"), "--iterations", "1", *BRIEF]) == 0
    said = "contains a fitted object. The fit ignores it and starts anew"
    assert f"{finished / 'scene.xml'}: {said}" in capsys.readouterr().out
    weights = ElementTree.parse(tmp_path / "run" / "scene.xml").findall("shape/string[@name='weights']")
    assert [element.get("value") for element in weights] == ["ring.pt"]


def test_a_users_mistake_is_one_line_and_status_2_before_any_work(broken_capture, tmp_path):
    path, _ = broken_capture
    (path.parent / "images/007.png").unlink()
    done = subprocess.run([sys.executable, "-m", "mi_ring.fit", path, "--out", tmp_path / "out"],
                          capture_output=True, text=True, timeout=120)  # fmt: skip
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "007.png" in done.stderr and "filename" in done.stderr
    assert not (tmp_path / "out").exists()
