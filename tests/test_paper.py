"""`mi-ring paper`: the experiments are valid, and the engine shows what has become of each run."""

import csv
import dataclasses
import os
import re
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import AXES, CENTER
from scipy.spatial.transform import Rotation

from mi_ring import paper
from mi_ring.capture import scenefile
from mi_ring.capture.loading import load_capture
from mi_ring.collection import fits
from mi_ring.errors import InputError
from mi_ring.experiments import brdf_slices, datasets, engine, measures, published, selection, single_view, tables
from mi_ring.experiments.catalogue import EXPERIMENTS
from mi_ring.experiments.experiment import NOT_RUN, QUICK, Column, Experiment, ExperimentOptions, Outcome, Run
from mi_ring.experiments.plots import bars, curves
from mi_ring.fit import parse_options
from mi_ring.fitting.config import Config
from mi_ring.metrics import evaluation, surfaces
from mi_ring.metrics.surfaces import hits, load_true_mesh
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.rendering.photograph_lights import Lights
from mi_ring.synthesis.materials import load_material, pattern_of
from mi_ring.synthesis.object_on_table import shape_of
from mi_ring.synthesis.options import SynthesizeConfig
from mi_ring.synthesis.path_traced_capture import settings_of
from mi_ring.system import machine

ALBEDO = np.array([0.7, 0.4, 0.25])  #: of a ball seen from one side
NO_DATA = datasets.Dataset("none", Path("none.xml"), Path("none"))
TINY = {"iterations": 2, "levels": (1,), "widths": (32,), "shares": (1.0,), "subdivisions": 2, "domain": "sphere"}


@pytest.fixture(scope="module")
def known_capture(small_capture, tmp_path_factory):
    """A folder with the small capture and its truth."""
    folder = tmp_path_factory.mktemp("known") / "egg"
    shutil.copytree(small_capture.parent, folder)
    (folder / "small.xml").rename(folder / "scene.xml")
    (folder / "truth").mkdir()
    ball = trimesh.creation.icosphere(subdivisions=4)
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    trimesh.Trimesh(CENTER + ball.vertices * AXES @ turn.T, ball.faces).export(folder / "truth" / "mesh.ply")
    return folder


@pytest.fixture
def photographed_ball(tmp_path):
    """An .npz of "photographs" of a ball from one side, with the true normals, by the formulas of a pinhole."""
    height, width, focal, centre, radius = 40, 56, 400.0, np.array([29.0, 18.0]), 60.0
    y, x = np.mgrid[:height, :width]
    rays = np.stack([(x - centre[0]) / focal, (y - centre[1]) / focal, np.ones((height, width))], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)  # OpenCV's axes: x right, y down, z forward
    middle = np.array([2.0, -3.0, single_view.DISTANCE])
    along = rays @ middle
    inside = along**2 - middle @ middle + radius**2
    mask = inside > 0
    points = rays * (along - np.sqrt(np.maximum(inside, 0)))[..., None]
    normals = np.where(mask[..., None], (points - middle) / radius, 0) * [1, -1, -1]  # x right, y up, z to the viewer
    lights = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    power = np.array([[1.0, 0.8, 0.5], [0.9, 1.1, 0.7], [0.6, 0.7, 1.2]])
    shading = np.maximum(normals[mask] @ lights.T, 0).T
    pixels = np.round(65535 * ALBEDO * power[:, None] * shading[..., None]).astype(np.uint16)
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    file = tmp_path / "ball.npz"
    np.savez(file, mask=mask, pixels_uint16=pixels, light_dir=lights, light_int=power, normal_gt=normals, K=K)
    return file, middle * [-1, -1, 1], radius  # as Mitsuba's camera, at the origin, has it


def data_for(name, known_capture, ball, tmp_path):
    """DATA of an experiment."""
    if name == "table2":
        (tmp_path / "mvpmsData" / "bearPNG").mkdir(parents=True)
        (tmp_path / "mvpmsData" / "bearPNG" / "Calib_Results.mat").touch()
        return (tmp_path,)
    return {"single": (ball,), "specularity": (), "stripes": (), "swap": ()}.get(name, (known_capture,))


# The experiments.


def test_every_run_is_one_that_a_fit_takes(known_capture, photographed_ball, tmp_path):
    for name, experiment in EXPERIMENTS.items():
        seeds = (0,) if name in ("swap", "resolution", "timing") else (0, 1)
        data = data_for(name, known_capture, photographed_ball[0], tmp_path)
        require_valid(experiment, data, known_capture, seeds)


