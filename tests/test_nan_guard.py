"""Losses, gradients and weights that are not finite: what a fit restores, and when it gives up."""

import numpy as np
import pytest
import torch
from helpers.quick_fits import BRIEF

from mi_ring import fit
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import terms
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.nan_guard import NanGuard


def test_a_fit_that_diverges_says_so_and_keeps_what_there_is(small_capture, tmp_path, monkeypatch):
    genuine = terms.rgb_loss
    monkeypatch.setattr(terms, "rgb_loss", lambda *a: genuine(*a) * float("nan"))
    with pytest.raises(InputError, match="diverged at iteration 17"):
        fit.main([str(small_capture), "--out", str(tmp_path / "run"), "--iterations", "40", *BRIEF])
    ring = torch.load(tmp_path / "run" / "ring.pt")["networks"]
    assert all(tensor.isfinite().all() for tensor in ring.values())


def test_a_fit_goes_back_from_numbers_that_are_none_and_on_with_smaller_steps(small_capture, monkeypatch):
    """Of weights at once, of losses when there are three in a row; a single one is left out."""
    changes = {"levels": (2,), "widths": (28,), "shares": (1,), "indirect": False, "refine": ("none",), "batch": 2}
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
