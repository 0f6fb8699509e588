"""Scenes to tensors: decoding, masks, the normalising sphere, and one clear line for what is wrong."""

import gc
import io
import re
import shutil
import weakref
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import tifffile
import torch
from conftest import AXES, CENTER
from PIL import Image

from mi_ring import images
from mi_ring.capture import decoding, loading, observation
from mi_ring.capture.pixels import Pixels
from mi_ring.capture.scenefile import fitted_scene_xml
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.fitting.checkpoint import digests
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.importers.reading import pixels_of
from mi_ring.objects.ring_file import load_fit, ring_state
from mi_ring.rendering.surface import Surface
from mi_ring.system.files import write_state


def test_srgb_decoding_is_the_standards():
    image = np.array([[[0, 10, 11], [127, 200, 255]]], np.uint8)
    linear, clipped = decoding.decode(image, linear=False, saturation=1.0)
    # IEC 61966-2-1, by hand: 10/255 is on the straight part, 11/255 on the power
    expected = [0, 10 / 255 / 12.92, ((11 / 255 + 0.055) / 1.055) ** 2.4]
    assert linear[0, 0] == pytest.approx(expected, abs=1e-7)
    assert linear[0, 1] == pytest.approx([0.21223, 0.57758, 1.0], abs=1e-5)  # published table values
    assert clipped.tolist() == [[[False, False, False], [False, False, True]]]


def test_sixteen_bits_are_linear_and_all_of_them_count():
    image = np.array([[[0, 1, 257], [32768, 65534, 65535]]], np.uint16)
    linear, clipped = decoding.decode(image, linear=True, saturation=0.5)
    np.testing.assert_allclose(linear, image / 65535.0, rtol=1e-6)
    assert clipped.tolist() == [[[False, False, False], [True, True, True]]]


@pytest.mark.parametrize(("form", "quality"), [("JPEG", 95), ("JPEG", 40), ("WEBP", 80)])
def test_what_lossy_coding_moves_below_full_scale_is_clipped(form, quality):
    """Of what a bright spot clips, the values of full scale alone are 87 % at most."""
    y, x = np.mgrid[:240, :320][..., None] / 240
    noise = 1 + 0.05 * np.random.default_rng(3).normal(size=(240, 320, 1))
    light = 1.9 * np.exp(-3 * ((x - 0.6) ** 2 + (y - 0.4) ** 2)) * [1, 0.9, 0.8] * noise
    exact, file = (255 * light.clip(0, 1) + 0.5).astype(np.uint8), io.BytesIO()
    Image.fromarray(exact).save(file, form, quality=quality)
    lossy = np.asarray(Image.open(file).convert("RGB"))
    clipped = lossy >= 255 * decoding.clip_value(lossy, 1.0) - 0.5
    assert (lossy == 255)[light > 1].mean() < 0.88 and clipped[light > 1].mean() > 0.94
    assert clipped[light < 0.9].mean() < 0.001
    assert decoding.clip_value(exact, 1.0) == 1 and decoding.clip_value(lossy, 0.9) == 0.9
    assert decoding.clip_value(lossy.astype(np.float32), 1.0) == 1


def test_values_of_bright_surfaces_are_not_clipped():
    """Values that grow toward full scale, and a white of 254, are no clipped pixels of 255."""
    growing = np.repeat(np.arange(256, dtype=np.uint8), 20 + np.arange(256) ** 2 // 100).reshape(-1, 1)
    growing = np.repeat(growing[:, :, None], 3, 2)
    assert decoding.clip_value(growing, 1.0) == 1
    white = np.where(growing == 255, np.uint8(254), growing)
    assert decoding.clip_value(white, 1.0) == 1


def test_srgb_encoding_inverts_decoding():
    v = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_to_linear(images.linear_to_srgb(v)), v, atol=1e-5)


def test_sixteen_bit_files_are_read_with_all_bits(broken_capture):
    path, _ = broken_capture
    pixels = np.arange(56 * 40 * 3, dtype=np.uint16).reshape(40, 56, 3) * 9 + 3
    mi.Bitmap(pixels).write(str(path.parent / "images/002.png"))
    scene = loading.load_capture(path)
    rgb = scene.observe([2])[0]
    np.testing.assert_allclose(rgb[0].numpy(), pixels / 65535.0, rtol=1e-6)