def require_valid(experiment, data, known_capture, seeds):
    for options in (
        ExperimentOptions(data, seeds=(3,)),
        ExperimentOptions(data, preset="paper", seeds=seeds),
        ExperimentOptions(data, (), "fast", quick=True),
    ):
        runs = experiment.runs(options)
        assert runs and len({run.name for run in runs}) == len(runs)
        for run in runs:
            config = run.config(options)
            assert Path(run.name).name == run.name and set(experiment.columns).isdisjoint(run.labels)
            assert config.iterations == QUICK["iterations"] or not options.quick
            if len(options.seeds) == 1:  # reading options takes a while
                command = parse_options([str(known_capture / "scene.xml"), *run.fit_options(options)])
                assert {f.name: getattr(command, f.name) for f in dataclasses.fields(Config)} == vars(config)


def test_what_the_paper_compares_is_what_runs_differ_in(known_capture):
    def of(name, *fields):
        return {tuple(getattr(run.config(options), f) for f in fields) for run in EXPERIMENTS[name].runs(options)}

    options = ExperimentOptions((known_capture,))
    assert of("steps", "steps") == {(t,) for t in (1, 2, 3, 5, 10, 20, 40)}
    assert {("ring", "sphere"), ("resnet", "sphere"), ("wide-resnet", "sphere")} <= of(
        "ablation", "shape_net", "domain"
    )
    assert {("linear", 16), ("octaves", 10), ("none", 16)} <= of("encoding", "encoding", "frequencies")
    assert of("genus", "domain") == {("sphere",), ("hull",)}
    assert of("table3", "refine") == {(("none",),), (("cameras",),)}
    assert [run.labels["views"] for run in EXPERIMENTS["views"].runs(options)] == [5, 10, 12]  # it has twelve


def test_labels_say_what_runs_are(known_capture):
    """Whatever the preset is; and a run is called the same whatever seeds stand beside it."""
    for preset in ("default", "paper"):
        options = ExperimentOptions((known_capture,), preset=preset)
        for run in EXPERIMENTS["ablation"].runs(options):
            if told := re.search(r"T = (\d+)", str(run.labels["network"])):
                assert run.config(options).steps == int(told[1])
    one, two = (
        EXPERIMENTS["table1"].runs(ExperimentOptions((known_capture,), seeds=seeds)) for seeds in ((0,), (0, 3))
    )
    assert [run.name for run in two] == [one[0].name, f"{one[0].name}-3"]
    gloss = ExperimentOptions(materials=("roughconductor alpha=0.1", "roughconductor alpha=0.3"), seeds=(0, 1))
    assert len({run.labels["material"] for run in EXPERIMENTS["specularity"].runs(gloss)}) == 2


def test_published_figures():
    bunny, *_, teapot, tool = published.TABLE1
    assert bunny == {"capture": "bunny", "by": "paper", "normal_mean": 3.61, "normal_median": 2.21, "depth_mean": 0.18,
                     "depth_median": 0.09, "psnr_input": 33.9, "psnr_novel": 33.5}  # fmt: skip
    assert (teapot["normal_mean"], teapot["psnr_novel"], tool["psnr_input"]) == (5.75, 27.6, 33.1)
    assert np.mean([row["normal_mean"] for row in published.TABLE1]) == pytest.approx(29.16 / 7)
    assert {row["object"]: (row["normal_mean"], row["depth_mm"]) for row in published.TABLE2} == {
        "bear": (4.42, 0.75), "buddha": (12.08, 0.67), "cow": (4.21, 0.77), "pot2": (6.63, 0.58),
        "reading": (7.61, 0.58),
    }  # fmt: skip
    wrong, refined = published.TABLE3
    assert (wrong["normal_mean"], wrong["depth_mean"], wrong["psnr_novel"]) == (10.3, 1.34, 25.6)
    assert (refined["normal_mean"], refined["depth_mean"], refined["psnr_novel"]) == (6.6, 0.65, 32.9)


