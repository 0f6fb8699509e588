"""Large photographs: reduced once, cropped to the object, and kept in the cache folder."""

import os
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image

import mi_ring
from mi_ring.calibration.rig import Rig
from mi_ring.capture import arrays, reduction
from mi_ring.capture.capture import Capture
from mi_ring.capture.decoding import LinearImage, recorded
from mi_ring.capture.loading import load_capture
from mi_ring.capture.pixels import Pixels
from mi_ring.geometry.camera import Camera
from mi_ring.scene.shot import Response, Shot, Window
from mi_ring.scene.tone_curve import ToneCurve
from mi_ring.synthesis.viewpoints import look_at
from mi_ring.system import cache
from mi_ring.system.cached_arrays import key_of

WIDTH, HEIGHT = 1300, 900
BOXES = [(300, 200, 760, 560), (420, 310, 840, 700), (250, 260, 610, 590)]  #: of the object: left, top, right, bottom


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def camera(k, size=(WIDTH, HEIGHT)):
    pose = look_at(np.array([4 * np.sin(k), 1.0, 4 * np.cos(k)]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera(pose, np.array([1400.0, 1380.0]), np.array([size[0] / 2 + 17, size[1] / 2 - 9]), size, -0.05)


def photographs(count=3, seed=3):
    """Noise, brighter to the right, and masks: the boxes."""
    random = np.random.default_rng(seed)
    images, masks = [], []
    for k in range(count):
        noise = random.integers(0, 90, (HEIGHT, WIDTH, 3)) + np.arange(WIDTH)[None, :, None] * 150 // WIDTH
        images.append(noise.astype(np.uint8))
        left, top, right, bottom = BOXES[k % 3]
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[top:bottom, left:right] = 255
        masks.append(mask)
    return images, masks


def capture_of(folder, **options):
    images, masks = photographs()
    made = Capture.from_arrays(images, masks, cameras=[camera(k) for k in range(3)], **options)
    return made.save(folder / "scene.xml").path


def srgb_to_linear(v):
    """By IEC 61966-2-1, in double precision."""
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_a_photograph_is_gone_from_memory_when_it_is_resized(kind, monkeypatch):
    class Pixels(np.ndarray):
        """Arrays that can have weak references."""

    alive, resized = [], reduction.resized
    shot = Shot("a", camera(0), encoding="linear" if kind == np.float32 else "srgb")
    window = reduction.windowed((WIDTH, HEIGHT), (7, 5), (1200, 800), 300)

    def read():
        image = photographs(1)[0][0].astype(kind).view(Pixels)
        alive.append(weakref.ref(image))
        return image

    monkeypatch.setattr(reduction, "resized", lambda *a: alive.append(alive[0]()) or resized(*a))
    reduction.reduced_image(shot, read, window)
    assert len(alive) > 2 and all(found is None for found in alive[1:])


@pytest.mark.parametrize("again", [False, True])  # True: the reduced photograph is read from the cache folder
def test_another_tone_curve_decodes_a_reduced_photograph_otherwise(tmp_path, again):
    """Closed form: linear = (S-curve⁻¹(sRGB⁻¹(value)))^(1/γ). The photograph is of one grey, so averages keep it."""
    value, given, curve = 90, ToneCurve(1.1, 1.2, 0.3), ToneCurve(1.3, 0.8, -0.1)
    grey = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    response = Response(given)
    made = Capture.from_arrays([grey] * 3, photographs()[1], cameras=[camera(k) for k in range(3)])
    path = (
        replace(made, shots=tuple(replace(shot, response=response) for shot in made.shots))
        .save(tmp_path / "s.xml")
        .path
    )
    capture = load_capture(path, width=200)
    if again:
        capture = load_capture(path, width=200)

    def linear(gamma, contrast, toe):
        odds = np.exp(toe) * (value / (255 - value)) ** (1 / contrast)
        return srgb_to_linear(odds / (1 + odds)) ** (1 / gamma)

    assert capture.observe([0]).rgb.numpy() == pytest.approx(linear(*given), rel=2e-3)
    other = tuple(replace(shot, response=Response(curve)) for shot in capture.shots)
    refined = replace(capture, shots=other)
    seen = refined.observe([0]).rgb.numpy()
    assert seen == pytest.approx(linear(*curve), rel=2e-3)
    assert recorded(seen[0], other[0]) == pytest.approx(float(srgb_to_linear(value / 255)), rel=2e-3)


def test_a_window_is_the_same_camera():
    shot = Shot("a", camera(1))
    window = Window((310, 120), (800, 600), (400, 200), (WIDTH, HEIGHT))
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    whole, part = (s.camera.project(points)[0] for s in (shot, shot.through(window)))
    np.testing.assert_allclose(part, (whole - [310, 120]) / [2, 3], atol=1e-9)
    np.testing.assert_allclose(shot.through(window).frame, [[-155, -40], [(1300 - 310) / 2, (900 - 120) / 3]])
    back = shot.through(window).whole
    np.testing.assert_allclose(back.camera.project(points)[0], whole, atol=1e-9)
    assert back.size == (WIDTH, HEIGHT) and back.window is None


def test_windows_contain_the_masks_and_are_of_one_size(tmp_path):
    capture = load_capture(capture_of(tmp_path), width=200)
    assert {shot.size for shot in capture.shots} == {(200, capture.shots[0].size[1])}
    for shot, (left, top, right, bottom) in zip(capture.shots, BOXES):
        (x, y), (width, height) = shot.window.corner, shot.window.extent
        assert x < left - 10 and y < top - 10 and x + width > right + 10 and y + height > bottom + 10
        assert width < 0.5 * WIDTH
    for mask, (left, top, right, bottom) in zip(capture.masks, BOXES):  # as many pixels as the scale says
        area = (right - left) * (bottom - top) / np.prod(capture.shots[0].window.scale)
        assert mask.sum() / 255 == pytest.approx(area, rel=1e-2)


def test_pixels_are_means_of_linear_light(tmp_path):
    """Twice as small, cropped: an independent mean; in several strips, as the photograph has 900 rows."""
    path = capture_of(tmp_path, saturation=0.9)
    whole = load_capture(path)
    bounds = [np.array(box).reshape(2, 2) for box in BOXES]
    size = reduction.crop_windows(whole.shots, bounds, 10**6)[0].extent
    width = size[0] // 2
    capture = load_capture(path, width=width)
    images = photographs()[0]
    for k, shot in enumerate(capture.shots):
        (x, y), (columns, rows) = shot.window.corner, shot.window.extent
        assert shot.window.size == (columns // 2, rows // 2)
        encoded = images[k][y : y + rows, x : x + columns] / 255
        blocks = encoded.reshape(rows // 2, 2, columns // 2, 2, 3)
        seen = capture.observe([k])
        np.testing.assert_allclose(seen.rgb[0], srgb_to_linear(blocks).mean((1, 3)), rtol=1e-3, atol=1e-6)
        np.testing.assert_array_equal(seen.clipped[0], (blocks >= 0.9).any((1, 3)))


def test_the_size_is_met_where_the_scale_is_no_whole_number(tmp_path):
    """By areas: the sum of light stays."""
    capture = load_capture(capture_of(tmp_path), width=173)
    images = photographs()[0]
    for k, shot in enumerate(capture.shots):
        assert shot.size[0] == 173 and min(shot.window.scale) > 2
        (x, y), (columns, rows) = shot.window.corner, shot.window.extent
        expected = srgb_to_linear(images[k][y : y + rows, x : x + columns] / 255).mean((0, 1))
        np.testing.assert_allclose(capture.observe([k]).rgb[0].mean((0, 1)), expected, rtol=2e-3)


def test_pixels_that_are_not_valid_stay_so(tmp_path):
    images, masks = photographs()
    valid = np.full((HEIGHT, WIDTH), 255, np.uint8)
    valid[:, 500:503] = 0
    made = Capture.from_arrays(images, masks, cameras=[camera(k) for k in range(3)], valid=[valid, None, None])
    capture = load_capture(made.save(tmp_path / "scene.xml").path, width=200)
    shot, seen = capture.shots[0], capture.observe([0])
    inside = (np.arange(seen.valid.shape[2] + 1) * shot.window.scale[0]) + shot.window.corner[0]
    touched = (inside[1:] > 500) & (inside[:-1] < 503)
    np.testing.assert_array_equal(seen.valid[0].numpy(), np.broadcast_to(~touched, seen.valid.shape[1:]))


def test_a_photograph_without_a_mask_is_not_cropped_and_one_that_its_object_fills_neither(tmp_path):
    images, masks = photographs()
    cameras = [camera(k) for k in range(3)]
    for given in ([*masks[:2], None], [np.full_like(masks[0], 255), *masks[1:]]):
        capture = reduction.reduced(Capture.from_arrays(images, given, cameras=cameras), 400)
        assert {shot.window.extent for shot in capture.shots} == {(1299, 900)}  # 3 pixels are averaged first
    small = Capture.from_arrays([i[:, :500] for i in images], [m[:, :500] for m in masks],
                                cameras=[camera(k, (500, HEIGHT)) for k in range(3)])  # fmt: skip
    assert reduction.reduced(small, 600) is small


def test_the_second_time_no_photograph_is_decoded(tmp_path, monkeypatch, own_cache):
    path = capture_of(tmp_path)
    first = load_capture(path, width=200)
    assert len(cache.files()) == 3 + 3  # photographs, bounds of masks

    def fail(*arguments):
        raise AssertionError("decoded again")

    with monkeypatch.context() as patch:
        patch.setattr(reduction, "reduced_image", fail)
        patch.setattr(reduction, "reduced_mask", fail)
        second = load_capture(path, width=200)
        for k in range(3):
            for a, b in zip(first.observe([k])[:4], second.observe([k])[:4]):
                assert (a == b).all()
    # Another photograph in the place of one is noticed, and so is a damaged file.
    pixels = photographs(seed=8)[0][1]
    Image.fromarray(pixels).save(tmp_path / "images/001.png")
    for _, _, file in cache.files():
        file.write_bytes(file.read_bytes()[:-10])
    third = load_capture(path, width=200)
    assert (third.observe([0]).rgb == first.observe([0]).rgb).all()
    assert not (third.observe([1]).rgb == first.observe([1]).rgb).all()


@pytest.mark.parametrize("share", [0.02, 0.5, 0.999])
def test_damage_anywhere_in_a_cached_file_is_noticed(share, own_cache):
    """At its beginning, in its middle and in its checksum."""
    key, mask = key_of("damaged"), np.arange(6, dtype=np.uint8).reshape(2, 3)
    image = LinearImage(np.ones((2, 3, 3), np.float16), np.zeros((2, 3, 3), bool))
    content = bytearray(reduction.packed(key, {"images": image, "masks": mask}))
    cache.store(key, bytes(content))
    assert np.array_equal(reduction.unpacked(key, "masks", lambda: "made"), mask)
    content[int(share * len(content))] ^= 0xA1
    cache.store(key, bytes(content))
    assert reduction.unpacked(key, "masks", lambda: "made") == "made" and not cache.cached(key)


def test_garbage_of_the_right_length_in_the_cache_is_noticed(tmp_path, monkeypatch, own_cache):
    """Also where the folder is read-only, so that it cannot be removed."""
    path = capture_of(tmp_path)
    first = load_capture(path, width=200)
    entries = {file: file.read_bytes() for _, _, file in cache.files()}
    for file, content in entries.items():
        file.write_bytes(np.random.default_rng(1).bytes(len(content)))
    with monkeypatch.context() as read_only:
        read_only.setattr(Path, "unlink", Mock(side_effect=PermissionError("read-only")))
        read_only.setattr(cache, "store", lambda key, content: False)
        second = load_capture(path, width=200)
        assert [shot.window for shot in second.shots] == [shot.window for shot in first.shots]
        assert (second.observe([0]).rgb == first.observe([0]).rgb).all()
    load_capture(path, width=200)
    assert {file: file.read_bytes() for _, _, file in cache.files()}.keys() == entries.keys()


def test_what_is_in_the_cache_is_of_these_masks_alone(tmp_path):
    """Not of those that a caller ignores or replaces."""
    path = capture_of(tmp_path)
    without = load_capture(path, masks="none", width=512, crop=False)
    assert not any(without.masks.given)
    given = load_capture(path, width=512, crop=False)
    assert all(mask.any() for mask in given.masks)
    whole = load_capture(path)
    other = np.zeros((HEIGHT, WIDTH), np.uint8)
    other[:80, :90] = 255
    replaced = replace(whole, masks=Pixels.of([other] * 3))
    corner = reduction.reduced(replaced, 512).shots[0].window.corner
    assert corner == (0, 0) and load_capture(path, width=512).shots[0].window.corner != corner


def test_other_files_in_the_folder_of_the_cache_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    (tmp_path / "go").mkdir()
    for name in ("go/mine", "photographs.txt"):
        (tmp_path / name).write_bytes(bytes(1000))
    load_capture(capture_of(tmp_path), width=200)
    (cache.cache_folder() / "notes.txt").write_text("mine")
    cache.prune(10)
    cache.empty()
    assert cache.size() == 0 and (cache.cache_folder() / "notes.txt").exists()
    assert (tmp_path / "go/mine").exists() and (tmp_path / "photographs.txt").exists()


def test_the_lens_of_photographs_on_their_side_is_one(tmp_path):
    """Their reduced focal lengths differ."""
    images = [photographs()[0][0], np.ascontiguousarray(photographs()[0][1].transpose(1, 0, 2))]
    cameras = [camera(0)._replace(focal=np.array([1400.0, 1400.0])),
               camera(1, (HEIGHT, WIDTH))._replace(focal=np.array([1400.0, 1400.0]))]  # fmt: skip
    capture = reduction.reduced(Capture.from_arrays(images, cameras=cameras), 300)
    assert capture.shots[0].camera.focal[0] < 0.8 * capture.shots[1].camera.focal[0]
    assert Rig(capture, np.zeros(3), 1.0).lens.tolist() == [0, 0]


@pytest.mark.parametrize("size", [(6655, 4991), (4093, 4093), (1301, 977)])
def test_the_squares_that_are_averaged_fill_the_window(size):
    window = reduction.windowed(size, (0, 0), size, 512)
    assert all(side % window.blocks == 0 for side in window.extent)
    assert window.blocks <= window.scale.min() and window.size[0] <= 512


def test_where_the_cache_cannot_be_written_photographs_are_read_each_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "file/cache"))
    capture = load_capture(capture_of(tmp_path), width=200)
    assert capture.observe([0, 2]).rgb.shape[2] == 200


def test_what_was_not_used_for_the_longest_time_leaves_the_cache_first():
    for k in range(5):
        cache.store(f"{k:032x}", bytes(1000))
        os.utime(cache.cache_folder() / f"{k:032x}", (k, k))
    cache.cached(f"{0:032x}")
    cache.prune(4000)
    left = {int(path.name, 16) for _, _, path in cache.files()}
    assert left == {0, 3, 4} and cache.size() == 3000
    cache.empty()
    assert cache.size() == 0


def test_threads_that_prune_at_the_same_time_remove_no_more_than_one_would(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    for k in range(400):
        cache.store(f"{k:032x}", bytes(1000))
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(cache.prune, [300_000] * 8))
    assert cache.size() == 240_000


def test_the_hull_of_crops_knows_that_nothing_is_outside(tmp_path):
    """A silhouette of the whole photograph: the mask in its place, with the camera of the whole."""
    path = capture_of(tmp_path)
    part, whole = load_capture(path, width=200).silhouettes(), load_capture(path).silhouettes()
    for silhouette, given, (left, top, right, bottom) in zip(part, whole, BOXES):
        point = given.camera.position + 4 * given.camera.directions(np.array([[100.0, 80.0]]))
        pasted, scale = silhouette.whole, given.camera.focal[0] / silhouette.camera.focal[0]
        rows, columns = np.nonzero(pasted.mask > 127)
        found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        expected = np.array([left, top, right, bottom]) / 3  # the silhouettes of 1300 pixels are made 3 times smaller
        np.testing.assert_allclose(np.array(found) * scale, expected, atol=2 * scale)
        np.testing.assert_allclose(pasted.camera.project(point)[0] * scale, [[100, 80]], atol=scale)
    hull = load_capture(path, width=200).hull
    far = torch.from_numpy(whole[0].camera.position + 4 * whole[0].camera.directions(np.array([[20.0, 20.0]]))).float()
    assert (hull.depth(far) < 0).all()


def test_masks_by_brightness_are_found_in_large_photographs(tmp_path):
    images, masks = photographs()
    dark = [np.where(m[..., None] > 0, np.maximum(i, 60), i % 3).astype(np.uint8) for i, m in zip(images, masks)]
    made = Capture.from_arrays(dark, cameras=[camera(k) for k in range(3)])
    capture = load_capture(made.save(tmp_path / "scene.xml").path, masks="auto", width=200)
    assert capture.threshold is not None
    for shot, mask, (left, top, right, bottom) in zip(capture.shots, capture.masks, BOXES):
        rows, columns = np.nonzero(mask > 127)
        found = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).reshape(2, 2)
        there = found * shot.window.scale + shot.window.corner
        np.testing.assert_allclose(there.ravel(), [left, top, right, bottom], atol=2 * max(shot.window.scale))


def test_the_results_of_a_fit_are_of_whole_photographs(tmp_path):
    """Sizes, cameras and masks; a refined focal length is in pixels of the photograph."""
    path = capture_of(tmp_path)
    config = mi_ring.Config.preset("fast", iterations=3, levels=(2,), widths=(64,), shares=(1,), subdivisions=2,
                                    domain="sphere", refine=("focal",), indirect=False)  # fmt: skip
    fit = mi_ring.Fit(load_capture(path), config)
    assert max(shot.size[0] for shot in fit.capture.shots) == reduction.WIDTH < WIDTH
    for _ in fit:
        pass
    fit.capture = replace(fit.capture)
    fit.course.masks[0] = None  # its mask counts as found anew
    fit.save(tmp_path / "run")
    again = load_capture(tmp_path / "run/scene.xml")
    given = load_capture(path)
    for found, shot in zip(again.shots, given.shots):
        assert found.size == shot.size and found.window is None
        np.testing.assert_allclose(found.camera.centre, shot.camera.centre, atol=1e-3)
        np.testing.assert_allclose(found.camera.focal, shot.camera.focal, rtol=0.01)
        np.testing.assert_allclose(found.camera.to_world, shot.camera.to_world, atol=1e-5)
    entry = fit.result().calibration["unknowns"]["focal"]
    assert np.ravel(entry["before"])[0] == pytest.approx(1390)
    overlap = (again.masks[0] > 127) == (given.masks[0] > 127)
    assert again.masks[0].shape == (HEIGHT, WIDTH) and overlap.mean() > 0.99


LARGE = """
import re, resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_DATA, (int(2.5 * 2**30),) * 2)
from mi_ring.system.machine import keep_memory
keep_memory()
import mi_ring
from mi_ring.capture.loading import load_capture
capture = load_capture(sys.argv[1], width=512)
config = mi_ring.Config.preset("fast", iterations=2, levels=(2,), widths=(64,), shares=(1,), domain="sphere",
                                indirect=False)
for it in mi_ring.Fit(capture, config):
    pass
# Not ru_maxrss, which counts the process that has started this one.
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 2**20)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_memory_does_not_grow_with_photographs(tmp_path):
    """Of 16 megapixels, as many as would not fit if each kept what it takes as floats, 192 MB."""
    small, masks = photographs()
    size, cameras = (4000, 4000 * HEIGHT // WIDTH), []
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for k in range(3):
        Image.fromarray(small[k]).resize(size).save(tmp_path / f"images/{k}.jpg", quality=80)
        Image.fromarray(masks[k]).resize(size, Image.Resampling.NEAREST).save(tmp_path / f"masks/{k}.png")
        scale = size[0] / WIDTH
        shot = camera(k)
        cameras.append(shot._replace(focal=scale * shot.focal, centre=scale * shot.centre, size=size))
    shots, relative = [], []
    for k in range(24):
        if k >= 3:
            (tmp_path / f"images/{k}.jpg").hardlink_to(tmp_path / f"images/{k % 3}.jpg")
        files = arrays.Files(Path(f"images/{k}.jpg"), Path(f"masks/{k % 3}.png"))
        shots.append(Shot(f"{k:02}", cameras[k % 3], files=files, saturation=1 - 0.001 * k))  # none is read for another
        relative.append(files)
    (tmp_path / "scene.xml").write_bytes(arrays.scene_xml(shots, relative, None, None, None))
    done = subprocess.run([sys.executable, "-c", LARGE, tmp_path / "scene.xml"], capture_output=True,
                          text=True, env=os.environ | {cache.VARIABLE: str(tmp_path / "cache")})  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 1.6
