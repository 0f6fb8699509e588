"""Averages of interreflection over iterations, against those of numpy."""

from types import SimpleNamespace

import numpy as np
import torch

from mi_ring.fitting.indirect_average import LATEST, averaged
from mi_ring.fitting.processes import ALONE
from mi_ring.rendering.global_illumination import GlobalIllumination

RANDOM = np.random.default_rng(3)


def around(radiance, alpha, factor=2):
    radiance, alpha = torch.tensor(radiance).float(), torch.tensor(alpha).float()
    n, h, w = alpha.shape
    return GlobalIllumination(radiance, [], radiance, radiance, alpha, torch.ones(n, factor * h, factor * w), factor)


def added(averages, new, index):
    """With the pictures of a single process."""
    seen, latest = averaged(averages, new, SimpleNamespace(all_photographs=index, share=ALONE.share(len(index))))
    averages |= latest
    return seen


def test_each_photograph_has_the_average_of_its_own_pictures():
    averages, pictures = {}, RANDOM.uniform(1, 2, (4, 3, 5, 7, 3))  # of three photographs, four times
    full = np.ones((3, 5, 7))
    for picture in pictures[:3]:
        seen = added(averages, around(picture, full), np.array([6, 2, 9]))
    np.testing.assert_allclose(seen.radiance, pictures[:3].mean(0), rtol=1e-5)
    seen = added(averages, around(pictures[3][[1]], full[[1]]), np.array([2]))  # one alone, and in another place
    np.testing.assert_allclose(seen.radiance[0], pictures[:, 1].mean(0), rtol=1e-5)
    assert averages.keys() == {2, 6, 9}


def test_light_is_averaged_over_what_was_covered_and_the_outline_is_the_newest():
    averages, light = {}, RANDOM.uniform(1, 2, (1, 5, 7, 3))
    for _ in range(3):
        alpha = RANDOM.uniform(0.3, 1, (1, 5, 7))
        seen = added(averages, around(light * alpha[..., None], alpha), np.array([0]))
        np.testing.assert_allclose(seen.radiance, light * alpha[..., None], rtol=1e-5)
        np.testing.assert_allclose(seen.alpha, alpha, rtol=1e-6)


def test_what_is_not_finite_is_left_out():
    averages, alpha, broken = {}, np.ones((1, 5, 7)), np.full((1, 5, 7, 3), 2.0)
    broken[0, 2, 3, 1] = np.nan
    seen = added(averages, around(broken, alpha), np.array([0]))
    assert seen.radiance.isfinite().all() and not averages
    for picture in (np.full((1, 5, 7, 3), 2.0), broken):
        np.testing.assert_allclose(added(averages, around(picture, alpha), np.array([0])).radiance, 2)
    assert averages[0][0] == 1


def test_what_was_is_forgotten_and_other_sizes_begin_anew():
    averages, alpha = {}, np.ones((1, 5, 7))
    for k in range(12):
        added(averages, around(np.full((1, 5, 7, 3), float(k)), alpha), np.array([0]))
    seen = added(averages, around(np.zeros((1, 5, 7, 3)), alpha), np.array([0]))
    before = seen.radiance.mean()
    for _ in range(20):
        seen = added(averages, around(np.zeros((1, 5, 7, 3)), alpha), np.array([0]))
    np.testing.assert_allclose(seen.radiance.mean(), before * (1 - LATEST) ** 20, rtol=1e-4)
    seen = added(averages, around(np.full((1, 6, 9, 3), 5.0), np.ones((1, 6, 9))), np.array([0]))
    np.testing.assert_allclose(seen.radiance, 5)