MISTAKES = [
    (["tabel1"], "NAME: is tabel1; must be one of table1, table2.*; perhaps you meant table1"),
    ([], "NAME is missing"),
    (["table1", "nowhere"], "nowhere: DATA: no such file or folder; table1 takes folders of captures"),
    (["table1", "--seeds", "1", "1"], "--seeds: is 1 1, must be different"),
    (["table1", "--seeds", "x"], r"--seeds: is x, must be INT \[INT \.\.\.\]"),
    (["table1", "--quick", "--preset", "fine"], "--preset: is fine, but --quick needs fast; leave one of the two out"),
    (["table1", "--threads", "-1"], "--threads: is -1, must be 0 to 1024"),
    (["table1", "EMPTY"], "scene.xml"),
    (["table1", "--only", "other"], "--only: has other, must be of"),
    (["table2"], "DATA: table2 needs one folder, that of DiLiGenT-MV"),
    (["table2", "EMPTY"], "has no file like mvpmsData/bearPNG/Calib_Results.mat"),
    (["single"], "DATA: single needs .npz files"),
    (["single", "EMPTY"], "is a folder"),
    (["swap", "--materials", "diffuse"], "--materials: apply to meshes, which this experiment does not use"),
    (["swap", "KNOWN", "KNOWN", "--seeds", "1", "2"], "--seeds: swap takes only one seed"),
    (["timing", "KNOWN", "--seeds", "0", "1"], "--seeds: timing takes only one seed"),
    (["specularity", "--materials", ""], "--materials: one is empty"),
    (["table1", "PLY", "--materials", " "], "--materials: one is empty"),
    (["table1", "PLY", "--materials", "diffuse", "plastic"], "--materials: are 2 for 1 meshes"),
    (["table1", "GLTF"], r"a.gltf: DATA: is neither a scene file, .xml, nor a mesh, .ply, .obj"),
    (["specularity", "--materials", "nowhere.binary"], "nowhere.binary: --materials: no such file"),
    (["specularity", "PLY", "--materials", "principled base_color=vertex_color"], "--materials: .* varies over the"),
    (["stripes", "PLY", "--materials", "diffuse", "TEXTURED"], "--materials: .*wood.xml: varies over the surface"),
    (["views", "--materials", "diffuse"], "--materials: apply to meshes only"),
    (["stripes", "--materials", "diffuse"], "--materials: are 1, stripes need two"),
    (["specularity", "EMPTY"], "DATA: must be one mesh"),
    (["swap", "KNOWN"], "DATA: is one capture; swap exchanges"),
    (["table1", "KNOWN", "KNOWN"], "DATA: two runs would have the name egg; rename"),
]  # fmt: skip


def test_wrong_arguments_give_one_clear_error(known_capture, tmp_path):
    (tmp_path / "empty").mkdir()
    trimesh.creation.box().export(tmp_path / "a.ply")
    (tmp_path / "a.gltf").write_text("{}")
    mi.Bitmap(np.ones((2, 2, 3), np.float32)).write(str(tmp_path / "wood.exr"))
    (tmp_path / "wood.xml").write_text('<bsdf type="diffuse"><texture name="reflectance" type="bitmap">'
                                       '<string name="filename" value="wood.exr"/></texture></bsdf>')  # fmt: skip
    files = {"EMPTY": "empty", "PLY": "a.ply", "GLTF": "a.gltf", "TEXTURED": "wood.xml"}
    places = {"KNOWN": str(known_capture), **{name: str(tmp_path / file) for name, file in files.items()}}
    for arguments, message in MISTAKES:
        with pytest.raises(InputError, match=message):
            paper.main([*(places.get(word, word) for word in arguments), "--out", str(tmp_path / "out")])
    assert not list((tmp_path).rglob("table.md"))


def test_each_run_has_a_folder_of_its_own(known_capture):
    """Captures egg with seed 3 and egg-3, and one that would be among the records."""
    runs = [Run(name, datasets.given(known_capture), {"capture": name}) for name in ("egg", "egg-3", "batch")]
    with pytest.raises(InputError, match="DATA: two runs would have the name egg-3; rename a capture, or leave out"):
        trial(runs[:2]).runs(ExperimentOptions(seeds=(0, 3)))
    with pytest.raises(InputError, match="DATA: a run would have the name batch of another folder; rename"):
        trial(runs[2:]).runs(ExperimentOptions())


def test_results_of_other_settings_have_folders_of_their_own(tmp_path, monkeypatch, capsys):
    folders = []
    monkeypatch.setattr(paper, "run_experiment", lambda experiment, options, out, *_: folders.append(out.name) or 2)
    for options in ([], ["--preset", "fast"], ["--preset", "paper"], ["--quick"]):
        assert paper.main(["ablation", *options, "--out", str(tmp_path)]) == 1
    assert "ablation/table.md; 2 runs failed" in capsys.readouterr().out  # and no figure
    assert folders == ["ablation", "ablation-fast", "ablation-paper", "ablation-quick"]
    materials = [("diffuse reflectance=0.2", "diffuse"), ("diffuse reflectance=0.3", "diffuse")]
    options = [ExperimentOptions((tmp_path / mesh,), two) for mesh in ("a.ply", "b/a.ply") for two in materials]
    for name, different in (("specularity", 6), ("stripes", 4)):
        assert len({run.name for a in options for run in EXPERIMENTS[name].runs(a)}) == different


def test_a_capture_without_truth_is_refused(small_capture):
    with pytest.raises(InputError, match="has no true surface, neither"):
        datasets.given(small_capture)


# The engine.


