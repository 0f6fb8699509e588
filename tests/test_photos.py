"""The command that makes a capture of a folder of photographs, and the stages of its way."""

import json
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.ellipsoid_pictures import CENTER, LENS, hit_ellipsoid, in_a_dim_room, poses
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ring import photos
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.images import write_image
from mi_ring.photogrammetry.folder import Picture, find_pictures, relative_exposures, without_exposure
from mi_ring.photogrammetry.object_masks import box_mask, kept_masks
from mi_ring.photogrammetry.shading_trial import ASSUMED_ALBEDO
from mi_ring.photogrammetry.structure_from_motion import SparseModel
from mi_ring.photogrammetry.table_plane import Plane
from mi_ring.photogrammetry.workflow import find_sheet, imported_cameras, make_upright, require_parallax
from mi_ring.system import command
from mi_ring.system.progress import progress

OPENGL = np.diag([1.0, -1, -1, 1])


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """The folder of which each test has a copy."""
    folder, random, frames = tmp_path_factory.mktemp("photographed"), np.random.default_rng(3), []
    (fx, fy), (cx, cy) = LENS.focal, LENS.centre
    for k, pose in enumerate(poses(20)):
        rgb, _ = in_a_dim_room(pose, random)
        Image.fromarray(rgb.astype(np.uint8)).save(folder / f"{k:02}.png")
        frames.append({"file_path": f"{k:02}.png", "transform_matrix": (pose @ OPENGL).tolist()})
    top = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": 160, "h": 120, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(top))
    return folder


@pytest.fixture
def folder(photographed, tmp_path):
    """Photographs of an ellipsoid in a dim room with lamps, and their cameras as transforms.json."""
    return Path(shutil.copytree(photographed, tmp_path / "photographs"))


def test_from_photographs_with_cameras_to_a_capture(folder, tmp_path, capsys):
    out = tmp_path / "capture"
    photos.main([str(folder), str(out), "--flash-offset", "0.1", "-0.05", "0"])
    text = capsys.readouterr().out
    assert f"Cameras: 20 of 20 photographs, as given by {folder / 'transforms.json'}" in text
    # They are equally bright at all distances.
    assert text.count("Problem: ") == text.count("Problem: brightness falls too little with the flash's distance") == 1
    capture = load_capture(out / "scene.xml")
    assert len(capture) == 20 and all(mask is not None for mask in capture.masks)
    center, radius = capture.sphere()
    np.testing.assert_allclose(center, 0, atol=0.02)
    assert 1.0 < 18 * radius / 2.5 < 1.7  # of the ellipsoid's mean axis; the unit is the distance of the cameras
    distances = [np.linalg.norm(shot.camera.position) for shot in capture.shots]
    assert np.median(distances) == pytest.approx(1, abs=0.02)
    camera, light = capture.shots[3].camera, capture.photographs.lights.positions()[3]
    local = camera.to_world[:3, :3].T @ (light - camera.position)
    np.testing.assert_allclose(local, [-0.1, 0.05, 0], atol=1e-5)  # Mitsuba's axes
    assert capture.reflectance(np.zeros(3), capture.exposure()) * np.pi > 1.5  # not known: interreflection is left out
    with pytest.raises(InputError, match="DIR: has a scene.xml already"):
        photos.main([str(folder), str(out)])
    (out / "scene.xml").unlink()
    for name in ("images", "masks", "valid"):
        for file in (out / name).glob("*"):
            file.unlink()
    before = {file: file.stat().st_mtime_ns for file in (out / "work/masks").iterdir()}
    photos.main([str(folder), str(out)])  # from what is in work/
    assert before == {file: file.stat().st_mtime_ns for file in (out / "work/masks").iterdir()}
    (out / "scene.xml").unlink()
    with pytest.raises(InputError, match="work/masks: has masks that were found with other --masks; remove it"):
        photos.main([str(folder), str(out), "--masks", "alpha"])
    for name in ("images", "masks", "valid"):
        shutil.rmtree(out / name, ignore_errors=True)
    (out / "work/masks/03.png").unlink()  # of no use
    photos.main([str(folder), str(out)])
    assert "Masks: 19 of 20 photographs" in (printed := capsys.readouterr().out)
    assert "Assumed: 20 files of 8 bits are sRGB\n" in printed
    assert len(load_capture(out / "scene.xml")) == 19
    (folder / "07.png").unlink()
    (out / "scene.xml").unlink()
    with pytest.raises(InputError, match="work: is of other photographs"):
        photos.main([str(folder), str(out)])


