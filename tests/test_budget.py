"""Which fit a given time allows."""

import json
import math
import re
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from mi_ring import fit as command
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import budget
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.lighting import Lighting
from mi_ring.fitting.schedule import Schedule, Stage
from mi_ring.output.results import read_log
from mi_ring.system.machine import threads_of

COSTS = {(4, 128): 0.25, (5, 256): 1.0, (6, 512): 4.0}
CHOICE = [Config.preset(name) for name in ("fast", "default", "fine")]


def test_seconds_are_those_of_the_stages():
    """Of 100 iterations from a sphere 60 are at level 4 and 40 at level 5; what is around them takes 40 of these."""
    config = Config(iterations=100, levels=(4, 5), widths=(128, 256), shares=(0.6, 0.4))
    assert budget.seconds_of(config, Schedule.of, COSTS) == pytest.approx(60 * 0.25 + 80 * 1.0)
    # From a hull two thirds of the first 60 are exchanged for 40 % as many of the second: 20 and 56.
    assert budget.seconds_of(config, partial(Schedule.of, near=True), COSTS) == pytest.approx(20 * 0.25 + 96 * 1.0)


@pytest.mark.parametrize("near, settling", [(False, False), (True, False), (True, True)])
def test_the_time_is_used_and_kept_to_and_more_of_it_means_a_finer_preset(near, settling):
    plan = partial(Schedule.of, near=near, settling=settling)
    subdivisions, iterations = [], []
    for seconds in (60, 100, 150, 300, 900, 3000, 9000):
        config = budget.fitting_into(seconds, CHOICE, plan, COSTS)
        taken = budget.seconds_of(config, plan, COSTS)
        assert taken <= 1.05 * seconds and taken > 0.9 * seconds
        subdivisions.append(len(config.levels))
        iterations.append((config.levels[-1], config.shares[-1], config.iterations))
    assert subdivisions == sorted(subdivisions) and subdivisions[0] == 2 and subdivisions[-1] == 3
    assert iterations == sorted(iterations) and len(set(iterations)) == len(iterations)


def test_there_is_a_least_number_of_iterations():
    assert budget.fitting_into(0.1, CHOICE, Schedule.of, COSTS).iterations == budget.FEWEST


def test_measuring_changes_nothing_of_the_fit(small_capture):
    """With it or without, a deterministic fit has the same weights after some iterations."""
    config = Config(iterations=4, levels=(2,), widths=(28,), shares=(1,), domain="sphere", deterministic=True)
    weights = []
    for measured in (True, False):
        capture = load_capture(small_capture)
        with threads_of(1):
            fit = Fit(capture, config)
            if measured:
                costs = budget.measure(fit, [Stage(2, 28, 0, 1), Stage(3, 56, 1, 2)])
                assert costs.keys() == {(2, 28), (3, 56)} and all(0 < s < math.inf for s in costs.values())
            for _ in range(3):
                fit.step()
        assert fit.iteration == 3 and fit.course.log == []
        weights.append(list(fit.ring.parameters()))
    assert all(map(torch.equal, *weights))


def test_what_settles_is_timed_like_what_shapes(small_capture, monkeypatch):
    """Both have the same level and width; the former takes less."""
    config = Config(iterations=4, levels=(2,), widths=(28,), shares=(1,), domain="sphere")
    fit, timed = Fit(load_capture(small_capture), config, lighting=Lighting("environment")), []
    step = Fit.step
    monkeypatch.setattr(Fit, "step", lambda trial: timed.append(step(trial).stage.settles))
    assert fit.schedule.stages[-1].settles
    budget.measure(fit, budget.all_stages(fit, [config]))
    assert timed and not any(timed)


def test_an_iteration_is_timed_twice_on_the_same_photographs(small_capture, monkeypatch):
    """The second time they are decoded already. An interrupt comes between two."""
    config = Config(iterations=4, levels=(2,), widths=(28,), shares=(1,), domain="sphere", batch=4)
    fit, seen = Fit(load_capture(small_capture), config), []
    step = Fit.step
    monkeypatch.setattr(Fit, "step", lambda trial: seen.append(tuple(step(trial).batch.photographs)))
    budget.measure(fit, [Stage(2, 28, 0, 1)])
    assert len(seen) == 2 and seen[0] == seen[1] and len(set(seen[0])) == 4
    assert budget.measure(fit, [Stage(2, 28, 0, 1)], interrupted=lambda: len(seen) == 3) == {} and len(seen) == 3


