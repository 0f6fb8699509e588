"""Folders of photographs that structure from motion puts together; some are ended on the way, some cannot be used."""

import functools
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from helpers.ellipsoid_pictures import AXES, CENTER, hit_ellipsoid, in_a_dim_room, pose_at, poses, rays_of
from PIL import ExifTags, Image, ImageOps
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from mi_ring import photos
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.flash_light import FlashCalibration
from mi_ring.photogrammetry.folder import (
    FLIPS,
    Picture,
    camera_names,
    find_pictures,
    orientation_axes,
    turn_with_cameras,
    up_directions,
    without_flash,
)
from mi_ring.photogrammetry.matching import BATCH, static_share
from mi_ring.photogrammetry.object_masks import SegmentedObject
from mi_ring.photogrammetry.structure_from_motion import SparseModel, structure_from_motion
from mi_ring.photogrammetry.workflow import imported_cameras, posed_pictures, require_same_photographs
from mi_ring.system.progress import progress

pty = pytest.importorskip("pty")  # not on Windows

SIZE = (400, 300)
LENS = Lens("PINHOLE", SIZE, (470.0, 470.0, 200.0, 150.0))


def rendered(pose, noise):
    """A speckled ellipsoid on a speckled table, lit by a flash at the camera: (H, W, 3) uint8."""
    camera = LENS.camera(pose)
    rays, t = rays_of(camera), hit_ellipsoid(camera)[0]
    hit = np.isfinite(t)
    floor = (CENTER[2] - AXES[2] - camera.position[2]) / rays[:, 2]
    place = camera.position + np.where(hit, t, floor)[:, None] * rays
    normal = (place - CENTER) / AXES**2
    cosine = np.where(hit, -(normal * rays).sum(1) / np.linalg.norm(normal, axis=1), -rays[:, 2])
    speckles = map_coordinates(noise, 5 * place.T, order=1, mode="grid-wrap")[:, None]
    albedo = np.where(hit[:, None], (0.6 + 0.1 * speckles) * [1, 0.6, 0.4], (0.12 + 0.04 * speckles) * [0.6, 0.9, 1])
    away = np.linalg.norm(place - camera.position, axis=1)
    radiance = albedo * (np.clip(cosine, 0, 1) * (16 / away) ** 2 + 0.03)[:, None]
    return (255 * radiance.clip(0, 1) ** (1 / 2.2)).reshape(*SIZE[::-1], 3).astype(np.uint8)


def walk(count):
    for k in range(count):
        turn, tilt = 2 * np.pi * k / count, np.radians(40 + 12 * np.sin(3 * k))
        d = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
        yield pose_at(CENTER + 16 * d, CENTER + 0.2 * np.array([np.sin(k), np.cos(k), 0]))


@pytest.fixture(scope="module")
def speckles():
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(64, 64, 64)), 1.2, mode="wrap")
    return noise / noise.std()


@pytest.fixture(scope="module")
def photographs(tmp_path_factory, speckles):
    """And their true masks in a folder within."""
    folder = tmp_path_factory.mktemp("photographs")
    (folder / "masks").mkdir()
    for k, pose in enumerate(walk(16)):
        name = f"# 2026 IMG ({k:02}).png"  # as messengers and file managers call them
        Image.fromarray(rendered(pose, speckles)).save(folder / name)
        mask = np.isfinite(hit_ellipsoid(LENS.camera(pose))[0]).reshape(SIZE[::-1])
        Image.fromarray(mask).convert("L").save(folder / "masks" / name)
    return folder


#: Runs the command once per stage, each in a process of its own that is ended without a word when the stage has come so
#: far. What takes long to import and starts no thread is imported once.
KILLED = """
import json, os, sys
import cv2, matplotlib.figure, pycolmap, scipy.optimize, torch, trimesh

def run(stage, steps):
    from mi_ring import photos
    def progress(things, what, total=None):
        for k, thing in enumerate(things):
            if what == stage and k == steps:
                os.kill(os.getpid(), 9)
            yield thing
    photos.progress = progress
    from mi_ring.importers import writer
    replace, count = os.replace, iter(range(10**6))
    def replaced(a, b):
        replace(a, b)
        if stage == "moving" and "images" in str(b) and next(count) == steps:
            os.kill(os.getpid(), 9)
    writer.os.replace = replaced
    if stage == "inspecting":
        photos.inspect = lambda capture: os.kill(os.getpid(), 9)
    photos.main(arguments)

stages, *arguments = sys.argv[1:]
ended = []
for stage, steps in json.loads(stages):
    if not (process := os.fork()):
        run(stage, steps)
        os._exit(0)
    ended.append([stage, os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])])
print(json.dumps(ended))
"""
STAGES = [
    ("sheet", 3), ("features", 5), ("matching", 1), ("cameras", 6), ("bundle adjustment", 1), ("reading", 4),
    ("masks", 3), ("writing", 5), ("moving", 4), ("inspecting", 0),
]  # fmt: skip


