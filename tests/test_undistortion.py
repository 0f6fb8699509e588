"""Undistortion: what the source does not show says nothing, radiance is interpolated, clipped pixels stay clipped."""

import json

import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.foreign_captures import converted, transforms

from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.geometry.hull import Hull, Silhouette
from mi_ring.images import linear_to_srgb
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.undistortion import Window, undistort

W, H = 57, 41
LENS = Lens("FULL_OPENCV", (W, H), (60.0, 66.0, 27.3, 19.6, 0.25, 0, 0, 0, 0, 0, 0, 0))  # a pincushion
TOP = {"fl_x": 60.0, "fl_y": 66.0, "cx": 27.3, "cy": 19.6, "k1": 0.25, "w": W, "h": H}


def places():
    """Where in the source the pixels' centres of the undistorted picture are, by Brown's formula: (H, W) x, y."""
    x, y = np.meshgrid((np.arange(W) + 0.5 - 27.3) / 60, (np.arange(H) + 0.5 - 19.6) / 66)
    radial = 1 + 0.25 * (x * x + y * y)
    return 27.3 + 60 * x * radial, 19.6 + 66 * y * radial


def test_pixels_beyond_the_source_are_not_valid():
    x, y = places()
    inside = (x >= 0) & (x <= W) & (y >= 0) & (y <= H)
    pixels, valid = undistort(np.full((H, W, 3), 200, np.uint8), LENS, srgb=True)
    assert np.array_equal(valid, inside) and 0.8 < inside.mean() < 0.99
    assert (pixels[valid] == 200).all() and not pixels[~valid].any()


