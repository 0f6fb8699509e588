"""Whether photographs from several sides of the object have the same background."""

import cv2
import numpy as np
import pytest

import mi_ring
from mi_ring.capture.background import background_moves
from mi_ring.capture.loading import load_capture
from mi_ring.capture.reduction import reduced
from mi_ring.images import linear_to_srgb, to_bytes

WIDTH, HEIGHT, COUNT = 90, 70, 12


def picture(width, height, contrast, rng):
    """A wall with smooth spots."""
    wall = cv2.GaussianBlur(rng.uniform(size=(height, width, 3)).astype(np.float32), (0, 0), 2.5)
    return 0.3 * (1 + contrast * (wall - wall.mean()) / wall.std())


def photographs(moves, contrast=0.15, level=1.0, noise=0.01, heights=1, table=0.0, radius=15, corners=0.0):
    """Photographs of a ball that changes, and its masks, of various exposures.

    They show a wall. `moves`: another part of it each; else one part for each of the `heights` of the camera. `table`:
    how much brighter the lower half is. `corners`: how much darker the corners are.
    """
    rng = np.random.default_rng(3)
    wall = picture(5 * WIDTH, 5 * HEIGHT, contrast, rng)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    dark = 1 - corners * ((row / HEIGHT - 0.5) ** 2 + (column / WIDTH - 0.5) ** 2)[..., None]
    images, masks = [], []
    for k in range(COUNT):
        place = k if moves else k % heights
        top, left = 29 * place % (4 * HEIGHT), 53 * place % (4 * WIDTH)
        image = wall[top : top + HEIGHT, left : left + WIDTH] * (1 + table * (row > 40))[..., None] * dark
        mask = (column - 48 - k % 3) ** 2 + (row - 33) ** 2 < (radius + k % 2) ** 2
        image *= level
        image[mask] = [0.5 + 0.3 * np.sin(k), 0.4, 0.3]
        image = image * rng.uniform(0.7, 1.3) + rng.normal(0, noise, image.shape)
        images.append(to_bytes(linear_to_srgb(image.clip(0, 1))))
        masks.append(255 * mask.astype(np.uint8))
    return images, masks


@pytest.fixture
def capture_of(small_capture):
    """A function that makes a capture of photographs and masks."""
    given = [shot.camera for shot in load_capture(small_capture, images=False).shots]

    def made(images, masks, **more):
        cameras = [camera._replace(size=image.shape[1::-1]) for camera, image in zip(given, images, strict=True)]
        return mi_ring.Capture.from_arrays(images, masks, cameras=cameras, center=[0, 0, 0], radius=1.0, **more)

    return made


@pytest.mark.parametrize("how", [
    {}, {"noise": 0.02}, {"contrast": 0.08}, {"heights": 3}, {"table": 2.0}, {"corners": 1.5}, {"radius": 3},
], ids=str)  # fmt: skip
@pytest.mark.parametrize("moves", [False, True])
def test_a_background_that_moves_is_told_from_one_that_background_moves(moves, how, capture_of):
    assert background_moves(capture_of(*photographs(moves, **how))) is moves


@pytest.mark.parametrize("how", [
    {"level": 0.003, "noise": 0.0005}, {"level": 0, "radius": 3, "noise": 0.002}, {"contrast": 0, "noise": 0.003},
    {"contrast": 0, "table": 2.0, "noise": 0.003}, {"contrast": 0, "corners": 1.5, "noise": 0.003},
], ids=str)  # fmt: skip
def test_a_black_or_plain_background_tells_nothing(how, capture_of):
    assert background_moves(capture_of(*photographs(False, **how))) is None


def test_too_few_masks_or_masks_that_cover_all_tell_nothing(capture_of):
    images, masks = photographs(False)
    assert background_moves(capture_of(images, [*masks[:2], *[None] * (COUNT - 2)])) is None
    assert background_moves(capture_of(images, [np.full_like(mask, 255) for mask in masks])) is None


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("moves", [False, True])
def test_borders_of_undistorted_photographs_tell_nothing(moves, known, capture_of):
    """They are black in all photographs."""
    images, masks = photographs(moves)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    corner = rows + columns < 50 + 10 * np.sin(columns)
    for image in images:
        image[corner] = 0
    valid = [~corner] * COUNT if known else None
    assert (background_moves(capture_of(images, masks, valid=valid)) is False) is not moves


def test_a_plate_that_turns_with_the_object_may_move(capture_of):
    (images, masks), (others, _) = photographs(False), photographs(True)
    plate = np.s_[45:60, 20:70]
    for image, other, mask in zip(images, others, masks):
        image[plate] = np.where(mask[plate][..., None] > 0, image[plate], other[plate])
    assert background_moves(capture_of(images, masks)) is False


def test_a_stand_that_looks_the_same_from_all_sides_does_not_stand_still(capture_of):
    images, masks = photographs(True, contrast=0.002, noise=0.002)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for image, mask in zip(images, masks):
        stand = (rows > 50) & (abs(columns - 48) < 12) & (mask == 0)
        image[stand] = (image[stand] * 0.6).astype(np.uint8)
    assert background_moves(capture_of(images, masks)) is None


def test_photographs_from_the_same_place_are_not_compared(small_capture):
    """As in brackets of exposures, and in bursts."""
    images, masks = photographs(True)
    pairs = [part for k in range(6) for part in (k, k)]
    given = [shot.camera for shot in load_capture(small_capture, images=False).shots]
    cameras = [given[k]._replace(size=(WIDTH, HEIGHT)) for k in pairs]
    images = [images[k] if n % 2 else (images[k] * 0.8).astype(np.uint8) for n, k in enumerate(pairs)]
    masks = [masks[k] for k in pairs]
    capture = mi_ring.Capture.from_arrays(images, masks, cameras=cameras, center=[0, 0, 0], radius=1.0)
    assert background_moves(capture)


@pytest.mark.parametrize("moves", [False, True])
def test_photographs_that_are_cropped_to_the_object_are_read_whole(moves, capture_of, tmp_path):
    large = [[cv2.resize(part, (9 * WIDTH, 9 * HEIGHT)) for part in parts] for parts in photographs(moves)]
    shown = np.ones((9 * HEIGHT, 9 * WIDTH), bool)
    shown[:200, :300] = False
    for image in large[0]:
        image[~shown] = 255
    capture = capture_of(*large, valid=[shown] * COUNT)
    assert background_moves(reduced(capture, 64)) is None  # there is no file to read again
    small = reduced(capture.save(tmp_path / "scene.xml"), 64)
    assert all(shot.window.share < 0.5 for shot in small.shots)
    assert background_moves(small) is moves
    small.shots[0].files.filename.unlink()
    assert background_moves(small) is None
