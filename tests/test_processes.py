"""A fit by two processes against the same fit by one."""

import os
import subprocess
import sys

import pytest
import torch
import trimesh
from helpers.quick_fits import TABLE

from mi_ring import fit
from mi_ring.fitting.processes import ALONE, Processes, Share
from mi_ring.objects.ring_file import load_fit
from mi_ring.output import results
from mi_ring.system.files import is_sealed

pytestmark = pytest.mark.skipif(not torch.distributed.is_gloo_available(), reason="PyTorch is built without gloo")

#: A step of a fit by both processes, and of the same fit by the first alone; then the command, in which the second
#: process is killed, in the second stage for details.
CODE = """
import os, signal, sys
from pathlib import Path
import torch
import mi_ring
from mi_ring import fit as command
from mi_ring.fitting import processes
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.renderer import Renderer
from mi_ring.system.machine import threads_of

folder, scene = sys.argv[1:3]
refine = ("cameras", "light", "power", "falloff", "ambient")
small = {"levels": (2,), "widths": (28,), "shares": (1.0,), "domain": "sphere", "refine": refine,
         "precision": "float32"}

def step(fit):
    found, optimisation, calibration = {}, fit.optimisation, fit.model.calibration
    parts = {"shape": fit.ring.shape_net, "brdf": fit.ring.brdf_net, "calibration": calibration}
    backward = optimisation.backward

    def noting(loss, it):  # before the gradients are clipped
        total = backward(loss, it)
        found.update({name: torch.cat([p.grad.flatten() for p in part.parameters() if p.grad is not None])
                      for name, part in parts.items()})
        return total

    optimisation.backward = noting
    fit.course.iteration = next(k for k in reversed(range(fit.iterations)) if fit.schedule.joint_due(k))
    it = fit.step()
    exposure, brightness, pose = optimisation.solvers
    found |= {"powers": exposure.measured, "curvature": pose.seen[1], "brightness": brightness.moments,
              "room": calibration.room.harmonics, "loss": torch.tensor(it.loss),
              "terms": torch.tensor([it.terms.get(name, 0.0) for name in fit.loss.terms]),
              "unexplained": torch.tensor(it.unexplained()),
              "averages": torch.stack([picture for _, picture in fit.renderer.averages.values()]),
              "stepped": torch.cat([p.detach().flatten() for p in fit.model.parameters()])}
    return found

capture = mi_ring.load_capture(scene)
configs = [mi_ring.Config(batch=batch, **small) for batch in (5, 1)]  # of one photograph one process has nothing
with threads_of(1):
    alone = [Fit(capture, config) for config in configs]
    with processes.joined() as team:
        assert team.count == 2
        for config, single in zip(configs, alone):
            found = step(Fit(capture, config))
            if team.rank == 0:
                torch.save([found, step(single)], f"{folder}/batch{config.batch}.pt")

try:
    command.main([scene, "--iterations", "0"])
except (mi_ring.InputError, SystemExit) as error:
    Path(folder, f"mistake{os.environ['RANK']}.txt").write_text(repr(error))

predict = Renderer.predict
def killed(renderer, problem, model, batch):
    if batch.number == 16 and os.environ["RANK"] == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    return predict(renderer, problem, model, batch)
Renderer.predict = killed
sys.exit(command.main(sys.argv[3:]))
"""
QUICK = ["--levels", "2", "3", "--widths", "28", "56", "--shares", "0.6", "0.4", "--subdivisions", "3", "--batch", "5",
         "--iterations", "8", "--deterministic", "--domain", "sphere",
         "--precision", "float32", "--no-indirect", "--detail-share", "1.25"]  # fmt: skip


def torchrun(*arguments):
    """Two processes; nothing of what they print is lost."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *arguments]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, env=environment, timeout=300)


@pytest.fixture(scope="module")
def folder(small_capture, tmp_path_factory):
    """Where the script has left its numbers, a run that was ended by the loss of a process, and one by one process."""
    folder = tmp_path_factory.mktemp("processes")
    (folder / "two.py").write_text(CODE)
    scene = small_capture.parent / "some_masks.xml"
    text = small_capture.read_text().replace("</scene>", TABLE)
    for k in (1, 2, 4, 7, 8):
        text = text.replace(f'<string name="mask" value="masks/{k:03}.png"/>', "")
    scene.write_text(text)
    options = [small_capture, "--out", folder / "two", *QUICK]
    done = torchrun(folder / "two.py", folder, scene, *options)
    assert done.returncode == 1 and "SIGKILL" in done.stderr, done.stderr
    assert fit.main([str(small_capture), "--out", str(folder / "one"), *QUICK]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("batch", [5, 1])
def test_gradients_of_a_step_are_those_of_one_process(folder, batch):
    shared, alone = torch.load(folder / f"batch{batch}.pt")
    assert shared.keys() == alone.keys() and float(alone["curvature"].norm()) > 0
    for name, value in alone.items():
        assert shared[name].shape == value.shape
        assert float((shared[name] - value).norm()) <= 1e-5 * float(value.norm()), name


@pytest.mark.slow
def test_a_lost_process_ends_the_fit_with_its_checkpoint_whole_which_goes_on_to_the_same_result(folder, small_capture):
    run, one = folder / "two", folder / "one"
    for name in ("checkpoint.pt", "checkpoint.before.pt"):
        assert is_sealed((run / name).read_bytes())
    assert not (run / "ring.pt").exists()
    done = torchrun("-m", "mi_ring.fit", small_capture, "--out", run, *QUICK, "--resume")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("12 photographs; results go to") == 1  # the others are silent
    vertices, expected = (trimesh.load(path / "mesh.ply", process=False).vertices for path in (run, one))
    assert abs(vertices - expected).max() < 1e-4 * expected.std(0).max()  # measured: 1e-6
    logs = [results.read_log(path) for path in (run, one)]
    assert [entry["iteration"] for entry in logs[0]] == [entry["iteration"] for entry in logs[1]] == [5, 10, 15, 18]
    for ours, theirs in zip(*logs):
        assert ours["loss"] == pytest.approx(theirs["loss"], rel=1e-5)
    found, alone = (load_fit(path).state_dict() for path in (run, one))
    details = [name for name in alone if ".grid.values" in name]
    assert found.keys() == alone.keys() and len(details) == 9  # of the flow, of the material, and a texture
    for name in details:
        assert float((found[name] - alone[name]).norm()) <= 1e-3 * float(alone[name].norm()) > 0, name  # measured: 8e-5


class Two(Processes):
    """The second of three, for shares alone."""

    count, rank = 3, 1


@pytest.mark.parametrize(("total", "part", "weight"), [
    (8, (2, 5), 3 / 8), (3, (1, 2), 1 / 3), (2, (0, 1), 0.5), (1, (0, 1), 0),
])  # fmt: skip
def test_shares_are_alike(total, part, weight):
    share = Share(Two(), total)
    assert (share.part.start, share.part.stop) == part and share.weight == pytest.approx(weight)


def test_one_process_has_all_and_exchanges_nothing():
    share, tensor = ALONE.share(7), torch.arange(7.0)
    assert share.part == slice(0, 7) and share.weight == 1
    assert share.sum(tensor) is tensor and share.gathered(tensor) is tensor and ALONE.exchanged == 0


@pytest.mark.slow
def test_mistakes_are_told_once(folder):
    first, second = ((folder / f"mistake{k}.txt").read_text() for k in (0, 1))
    assert first == "InputError('--iterations: is 0, must be 1 to 1,000,000')" and second == "SystemExit(2)"
