"""Batches of fits: what becomes of each, whatever is killed."""

import dataclasses
import importlib.util
import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import psutil
import pytest
from helpers.quick_fits import BRIEF

from mi_ring import batch
from mi_ring.collection import fits
from mi_ring.collection.jobs import Job, Record, make_jobs
from mi_ring.errors import InputError
from mi_ring.output import results
from mi_ring.output.index import Entry, write_index
from mi_ring.system import command

OPTIONS = ["--iterations", "60", "--deterministic", *BRIEF]
needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None or sys.platform == "win32", reason="needs ray, an extra, and /proc"
)


class Script:
    """Stands for the process of a fit: does what the test says, one step for each time that it is begun."""

    def __init__(self, monkeypatch, *steps):
        self.steps, self.commands = list(steps), []
        monkeypatch.setattr(fits, "run", self)

    def __call__(self, command, job, tell):
        self.commands.append(command)
        status, iteration, complaint = self.steps.pop(0)
        job.folder.mkdir(parents=True, exist_ok=True)
        if iteration:
            (job.folder / "checkpoint.pt").write_bytes(b"")
            results.write_log(job.folder, [{"iteration": iteration, "unexplained": 0.1}])
        for name in ("ring.pt", "report.html") if status == 0 else ():
            (job.folder / name).write_text("")
        return status, complaint


@pytest.fixture
def job(small_capture, tmp_path):
    return Job(small_capture, tmp_path / "out/small", ("--seed", "3"))


def fitted(job, retries):
    return fits.fit_to_the_end(job, job.fingerprint(), retries)


KILLED = "was ended by SIGKILL"


def test_a_fit_that_dies_goes_on_from_its_checkpoint_and_gives_up_where_it_gets_no_further(job, monkeypatch):
    script = Script(monkeypatch, (-9, 0, KILLED), (-9, 5, KILLED), (143, 10, ""), (0, 60, ""))
    assert fitted(job, 1).state == "done"
    assert [("--resume" in command) for command in script.commands] == [False, False, True, True]
    script = Script(monkeypatch, *[(-9, 60, KILLED)] * 3)
    record = fitted(job, 2)
    assert (record.state, record.message, len(script.commands)) == ("failed", KILLED, 3)


def test_a_checkpoint_that_is_refused_is_not_gone_on_from(job, monkeypatch):
    script = Script(monkeypatch, (-9, 5, KILLED), (2, 0, "checkpoint.pt: is of format 3"), (0, 60, ""))
    assert fitted(job, 1).state == "done"
    assert [("--resume" in command) for command in script.commands] == [False, True, False]


@needs_ray
def test_a_disk_that_is_full_for_a_while_does_not_end_a_batch(job, monkeypatch):
    pages = Mock(side_effect=[None, InputError("index.html: cannot be written"), None, None])
    monkeypatch.setattr(batch, "write_index", pages)

    def fit_all(todo, resources, retries, look):
        for state in ("running", "done"):
            job.save(dataclasses.replace(job.record, state=state))
            look()

    monkeypatch.setattr(batch, "fit_all", fit_all)
    assert batch.main([str(job.scene), "--out", str(job.folder.parent)]) == 0
    assert pages.call_count == 4


@needs_ray
def test_an_interrupt_is_on_the_page_and_goes_on(job, monkeypatch, capsys):
    def fit_all(todo, resources, retries, look):
        job.save(dataclasses.replace(job.record, state="running", tries=9))
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise KeyboardInterrupt from None  # as Ray does while it waits

    monkeypatch.setattr(batch, "fit_all", fit_all)
    wrong = job.folder.parent.parent / "wrong.xml"
    wrong.write_text("<scene")
    arguments = [str(job.scene), str(wrong), "--out", str(job.folder.parent)]
    handler = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt) as stop:
        batch.main(arguments)
    assert command.exit_status(stop.value) == 128 + signal.SIGTERM and signal.getsignal(signal.SIGTERM) is handler
    said = capsys.readouterr()
    assert "wrong: failed: " in said.out and said.err.endswith("give the same command again\n")
    page = (job.folder.parent / "index.html").read_text()
    assert "1 interrupted" in page and "1 failed" in page and "running</" not in page and "refresh" not in page
    monkeypatch.setattr(batch, "fit_all", lambda todo, *_: Script(monkeypatch, (0, 60, "")) and fitted(job, 0))
    wrong.unlink()
    assert batch.main([arguments[0], *arguments[2:]]) == 0