def trial(runs):
    columns = {"normal_mean": Column("normals °"), "iou": Column("IoU", 3)}
    reference = [{"capture": "egg", "by": "somebody", "normal_mean": 5.0}]
    return Experiment("A trial.", lambda options: runs, columns, bars(("normal_mean", "°")), "none", reference)


def test_a_trial_goes_on_where_it_stopped_and_shows_what_failed(known_capture, tmp_path, monkeypatch):
    options, out = ExperimentOptions(preset="fast", threads=1, quick=True), tmp_path / "trial"
    egg, broken = datasets.given(known_capture), datasets.Dataset("cup", tmp_path / "cup.xml", tmp_path / "truth")
    runs = [Run(f"egg-{k}", egg, {"capture": "egg", "seed": k}, TINY | {"seed": k}, watched=k == 1) for k in (0, 1)]
    runs.insert(1, Run("cup", broken, {"capture": "cup", "seed": 0}, TINY))

    assert engine.run_experiment(trial(runs), options, out, ["egg-0"]) == 0
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [row["state"] for row in rows] == ["", "not run", "not run", "", ""]  # with the mean of one
    ring = (out / "runs" / "egg-0" / "ring.pt").stat().st_mtime_ns

    measured = []

    def evaluated(run, *arguments):
        measured.append(run.name)
        return measures.evaluated(run, *arguments)

    monkeypatch.setattr(engine, "evaluated", evaluated)
    monkeypatch.setattr(engine, "write_table_and_figure", Mock(wraps=engine.write_table_and_figure))
    assert engine.run_experiment(trial(runs), options, out) == 1
    assert engine.write_table_and_figure.call_count == 2  # nothing is new of the first
    assert measured == ["egg-1"] and (out / "runs" / "egg-0" / "ring.pt").stat().st_mtime_ns == ring
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [(row["capture"], row["seed"], row["by"]) for row in rows] == [
        ("egg", "0", "ours"), ("cup", "0", "ours"), ("egg", "1", "ours"), ("egg", "mean of 2", "ours"),
        ("egg", "", "somebody"),
    ]  # fmt: skip
    assert rows[1]["state"].startswith("failed: ") and "cup.xml" in rows[1]["state"] and not rows[1]["normal_mean"]
    for name in ("normal_mean", "iou"):
        own = [float(row[name]) for row in rows if row["capture"] == "egg" and row[name]]
        assert own[2] == pytest.approx((own[0] + own[1]) / 2)
        assert own[0] > 0
    text = (out / "table.md").read_text()
    assert text.startswith("A trial.") and f"| egg | 0 | ours | {float(rows[0]['normal_mean']):.2f} |" in text
    assert (out / "figure.png").stat().st_size > 1000

    # What is compared with has changed.
    time.sleep(0.01)
    (egg.truth / "mesh.ply").touch()
    assert engine.run_experiment(trial(runs[:1]), options, out) == 0 and measured == ["egg-1", "egg-0"]
    assert engine.run_experiment(trial(runs[1:2]), options, out) == 1 and not (out / "figure.png").exists()

    # The second was looked at in its course, which ends with its result.
    arguments = runs[2], out / "runs" / "egg-1", options
    course = measures.course(*arguments)
    assert [row["iteration"] for row in course] == [1, 2] and 0 < course[0]["seconds"] < course[1]["seconds"]
    monkeypatch.setattr(measures, "LEVELS", (1, 2, 3))
    levels = measures.by_level(*arguments)
    assert [row["vertices"] for row in levels] == [10 * 4**k + 2 for k in (1, 2, 3)]
    for row in (course[-1], levels[TINY["subdivisions"] - 1]):
        assert row["normal_mean"] == pytest.approx(float(rows[2]["normal_mean"]), abs=1e-3)


def test_interrupts_are_no_deaths(known_capture, tmp_path, monkeypatch):
    begun = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(fits, "run", begun)
    run = Run("egg", datasets.given(known_capture), {"capture": "egg"}, TINY)
    for _ in range(engine.RETRIES + 2):
        with pytest.raises(KeyboardInterrupt):
            engine.try_run(run, ExperimentOptions(preset="fast", threads=1, quick=True), tmp_path / "trial")
    assert begun.call_count == engine.RETRIES + 2


def test_a_figure_that_cannot_be_drawn_stops_nothing(tmp_path, capsys):
    def broken(ran):
        raise ValueError("too\nlarge")

    run = Run("a", NO_DATA, {"capture": "egg", "seed": 0})
    (tmp_path / "figure.png").touch()  # of before
    engine.write_table_and_figure(
        dataclasses.replace(trial([run]), figure=broken), [Outcome(run, Path(), [{"iou": 0.5}], "")], tmp_path, ""
    )
    assert capsys.readouterr().out == f"{tmp_path}/figure.png: cannot be drawn: too large\n"
    assert (tmp_path / "table.md").is_file() and not (tmp_path / "figure.png").exists()