def test_masks_that_were_painted_in(folder, tmp_path):
    file = tmp_path / "01.png"
    soft = np.linspace(0, 65535, 80).astype(np.uint16)[None].repeat(60, 0)[..., None]
    write_image(soft, file)  # half of the photograph's size
    found = kept_masks([Picture(folder / f"{k:02}.png") for k in range(3)], tmp_path)
    assert list(found) == ["01"] and np.unique(found["01"]).tolist() == [0, 128, 255]
    assert [(found["01"] == value).mean() for value in (0, 128, 255)] == [0.25, 0.5, 0.25]
    write_image(np.zeros((100, 160, 1), np.uint8), file)
    with pytest.raises(InputError, match=r"01.png: is 160 x 100 pixels, .* 160 x 120 of its photograph"):
        kept_masks([Picture(folder / "01.png")], tmp_path)
    with pytest.raises(InputError, match="has no masks any more"):
        kept_masks([Picture(folder / "00.png")], tmp_path)


def test_a_box_in_a_photograph_is_where_its_corners_are(folder):
    camera = LENS.camera(next(poses(20)))
    low, high = CENTER + np.array([[-2, -3, -1], [1, 2, 3]])
    shown = box_mask(camera, np.stack([low, high], 1).ravel())
    points = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    pixel, _ = camera.project(points)
    column, row = pixel.astype(int).T
    inside = np.zeros((120, 160), np.uint8)
    inside[row, column] = 1
    assert (inside <= cv2.dilate(shown, np.ones((3, 3)))).all()
    assert (shown <= cv2.dilate(inside, np.ones((5, 5)))).all()


def test_a_capture_is_not_written_among_what_it_is_made_of(folder, tmp_path):
    for arguments in ([folder, folder], [folder, folder.parent, "--masks", folder.parent / "masks"]):
        (folder.parent / "masks").mkdir(exist_ok=True)
        with pytest.raises(InputError, match="is where the capture is written"):
            photos.main([str(argument) for argument in arguments])
    folder.rename(tmp_path / "images")
    with pytest.raises(InputError, match="images: FOLDER: is where the capture is written"):
        photos.main([str(tmp_path / "images"), str(tmp_path)])


def test_geocentric_cameras_and_wrong_ones(folder):
    file = folder / "transforms.json"
    top = json.loads(file.read_text())
    pictures = find_pictures(folder, upright=False)
    near = imported_cameras(pictures)
    for frame in top["frames"]:
        for row, shift in zip(frame["transform_matrix"], (4.1e6, 6.2e5, -4.8e6)):
            row[3] += shift
    file.write_text(json.dumps(top))
    far = imported_cameras(pictures)
    for name, (_, pose) in far.cameras.items():
        np.testing.assert_allclose(pose, near.cameras[name][1], atol=1e-8)
    for frame in top["frames"]:
        frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
    file.write_text(json.dumps(top))
    with pytest.raises(InputError, match=r"00.png: camera: the last row of its pose is .*; is it transposed"):
        imported_cameras(pictures)