def test_a_mistake_is_not_tried_again(job, monkeypatch):
    script = Script(monkeypatch, (2, 0, "small.xml: there is no such file"))
    record = fitted(job, 5)
    assert (record.state, record.message, len(script.commands)) == ("failed", "small.xml: there is no such file", 1)


def test_a_worker_that_is_killed_again_and_again_does_not_try_for_ever(job, monkeypatch):
    def dies(command, job, tell):
        raise KeyboardInterrupt  # as near to a death as a test can be

    monkeypatch.setattr(fits, "run", dies)
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            fitted(job, 2)
    assert fitted(job, 2).message == "was killed repeatedly"


def test_what_is_done_is_done_until_an_input_or_an_option_changes(broken_capture, tmp_path, monkeypatch):
    path, edit = broken_capture
    job = Job(path, tmp_path / "out/small", ("--seed", "3"))
    Script(monkeypatch, (0, 60, ""))
    fitted(job, 0)
    assert job.is_done(job.fingerprint()) and job.record.iteration == 60
    assert not job.is_done(Job(path, job.folder, ("--seed", "4")).fingerprint())
    mask = path.parent / "masks/003.png"
    before = mask.read_bytes()
    mask.write_bytes(before + b" ")
    assert not job.is_done(job.fingerprint())
    script = Script(monkeypatch, (2, 0, "masks/003.png: is wrong"))
    assert fitted(job, 0).state == "failed"
    assert "--resume" not in script.commands[0]  # anew, and from no checkpoint of another
    mask.write_bytes(before)
    assert job.is_done(job.fingerprint())  # as before: the fit that failed has not touched it
    (job.folder / "ring.pt").write_text("of another fit")
    assert not job.is_done(job.fingerprint())
    edit('<float name="fx" value="60.0"/>', '<float name="fx" value="60.5"/>')
    assert job.fingerprint() != job.record.fingerprint


def test_paths_in_options_are_those_of_where_the_batch_was_begun(small_capture, tmp_path, monkeypatch):
    """A worker of a cluster is elsewhere."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (job,) = make_jobs([small_capture], tmp_path / "out", ["--domain", "mesh", "ball.ply"])
    before = job.fingerprint()
    (tmp_path / "here/ball.ply").write_text("ply")
    monkeypatch.chdir(tmp_path)
    assert job.fingerprint() != before
    job.output.parent.mkdir(parents=True)
    assert fits.run([sys.executable, "-c", "print(open('ball.ply').read())"], job) == (0, "ply")


def test_what_a_fit_prints_is_told_while_it_goes_on(small_capture, tmp_path):
    (job,) = make_jobs([small_capture], tmp_path, [])
    job.output.parent.mkdir(parents=True)
    told = []

    def tell(line):
        told.append(line)
        (tmp_path / "heard").touch()  # for which the first line waits

    text = """import pathlib, time
print("one", "tw", sep=chr(13), end="", flush=True)
while not pathlib.Path("heard").exists():
    time.sleep(.01)
