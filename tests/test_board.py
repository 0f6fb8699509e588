"""The sheet of markers: its page, and what photographs of it tell."""

import re
from functools import lru_cache

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ring import board as command
from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.marker_sheet import (
    DOTS,
    MarkerSheet,
    SheetDetection,
    align,
    calibrate,
    page,
    sample_paper,
)

MIDDLE = Lens("SIMPLE_RADIAL", (600, 420), (640.0, 300.0, 210.0, -0.06))
ASIDE = Lens("SIMPLE_RADIAL", (600, 420), (640.0, 313.0, 201.0, -0.06))
PAPER = np.array([0.8, 0.7, 0.5])  #: its colour under the lamp, linear


def pose_at(turn, tilt, away, roll, target):
    """Camera-to-world, OpenCV's axes, from angles [deg] about the sheet and the distance [mm]."""
    turn, tilt = np.radians([turn, tilt])
    back = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, back), -back], 1)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    assert np.linalg.det(pose[:3, :3]) > 0
    pose[:3, 3] = np.array([*target, 0]) + away * back
    return pose


def poses(count):
    random = np.random.default_rng(4)
    for k in range(count):
        yield pose_at(360 * k / count + 20, random.uniform(40, 70), random.uniform(330, 420),
                      random.uniform(-15, 15), random.uniform(-20, 20, 2))  # fmt: skip


@lru_cache
def texture():
    """The page at half its resolution, (2079, 1470) float32."""
    sheet = np.array(page("a4")).astype(np.float32)
    return cv2.GaussianBlur(cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), (0, 0), 1.0)


@lru_cache
def rays_of(lens):
    """Of all quarters of pixels (4·H·W, 3), z = 1."""
    width, height = lens.size
    x, y = np.meshgrid((np.arange(2 * width) + 0.5) / 2, (np.arange(2 * height) + 0.5) / 2)
    return np.column_stack([lens.colmap.cam_from_img(np.stack([x, y], -1).reshape(-1, 2)), np.ones(x.size)])


def photograph(lens, pose):
    """(H, W, 3) uint8: the page on black, sampled 2 × 2 times a pixel, blurred, with noise, in the paper's colour."""
    width, height = lens.size
    sheet, rays = texture(), rays_of(lens) @ pose[:3, :3].T
    hit = pose[:3, 3] - pose[2, 3] / rays[:, 2:] * rays
    place = hit[:, :2] * [1, -1] * DOTS / 2 + np.array(sheet.shape[::-1]) / 2 - 0.5
    place = place.reshape(2 * height, 2 * width, 2).astype(np.float32)
    shown = cv2.remap(sheet, place, None, cv2.INTER_LINEAR, borderValue=0)
    shown = cv2.GaussianBlur(cv2.resize(shown, lens.size, interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    rgb = 255 * (0.06 + 0.94 * shown[..., None] * PAPER) ** (1 / 2.2)
    random = np.random.default_rng(int(1e3 * abs(pose[0, 3])))
    return (rgb + random.normal(0, 2, rgb.shape)).clip(0, 255).round().astype(np.uint8)


def truth(lens, pose, points):
    """Where a camera sees points (n, 3), and are they in front of it?"""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    assert (local[:, 2] > 0).all()
    return lens.colmap.img_from_cam(local)


@pytest.fixture(scope="module")
def aside():
    """Cameras and what is found in their photographs, by name; the lens's principal point is not in the middle."""
    cameras = {f"{k:02}": (ASIDE, pose) for k, pose in enumerate(poses(7))}
    return cameras, {name: MarkerSheet().detect(photograph(*camera)) for name, camera in cameras.items()}


def test_corners_are_found_where_they_are(aside):
    cameras, sightings = aside
    errors = []
    for name, (lens, pose) in cameras.items():
        sighting = sightings[name]
        assert len(sighting.ids) > 85 and (sighting.points[:, 2] == 0).all()
        errors.append(sighting.pixels - truth(lens, pose, sighting.points))
    errors = np.concatenate(errors)
    assert np.abs(errors.mean(0)).max() < 0.03  # a convention that is half a pixel off
    assert np.sqrt((errors**2).sum(1).mean()) < 0.1 and np.quantile(np.linalg.norm(errors, axis=1), 0.95) < 0.15


def test_what_stands_on_the_sheet_hides_its_corners(aside):
    """No corner is guessed beneath it."""
    cameras, sightings = aside
    picture, hidden = photograph(*cameras["01"]), np.zeros((420, 600), np.uint8)
    cv2.ellipse(hidden, (330, 190), (90, 60), 25, 0, 360, 1, -1)
    speckled = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, picture.shape), (0, 0), 3) * 400 + 110
    picture[hidden > 0] = speckled.clip(0, 255)[hidden > 0]
    sighting = MarkerSheet().detect(picture)
    exact = truth(*cameras["01"], sighting.points)
    assert 40 < len(exact) < len(sightings["01"].ids) - 8
    assert not hidden[tuple(exact[:, ::-1].astype(int).T)].any()
    assert np.linalg.norm(sighting.pixels - exact, axis=1).max() < 0.4


