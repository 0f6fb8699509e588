"""Which fit a given time allows."""

import math

import pytest
import torch

from mi_ring import fit as command
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import budget
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.schedule import Stage

COSTS = {(4, 128): 0.25, (5, 256): 1.0, (6, 512): 4.0}
CHOICE = [Config.preset(name) for name in ("fast", "default", "fine")]


def test_seconds_are_those_of_the_stages():
    """Of 100 iterations from a sphere 60 are at level 4 and 40 at level 5."""
    config = Config(iterations=100, levels=(4, 5), widths=(128, 256), shares=(0.6, 0.4))
    assert budget.seconds_of(config, False, COSTS) == pytest.approx(60 * 0.25 + 40 * 1.0)
    # From a hull two thirds of the first 60 are exchanged for 40 % as many of the second: 20 and 56.
    assert budget.seconds_of(config, True, COSTS) == pytest.approx(20 * 0.25 + 56 * 1.0)


@pytest.mark.parametrize("near", [False, True])
def test_the_time_is_used_and_kept_to_and_more_of_it_means_a_finer_preset(near):
    subdivisions, iterations = [], []
    for seconds in (20, 60, 150, 300, 900, 3000, 9000):
        config = budget.fitting_into(seconds, CHOICE, near, COSTS)
        taken = budget.seconds_of(config, near, COSTS)
        assert taken <= 1.05 * seconds and taken > 0.9 * seconds
        subdivisions.append(len(config.levels))
        iterations.append((config.levels[-1], config.shares[-1], config.iterations))
    assert subdivisions == sorted(subdivisions) and subdivisions[0] == 2 and subdivisions[-1] == 3
    assert iterations == sorted(iterations) and len(set(iterations)) == len(iterations)


def test_there_is_a_least_number_of_iterations():
    assert budget.fitting_into(0.1, CHOICE, False, COSTS).iterations == budget.FEWEST


def test_measuring_changes_nothing_of_the_fit(small_capture):
    """The same random numbers, weights and log afterwards, and what was asked for is measured."""
    config = Config(iterations=2, levels=(2,), widths=(28,), shares=(1,), domain="sphere", refine=("power",))
    fit = Fit(load_capture(small_capture), config)
    before, weights = fit.state(), [p.detach().clone() for p in fit.ring.parameters()]
    costs = budget.measure(fit, [Stage(2, 28, 0, 1), Stage(3, 56, 1, 2)])
    after = fit.state()
    assert costs.keys() == {(2, 28), (3, 56)} and all(0 < s < math.inf for s in costs.values())
    assert (before["random"] == after["random"]).all() and after["iteration"] == 0 and after["log"] == []
    assert all(map(torch.equal, weights, fit.ring.parameters()))


@pytest.mark.parametrize(("options", "complaint"), [
    (["--minutes", "-1"], "--minutes: is -1.0, must be 0 or more"),
    (["--minutes", "1", "--deterministic"], "--deterministic: does not go with --minutes"),
    (["--minutes", "1", "--iterations", "9"], "--minutes: chooses --iterations; give one of the two"),
    (["--minutes", "0.01"], "of which start and results of this capture take all; give "),
])  # fmt: skip
def test_mistakes_are_told(small_capture, tmp_path, options, complaint):
    with pytest.raises(InputError, match=complaint.replace(".", r"\.")):
        command.main([str(small_capture), "--out", str(tmp_path / "run"), "--domain", "sphere", *options])
    assert not (tmp_path / "run").exists()