@pytest.mark.parametrize("encoding", ["auto", "srgb"])
def test_ambient_light_is_subtracted(broken_capture, encoding):
    """In linear light; where either photograph is clipped the difference is at least as bright as can be told."""
    path, edit = broken_capture
    random = np.random.default_rng(2)
    ambient, lit = (random.integers(low, high, (40, 56, 3), np.uint8) for low, high in ((0, 90), (100, 255)))
    lit[3, 5], lit[4, 6], ambient[7, 8] = 255, 10, 200
    lit[7, 8] = 150
    for name, pixels in (("images/002.png", lit), ("images/dark.png", ambient)):
        mi.Bitmap(pixels).write(str(path.parent / name))
    said = '<string name="ambient" value="images/dark.png"/>'
    said += '<string name="encoding" value="srgb"/>' if encoding == "srgb" else ""
    edit('value="images/002.png"/>', 'value="images/002.png"/>' + said)
    capture = loading.load_capture(path)
    rgb, clipped, *_ = capture.observe([2])
    v = np.stack([lit, ambient]) / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    expected = linear[0] - linear[1]  # where there is nothing, noise about 0
    assert clipped[0, 3, 5].all() and not clipped[0, 4, 6].any() and (expected[7, 8] < 0).all()
    expected = expected.clip(0) if encoding == "srgb" else expected  # which knows nothing less than 0
    expected[3, 5] = 1
    np.testing.assert_allclose(rgb[0].numpy(), expected, atol=2e-6)
    assert "images/dark.png" in digests(capture, Config())


def test_tiff_files_are_read_with_all_bits(broken_capture):
    path, edit = broken_capture
    edit("images/002.png", "images/002.tiff")
    pixels = np.arange(56 * 40 * 3, dtype=np.uint16).reshape(40, 56, 3) * 9 + 3
    tifffile.imwrite(path.parent / "images/002.tiff", pixels)
    np.testing.assert_allclose(loading.load_capture(path).observe([2])[0][0].numpy(), pixels / 65535.0, rtol=1e-6)


