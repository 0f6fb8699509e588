"""Optimisers that evaluate the loss again within a step."""

import pytest
import torch
from helpers.quick_fits import TABLE

import mi_ring
from mi_ring.fitting import optimisation
from mi_ring.fitting.schedule import Rate, Stepper


def lbfgs(networks, config, device):
    """As a user would write it in `network_steppers`."""
    optimizer = torch.optim.LBFGS(networks.parameters(), max_iter=3, line_search_fn="strong_wolfe")
    return [Stepper(optimizer, [Rate(1.0, 1.0)], evaluates=True)]


@pytest.fixture
def fit(broken_capture, monkeypatch):
    """By L-BFGS, with averaged interreflection, solved room light and refined cameras."""
    path, edit = broken_capture
    edit("</scene>", TABLE)
    monkeypatch.setattr(optimisation, "network_steppers", lbfgs)
    config = mi_ring.Config(levels=(2,), widths=(28,), shares=(1.0,), batch=4, refine=("cameras", "ambient"),
                            domain="sphere", iterations=8)  # fmt: skip
    fit = mi_ring.Fit(mi_ring.load_capture(path), config)
    fit.course.iteration = 4
    return fit


def drawn(fit):
    batch = fit.sampler.draw(fit.problem, fit.schedule, fit.ring.domain, fit.iteration)
    return batch, fit.sampler.observe(fit.problem, fit.capture, batch)


def test_an_evaluation_changes_nothing(fit):
    fit.step()  # so that there are averages
    batch, observation = drawn(fit)
    averages = dict(fit.renderer.averages)
    losses = [fit.evaluate(batch, observation)[1].loss for _ in range(2)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert averages.keys() == fit.renderer.averages.keys()
    assert all(averages[k][0] == count for k, (count, _) in fit.renderer.averages.items())


def test_an_optimiser_may_evaluate_the_loss_again(fit):
    batch, observation = drawn(fit)
    evaluations = []

    def evaluate():
        loss, it = fit.evaluate(batch, observation)
        evaluations.append(it.loss)
        return loss, it

    it = fit.optimisation.step(evaluate)
    assert len(evaluations) > 2 and it.loss == evaluations[0]
    assert fit.evaluate(batch, observation)[1].loss < 0.95 * evaluations[0]
    assert not fit.renderer.averages  # they get the pictures of an iteration, when it is done
    fit.renderer.remember(it.prediction)
    assert {count for count, _ in fit.renderer.averages.values()} == {1}
    assert fit.step().number == 5