def test_a_ramp_shows_where_each_pixel_comes_from():
    """Bilinear interpolation of a linear image is exact, also where squares that are computed at once meet."""
    for width, height in ((1100, 530), (7, 1), (1, 9)):
        lens = Lens("FULL_OPENCV", (width, height), (900.0, 940.0, 0.47 * width, 0.52 * height, 0.25, *[0] * 7))
        x, y = np.meshgrid((np.arange(width) + 0.5) / 900 - 0.47 * width / 900,
                           (np.arange(height) + 0.5) / 940 - 0.52 * height / 940)  # fmt: skip
        radial = 1 + 0.25 * (x * x + y * y)
        x, y = 0.47 * width + 900 * x * radial, 0.52 * height + 940 * y * radial
        ramp = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float32)
        pixels, valid = undistort(ramp, lens, saturation=np.inf)
        assert np.array_equal(valid, (x >= 0) & (x <= width) & (y >= 0) & (y <= height)) and valid.mean() > 0.8
        expected = np.stack([(x - 0.5).clip(0, width - 1), (y - 0.5).clip(0, height - 1)], -1)
        np.testing.assert_allclose(pixels[valid], expected[valid], atol=2e-4)
        window = Window(width // 3, height // 2, width // 2 + 1, height // 3 + 1)
        part, _ = undistort(ramp, lens, saturation=np.inf, window=window)
        whole = pixels[window.top : window.top + window.height, window.left : window.left + window.width]
        np.testing.assert_allclose(part, whole, atol=2e-4)


def test_radiance_is_interpolated_not_its_encoding():
    """Beside an edge between dark and bright, by hand: the mean of the two radiances."""
    dark, bright = 10, 230
    picture = np.full((H, W, 3), dark, np.uint8)
    picture[:, 40:] = bright
    x, _ = places()
    share = np.clip(x - 39.5, 0, 1)  # between the centres of columns 39 and 40
    radiance = [float(srgb_to_linear(np.float32(v / 255))) for v in (dark, bright)]
    expected = linear_to_srgb(radiance[0] * (1 - share) + radiance[1] * share) * 255
    pixels, valid = undistort(picture, LENS, srgb=True)
    between = valid & (share > 0.1) & (share < 0.9)
    assert between.sum() > 10
    np.testing.assert_allclose(pixels[between, 1], expected[between], atol=0.51)
    linear = np.where(picture == dark, 0.1, 0.7).astype(np.float32)
    np.testing.assert_allclose(undistort(linear, LENS)[0][between, 0], (0.1 + 0.6 * share)[between], atol=1e-4)


@pytest.mark.parametrize(("kind", "saturation", "clipped"), [(np.uint8, 1.0, 255), (np.uint16, 0.9, 59000)])
def test_what_a_clipped_pixel_has_a_part_in_is_clipped(kind, saturation, clipped):
    picture = np.full((H, W, 3), clipped // 2, kind)
    picture[20, 30, 1] = clipped
    pixels, _ = undistort(picture, LENS, srgb=kind == np.uint8, saturation=saturation)
    x, y = places()
    part = (np.abs(x - 30.5) < 1) & (np.abs(y - 20.5) < 1)
    assert part.sum() >= 2
    assert (pixels[part][:, 1] >= saturation * np.iinfo(kind).max).all()
    assert (pixels[~part][:, 1] < saturation * np.iinfo(kind).max).all() and (pixels[..., 0] <= clipped // 2 + 1).all()


@pytest.fixture
def lens_capture(tmp_path):
    """Two photographs through that lens, with masks of a disc."""
    source = transforms(tmp_path / "data", TOP, [{"file_path": "a.png"}, {"file_path": "b.png"}],
                        lambda k: np.full((H, W, 3), 120 + 50 * k, np.uint8))  # fmt: skip
    y, x = np.mgrid[:H, :W]
    mi.Bitmap((255 * ((x - 28) ** 2 + (y - 20) ** 2 < 100)).astype(np.uint8)[..., None]).write(str(source / "m.png"))
    top = json.loads((source / "transforms.json").read_text())
    for frame in top["frames"]:
        frame["mask_path"] = "m.png"
    (source / "transforms.json").write_text(json.dumps(top))
    return converted("transforms", source, tmp_path / "lens.xml")


def test_a_scene_says_where_its_photographs_show_something(lens_capture):
    assert len({shot.files.valid for shot in lens_capture.shots}) == 1  # one lens, one file
    rgb, clipped, _, masked, valid = lens_capture.observe([0, 1])
    assert masked.all() and valid.shape == (2, H, W) and 0.8 < valid.float().mean() < 0.99
    assert not rgb[~valid].any() and clipped[~valid].all() and not clipped[valid].any()
    assert rgb[1][valid[1]].min() > rgb[0][valid[0]].max() > 0.1  # nothing was darkened at the border
    half = lens_capture.observe([1], 2)
    blocks = valid[1, : H // 2 * 2, : W // 2 * 2].reshape(H // 2, 2, W // 2, 2).all(3).all(1)
    assert (half.valid[0] == blocks).all() and half.clipped[0][~blocks].all()


def test_where_a_mask_says_nothing_it_does_not_cut_the_hull(lens_capture):
    silhouettes = lens_capture.silhouettes()
    assert all(s.valid is not None for s in silhouettes)
    camera = silhouettes[0].camera
    mask = np.full((H, W), 255, np.uint8)
    mask[:, :20] = 0
    valid = np.where(mask, 255, 0).astype(np.uint8)
    towards = camera.position + 5 * camera.directions(np.array([[10.5, 20.5], [40.5, 20.5]]))
    turned = camera.to_world.copy()
    turned[:3, 3] += camera.to_world[:3, 0]
    other = Silhouette(np.full((H, W), 255, np.uint8), camera._replace(to_world=turned), "other")
    for known, left in ((None, False), (valid, True)):
        hull = Hull([Silhouette(mask, camera, "cut", known), other, other], "test", outliers=0)
        depth = hull.depth(torch.as_tensor(towards, dtype=torch.float32))
        assert (depth[0] > 0) == left and depth[1] > 0