@pytest.fixture
def brought(tmp_path):
    """A folder of masks of the ellipsoid."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for k, pose in enumerate(poses(20)):
        mask = np.isfinite(hit_ellipsoid(LENS.camera(pose))[0]).reshape(120, 160)
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(folder / f"{k:02}.png.png")
    return folder


def test_photographs_of_12_bits_in_16(folder, brought, tmp_path, capsys):
    """Over-exposed pixels are known, and light and object are in the units of the files."""
    for file in folder.glob("*.png"):
        linear = 1.5 * srgb_to_linear(np.asarray(Image.open(file)) / np.float32(255))
        write_image((linear.clip(0, 1) * 4095 + 0.5).astype(np.uint16), file)
    photos.main([str(folder), str(tmp_path / "capture"), "--masks", str(brought)])
    assert (
        "20 photographs of 16 bits is above 4095: taken for 12 bits, over-exposed at 4095\n" in capsys.readouterr().out
    )
    capture = load_capture(tmp_path / "capture/scene.xml")
    albedos = []
    for k, shot in enumerate(capture.shots):
        rgb, clipped, mask = (own[0].numpy() for own in capture.observe([k])[:3])
        assert shot.saturation == pytest.approx(4094.5 / 65535) and clipped.any()
        np.testing.assert_array_equal(clipped, rgb > 4094.6 / 65535)
        distance = np.linalg.norm(shot.camera.position)
        albedos.append(np.pi * rgb[mask > 0.5].mean() * distance**2 / shot.light.rgb.mean())
    assert np.median(albedos) == pytest.approx(ASSUMED_ALBEDO, rel=0.05)


def test_masks_that_the_user_brings(folder, brought, tmp_path):
    photos.main([str(folder), str(tmp_path / "capture"), "--masks", str(brought)])
    capture = load_capture(tmp_path / "capture/scene.xml")
    first = next(poses(20))
    inside = np.isfinite(hit_ellipsoid(LENS.camera(first))[0]).sum()
    assert (capture.masks[0] > 127).sum() == inside
    for file in list(brought.iterdir())[8:]:
        file.unlink()
    with pytest.raises(InputError, match=r"--masks: .*masks: has masks for 8 of 20 photographs"):
        photos.main([str(folder), str(tmp_path / "other"), "--masks", str(brought)])


@pytest.mark.parametrize(("arguments", "words"), [
    (["nowhere", "out"], "nowhere: FOLDER: no such folder"),
    (["{folder}", "out", "--square-mm", "0"], "--square-mm: is 0"),
    (["{folder}", "out", "--turntable"], "--turntable: the sheet"),
    (["{folder}", "out", "--box", "0", "1", "0", "1", "0", "1"], "--box: is in the frame of the sheet"),
    (["{folder}", "out", "--box", "0", "1", "1", "0", "0", "1"], "--box: is 0.0 1.0 1.0 0.0 0.0 1.0, must be lowest"),
    (["{folder}"], "DIR is missing; --help tells more"),
    ([], "FOLDER and DIR are missing; --help tells more"),
    (["{folder}", "out", "--flash-offset", "1"], "--flash-offset: must be 3 values"),
    (["{folder}", "out", "--masks", "typo"], "--masks: typo: no such folder; give auto"),
])  # fmt: skip
def test_mistakes_of_the_user(arguments, words, folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.photos", photos.main, [a.format(folder=folder) for a in arguments])
    message = capsys.readouterr().err.splitlines()[-1]
    assert stop.value.code == 2 and words in message


def test_upright_is_where_the_photographs_have_up_and_the_object_is_the_origin():
    turn = Rotation.from_euler("xyz", [70, 20, -30], degrees=True).as_matrix()
    cameras = {}
    for k, pose in enumerate(poses(12)):
        turned = np.eye(4)
        turned[:3, :3], turned[:3, 3] = turn @ pose[:3, :3], turn @ pose[:3, 3]
        cameras[str(k)] = LENS, turned
    motion = SparseModel(cameras, (turn @ CENTER)[None], None, {})
    ups = dict.fromkeys(cameras, np.array([0.0, -1, 0]))
    moved, none, known = make_upright(motion, turn @ CENTER, None, ups)
    np.testing.assert_allclose(moved.points, 0, atol=1e-9)
    heights = [pose[2, 3] for _, pose in moved.cameras.values()]
    distances = [np.linalg.norm(pose[:3, 3]) for _, pose in moved.cameras.values()]
    assert min(heights) > 0.1 and np.median(distances) == pytest.approx(1)
    assert none is None and known
    ways = {name: Rotation.from_euler("z", 150 * k, degrees=True).apply([0, -1, 0]) for k, name in enumerate(cameras)}
    assert not make_upright(motion, turn @ CENTER, None, ways)[2]  # held in every way
    low = Plane(turn[:, 2], float(turn[:, 2] @ turn @ (CENTER - [0, 0, 3])))  # 3 below the object's middle
    exact, plane, _ = make_upright(motion, turn @ CENTER, low, ups)
    np.testing.assert_allclose(plane.normal, [0, 0, 1], atol=1e-9)
    assert plane.offset * 18 == pytest.approx(-3, rel=0.1)  # the cameras are 18 away, now 1
    for (_, pose), before in zip(exact.cameras.values(), poses(12)):
        assert pose[2, 1] == pytest.approx(before[2, 1])  # how much the photograph's down is the world's up


@pytest.mark.parametrize("degrees, enough", [(12, False), (18, True)])
def test_photographs_from_one_side_are_refused(degrees, enough):
    turns = Rotation.from_euler("y", np.linspace(-degrees / 2, degrees / 2, 5)[:, None], degrees=True).as_matrix()
    poses_ = [np.block([[turn, np.ones((3, 1))], [np.eye(4)[3:]]]) for turn in turns]
    motion = SparseModel({str(k): (LENS, pose) for k, pose in enumerate(poses_)}, np.zeros((0, 3)), None, {})
    with nullcontext() if enough else pytest.raises(InputError, match="folder: .* within 12 degrees; walk around"):
        require_parallax(motion, Path("folder"))


def test_a_process_that_is_ended_says_nothing():
    """COLMAP's library would print a stack trace."""
    pytest.importorskip("pycolmap")
    code = "import os; from mi_ring.system.optional import need; need('pycolmap', ''); os.kill(os.getpid(), 15)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (-15, "")