@pytest.mark.slow
def test_a_process_that_is_killed_at_any_stage_goes_on(photographs, tmp_path):
    pytest.importorskip("pycolmap")
    arguments = [str(photographs), str(tmp_path / "capture"), "--masks", str(photographs / "masks")]
    command = [sys.executable, "-c", KILLED, json.dumps(STAGES), *arguments]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 0 and not ended.stderr, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1]) == [[stage, -9] for stage, _ in STAGES]
    photos.main(arguments)
    capture = load_capture(tmp_path / "capture/scene.xml")
    assert len(capture) == 16 and (tmp_path / "capture/check.png").exists()
    found = [(mask > 127).sum() for mask in capture.masks]
    true = [(np.array(Image.open(file)) > 0).sum() for file in sorted((photographs / "masks").iterdir())]
    np.testing.assert_allclose(found, true, rtol=0.02)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_native_work_in_one_line(number, photographs, tmp_path):
    """In a terminal, which says that it has no columns."""
    pytest.importorskip("pycolmap")
    ours, theirs = pty.openpty()
    arguments = [sys.executable, "-m", "mi_ring.photos", str(photographs), str(tmp_path / "capture")]
    listening = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # who starts the tests may ignore it
    process = subprocess.Popen(arguments, stdout=theirs, stderr=theirs, preexec_fn=listening)
    os.close(theirs)
    text = bytearray()

    def listen():
        while True:
            try:
                text.extend(os.read(ours, 4096))
            except OSError:
                return

    listener = threading.Thread(target=listen)
    listener.start()
    until = time.monotonic() + 120
    while b"matching" not in text and time.monotonic() < until:
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(number)
    assert process.wait(120) == 128 + number
    assert not (tmp_path / "capture/work/sparse").exists()  # it did not wait for the end of it
    listener.join()
    os.close(ours)
    last = text.decode().replace("\r", "\n").split("\n")
    assert [line for line in last if line.strip()][-1] == "interrupted; to continue, give the same command again"
    assert b"Traceback" not in text and (tmp_path / "capture/work/sheet.json").exists()


def test_a_photograph_that_does_not_show_the_object_is_left_out(tmp_path, capsys):
    """And those that do go on without it."""
    random, frames = np.random.default_rng(3), []
    for k, pose in enumerate(poses(20)):
        if k == 5:
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 70, degrees=True).as_matrix()
        Image.fromarray(in_a_dim_room(pose, random)[0].astype(np.uint8)).save(tmp_path / f"{k:02}.png")
        frames.append({"file_path": f"{k:02}.png", "transform_matrix": (pose @ np.diag([1, -1, -1, 1.0])).tolist()})
    top = {"fl_x": 170, "fl_y": 176, "cx": 77, "cy": 64, "w": 160, "h": 120, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(top))
    photos.main([str(tmp_path), str(tmp_path / "capture")])
    assert "Masks: 19 of 20 photographs\n  without: 05: " in capsys.readouterr().out
    capture = load_capture(tmp_path / "capture/scene.xml")
    assert len(capture) == 19 and "05" not in capture.names


def test_photographs_from_one_place_are_told_after_the_first_pairs(tmp_path, speckles):
    pytest.importorskip("pycolmap")
    random, whole = np.random.default_rng(0), rendered(next(walk(14)), speckles)
    for k in range(14):
        moved = np.roll(whole, random.integers(-9, 10, 2), (0, 1)) + random.normal(0, 3, whole.shape)
        Image.fromarray(moved.clip(0, 255).astype(np.uint8)).save(tmp_path / f"{k:02}.png")
    batches = []

    def counting(things, what, *_):
        return (batches.append(what) or thing for thing in things)

    with pytest.raises(InputError, match=r"100% of the first 60 pairs are from one place; walk around"):
        structure_from_motion(find_pictures(tmp_path), {}, tmp_path / "work", counting)
    assert batches.count("matching") == BATCH
    database = tmp_path / "work/database.db"  # where an interrupted one goes on there are more pairs than are asked for
    assert static_share(database, [("01.png", "00.png"), ("02.png", "03.png")]) == 1
    assert static_share(database, [("01.png", "00.png"), ("12.png", "13.png")]) == 0.5