def of_labels(rows, **labels):
    """Outcomes of runs of an egg, one for each of some rows, with other values of labels; no row: one that failed."""
    runs = [Run("a", NO_DATA, {"capture": "egg", **dict(zip(labels, values))})
            for values in zip(*labels.values())]  # fmt: skip
    return [Outcome(run, Path(), [row], "") if row else Outcome(run, failed="burst") for run, row in zip(runs, rows)]


def test_figures_leave_out_nothing():
    nan = float("nan")
    rows = [{"iou": nan}, {"iou": 0.5}, {}, {"iou": 0.7}, {"iou": 0.3}]
    outcomes = of_labels(rows, T=[3, 10, 5, 3, 10], seed=[0, 0, 0, 4, 4])
    (axes,) = bars(("iou", "IoU"))(outcomes).axes
    assert [label.get_text() for label in axes.get_yticklabels()][:3] == [
        "egg, T 3, seed 0", "egg, T 10, seed 0", "egg, T 5, seed 0"]  # fmt: skip
    assert [(text.get_text(), text.get_position()[1]) for text in axes.texts] == [(" NaN", 0), (" failed", 2)]
    assert [(bar.get_width(), bar.get_y() + 0.4) for bar in axes.patches] == [(0.5, 1), (0.7, 3), (0.3, 4)]
    figure = curves(("T", "T"), ("iou", "IoU"))(outcomes)
    lines = {line.get_label(): line.get_xydata().tolist() for line in figure.axes[0].lines}
    assert lines.keys() == {"egg, seed 0; NaN at 3", "egg, seed 4"} and lines["egg, seed 4"] == [[3, 0.7], [10, 0.3]]
    assert figure.get_supxlabel() == "failed: egg, T 5, seed 0"


def test_means_are_over_seeds_and_over_objects():
    outcomes = of_labels(
        [{"iou": value} for value in (0.1, 0.3, 0.6, 0.8)], object=["a", "a", "b", "b"], seed=[0, 1] * 2
    )
    rows = tables.means(dataclasses.replace(trial([]), mean_over="object"), outcomes)
    assert [(row["object"], row.get("seed"), row["iou"]) for row in rows] == [
        ("a", "mean of 2", pytest.approx(0.2)), ("b", "mean of 2", pytest.approx(0.7)),
        ("mean of 4", None, pytest.approx(0.45)),
    ]  # fmt: skip