def test_grey_pictures_and_those_with_alpha_are_read(broken_capture):
    path, edit = broken_capture
    edit("masks/001.png", "images/001.png")
    grey = np.arange(56 * 40, dtype=np.uint8).reshape(40, 56, 1)
    mi.Bitmap(grey).write(str(path.parent / "images/000.png"))
    rgb, alpha = np.concatenate([grey, grey // 2, grey // 3], 2), np.zeros_like(grey)
    alpha[10:20], alpha[20:30] = 255, 51
    mi.Bitmap(np.concatenate([rgb, alpha], 2)).write(str(path.parent / "images/001.png"))
    scene = loading.load_capture(path)
    assert np.array_equal(scene.images[0], np.repeat(grey, 3, 2))
    assert np.array_equal(scene.images[1][10:20], rgb[10:20])
    assert not scene.images[1][:10].any() and not scene.images[1][30:].any()  # transparent: black
    linear = decoding.decode(rgb, linear=False, saturation=1.0)[0]
    np.testing.assert_allclose(scene.observe([1])[0][0, 20:30], 0.2 * linear[20:30], rtol=0.1, atol=2e-4)
    assert np.array_equal(scene.masks[1], alpha[..., 0])  # the photograph is its own mask


def test_a_photograph_without_alpha_is_no_mask(broken_capture):
    path, edit = broken_capture
    edit("masks/001.png", "images/001.png")
    with pytest.raises(
        InputError, match=r'001.png: photograph "001", mask: is the photograph itself, which has no alp'
    ):
        loading.load_capture(path)


def test_sixteen_bit_masks_are_read(broken_capture):
    path, _ = broken_capture
    mask = np.zeros((40, 56, 1), np.uint16)
    mask[10:20, 5:30] = 65535
    mi.Bitmap(mask).write(str(path.parent / "masks/003.png"))
    assert np.array_equal(loading.load_capture(path).masks[3], (mask[:, :, 0] // 257).astype(np.uint8))


def test_files_are_those_beside_the_scene_not_those_of_the_working_directory(broken_capture, monkeypatch):
    path, _ = broken_capture
    elsewhere = path.parent.parent / "elsewhere"
    shutil.copytree(path.parent, elsewhere)
    (path.parent / "images/003.png").unlink()
    monkeypatch.chdir(elsewhere)
    with pytest.raises(InputError, match="images/003.png"):
        loading.load_capture(path)


def test_a_shape_needs_no_id(broken_capture):
    path, edit = broken_capture
    edit(' id="object"', "")
    scene = loading.load_capture(path)
    Surface(scene.scene, scene.shape)


def test_a_rotation_of_nine_numbers_may_have_its_place_beside_it(broken_capture):
    path, _ = broken_capture
    before = [shot.camera.to_world for shot in loading.load_capture(path, images=False).shots]

    def split(match):
        m = np.array(match[1].split(), float).reshape(4, 4)
        return '<matrix value="{} {} {}  {} {} {}  {} {} {}"/><translate x="{}" y="{}" z="{}"/>'.format(
            *m[:3, :3].ravel(), *m[:3, 3])  # fmt: skip

    path.write_text(re.sub('<matrix value="([^"]*)"/>', split, path.read_text()))
    after = [shot.camera.to_world for shot in loading.load_capture(path, images=False).shots]
    np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-5)


def test_declared_encoding_beats_the_default(broken_capture):
    path, edit = broken_capture
    edit('<string name="filename" value="images/001.png"/>',
         '<string name="filename" value="images/001.png"/><string name="encoding" value="srgb"/>')  # fmt: skip
    pixels = np.arange(56 * 40 * 3, dtype=np.uint16).reshape(40, 56, 3) * 9 + 3
    for k in (1, 2):
        mi.Bitmap(pixels).write(str(path.parent / f"images/{k:03}.png"))
    scene = loading.load_capture(path)
    for k, convert in ((1, srgb_to_linear), (2, np.float32)):
        np.testing.assert_allclose(scene.observe([k])[0][0].numpy(), convert(pixels / 65535.0), atol=1e-6)


def test_shrinking_averages_blocks(small_capture):
    scene = loading.load_capture(small_capture)
    full, _, mask, masked, _ = scene.observe([3, 7])
    small, _, coverage, *_ = scene.observe([3, 7], 4)
    assert masked.tolist() == [True, True]
    assert small.shape == (2, 10, 14, 3) and coverage.shape == (2, 10, 14)
    torch.testing.assert_close(small[1, 4, 6], full[1, 16:20, 24:28].mean((0, 1)))
    torch.testing.assert_close(coverage[0, 5, 7], mask[0, 20:24, 28:32].mean())


@pytest.fixture
def decodes(monkeypatch):
    """How many photographs have been decoded."""
    calls, decode = [], decoding.decode
    monkeypatch.setattr(observation, "decode", lambda *args: calls.append(None) or decode(*args))
    return lambda: len(calls)


def test_small_photographs_are_remembered_as_many_as_fit(small_capture, monkeypatch, decodes):
    monkeypatch.setattr(observation, "REMEMBERED_PIXELS", 3 * 28 * 20 + 7)
    scene = loading.load_capture(small_capture)
    first = scene.observe([5, 2, 9, 4], 2)
    again = scene.observe([4, 9, 5], 2)
    assert all(torch.equal(a[[3, 2, 0]], b) for a, b in zip(first[:4], again[:4]))
    assert decodes() == 5
    scene.observe([7], 1)
    scene.observe([7], 1)
    assert decodes() == 7


def test_cleared_caches_are_filled_again(small_capture, decodes):
    scene = loading.load_capture(small_capture)
    first = scene.observe([5, 2], 2)
    scene.clear_caches()
    again = scene.observe([5, 2], 2)
    assert decodes() == 4
    assert all(torch.equal(a, b) for a, b in zip(first[:4], again[:4], strict=True))


@pytest.fixture
def opened_files(monkeypatch):
    """Names of the photographs and masks that have been read whole."""
    calls, read = [], decoding.read_image
    monkeypatch.setattr(decoding, "read_image", lambda path, **how: calls.append(path.name) or read(path, **how))
    return calls


def test_of_very_many_photographs_the_headers_are_read_and_the_rest_when_it_is_needed(
    broken_capture, monkeypatch, opened_files
):
    path, _ = broken_capture
    whole = loading.load_capture(path)
    assert len(opened_files) == 24
    opened_files.clear()
    monkeypatch.setattr(loading, "MANY", 12 * 56 * 40 - 1)
    scene = loading.load_capture(path)
    assert opened_files == ["000.png", "000.png"]  # a photograph and its mask
    for one, other in zip(whole.observe([7, 2])[:4], scene.observe([7, 2])[:4], strict=True):
        assert torch.equal(one, other)
    assert len(opened_files) == 6
    Image.new("RGB", (56, 41)).save(path.parent / "images/004.png")
    with pytest.raises(InputError, match=r"004.png: photograph \"004\", filename: is 56 x 41 pixels.*56 x 40"):
        loading.load_capture(path)
    (path.parent / "images/004.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="004.png.*cannot be read as an image"):
        loading.load_capture(path)


def test_pixels_are_kept_as_many_as_fit_and_shared(monkeypatch):
    read = []

    def reader(value):
        return lambda: read.append(value) or np.full((5, 7), value, np.uint8)

    monkeypatch.setattr("mi_ring.capture.pixels.KEPT", 2 * 35)
    shared = reader(3)
    several = Pixels([reader(1), shared, None, shared, reader(4)])
    assert several.given == [True, True, False, True, True] and not read
    for _ in range(2):
        assert [None if array is None else array[0, 0] for array in several] == [1, 3, None, 3, 4]
    assert read == [1, 3, 4, 4]
    part = several.part([4, 1]).replaced({0: reader(5)})
    assert [array[0, 0] for array in part] == [5, 3] and read[4:] == [5]
    part.clear()
    assert [array[0, 0] for array in part] == [5, 3] and read[5:] == [5, 3]


@pytest.mark.parametrize("kind", [Pixels.of, list])
def test_pixels_may_be_replaced_by_arrays(kind, small_capture):
    scene = loading.load_capture(small_capture)
    scene = replace(scene, images=kind([image[..., ::-1].copy() for image in scene.images]))
    scene.clear_caches()
    part = scene.part([3, 1])
    np.testing.assert_array_equal(part.images[0][..., ::-1], loading.load_capture(small_capture).images[3])
    torch.testing.assert_close(part.observe([0])[0], scene.observe([3])[0])


def test_each_photograph_is_remembered_at_its_own_scale(small_capture, decodes):
    scene = loading.load_capture(small_capture)
    for _ in range(3):
        half, quarter = scene.observe([5], 2), scene.observe([9], 4)
    assert decodes() == 2
    torch.testing.assert_close(scene.observe([5], 4)[0][0], images.box_filter(half[0][0], 2))
    assert quarter[0].shape == (1, 10, 14, 3) and decodes() == 3


def test_photographs_to_look_at_are_evenly_spread(small_capture):
    scene = loading.load_capture(small_capture)
    assert scene.spread() == list(range(12)) and scene.spread(5) == [0, 2, 4, 7, 9]


def test_masks_are_found_in_a_dark_room(small_capture):
    given, found = loading.load_capture(small_capture), loading.load_capture(small_capture, masks="none")
    assert given.threshold is None and 0 < found.threshold < 0.02
    for mask, guess in zip(given.masks, found.masks):
        both, either = ((mask > 127) & (guess > 127)).sum(), ((mask > 127) | (guess > 127)).sum()
        assert both > 0.9 * either  # the lights are beside the cameras: a thin crescent is dark
    assert loading.load_capture(small_capture, masks="auto").masks[3].tolist() == given.masks[3].tolist()


def test_no_masks_are_found_in_a_bright_room(broken_capture):
    path, _ = broken_capture
    for file in path.parent.glob("images/*.png"):
        image = np.array(mi.Bitmap(str(file)))
        mi.Bitmap(np.maximum(image, 90)).write(str(file))
    scene = loading.load_capture(path, masks="none")
    assert scene.threshold is None and list(scene.masks) == [None] * 12


def test_a_room_is_lit_where_more_is_seen_than_the_object(small_capture, broken_capture):
    assert not loading.load_capture(small_capture).lit_room
    path, _ = broken_capture
    for image in (path.parent / "images").iterdir():
        pixels = images.read_image(image)
        images.write_image(np.maximum(pixels, 40), image)
    assert loading.load_capture(path).lit_room
    assert not loading.load_capture(path, masks="none").lit_room  # without masks nobody knows


def test_a_photograph_that_the_light_missed_gets_no_mask(broken_capture):
    path, _ = broken_capture
    missed = np.zeros((40, 56, 3), np.uint8)
    missed[30, 50] = 255  # a hot pixel
    mi.Bitmap(missed).write(str(path.parent / "images/004.png"))
    scene = loading.load_capture(path, masks="none")
    assert scene.masks[4] is None and sum(mask is not None for mask in scene.masks) == 11
    for file in path.parent.glob("images/*.png"):
        mi.Bitmap(np.zeros((40, 56, 3), np.uint8)).write(str(file))
    assert loading.load_capture(path, masks="none").threshold is None


def test_specks_are_no_object(broken_capture):
    path, _ = broken_capture
    image = np.array(mi.Bitmap(str(path.parent / "images/004.png")))
    assert not image[2, 3].any()
    image[2, 3] = 200  # a hot pixel
    mi.Bitmap(image).write(str(path.parent / "images/004.png"))
    assert loading.load_capture(path, masks="none").masks[4][2, 3] == 0


def test_sphere_of_masks_finds_the_object(small_capture):
    center, radius = loading.load_capture(small_capture).sphere()
    volume = np.prod(AXES) ** (1 / 3)
    # Twelve views: the hull is a little larger than the object, and masks are uncertain by half a pixel, 5 % of it.
    assert np.linalg.norm(center - CENTER) < 0.1 * volume
    assert 0.95 * volume < radius / 1.3 < 1.25 * volume


def test_sphere_of_cameras_is_near_the_object(broken_capture):
    path, _ = broken_capture
    text = path.read_text()
    for k in range(12):
        text = text.replace(f'<string name="mask" value="masks/{k:03}.png"/>', "")
    path.write_text(text)
    scene = loading.load_capture(path)
    assert scene.observe([0])[3].tolist() == [False]
    center, radius = scene.sphere()
    assert np.linalg.norm(center - CENTER) < 8  # principal point and targets are off the centre
    assert 10 < radius < 40


def test_sphere_of_the_xml_wins(broken_capture):
    path, edit = broken_capture
    edit(
        '<bsdf type="cooktorrance"/>',
        '<bsdf type="cooktorrance"/><float name="radius" value="4.5"/><point name="center" x="1" y="2" z="3"/>',
    )
    center, radius = loading.load_capture(path).sphere()
    assert center.tolist() == [1, 2, 3] and radius == 4.5


def test_a_fit_keeps_the_ground_of_the_xml(broken_capture, tmp_path):
    path, edit = broken_capture
    edit('<bsdf type="cooktorrance"/>', '<bsdf type="cooktorrance"/><point name="ground" x="1" y="2" z="-3"/>'
         '<vector name="up" x="0" y="3" z="4"/><float name="metres" value="0.001"/>')  # fmt: skip
    capture = loading.load_capture(path)
    np.testing.assert_allclose(capture.shape.ground, [[1, 2, -3], [0, 0.6, 0.8]], atol=1e-6)
    ring = Fit(capture, Config(iterations=2, levels=(1,), widths=(32,), shares=(1.0,), domain="sphere")).ring
    write_state(ring_state(ring), tmp_path / "ring.pt")
    saved = load_fit(tmp_path)
    np.testing.assert_allclose(saved.ground, capture.shape.ground, atol=1e-6)
    np.testing.assert_allclose(saved.up, [0, 0.6, 0.8], atol=1e-6)
    assert saved.metres == pytest.approx(0.001)
    text = fitted_scene_xml(path, tmp_path, 3, ring.bsdf).decode()
    assert "ring.pt" in text and "ground" not in text and '"up"' not in text and "metres" not in text
    again = mi.load_dict({"type": "scene", "object": {"type": "shapenet", "weights": str(tmp_path / "ring.pt")}})
    assert (again.shapes()[0].up, again.shapes()[0].metres) == (saved.up, saved.metres)


def test_exposure_and_reflectance_follow_the_lamp(small_capture):
    scene = loading.load_capture(small_capture)
    exposure = scene.exposure()
    values = [scene.observe([k], 4) for k in range(12)]
    inside = torch.cat([rgb[mask > 0.5] for rgb, _, mask, *_ in values])
    assert exposure == pytest.approx(inside.mean().item(), rel=1e-5)
    # The lamp gives 2.2 at the centre, so a surface there that looks `exposure` bright reflects exposure / 2.2.
    assert scene.reflectance(CENTER, exposure) == pytest.approx(exposure / 2.2, rel=1e-4)


def test_a_jpeg_that_ends_too_early_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    images.write_image(noise, tmp_path / "a.jpg")
    whole = np.array(mi.Bitmap(str(tmp_path / "a.jpg")))
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.jpg"), whole)
    content = (tmp_path / "a.jpg").read_bytes()
    for share in (0.3, 0.99):
        (tmp_path / "a.jpg").write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=r"a.jpg: cannot be read as image \(image file is truncated"):
            pixels_of(tmp_path / "a.jpg")


def test_reading_a_capture_frees_scenes_that_nobody_uses(small_capture):
    """Objects that refer to each other, as scenes do, which Dr.Jit would compile into the kernels of the next fit."""

    class Scene:
        pass

    one = Scene()
    one.itself, gone = one, weakref.ref(one)
    gc.disable()
    try:
        del one
        loading.load_capture(small_capture)
        assert gone() is None
    finally:
        gc.enable()
