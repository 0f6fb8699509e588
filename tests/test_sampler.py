"""What an iteration draws: photographs in rounds, and random numbers by purpose."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mi_ring.capture.loading import load_capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.sampler import SEEDED, Sampler

TINY = {"iterations": 3, "levels": (1,), "widths": (28,), "shares": (1.0,), "batch": 4, "domain": "sphere"}


@pytest.fixture(scope="module")
def capture(small_capture):
    return load_capture(small_capture)


def drawn(capture, **changes):
    """The batches of a fit's iterations."""
    return [it.batch for it in Fit(capture, Config(**TINY | changes))]


@pytest.fixture(scope="module")
def usual(capture):
    return drawn(capture)


def test_each_purpose_has_numbers_of_its_own(usual, capture):
    seeds = [batch.seeds[name] for batch in usual for name in SEEDED]
    assert len(set(seeds)) == 3 * len(SEEDED)
    other = drawn(capture, seed=1)
    assert not {batch.seeds[name] for batch in other for name in SEEDED} & {*seeds}
    assert [one.photographs.tolist() for one in usual] != [one.photographs.tolist() for one in other]


@pytest.mark.parametrize("changes", [
    {"weights": {"velocity": 0.0}}, {"indirect": False}, {"refine": ("none",)}, {"weights": {"mask": 0.0}},
    {"resample": False},
], ids=str)  # fmt: skip
def test_what_is_switched_off_changes_nothing_else_that_is_drawn(changes, usual, capture):
    """So that fits with the same seed can be compared: photographs, rotations of the sphere, and all seeds."""
    other = drawn(capture, **changes)
    for one, another in zip(usual, other, strict=True):
        assert one.photographs.tolist() == another.photographs.tolist() and one.seeds == another.seeds
        assert torch.equal(one.points, another.points) == changes.get("resample", True)


def test_details_see_other_photographs_in_each_iteration():
    """A quarter of those of a size at most, but one; where memory asks for fewer, these."""
    capture = SimpleNamespace(shots=[SimpleNamespace(size=(8, 8))] * 12, sizes={(8, 8): np.arange(12)})
    sampler = Sampler(SimpleNamespace(capture=capture, fitted=np.arange(12), config=Config(seed=5)))
    assert [len(sampler.draw_photographs(8, most)[0]) for most in (None, 8, 2, 0)] == [8, 3, 2, 1]


def test_each_photograph_comes_before_one_comes_again():
    sizes = {(40, 56): np.arange(5), (56, 40): np.arange(5, 12)}
    shots = [SimpleNamespace(size=size) for size, index in sizes.items() for _ in index]
    capture = SimpleNamespace(shots=shots, sizes=sizes)
    sampler = Sampler(SimpleNamespace(capture=capture, fitted=np.arange(12), config=Config(seed=5)))
    drawn: dict = {size: [] for size in sizes}
    for _ in range(60):
        index, size = sampler.draw_photographs(3)
        assert len({*index.tolist()}) == 3 and {*index.tolist()} <= {*sizes[size].tolist()}
        drawn[size] += index.tolist()
    for size, alike in sizes.items():
        times = np.bincount(drawn[size])[alike]
        assert times.sum() > 40 and times.max() - times.min() <= 1
        orders = [drawn[size][k : k + len(alike)] for k in range(0, len(drawn[size]) - len(alike), len(alike))]
        assert len({tuple(one) for one in orders}) > len(orders) / 2  # in another order