def test_a_table_says_on_which_gpu(monkeypatch):
    assert "RTX" not in tables.markdown(trial([]), {"by": "by"}, [], "said")
    monkeypatch.setattr(machine, "device", lambda: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA RTX 1")
    assert "said; NVIDIA RTX 1, " in tables.markdown(trial([]), {"by": "by"}, [], "said")


def test_numbers_that_are_none_are_shown():
    run = Run("a", NO_DATA, {"capture": "egg", "seed": 0})
    other = dataclasses.replace(run, name="b", labels={"capture": "egg", "seed": 1})
    outcomes = [Outcome(run, Path(), [{"normal_mean": float("nan")}], ""), Outcome(other, failed="it | burst")]
    experiment = trial([run, other])
    rows = tables.table_of(experiment, outcomes)
    names = tables.headings(experiment, outcomes, rows)
    assert list(names.values()) == ["capture", "seed", "by", "normals °", "state"]
    text = tables.markdown(experiment, names, rows, "said")
    assert "| egg | 0 | ours | nan |  |" in text and "| egg | 1 | ours |  | failed: it / burst |" in text
    assert "| egg | mean of 1 of 2 | ours | nan |  |" in text and "| egg |  | somebody | 5.00 |  |" in text


def test_a_mean_is_of_numbers_that_all_have():
    run = Run("a", NO_DATA, {"capture": "egg", "seed": 0})
    other = dataclasses.replace(run, name="b", labels={"capture": "egg", "seed": 1})
    outcomes = [
        Outcome(run, Path(), [{"normal_mean": 1.0, "iou": 0.5}], ""),
        Outcome(other, Path(), [{"iou": 0.7}], ""),
    ]
    mean = tables.means(trial([run, other]), outcomes)
    assert mean == [{"capture": "egg", "seed": "mean of 2", "by": "ours", "state": "", "iou": pytest.approx(0.6)}]


# What is measured, and the captures.


def test_slices_are_those_of_equation_1():
    random = np.random.default_rng(1)
    material = {"diffuse": random.uniform(0.1, 0.5, (5, 3)), "specular": random.uniform(0.02, 0.2, 5),
                "roughness": random.uniform(0.2, 0.8, 5)}  # fmt: skip
    found = brdf_slices.brdf_slices(brdf_slices.bsdf_of(material), 5)
    cosine, r = np.cos(brdf_slices.ANGLES), material["roughness"][:, None]
    d = r**2 / (cosine**2 * (r**2 - 1) + 1) ** 2
    g = (2 / (1 + np.sqrt(1 + r**2 * np.tan(brdf_slices.ANGLES) ** 2))) ** 2
    gloss = material["specular"][:, None] * d * g / np.pi / cosine**2
    np.testing.assert_allclose(found, material["diffuse"][:, None] + gloss[..., None], rtol=1e-3)
    grey = brdf_slices.brdf_slices(load_material("diffuse reflectance=0.3,0.6,0.9", "--material", False), 1)
    np.testing.assert_allclose(grey, np.broadcast_to(np.array([0.3, 0.6, 0.9]) / np.pi, grey.shape), rtol=1e-5)


def test_errors_of_slices():
    truth, other = np.full((4, 2, 3), 0.2), np.full((4, 2, 3), 0.8)
    found = truth * np.array([1.1, 0.9, 1.3, 5.0])[:, None, None]
    row = measures.compare_slices(found, truth, other)
    assert row["slice_error"] == pytest.approx(20) and row["right_material"] == pytest.approx(75)
    assert "right_material" not in measures.compare_slices(found, truth, None)
    black = np.zeros_like(truth)  # as far as can be seen
    assert measures.compare_slices(black + 1e-4, black, None)["slice_error"] == pytest.approx(10)


def test_places_of_the_second_material_are_where_it_is_seen():
    ball = trimesh.creation.icosphere(subdivisions=3)
    config = SynthesizeConfig(Path(), Path(), "diffuse reflectance=0,0,0", "diffuse reflectance=1,1,1", bands=5)
    black, white = (load_material(str(m), "", False) for m in (config.material, config.second))
    pattern = pattern_of("stripes", np.asarray(ball.vertices), 5, 1, "")
    scene = mi.load_dict({"type": "scene", "ball": shape_of(ball, None, pattern.blend(black, white), pattern)})
    points = ball.triangles_center
    out = mi.Vector3f(*map(mi.Float, ball.face_normals.T))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(*map(mi.Float, points.T)) + out, -out))
    seen = np.array(si.bsdf().eval(mi.BSDFContext(), si, si.wi))[0] > 0.1
    found = brdf_slices.is_second_material(config, ball.bounds, points)
    assert np.array_equal(found, seen) and 0.3 < found.mean() < 0.7


def test_each_point_has_its_stripe_however_coarse_the_mesh_is():
    """A fit's points are beside the true surface, too, beyond its lowest and its highest."""
    bounds = np.array([[-3.0, 10.0, -1.0], [3.0, 16.0, 5.0]])
    config = SynthesizeConfig(Path(), Path(), second="diffuse", bands=6)
    heights = np.array([9.9, 10.4, 11.5, 12.9, 13.1, 14.6, 15.9, 16.2])
    points = np.stack([np.linspace(-4, 4, 8), heights, np.linspace(6, -2, 8)], 1)
    assert brdf_slices.is_second_material(config, bounds, points).tolist() == [
        k % 2 == 1 for k in (0, 0, 1, 2, 3, 4, 5, 5)
    ]


def test_errors_in_millimetres_are_those_of_two_spheres(known_capture, tmp_path, monkeypatch):
    """Concentric ones: between them it is 1.5 mm, along a ray that passes the middle at a distance b a little more."""
    monkeypatch.setattr(surfaces, "POINTS", 2000)
    monkeypatch.setattr(evaluation, "compare_photographs", lambda *_: ({}, [{}]))  # which are no lengths
    part = datasets.Subset.of(tmp_path / "part", datasets.given(known_capture), 3)
    part.prepare()
    part, scene = dataclasses.replace(part, truth=tmp_path / "truth"), part.scene
    radius, more, ball = 16.0, 1.5, trimesh.creation.icosphere(subdivisions=4)
    ring = FittedObject(CENTER, radius, scale=0.5, subdivisions=2)
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    (tmp_path / "log.jsonl").write_text('{"seconds": 7.0}\n')
    fitted = scenefile.fitted_scene_xml(scene, tmp_path, 2, '<bsdf type="cooktorrance"/>')
    (tmp_path / "scene.xml").write_bytes(fitted)
    (tmp_path / "truth").mkdir()
    for file, r in (("mesh.ply", radius + more), ("truth/mesh.ply", radius)):
        trimesh.Trimesh(CENTER + r * ball.vertices, ball.faces).export(tmp_path / file)
    (row,) = measures.in_millimetres(Run("ball", part, {}), tmp_path, ExperimentOptions())
    depths = []
    for shot in load_capture(scene, images=False).shots:
        camera = shot.camera
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in camera.size))
        rays = np.stack([(camera.centre[0] - x) / camera.focal[0], (camera.centre[1] - y) / camera.focal[1], x**0], -1)
        rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ camera.to_world[:3, :3].T
        middle = CENTER - camera.to_world[:3, 3]
        squared = middle @ middle - (rays @ middle) ** 2
        squared = squared[squared < radius**2]
        depths.append(np.sqrt((radius + more) ** 2 - squared) - np.sqrt(radius**2 - squared))
    assert row["chamfer_mm"] == pytest.approx(more, rel=0.01)
    assert row["depth_mm"] == pytest.approx(np.concatenate(depths).mean(), rel=0.01)