def test_photographs_that_are_the_same_file_are_named(tmp_path):
    for k in range(9):
        Image.fromarray(np.full((6, 8, 3), 10 * (k % 8), np.uint8)).save(tmp_path / f"{k}.png")
    with pytest.raises(InputError, match=r"FOLDER: 0.png, 8.png are the same photograph; keep one of them"):
        find_pictures(tmp_path)


@pytest.mark.parametrize(("name", "pattern"), [
    ("3_mask.png", "3_mask.png: FOLDER: looks like the mask of 3.png; move masks to a folder of their own"),
    ("3.tif", "3.tif: FOLDER: has the name of 3.png; keep one of them, or move masks to a folder"),
])  # fmt: skip
def test_masks_among_the_photographs_are_refused(tmp_path, name, pattern):
    for k in range(8):
        Image.new("RGB", (20, 10), (k, 9, 8)).save(tmp_path / f"{k}.png")
    Image.new("L", (20, 10), 255).save(tmp_path / name)
    with pytest.raises(InputError, match=pattern):
        find_pictures(tmp_path)
    (tmp_path / "masks").mkdir()
    moved = (tmp_path / name).rename(tmp_path / "masks" / name)
    found = [picture.mask_file(tmp_path / "masks") for picture in find_pictures(tmp_path)]
    assert found == [None] * 3 + [moved] + [None] * 4


def test_a_broken_photograph_may_be_replaced(tmp_path):
    for k in range(8):
        Image.fromarray(np.full((6, 8, 3), 10 * k, np.uint8)).save(tmp_path / f"{k}.jpg")
    work = tmp_path / "work"
    require_same_photographs(find_pictures(tmp_path), work)
    Image.fromarray(np.full((12, 8, 3), 7, np.uint8)).save(tmp_path / "3.jpg")
    require_same_photographs(find_pictures(tmp_path), work)  # nothing has been made of them
    (work / "sheet.json").write_text("{}")
    require_same_photographs(find_pictures(tmp_path), work)
    Image.fromarray(np.full((24, 8, 3), 7, np.uint8)).save(tmp_path / "3.jpg")
    with pytest.raises(InputError, match="work: is of other photographs"):
        require_same_photographs(find_pictures(tmp_path), work)
    (work / "photographs.json").write_text(json.dumps({"00.png": [123, 1]}))  # as it was once
    with pytest.raises(InputError, match="work: was begun by another version"):
        require_same_photographs(find_pictures(tmp_path), work)


