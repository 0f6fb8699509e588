"""Checkpoints: what goes on from one, and what is refused."""

import math

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import CENTER
from helpers.quick_fits import BRIEF, ITERATIONS, QUICK, SPHERE, TABLE

from mi_ring import fit
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import schedule, session
from mi_ring.fitting.checkpoint import FORMAT
from mi_ring.fitting.fit import Fit
from mi_ring.geometry import domain
from mi_ring.output import results
from mi_ring.system import cache, files, machine

#: Details take ten iterations, of which the last three are on a finer mesh. Then a texture is found.
DETAILED = [*SPHERE, "--no-indirect", "--refine", "power", "--lobes", "1", "--detail-share", "1.25"]


@pytest.mark.parametrize(("table", "start", "stop", "stage"), [
    (False, [*QUICK, "--no-indirect"], 4, 1), (True, SPHERE, 6, 1),
    (False, DETAILED, 15, 2),  # the last iteration of a stage
])  # fmt: skip
def test_deterministic_fits_are_equal_bit_by_bit_also_when_resumed(
    broken_capture, tmp_path, monkeypatch, table, start, stop, stage
):
    """Also with an empty cache folder, and with one that has the start surface of the other fit.

    One is interrupted after a room was solved for, and before that is done again.
    """
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(schedule, "EARLIEST", 2)
    small_capture, edit = broken_capture
    if table:
        edit("</scene>", TABLE)
    arguments = [str(small_capture), "--iterations", "8", "--deterministic", "--seed", "4", *start]
    assert fit.main([*arguments, "--out", str(tmp_path / "a")]) == 0
    domain.samplings.cache_clear()  # as in a process of its own

    interrupted = fit.parse_options([*arguments, "--out", str(tmp_path / "b")])
    with machine.threads_of(1):
        first = Fit(load_capture(small_capture), interrupted)
        results.prepare_folder(tmp_path / "b", small_capture, interrupted.settings())
        keeper = session.Keeper(first, tmp_path / "b", lambda: None)
        session.train(first, keeper, lambda: first.iteration == stop, None)
    assert stop < first.iterations and first.schedule.stage(stop - 1) is first.schedule.stages[stage]
    if start is DETAILED:
        assert first.schedule.stages[stage].last == stop and first.schedule.stages[stage + 1].detail
    assert fit.main([*arguments, "--out", str(tmp_path / "b"), "--resume"]) == 0

    rings = [torch.load(tmp_path / name / "ring.pt")["networks"] for name in ("a", "b")]
    assert all(torch.equal(rings[0][key], rings[1][key]) for key in rings[0])
    assert (tmp_path / "a" / "mesh.ply").read_bytes() == (tmp_path / "b" / "mesh.ply").read_bytes()
    logs = [[{**e, "seconds": 0} for e in results.read_log(tmp_path / name)] for name in ("a", "b")]
    assert logs[0] == logs[1]


def test_a_damaged_checkpoint_is_made_good_by_the_one_before(small_capture, tmp_path, monkeypatch, capsys):
    """As in a deterministic fit that nobody disturbed. What is damaged does not take the place of what is not."""
    quick = [*BRIEF, "--iterations", "6", "--deterministic"]
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


def test_resume_refuses_other_settings_and_missing_checkpoints(finished, small_capture, broken_capture, tmp_path):
    (broken_capture[0].parent / "images/007.png").unlink()  # nobody has looked for the photographs yet
    with pytest.raises(InputError, match="checkpoint.pt: no such file; run without --resume"):
        fit.main([str(broken_capture[0]), "--out", str(tmp_path), "--resume"])
    with pytest.raises(InputError, match="gone.xml: no such file"):
        fit.main([str(tmp_path / "gone.xml"), "--out", str(tmp_path), "--resume"])
    changed = f"--iterations: was {ITERATIONS} before, is 80 now; --batch: was 4 before, is 8 now, the default; give"
    with pytest.raises(InputError, match=f"{changed} the same"):
        fit.main(
            [str(small_capture), "--out", str(finished), "--resume", "--iterations", "80", *SPHERE, "--batch", "8"]
        )
    state = torch.load(finished / "checkpoint.pt", weights_only=False)
    files.write_state(state | {"format": state["format"] - 1}, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match=f"checkpoint of format {FORMAT - 1}, mi_ring .* goes on from {FORMAT}"):
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
    options = ["--out", str(tmp_path), "--resume", "--iterations", str(ITERATIONS), *SPHERE]
    with pytest.raises(InputError, match=r"checkpoint\.pt: holds no fit that could go on"):
        fit.main([str(small_capture), *options])


def test_resume_notices_files_that_changed(small_capture, broken_capture, tmp_path):
    path, edit = broken_capture
    trimesh.creation.icosphere(subdivisions=2, radius=30).apply_translation(CENTER).export(path.parent / "ball.ply")
    edit('<bsdf type="cooktorrance"/>', '<string name="domain" value="ball.ply"/><bsdf type="cooktorrance"/>')
    arguments = [str(path), "--out", str(tmp_path / "run"), "--iterations", "2", *BRIEF]
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