def test_photographs_from_one_side_are_where_the_truth_is(photographed_ball, tmp_path):
    file, middle, radius = photographed_ball
    scene = tmp_path / "captures/ball/scene.xml"
    dataset = single_view.SingleView.of(scene.parent, file)
    dataset.prepare()
    center, size = load_capture(scene).sphere()
    assert np.linalg.norm(center - middle) < 3 and size == pytest.approx(radius, rel=0.05)
    folder = tmp_path / "run"
    folder.mkdir()
    ball = trimesh.creation.icosphere(subdivisions=5)
    trimesh.Trimesh(middle + radius * ball.vertices, ball.faces).export(folder / "mesh.ply")
    (folder / "log.jsonl").write_text('{"seconds": 7.0}\n')
    (row,) = measures.single_view_normals(Run("ball", dataset, {}), folder, ExperimentOptions())
    assert row["normal_mean"] < 0.5 and row["missed"] < 2 and row["seconds"] == 7
    capture = load_capture(scene)
    seen, _, normals, _ = hits(load_true_mesh(folder / "mesh.ply")[1], capture.photograph(0))
    for k, observed in enumerate(capture.observe([0, 1, 2]).rgb.numpy()):
        light = Lights.of(capture.shots)[k]
        brightness = ALBEDO * light.rgb * np.maximum(normals @ -light.vector, 0)[:, None]  # by Lambert
        there = seen & (observed.reshape(-1, 3) > 0).any(1)
        assert there.sum() > 0.5 * seen.sum()
        np.testing.assert_allclose(observed.reshape(-1, 3)[there], brightness[there], atol=0.01)
    with pytest.raises(InputError, match="pixels_uint16: is of float64, must be of uint16"):
        np.savez(tmp_path / "float.npz", **{**np.load(file), "pixels_uint16": np.load(file)["pixels_uint16"] / 65535})
        dataclasses.replace(dataset, file=tmp_path / "float.npz").read()
    with pytest.raises(InputError, match=r"light_int: is of shape \(2, 3\), must be \(3, 3\) by mask and"):
        np.savez(file, **{**np.load(file), "light_int": np.ones((2, 3))})
        dataset.read()
    with pytest.raises(InputError, match="has no array light_dir of 2 dimensions"):
        np.savez(file, **{k: v for k, v in np.load(file).items() if k != "light_dir"})
        dataset.read()


def test_captures_of_one_name_have_folders_of_their_own(tmp_path):
    cups = [selection.path_traced(ExperimentOptions(), tmp_path / mesh, f"plastic roughness={roughness}")
            for mesh, roughness in (("a/cup.ply", 0.2), ("b/cup.ply", 0.2), ("a/cup.ply", 0.3))]  # fmt: skip
    assert {cup.name for cup in cups} == {"cup"} and len({cup.scene for cup in cups}) == 3


def test_parts_and_perturbed_captures_are_of_the_same_photographs(known_capture, tmp_path):
    egg = datasets.given(known_capture)
    whole = load_capture(egg.scene)

    def made(dataset):
        dataset.prepare()
        return dataset.scene

    part = datasets.Subset.of(tmp_path / "part", egg, 5)
    some = load_capture(made(part))
    assert [shot.name for shot in some.shots] == ["000", "003", "006", "008", "011"]
    assert part.truth == known_capture / "truth"
    torch.testing.assert_close(some.observe([1]).rgb, whole.observe([3]).rgb)
    before = part.scene.stat().st_ino
    assert made(part).stat().st_ino == before  # it is there already
    more = datasets.Subset.of(tmp_path / "part", egg, 6)
    assert len(load_capture(made(more))) == 6  # of the same name
    wrong = datasets.PerturbedCameras.of(tmp_path / "wrong", egg, 0.5, 0)
    other = load_capture(made(wrong))
    torch.testing.assert_close(other.observe([3]).rgb, whole.observe([3]).rgb)
    assert 0.4 < measures.rotation_error(egg.scene, other.path) < 1.4  # √3 · 0.5° but for chance
    assert measures.rotation_error(egg.scene, egg.scene) < 1e-3
    said = egg.scene.with_name("calibrated.xml")
    said.write_text(re.sub('(<sensor type="photograph"[^>]*>)', r'\1<boolean name="calibrated" value="true"/>',
                           egg.scene.read_text()))  # fmt: skip
    wrong = datasets.PerturbedCameras.of(tmp_path / "said", datasets.given(said), 0.5, 0)
    assert load_capture(said).known and not load_capture(made(wrong)).known
    said.unlink()


