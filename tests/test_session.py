"""A fit and its folder, whatever interrupts it: signals, full disks, folders that are removed or taken."""

import json
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
from unittest.mock import Mock

import pytest
from helpers.quick_fits import BRIEF, FILES, distance

from mi_ring import fit, render
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import session
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.objects.ring_file import load_fit
from mi_ring.output import results
from mi_ring.system import files

TINY = {"iterations": 2, "levels": (1,), "widths": (28,), "shares": (1,), "subdivisions": 2, "domain": "sphere"}


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


@pytest.mark.parametrize(
    ("moment", "number"),
    [("write_inputs", signal.SIGINT), ("write_inputs", signal.SIGTERM), ("write", signal.SIGINT)],
)
def test_signals_outside_the_loop_lose_nothing(moment, number, small_capture, tmp_path, monkeypatch, capsys):
    genuine = getattr(results, moment)

    def interrupted(*arguments):
        signal.raise_signal(number)
        genuine(*arguments)

    monkeypatch.setattr(results, moment, interrupted)
    status = fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "2", *BRIEF])
    never = {"checkpoint.before.pt"} if moment == "write_inputs" else set()  # before the first iteration
    assert {p.name for p in (tmp_path / "run").iterdir()} == set(FILES) - never
    assert status == (128 + number if moment == "write_inputs" else 0)  # at the end there is nothing left to resume
    assert ("--resume" in capsys.readouterr().out) == (status != 0)


def test_the_second_ctrl_c_says_how_to_go_on(small_capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(results, "write", lambda *_: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    with pytest.raises(KeyboardInterrupt):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "2", *BRIEF])
    assert capsys.readouterr().out.endswith("has a checkpoint: go on with the same command and --resume\n")


def test_a_photograph_that_changes_during_the_fit_is_named(small_capture, tmp_path, monkeypatch, capsys):
    scene = Path(shutil.copytree(small_capture.parent, tmp_path / "capture")) / small_capture.name
    photograph = sorted(scene.parent.glob("images/*"))[0]
    monkeypatch.setattr(results, "write_log", lambda *_: photograph.write_bytes(photograph.read_bytes() + b"0"))
    monkeypatch.setattr(results, "write", lambda *_: None)
    fit.main([str(scene), "--out", str(tmp_path / "run"), "--iterations", "2", *BRIEF])
    assert f"images/{photograph.name}: changed while the fit ran" in capsys.readouterr().out


@pytest.mark.skipif(os.name != "posix", reason="Windows has other signals")
def test_the_signal_of_a_terminal_that_closes_loses_nothing(small_capture, tmp_path, begun):
    """However often they come; nor does a reader of the output that is gone, of which nobody hears then."""
    folder, end = tmp_path / "run", signal.SIGHUP
    options = ["--out", str(folder), "--iterations", "900", *BRIEF]
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
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "10", *BRIEF]) == 0
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
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "10", *BRIEF]) == 0
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
        fit.main([str(small_capture), "--out", str(folder), "--iterations", "2", *BRIEF])
    (elsewhere,) = tmp_path.glob("mi_ring-run-*/run")
    assert str(told.value) == f"{folder}/ring.pt: cannot be written (as if); the results are in {elsewhere} instead"
    assert {p.name for p in elsewhere.iterdir()} == set(FILES) - {"inputs.png", "checkpoint.before.pt"}
    assert load_fit(elsewhere)

    # Nor does what is left depend on the scene, which may have been on the same drive, nor on the report.
    running = Fit(load_capture(small_capture), Config(**TINY))
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


def test_a_photograph_that_is_damaged_before_the_report_is_written(small_capture, tmp_path, monkeypatch):
    """What is in the folder stays there, and the user is told to restore the file."""
    running, folder = Fit(load_capture(small_capture), Config(**TINY)), tmp_path / "run"
    keeper = session.Keeper(running, folder, lambda: None)
    damaged = InputError(f"{small_capture.parent}/images/003.png: filename: is truncated; copy it again")
    monkeypatch.setattr(results, "write", Mock(side_effect=damaged))
    monkeypatch.setattr(keeper, "rescue", Mock())
    with pytest.raises(InputError, match=r"003\.png: filename: is truncated; .*run has what could be written"):
        keeper.finish(b"")
    assert not keeper.rescue.called


def test_a_fit_says_why_it_has_no_details(small_capture):
    def reason(count=12, **settings):
        fit = Fit(load_capture(small_capture).part(range(count)), Config(**{**TINY, "detail": "both", **settings}))
        return session.details_missing(fit)

    assert "need 4 photographs" in reason(3, detail_share=20.0)
    assert "iterations are too few" in reason(detail_share=0.1)
    assert reason(detail_share=20.0) == reason(detail="none") == ""


def test_ctrl_c_leaves_a_usable_folder_and_resume_finishes(small_capture, tmp_path, begun):
    folder = tmp_path / "run"
    options = ["--out", str(folder), "--iterations", "40", *BRIEF]
    process = begun([sys.executable, "-m", "mi_ring.fit", str(small_capture), *options], folder)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130, output
    assert "--resume" in output and "Traceback" not in output
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    stopped = results.read_log(folder)[-1]["iteration"]
    assert stopped < 40

    assert fit.main([str(small_capture), *options, "--resume"]) == 0
    assert [e["iteration"] for e in results.read_log(folder)][-1] == 40
    assert distance(folder / "mesh.ply") < 0.05


def test_results_never_go_onto_the_scene_itself(finished, broken_capture):
    path, _ = broken_capture
    before = path.read_bytes()
    with pytest.raises(InputError, match="holds the scene file"):
        fit.main([str(path), "--out", str(path.parent), "--iterations", "1", *BRIEF])
    with pytest.raises(InputError, match="own photographs"):
        render.main([str(finished), str(path), str(path.parent / "images")])
    assert path.read_bytes() == before


def test_a_second_fit_moves_the_first_result_aside(finished, small_capture, tmp_path):
    folder = tmp_path / "small"
    shutil.copytree(finished, folder)
    assert fit.main([str(small_capture), "--out", str(folder), "--iterations", "2", *BRIEF]) == 0
    before, aside, now = ((place / "mesh.ply").read_bytes() for place in (finished, tmp_path / "small.1", folder))
    assert aside == before != now


def test_an_output_folder_that_is_a_file_is_one_line(small_capture, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out: cannot be written"):
        fit.main([str(small_capture), "--out", str(tmp_path / "file" / "run"), "--iterations", "1", *BRIEF])


def test_scenes_of_the_same_name_do_not_share_a_folder_by_default(small_capture, broken_capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = ["--iterations", "1", *BRIEF]
    assert fit.main([str(small_capture), *quick]) == 0
    assert fit.main([str(small_capture), *quick]) == 0  # the same scene: the first result is moved aside
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["small", "small.1"]
    with pytest.raises(InputError, match="out/small: holds the results of another scene, .*small.xml; give another"):
        fit.main([str(broken_capture[0]), *quick])
    assert fit.main([str(broken_capture[0]), "--out", "out/mine", *quick]) == 0


def test_two_fits_into_one_folder_are_refused(small_capture, tmp_path):
    with (
        files.locked(tmp_path / "run"),
        pytest.raises(InputError, match="run: --out: another process is writing there"),
    ):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "1", *BRIEF])
    assert not (tmp_path / "run").exists()