SMALL = ["--levels", "2", "--widths", "28", "--shares", "1", "--subdivisions", "2", "--domain", "sphere",
         "--refine", "none", "--no-indirect", "--detail", "none", "--lobes", "1"]  # fmt: skip


def test_a_fit_of_so_many_minutes_goes_on_as_one(small_capture, tmp_path, monkeypatch, capsys):
    """At 2.5 s an iteration 20 of 60 s are for pictures and results, and 16 iterations are left."""
    monkeypatch.setattr(command, "measure", lambda fit, stages: {(2, 28): 2.5})
    monkeypatch.setattr(budget, "FEWEST", 8)
    monkeypatch.setattr(budget, "AROUND", 8)
    monkeypatch.setattr(command, "time", SimpleNamespace(monotonic=lambda: 0.0, perf_counter=lambda: 0.0))
    call = [str(small_capture), "--out", str(tmp_path / "run"), *SMALL, "--minutes", "1"]
    with pytest.raises(InputError, match="is 0.5, too few for a fit of this capture on this machine; give 0.8 or more"):
        command.main([*call[:-1], "0.5"])  # 8 iterations, and what takes as long: 40 s, and a fifth more
    assert command.main(call) == 0
    options = json.loads((tmp_path / "run/config.json").read_text())
    assert options["iterations"] == 16 and options["minutes"] == 1
    assert read_log(tmp_path / "run")[-1]["iteration"] == options["iterations"]
    assert f"--preset {options['preset']} --iterations {options['iterations']}" in capsys.readouterr().out
    assert command.main([*call, "--resume"]) == 0
    for strange in ("4", None, [1]):
        (tmp_path / "run/config.json").write_text(json.dumps(options | {"minutes": strange}))
        with pytest.raises(InputError, match="--minutes: was 4 before|--(preset|iterations): was"):
            command.main([*call, "--resume"])
    (tmp_path / "run/config.json").write_text(json.dumps(options))
    with pytest.raises(InputError, match="--minutes: was 1 before, is 2 now"):
        command.main([*call[:-1], "2", "--resume"])
    with pytest.raises(InputError, match="--minutes: was 1 before, is not given now"):
        command.main([*call[:-2], "--resume"])
    (tmp_path / "run/config.json").write_text(json.dumps(options | {"minutes": 0}))
    with pytest.raises(InputError, match="--minutes: was not given before, is 1 now"):
        command.main([*call, "--resume"])
    (tmp_path / "run/config.json").write_text(json.dumps(options))
    with pytest.raises(InputError, match="--batch: was 8 before, is 3 now"):
        command.main([*call, "--resume", "--batch", "3"])


def test_presets_that_do_not_go_with_the_other_options_are_no_choice(small_capture):
    arguments = [str(small_capture), "--minutes", "5", "--shares", "1", "1", "1"]  # fast has two stages
    choice = command.choice_of(command.parse_options(arguments), arguments)
    assert [c.preset for c in choice] == ["default", "fine"]


@pytest.mark.parametrize(("options", "complaint"), [
    (["--minutes", "-1"], "--minutes: is -1.0, must be 0 to 10000"),
    (["--minutes", "1e307"], "--minutes: is 1e+307, must be 0 to 10000"),
    (["--threads", "20000"], "--threads: is 20000, must be 0 to 1024"),
    (["--minutes", "1", "--deterministic"], "--deterministic: does not go with --minutes"),
    (["--minutes", "1", "--iterations", "9"], "--minutes: chooses --iterations; give one of the two"),
    (["--minutes", "0.001"], "--minutes: is 0.001, but the start alone has taken "),
])  # fmt: skip
def test_mistakes_are_told(small_capture, tmp_path, options, complaint):
    with pytest.raises(InputError, match=re.escape(complaint)):
        command.main([str(small_capture), "--out", str(tmp_path / "run"), *SMALL, *options])
    assert not (tmp_path / "run").exists()