@dataclasses.dataclass(frozen=True)
class Slow(datasets.CachedDataset):
    """A capture that takes a while and comes to nothing."""

    events: list
    pause: Callable = lambda: time.sleep(0.3)

    def origin(self):
        self.events.append("begun")
        self.pause()
        self.events.append("done")
        raise InputError("there is\nnone")


def both_tried(first, second, out):
    """What has become of two runs that are made at the same time."""
    options = ExperimentOptions(preset="fast", quick=True)
    with ThreadPoolExecutor(2) as pool:
        return [*pool.map(lambda dataset: engine.try_run(Run("a", dataset, {}), options, out).failed, [first, second])]


def test_one_capture_is_made_in_turn_and_others_at_the_same_time(tmp_path, capsys):
    events = []
    two = [Slow.of(tmp_path / "cup", events) for _ in range(2)]
    assert both_tried(*two, tmp_path / "out") == ["there is none"] * 2
    assert events == ["begun", "done"] * 2
    assert "cup: another process writes it" in capsys.readouterr().out
    barrier = threading.Barrier(2, timeout=10)  # broken unless both get there
    two = [Slow.of(tmp_path / name, [], barrier.wait) for name in ("cup", "pot")]
    assert both_tried(*two, tmp_path / "out") == ["there is none"] * 2
    assert "waiting" not in capsys.readouterr().out


def test_captures_of_runs_that_are_not_wanted_are_not_made(tmp_path):
    options, events = ExperimentOptions(preset="fast", quick=True), []
    nowhere = datasets.Dataset("cup", tmp_path / "cup.xml", tmp_path / "truth")
    for dataset in (Slow.of(tmp_path / "cup", events), nowhere, datasets.Subset.of(tmp_path / "part", nowhere, 3)):
        outcome = engine.try_run(Run("a", dataset, {}), options, tmp_path / "out", wanted=False)
        assert outcome.failed == NOT_RUN and not events


def test_a_converted_capture_is_made_again_when_any_of_its_files_changes(tmp_path, monkeypatch):
    bear = tmp_path / "bearPNG"
    (bear / "view_01").mkdir(parents=True)
    names = "001.png", "mask.png", "light_directions.txt", "light_intensities.txt"
    names = "Calib_Results.mat", "mesh_Gt.ply", *(f"view_01/{name}" for name in names)
    for name in names:
        (bear / name).touch()
    written = []
    monkeypatch.setattr(datasets, "write_scene", lambda source: written.append(source.scene.write_text("<scene/>")))
    dataset = datasets.DiligentObject.of(tmp_path / "captures/bear", bear)
    for count, name in enumerate(names, 1):
        dataset.prepare()
        dataset.prepare()
        assert len(written) == count
        os.utime(bear / name, (count, count))


def test_captures_are_known_by_the_files_that_theirs_name(tmp_path):
    (tmp_path / "textures").mkdir()
    files = {
        "wood.xml": '<bsdf type="diffuse"><texture type="bitmap"><string name="filename" value="textures/wood.png"/>'
                    "</texture></bsdf>",
        "cup.obj": "mtllib cup.mtl\nv 0 0 0\n", "cup.mtl": "newmtl a\nmap_Kd cup.png\n", "cup.png": "", "other.png": "",
        "textures/wood.png": "",
    }  # fmt: skip
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    config, found = SynthesizeConfig(tmp_path / "cup.obj", Path(), str(tmp_path / "wood.xml")), []
    for name in ("other.png", "textures/wood.png", "cup.mtl", "cup.png"):
        (tmp_path / name).write_text(files[name] + "\n")
        found.append(settings_of(config)["digests"])
    mesh, material = ([digests[name] for digests in found] for name in ("mesh", "material"))
    assert material[0] != material[1] == material[2] and mesh[0] == mesh[1]
    assert len({*mesh}) == 3
