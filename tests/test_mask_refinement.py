"""Outlines by GrabCut, and masks as unknowns of a fit."""

import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import torch

import mi_ring
from mi_ring import Config, Fit, InputError
from mi_ring.capture.grabcut import grabcut, overlap
from mi_ring.fitting import fit as fitting
from mi_ring.fitting import mask_refinement

WITHOUT = [1, 4, 5, 10]  #: photographs whose masks are taken away
SHORT = {
    "iterations": 24, "levels": (3,), "widths": (56,), "shares": (1,), "subdivisions": 3, "indirect": False,
    "detail": "none",
}  # fmt: skip


def ellipse(x, y, rows=50, columns=70):
    i, j = np.mgrid[:rows, :columns]
    return (((j - x) / 21) ** 2 + ((i - y) / 14) ** 2 < 1).astype(np.uint8)


def test_the_outline_is_that_of_the_colours_near_the_coverage():
    true, noise = ellipse(33, 24), np.random.default_rng(1).normal(0, 6, (50, 70, 3))
    true[20:28, :3] = 1  # looks alike, but is elsewhere
    picture = np.where(true[..., None] > 0, [150, 60, 40], [70, 90, 80]) + noise
    nowhere = np.zeros(true.shape, bool)
    found = grabcut(picture.clip(0, 255).astype(np.uint8), ellipse(34, 25), nowhere, 0.04)
    assert overlap(ellipse(34, 25), ellipse(33, 24)) < 0.94
    assert overlap(found, ellipse(33, 24)) > 0.99
    never = nowhere.copy()
    never[:, 40:] = True
    found = grabcut(picture.clip(0, 255).astype(np.uint8), ellipse(34, 25), never, 0.04)
    assert not found[never].any() and overlap(found[:, :40], ellipse(33, 24)[:, :40]) > 0.99


def test_overlap_by_hand():
    a, b = np.array([[1, 1, 0], [0, 0, 0]]), np.array([[0, 1, 1], [1, 0, 0]])
    assert overlap(a, b) == 1 / 4
    assert overlap(0 * a, 0 * b) == 1


@pytest.fixture
def without_some_masks(small_capture, tmp_path):
    """The small capture, of which some photographs have no mask, and the masks of all (N, H, W)."""
    true = np.stack(mi_ring.load_capture(small_capture).masks) > 127
    shutil.copytree(small_capture.parent, tmp_path / "some")
    scene = tmp_path / "some" / small_capture.name
    tree = ElementTree.parse(scene)
    for k in WITHOUT:
        sensor = tree.find(f"sensor[@id='{k:03}']")
        sensor.remove(sensor.find("string[@name='mask']"))
    tree.write(scene)
    return scene, true


def test_masks_that_are_missing_are_found_about_the_surface_and_written(without_some_masks, tmp_path):
    scene, true = without_some_masks
    capture = mi_ring.load_capture(scene)
    fit = Fit(capture, Config(**SHORT, refine=("masks",)))
    for it in fit:
        masked = sum(mask is not None for mask in fit.capture.masks)
        assert masked == (12 if it.number > 12 else 12 - len(WITHOUT))
    assert [k for k, mask in enumerate(capture.masks) if mask is None] == WITHOUT  # the capture stays as it was
    for k in range(12):
        assert overlap(fit.capture.masks[k] > 127, true[k]) > 0.93, k

    other = Fit(capture, fit.problem.config, state=fit.state())
    for one, another in zip(fit.capture.masks, other.capture.masks):
        np.testing.assert_array_equal(one, another)

    fit.save(tmp_path / "run")
    written = mi_ring.load_capture(tmp_path / "run" / "scene.xml")
    assert [shot.files.mask.name for shot in written.shots] == [f"{k:03}.png.png" for k in range(12)]
    for one, another in zip(fit.capture.masks, written.masks):
        np.testing.assert_array_equal(one, another)


def test_what_the_second_search_is_not_sure_of_stays(without_some_masks, monkeypatch):
    scene, _ = without_some_masks
    fit = Fit(mi_ring.load_capture(scene), Config(**SHORT, refine=("masks",)))
    half = {k: torch.ones(40, 56, dtype=torch.uint8) for k in range(12)}
    searches = iter([half, {k: 0 * mask for k, mask in half.items() if k != 4}])
    monkeypatch.setattr(fitting, "find_masks", lambda *parts: next(searches))
    fit.refine_masks()
    fit.refine_masks()
    masks = fit.course.masks
    assert sorted(masks) == list(range(12))
    assert masks[4].all() and not masks[5].any()
    assert (fit.capture.masks[4] == 255).all()


def test_outlines_of_reduced_pictures_stay_where_they_are(small_capture):
    capture = mi_ring.load_capture(small_capture)
    shot = capture.shots[0]
    outline = torch.zeros(40 // 3, 56 // 3, dtype=torch.uint8)
    outline[4:, 10:] = 1  # from row 12 and column 30 on
    mask = mask_refinement.with_masks(capture, {0: outline}).masks[0]
    assert mask.shape == shot.size[::-1]
    expected = np.zeros((40, 56), bool)
    expected[12:, 30:] = True
    expected[12, 30] = False  # corners are rounded
    np.testing.assert_array_equal(mask > 127, expected)


def test_masks_that_do_not_go_with_the_surface_are_not_taken(without_some_masks, monkeypatch):
    scene, _ = without_some_masks
    capture = mi_ring.load_capture(scene)
    fit = Fit(capture, Config(**SHORT, refine=("masks",)))
    monkeypatch.setattr(
        mask_refinement, "grabcut", lambda picture, coverage, background, band: coverage * (np.arange(56) > 27)
    )
    fit.course.iteration = 20
    fit.step()
    assert not fit.course.masks
    for before, after in zip(capture.masks, fit.capture.masks):
        assert before is after


def test_masks_of_a_dark_room_are_left_alone(small_capture):
    capture = mi_ring.load_capture(small_capture, masks="none")
    assert capture.threshold is not None
    with pytest.raises(InputError, match="--refine masks: .* by brightness"):
        Fit(capture, Config(**SHORT, refine=("masks", "light")))