def test_exposures_of_exif(tmp_path):
    pictures = []
    for k, seconds in enumerate((0.01, 0.02, 0.02, 0.05)):
        image = Image.new("RGB", (8, 6))
        exif = image.getexif()
        exif.get_ifd(0x8769).update({33434: seconds, 34855: 100, 33437: 4.0})
        image.save(tmp_path / f"{k}.jpg", exif=exif)
        pictures.append(Picture(tmp_path / f"{k}.jpg"))
    np.testing.assert_allclose(relative_exposures(pictures), [0.5, 1, 1, 2.5], rtol=1e-3)
    Image.new("RGB", (8, 6)).save(tmp_path / "none.jpg")
    silent = Picture(tmp_path / "none.jpg")
    np.testing.assert_allclose(relative_exposures([*pictures, silent]), [0.5, 1, 1, 2.5, 1], rtol=1e-3)
    assert without_exposure([*pictures, silent]) == ["none.jpg"]
    np.testing.assert_array_equal(relative_exposures([silent, silent]), np.ones(2))
    assert without_exposure([silent, silent]) == []


def test_damaged_photographs_are_named_together(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    for k in range(9):
        Image.fromarray(np.roll(noise, k)).save(tmp_path / f"{k}.jpg")
    for k in (2, 5):
        file = tmp_path / f"{k}.jpg"
        file.write_bytes(file.read_bytes()[:1500])
    with pytest.raises(InputError, match=r"2.jpg: cannot be read .*; 2 photographs cannot .*: 2.jpg, 5.jpg; repair"):
        find_sheet(find_pictures(tmp_path), 1.0, tmp_path, progress)
    assert not (tmp_path / "sheet.json").exists()


@pytest.mark.parametrize("size", [(1, 1), (1, 5000), (2000, 50)])
def test_photographs_too_small_or_too_narrow_for_features_are_named(size, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (9, 60, 80, 3), np.uint8)
    for k, pixels in enumerate(noise):
        Image.fromarray(pixels).resize(size if k == 4 else (80, 60)).save(tmp_path / f"{k}.png")
    with pytest.raises(InputError, match=r"4.png: is {} x {} pixels; the shorter side must .*; repair".format(*size)):
        find_sheet(find_pictures(tmp_path), 1.0, tmp_path, progress)


def test_inks_are_not_taken_for_light(tmp_path):
    inks = Image.new("CMYK", (9, 7), (20, 90, 200, 10))
    inks.save(tmp_path / "a.tif")
    inks.save(tmp_path / "a.jpg")
    for name in ("a.tif", "a.jpg"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read as photograph \(its colours .* CMYK; save"):
            _ = Picture(tmp_path / name).pixels