def test_the_frame_has_the_printed_side_up():
    """By OpenCV's own way: the first corner is at the top left of the page as it is read."""
    sheet = np.array(page("letter"), np.uint8) * 255
    sighting = MarkerSheet(40.0).detect(sheet)
    assert sighting.ids.tolist() == list(range(96))
    np.testing.assert_allclose(sighting.points[[0, 7, 88]], [[-140, 220, 0], [140, 220, 0], [-140, -220, 0]])
    middle = np.array(sheet.shape[::-1]) / 2
    exact = middle + sighting.points[:, :2] * [1, -1] * DOTS / 2
    np.testing.assert_allclose(sighting.pixels, exact, atol=1.0)  # where the margins are odd
    shift = (sighting.pixels - exact).mean(0)
    np.testing.assert_allclose(sighting.pixels - shift, exact, atol=0.01)


def test_large_photographs_are_as_exact_as_small_ones():
    """Found in the reduced picture, refined in the large one, its size no multiple of the reduction."""
    lens = Lens("PINHOLE", (2251, 1403), (2400.0, 2400.0, 1101.5, 707.0))
    pose = pose_at(70, 60, 520, 5, (3, 8))
    sheet = cv2.resize(np.array(page("a4"), np.uint8) * 255, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    H = np.array([[lens.params[0], 0, lens.params[2]], [0, lens.params[1], lens.params[3]], [0, 0, 1]])
    H = H @ np.linalg.inv(pose)[:3, [0, 1, 3]]
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    place = np.array([[7, 0, sheet.shape[1] / 2], [0, -7, sheet.shape[0] / 2], [0, 0, 1]])
    picture = cv2.warpPerspective(sheet, half @ H @ np.linalg.inv(half @ place), lens.size, flags=cv2.INTER_LINEAR)
    sighting = MarkerSheet().detect(cv2.GaussianBlur(picture, (0, 0), 1.2))
    exact = (np.column_stack([sighting.points[:, :2], np.ones(len(sighting.ids))])) @ H.T
    errors = sighting.pixels - exact[:, :2] / exact[:, 2:]
    assert len(errors) > 80 and np.abs(errors).max() < 0.15 and np.abs(errors.mean(0)).max() < 0.02


def test_nothing_and_a_strip_are_no_sighting():
    random = np.random.default_rng(0)
    assert MarkerSheet().detect(random.integers(0, 255, (200, 300, 3)).astype(np.uint8)) is None
    sheet = np.array(page("a4"), np.uint8) * 255
    top = (sheet.shape[0] - 13 * 20 * DOTS) // 2
    strip = np.full_like(sheet, 255)
    strip[top : top + 2 * 20 * DOTS] = sheet[top : top + 2 * 20 * DOTS]  # two rows of squares: one of corners
    assert MarkerSheet().detect(strip) is None
    strip[: top + 3 * 20 * DOTS] = sheet[: top + 3 * 20 * DOTS]
    assert len(MarkerSheet().detect(strip).ids) == 16


def test_the_sheet_alone_gives_the_cameras():
    cameras = {f"{k:02}": (MIDDLE, pose) for k, pose in enumerate(poses(7))}
    sightings = {name: MarkerSheet().detect(photograph(*camera)) for name, camera in cameras.items()}
    ids, points, pixels = sightings["03"]
    bent = pixels + 30 * np.sin(pixels[:, ::-1] / 40)  # of a sheet that is not flat
    sightings["03"] = SheetDetection(ids, points, bent)
    lens, found, errors = calibrate(sightings, MIDDLE.size)
    assert found.keys() == errors.keys() == sightings.keys() - {"03"} and max(errors.values()) < 0.2
    assert lens.model == "SIMPLE_RADIAL" and lens.centre == (300, 210)
    assert lens.focal[0] == pytest.approx(640, rel=0.005)
    assert lens.params[3] == pytest.approx(-0.06, abs=0.01)
    for name, pose in found.items():
        true = cameras[name][1]
        assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.01 * np.linalg.norm(true[:3, 3])
        np.testing.assert_allclose(pose[:3, :3], true[:3, :3], atol=0.01)
        assert pose[2, 3] > 0 and np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_two_photographs_are_too_few(aside):
    two = dict(list(aside[1].items())[:2])
    with pytest.raises(InputError, match="2 photographs show enough"):
        calibrate(two, ASIDE.size)


def moved(cameras, scale, rotation, shift):
    """In another frame."""
    result = {}
    for name, (lens, pose) in cameras.items():
        there = np.eye(4)
        there[:3, :3] = rotation @ pose[:3, :3]
        there[:3, 3] = scale * rotation @ pose[:3, 3] + shift
        result[name] = lens, there
    return result


def test_the_sheet_gives_cameras_their_scale_and_frame(aside):
    cameras, sightings = aside
    turn = Rotation.from_euler("xyz", [130, -40, 75], degrees=True).as_matrix()
    elsewhere = moved(cameras, 0.013, turn, np.array([5.0, -3.0, 8.0]))
    lens, wrong = elsewhere["02"]
    wrong = wrong.copy()
    wrong[:3, :3] = wrong[:3, :3] @ Rotation.from_euler("xyz", [3, -4, 5], degrees=True).as_matrix()
    elsewhere["02"] = lens, wrong
    found = align(sightings | {"without camera": sightings["00"]}, elsewhere)
    assert found.scale == pytest.approx(1 / 0.013, rel=1e-3)
    np.testing.assert_allclose(found.rotation, turn.T, atol=1e-3)
    centres = np.array([elsewhere[name][1][:3, 3] for name in cameras])
    there = found.scale * centres @ found.rotation.T + found.shift
    np.testing.assert_allclose(there, [pose[:3, 3] for _, pose in cameras.values()], atol=0.4)
    assert found.corners > 85 and 0 < found.rms < 0.1


def test_a_sheet_that_was_moved_is_refused(aside):
    cameras, sightings = aside
    with pytest.raises(InputError, match="show 0 of its corners together"):
        align({"00": sightings["00"]}, cameras)
    mixed = {}
    for name, (ids, _, pixels) in sightings.items():
        order = np.random.default_rng(2).permutation(96)  # the same in all: corners are in space, but elsewhere
        mixed[name] = SheetDetection(order[ids], MarkerSheet().points[order[ids]], pixels)
    with pytest.raises(InputError, match="mm on"):
        align(mixed, cameras)


def test_white_is_the_papers_colour(aside):
    cameras, sightings = aside
    picture = photograph(*cameras["00"])
    linear = ((picture / 255.0) ** 2.2).astype(np.float32)
    places, colours, beside = sample_paper(linear, sightings["00"])
    np.testing.assert_allclose(colours, np.broadcast_to(0.06 + 0.94 * PAPER, colours.shape), rtol=0.06)
    squares = np.abs(places[:, :2] / 20)  # from the middle of 9 x 13
    assert 0.2 < beside.mean() < 0.8
    np.testing.assert_allclose(squares[~beside], squares[~beside].round(), atol=1e-6)
    np.testing.assert_allclose((squares[beside] - [4.5, 6.5]).max(1), 0.2, atol=1e-6)
    few = SheetDetection(*(part[:6] for part in sightings["00"]))
    assert not len(sample_paper(linear, few).points)


def test_white_is_asked_of_white_squares_only():
    """Markers in red, black squares in green: none of it must be seen."""
    sheet = np.array(page("a4"))
    sighting = MarkerSheet().detect(sheet.astype(np.uint8) * 255)
    picture = np.zeros((*sheet.shape, 3), np.float32)
    picture[sheet] = [0.3, 0.6, 0.9]
    for ids in (sighting.ids, sighting.ids[:16], sighting.ids[40:56]):
        part = SheetDetection(ids, sighting.points[ids], sighting.pixels[ids])
        _, colours, _ = sample_paper(picture, part)
        assert len(colours)
        np.testing.assert_allclose(colours, np.broadcast_to([0.3, 0.6, 0.9], colours.shape), rtol=1e-6)


def test_white_is_that_of_where_it_is_said_to_be():
    """Paper whose light falls off to one side: what is brighter on one side of a square is darker on the other."""
    sheet = np.array(page("a4"))
    sighting = MarkerSheet().detect(sheet.astype(np.uint8) * 255)
    row, column = np.mgrid[: sheet.shape[0], : sheet.shape[1]]
    light = 0.3 + 0.4 * column / sheet.shape[1] - 0.2 * row / sheet.shape[0]
    places, colours, _ = sample_paper((sheet * light)[..., None].repeat(3, 2).astype(np.float32), sighting)
    x, y = DOTS * (places[:, :2].T + np.array([[210], [-297]]) / 2)  # from the left, and downward to the top
    expected = 0.3 + 0.4 * x / sheet.shape[1] + 0.2 * y / sheet.shape[0]
    np.testing.assert_allclose(colours[:, 0], expected, rtol=2e-3)


@pytest.mark.parametrize("paper, size", [("a4", (210, 297)), ("letter", (215.9, 279.4))])
def test_the_page_is_true_to_scale(paper, size, tmp_path, capsys):
    file = tmp_path / "new" / "sheet.pdf"
    command.main([str(file), "--paper", paper])
    assert str(file) in capsys.readouterr().out
    text = file.read_bytes()
    box = [float(v) for v in re.search(rb"/MediaBox \[(.*?)\]", text)[1].split()]
    np.testing.assert_allclose(np.array(box[2:]) * 25.4 / 72, size, atol=0.05)  # [mm]
    width, height = (int(re.search(rb"/%s (\d+)" % key, text)[1]) for key in (b"Width", b"Height"))
    drawn = [float(v) for v in re.search(rb"q ([\d.]+) 0(?:\.0+)? 0(?:\.0+)? ([\d.]+) ", text).groups()]
    np.testing.assert_allclose(drawn, box[2:], rtol=1e-5)
    assert b"CCITTFaxDecode" in text  # without loss

    command.main([str(file.with_suffix(".PNG")), "--paper", paper])
    with Image.open(file.with_suffix(".PNG")) as picture:
        assert picture.size == (width, height)
        dots = np.array(picture.info["dpi"]) / 25.4
        sheet = np.array(picture)
    np.testing.assert_allclose(dots, width / (box[2] * 25.4 / 72), rtol=1e-5)
    top = np.flatnonzero(~sheet.all(1))[0]
    row = np.flatnonzero(np.diff(sheet[top + 5].astype(int)))  # through the black squares of the first row
    squares = row[np.append(True, np.diff(row) > 10 * dots[0])]
    np.testing.assert_allclose((squares[5:] - squares[:-5]) / dots[0], 100, rtol=1e-4)
    assert row[0] > 8 * dots[0] and top > 8 * dots[1]  # what a printer leaves white
    below = np.flatnonzero(~sheet.all(1))[-1]
    assert (below - top) / dots[1] > 260.5 and (len(sheet) - below) / dots[1] > 4  # the line to read


@pytest.mark.parametrize("name, what", [("sheet.jpg", "ends in .jpg; must end in .pdf or .png"),
                                        ("sheet", "ends in nothing; must"),
                                        ("file.txt/sheet.pdf", "cannot be written")])  # fmt: skip
def test_what_cannot_be_written_is_one_line(name, what, tmp_path):
    (tmp_path / "file.txt").touch()
    with pytest.raises(InputError, match=what) as stop:
        command.main([str(tmp_path / name)])
    assert "\n" not in str(stop.value)