print("o")"""
    job = dataclasses.replace(job, cwd=tmp_path)
    assert fits.run([sys.executable, "-c", text], job, tell) == (0, "two") and told == ["one", "two"]


def test_a_fit_ends_with_who_waits_for_it(small_capture, tmp_path):
    (job,) = make_jobs([small_capture], tmp_path, [])
    job.output.parent.mkdir(parents=True)

    def tell(line):
        raise KeyboardInterrupt(line)

    text = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    with pytest.raises(KeyboardInterrupt) as stop:
        fits.run([sys.executable, "-c", text], job, tell)
    with pytest.raises(ProcessLookupError):
        os.kill(int(str(stop.value)), 0)


def test_scenes_of_the_same_name_are_refused(small_capture, broken_capture, tmp_path):
    with pytest.raises(InputError, match=r"small\.xml: is given twice"):
        make_jobs([small_capture, small_capture], tmp_path, [])
    with pytest.raises(InputError, match=r"small\.xml: its results would go to .*small, as do those of .*small\.xml"):
        make_jobs([small_capture, broken_capture[0]], tmp_path, [])


@pytest.mark.parametrize(("arguments", "words"), [
    (["a.xml", "--workers", "0"], "--workers: is 0, must be 1 or more"),
    (["a.xml", "--", "--out", "there"], "--out: is set by the batch; leave it out"),
    (["a.xml", "--", "--iteration", "3"], "options of fits, after --: Unrecognized options: --iteration, 3; perhaps"),
    (["a.xml", "--preset", "fast"], "Unrecognized options: --preset, fast; options of fits come after --, as in"),
    (["a.xml", "--", "--minutes", "-1"], "--minutes: is -1.0, must be 0 to 10000"),
    ([], "is missing"),
])  # fmt: skip
def test_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(batch, "make_jobs", lambda scenes, *_: [Job(scene, tmp_path) for scene in scenes])
    with pytest.raises(InputError, match=re.escape(words)):
        batch.main(arguments)
    assert not list(tmp_path.iterdir())


def test_the_page_shows_pictures_and_figures_of_reports_and_runs_no_script(tmp_path):
    folder = tmp_path / "a & <script>alert(1)"
    folder.mkdir()
    pixel = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
    (folder / "report.html").write_text(
        "<tr><th>PSNR of the photographs</th><td>31.25 dB (sRGB, all pixels, 4 samples each)</td></tr>"
        f'<img class="over" src="data:image/png;base64,{pixel}" alt="prediction x">'
    )
    results.write_log(folder, [{"iteration": 5, "unexplained": 0.0731}])
    (tmp_path / "batch").mkdir()
    (tmp_path / "batch/b#.txt").write_text("what it has printed")
    entries = [Entry(folder.name, "done", "", folder, tmp_path / "batch/a.txt"),
               Entry("b#", "failed", "b.xml: <b>wrong</b>", tmp_path / "b#", tmp_path / "batch/b#.txt")]  # fmt: skip
    write_index(tmp_path, entries, False)
    page = (tmp_path / "index.html").read_text()
    assert "<td>31.25 dB</td>" in page and "<td>7.3%</td>" in page and "data:image/jpeg;base64," in page
    assert "<script" not in page and "&lt;b&gt;wrong" in page and "1 done" in page and "1 failed" in page
    assert 'href="a%20%26%20%3Cscript%3Ealert%281%29/report.html"' in page
    assert 'href="batch/b%23.txt">failed</a>' in page and ">done</td>" in page  # which has printed nothing


@pytest.mark.slow
@needs_ray
def test_fits_go_on_when_their_processes_and_workers_are_killed(small_capture, tmp_path, monkeypatch, capsys):
    """One scene whose fit is killed, then its worker of Ray; one that is wrong and stops nothing."""
    monkeypatch.setenv("PYTHONPATH", str(Path(batch.__file__).parents[1]))
    shutil.copytree(small_capture.parent, tmp_path / "captures")
    scene = tmp_path / "captures/small.xml"
    wrong = scene.with_name("wrong.xml")
    text = scene.read_text()
    damaged = scene.with_name("damaged.png")
    content = bytearray((scene.parent / "images/003.png").read_bytes())
    content[len(content) // 2] ^= 255  # its header says nothing of it
    damaged.write_bytes(content)
    wrong.write_text(text.replace("images/003.png", "damaged.png"))
    out, killed = tmp_path / "out", []

    def kill(whom):
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline:
            running = psutil.process_iter(["cmdline"]) if (out / "small/checkpoint.pt").exists() else ()
            own = [p for p in running if str(out / "small") in "\0".join(p.info["cmdline"] or [])]
            if own:
                {"fit": own[0], "worker": own[0].parent()}[whom].kill()
                killed.append(whom)
                own[0].wait(deadline - time.monotonic())  # it dies with its worker
                return
            time.sleep(0.05)

    assassin = threading.Thread(target=lambda: [kill("fit"), kill("worker")])
    assassin.start()
    status = batch.main([str(scene), str(wrong), "--out", str(out), "--workers", "1", "--cpus", "1", "--", *OPTIONS])
    assassin.join()
    said = capsys.readouterr().out
    assert killed == ["fit", "worker"] and status == 1, said
    assert said.count("small: died; continues at or shortly before iteration ") == 2
    assert "1 of 2 done, not wrong" in said and re.search(r"wrong: failed: .*damaged\.png", said)
    records = {name: Record(**json.loads((out / f"batch/{name}.json").read_text())) for name in ("small", "wrong")}
    assert records["small"].state == "done" and results.read_log(out / "small")[-1]["iteration"] == 60
    assert (out / "small/report.html").is_file()
    assert (out / "batch/small.txt").read_text().count("--resume") == 2
    wrong.unlink()
    assert batch.main([str(scene), "--out", str(out), "--", *OPTIONS]) == 0  # at once, and without Ray
    assert "1 of 1 are done already" in capsys.readouterr().out