def test_a_bar_is_shown_in_a_terminal_of_no_columns(monkeypatch):
    ours, theirs = pty.openpty()
    with open(theirs, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        list(progress(range(3), "counting"))
        print("end", file=terminal, flush=True)
        assert b"counting" in os.read(ours, 1000)
    os.close(ours)


def test_a_bar_is_lines_of_a_log(monkeypatch):
    log = io.StringIO()
    monkeypatch.setattr(sys, "stderr", log)
    list(progress(range(3), "counting"))
    assert not log.getvalue()  # it took no time
    monkeypatch.setattr("mi_ring.system.progress.DELAY", 0.0)
    list(progress(range(3), "counting", mininterval=0))
    first, last = log.getvalue().splitlines()  # it took no time between them
    assert first.startswith("counting") and "3/3" not in first and "3/3" in last and log.getvalue().endswith("\n")
    monkeypatch.setattr("mi_ring.system.progress.LOG_INTERVAL", 0.0)
    list(progress(range(3), "counting", mininterval=0))
    lines = log.getvalue().splitlines()[2:]
    assert len(lines) >= 3 and "3/3" in lines[-1] and "\r" not in log.getvalue()
    assert all(line.startswith("counting") for line in lines)


def save_turned(pixels, path, orientation):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(pixels).save(path, exif=exif)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_the_alpha_of_a_grey_photograph_is_its_mask(tmp_path, kind):
    grey, alpha = (np.arange(35).reshape(5, 7) * step % np.iinfo(kind).max for step in (7, 1000))
    pixels = np.dstack([grey, alpha]).astype(kind)
    file = tmp_path / "a.tif"
    if kind == np.uint8:
        file = tmp_path / "a.png"
        Image.fromarray(pixels).save(file)
    else:
        tifffile.imwrite(file, pixels, photometric="minisblack", planarconfig="contig", extrasamples=["unassalpha"])
    picture = Picture(file)
    np.testing.assert_array_equal(picture.pixels, pixels[..., [0, 0, 0, 1]])
    np.testing.assert_array_equal(picture.mask("alpha"), pixels[..., 1] // (np.iinfo(kind).max // 255))


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_are_turned_as_pillow_turns_them(orientation, suffix, tmp_path):
    pixels = np.zeros((40, 64, 4 if suffix == "png" else 3), np.uint8)
    pixels[4:12, 40:60] = 255
    file = tmp_path / f"a.{suffix}"
    save_turned(pixels, file, orientation)
    with Image.open(file) as image:
        expected = np.array(ImageOps.exif_transpose(image))
    picture, stored = Picture(file), Picture(file, upright=False)
    np.testing.assert_array_equal(picture.pixels, expected)
    assert picture.size == expected.shape[1::-1]
    assert stored.size == (64, 40)
    assert np.abs(stored.pixels.astype(int) - pixels).max() < 30
    if suffix == "png":
        np.testing.assert_array_equal(picture.mask("alpha"), expected[..., 3])
    mask = tmp_path / "masks"
    mask.mkdir()
    Image.fromarray(expected[..., 0]).save(mask / "a.png")  # as an editor shows and saves it
    np.testing.assert_array_equal(picture.mask(mask), expected[..., 0])
    # The middle of the bright patch, from that of the photograph, turns with it.
    before, after = (
        np.mean(np.nonzero(p[..., 0] > 100), 1)[::-1] + 0.5 - np.array(p.shape[1::-1]) / 2 for p in (pixels, expected)
    )
    np.testing.assert_allclose(orientation_axes(orientation) @ [*before, 7], [*after, 7], atol=0.6)


def test_the_flash_turns_with_the_camera(tmp_path):
    """Right of the lens in a landscape; the camera turned to the left, as EXIF's 8 says: above it."""
    for k, orientation in enumerate((1, 1, 8)):
        save_turned(np.zeros((4, 6, 3), np.uint8), tmp_path / f"{k}.jpg", orientation)
    pictures = [Picture(tmp_path / f"{k}.jpg") for k in range(3)]
    found = turn_with_cameras(pictures, np.array([10.0, 0, 1]))
    np.testing.assert_array_equal([found["0"], found["1"], found["2"]], [[10, 0, 1], [10, 0, 1], [0, -10, 1]])


def test_lights_are_those_that_the_sheet_tells(tmp_path):
    """Also of a photograph that was held on its side, and of one that shows nothing of the sheet, by its exposure."""
    for k, (orientation, seconds) in enumerate(((1, 0.01), (1, 0.02), (8, 0.02), (1, 0.04))):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        exif.get_ifd(ExifTags.IFD.Exif).update({0x829A: seconds, 0x829D: 2.0, 0x8827: 100})
        Image.new("RGB", (6, 4)).save(tmp_path / f"{k}.jpg", exif=exif)
    pictures = [Picture(tmp_path / f"{k}.jpg") for k in range(4)]
    poses = {}
    for k, picture in enumerate(pictures):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("zyx", [20 * k, 7, 150], degrees=True).as_matrix()
        pose[:3, 3] = 10 * k, -5, 300
        poses[picture.name] = (pose, np.array(picture.axes))
    motion = SparseModel({name: (LENS, pose) for name, (pose, _) in poses.items()}, np.zeros((0, 3)), None, {})
    flash = FlashCalibration(np.array([-20.0, -15, 2]), 1.5, np.zeros(3), 1.2, np.array([9.0, 8, 7]),
                  {"0": np.array([4.0, 4, 4]), "1": np.array([9.0, 8, 8]), "2": np.array([9.0, 9, 9])})  # fmt: skip
    taken = posed_pictures(pictures, motion, SegmentedObject({}, np.zeros(3), 0.2, None), np.zeros(3), flash)
    for one, (pose, axes) in zip(taken, poses.values()):
        np.testing.assert_allclose(one.light.vector, pose[:3, :3] @ axes @ flash.offset + pose[:3, 3])
        assert (one.falloff, one.gamma) == (1.5, 1.2)
    assert [one.measured for one in taken] == [True, True, True, False]
    np.testing.assert_allclose(taken[2].light.rgb, 9)
    np.testing.assert_allclose(taken[3].light.rgb, 2 * flash.power)  # 0.02 s are usual
    alone = posed_pictures(pictures, motion, SegmentedObject({}, np.zeros(3), 0.2, None), np.array([3.0, 0, 0]), None)
    np.testing.assert_allclose(alone[0].light.vector, poses["0"][0][:3, 0] * 3 + poses["0"][0][:3, 3])
    assert not any(one.measured for one in alone) and alone[0].falloff == 0


def test_photographs_without_flash_are_told_among_those_with(tmp_path):
    def write(name, fired):
        exif = Image.Exif()
        if fired is not None:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.Flash] = fired
        Image.new("RGB", (6, 4)).save(tmp_path / name, exif=exif)
        return Picture(tmp_path / name)

    pictures = [write(f"{k}.jpg", fired) for k, fired in enumerate((9, 16, 25, 9, None, 1))]
    assert without_flash(pictures) == ["1.jpg"]
    assert without_flash([pictures[1]] * 3 + [pictures[0]]) == []  # a torch does not fire


def test_models_of_cameras_are_told_apart(tmp_path):
    for k, model in enumerate(("One", "Other", "One", None)):
        exif = Image.Exif()
        if model:
            exif[ExifTags.Base.Model] = model
        Image.new("RGB", (8, 6)).save(tmp_path / f"{k}.jpg", exif=exif)
    assert camera_names([Picture(tmp_path / f"{k}.jpg") for k in range(4)]) == {"One": 2, "Other": 1}


def test_the_flash_and_up_are_as_photographs_are_shown_though_their_pixels_are_not_turned(tmp_path):
    for k in range(3):
        save_turned(np.zeros((4, 6, 3), np.uint8), tmp_path / f"{k}.jpg", 6)  # turned to the right when it is shown
    pictures = [Picture(tmp_path / f"{k}.jpg", upright=False) for k in range(3)]
    assert turn_with_cameras(pictures, np.array([10.0, 0, 1]))["1"].tolist() == [0, -10, 1]
    assert up_directions(pictures)["2"].tolist() == [-1, 0, 0]
    assert up_directions([Picture(tmp_path / "0.jpg")])["0"].tolist() == [0, -1, 0]


def test_the_flash_turns_with_heif_whose_reader_turns_the_pixels(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    for k, orientation in enumerate((1, 1, 8)):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        picture = heif.from_pillow(Image.fromarray(np.full((40, 64, 3), 90 * k, np.uint8)))
        picture.save(tmp_path / f"{k}.heic", exif=exif.tobytes())
    pictures = [Picture(tmp_path / f"{k}.heic") for k in range(3)]
    assert [picture.size for picture in pictures] == [(64, 40), (64, 40), (40, 64)]
    assert [picture.pixels.shape[:2] for picture in pictures] == [(40, 64), (40, 64), (64, 40)]
    found = turn_with_cameras(pictures, np.array([10.0, 0, 1]))
    np.testing.assert_array_equal([found["0"], found["1"], found["2"]], [[10, 0, 1], [10, 0, 1], [0, -10, 1]])


def test_names_that_scene_files_cannot_have(tmp_path):
    for k in range(8):
        Image.fromarray(np.full((6, 8, 3), k, np.uint8)).save(tmp_path / f"{k}.png")
    (tmp_path / "export.jpg").mkdir()  # no photograph
    assert len(find_pictures(tmp_path)) == 8
    for name, words in ((b"a$b.jpg", r"a\$b.jpg: FOLDER: has a \$"), (b"Gr\xfcn.jpg", "this name is not UTF-8")):
        file = Path(os.fsdecode(bytes(tmp_path) + b"/" + name))
        file.write_bytes(b"\xff\xd8" + name)
        with pytest.raises(InputError, match=words):
            find_pictures(tmp_path)
        file.unlink()


@pytest.mark.parametrize("compression", ["lzw", "zlib", "zstd"])
def test_compressed_tiffs(compression, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    pixels = np.full((48, 64, 3), (90, 120, 30), np.uint8)
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(pixels, compression=compression, photometric="rgb")
        file.write(pixels[::2, ::2] // 2, compression=compression, photometric="rgb", subfiletype=1)  # a thumbnail
    np.testing.assert_array_equal(Picture(tmp_path / "a.tif").srgb(), pixels)


def test_a_photograph_must_not_be_called_like_the_surface(tmp_path):
    for name in ("a", "b", "c", "d", "e", "f", "g", "object"):
        Image.fromarray(np.full((6, 8, 3), ord(name[0]), np.uint8)).save(tmp_path / f"{name}.png")
    with pytest.raises(InputError, match=r"object.png: FOLDER: .*; rename it"):
        find_pictures(tmp_path)


@pytest.mark.parametrize("orientation", FLIPS.values())
def test_raw_photographs_are_turned_as_libraw_turns_them(orientation, tmp_path):
    rawpy, tifffile = pytest.importorskip("rawpy"), pytest.importorskip("tifffile")
    mosaic = np.full((48, 64), 1000, np.uint16)
    mosaic[4:16, 40:60] = 30000
    colours = np.array([10000, 0, 0, 0, 10000, 0, 0, 0, 10000])
    matrix = np.stack([colours, np.full(9, 10000)], 1).ravel().tolist()
    tifffile.imwrite(tmp_path / "a.dng", mosaic, photometric=32803, extratags=[
        (274, 3, 1, orientation, True), (33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True),
        (50706, 1, 4, (1, 4, 0, 0), True), (50708, 2, 0, "none", True), (50721, 10, 9, matrix, True),
        (50728, 5, 3, (1, 1, 1, 1, 1, 1), True), (50717, 3, 1, 65535, True),
    ])  # fmt: skip
    with rawpy.imread(str(tmp_path / "a.dng")) as raw:
        expected = raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True)
    picture = Picture(tmp_path / "a.dng")
    assert picture.orientation == orientation and picture.size == expected.shape[1::-1]
    assert "pixels" not in vars(picture)  # they would stay in memory
    np.testing.assert_array_equal(picture.pixels, expected)
    assert Picture(tmp_path / "a.dng", upright=False).size == (64, 48)


def test_cameras_of_another_tool_are_taken_whatever_photographs_lack_or_are_gone(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    (tmp_path / "images").mkdir()
    label = ("<camera id='{0}' sensor_id='0' label='p{0}'>"
             "<transform>1 0 0 {0} 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>")  # fmt: skip
    (tmp_path / "cameras.xml").write_text(
        "<document><chunk><sensors><sensor id='0' type='frame'><calibration class='adjusted' type='frame'>"
        "<resolution width='64' height='40'/><f>60</f></calibration></sensor></sensors><cameras>"
        f"{''.join(label.format(k) for k in range(12))}</cameras></chunk></document>"
    )
    pixels = np.random.default_rng(0).integers(0, 255, (10, 40, 64, 3), np.uint8)
    for k in range(10):  # one has exposure in its EXIF, the others have none; two were deleted
        exif = Image.Exif()
        if k == 3:
            exif.get_ifd(0x8769).update({33434: 0.01, 33437: 2.0, 34855: 100})
        Image.fromarray(pixels[k]).save(tmp_path / f"images/p{k}.{'heic' if k % 2 else 'jpg'}", exif=exif)
    motion = imported_cameras(find_pictures(tmp_path / "images", upright=False))
    assert list(motion.cameras) == [f"p{k}" for k in range(10)] and not motion.failed
    np.testing.assert_allclose(np.diff([pose[0, 3] for _, pose in motion.cameras.values()]), 1)


def test_cameras_of_another_tool_are_those_of_the_pixels_as_stored(tmp_path):
    pixels, eye = np.random.default_rng(0).integers(0, 255, (8, 40, 60, 3), np.uint8), np.eye(4).tolist()
    for k in range(8):
        save_turned(pixels[k], tmp_path / f"{k}.jpg", k + 1)
    frames = [{"file_path": f"{k}.jpg", "transform_matrix": eye} for k in range(8)]
    top = {"fl_x": 60, "fl_y": 60, "cx": 30, "cy": 20, "w": 60, "h": 40, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(top))
    motion = imported_cameras(find_pictures(tmp_path, upright=False))
    assert {lens.size for lens, _ in motion.cameras.values()} == {(60, 40)}
    with pytest.raises(InputError, match=r"has a camera of 60 x 40 pixels for 4.jpg, which has 40 x 60"):
        imported_cameras(find_pictures(tmp_path))
