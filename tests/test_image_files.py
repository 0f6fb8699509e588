"""Every kind of image file is read alike by all commands, and what it says about its colours is heeded."""

import json
import struct
from pathlib import Path

import imagecodecs
import mitsuba as mi
import numpy as np
import pytest
import tifffile
from helpers.foreign_captures import colmap_folder, converted, transforms
from PIL import Image, ImageCms, PngImagePlugin

from mi_ring import images
from mi_ring.colour_profiles import primaries_profile
from mi_ring.errors import InputError
from mi_ring.importers.photogrammetry import exposures_of
from mi_ring.importers.reading import has_alpha, pixels_of
from mi_ring.photogrammetry.folder import Picture

SIZE = W, H = 30, 22
#: Linear sRGB of four vertical stripes; black to white is asymmetric.
STRIPES = np.array([[0.6, 0.05, 0.04], [0.05, 0.45, 0.08], [0.3, 0.3, 0.3], [0.02, 0.04, 0.5]])


def to_xyz(primaries, white=(0.3127, 0.3290)):
    xyz = np.array([[x, y, 1 - x - y] for x, y in np.reshape(primaries, (3, 2))]).T
    return xyz * np.linalg.solve(xyz, np.array([white[0], white[1], 1 - sum(white)]) / white[1])


SRGB, P3 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06), (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
TO_P3 = np.linalg.inv(to_xyz(P3)) @ to_xyz(SRGB)


def stripes(values=STRIPES):
    return np.repeat(values, [9, 8, 7, 6], 0)[None].repeat(H, 0)


def eight(linear):
    return images.to_bytes(images.linear_to_srgb(linear))


def sixteen(encoded):
    return (encoded * 65535 + 0.5).astype(np.uint16)


def p3_profile():
    """Display P3 with sRGB's curve, as phones write it."""
    curve = np.where((x := np.linspace(0, 1, 1024)) <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    places = [value for k in range(3) for value in (*P3[2 * k : 2 * k + 2], 1.0)]
    return imagecodecs.cms_profile("rgb", whitepoint=(0.3127, 0.3290, 1.0), primaries=tuple(places),
                                   transferfunction=(curve * 65535).astype(np.uint16))  # fmt: skip


def by_pillow(suffix, **options):
    return lambda path, linear: Image.fromarray(eight(linear)).save(path.with_suffix(suffix), **options)


def png16(*chunks):
    """A PNG of 16 bits, sRGB-encoded if a chunk says so, linear otherwise."""

    def write(path, linear):
        said = any(kind != b"gAMA" or struct.unpack(">I", data)[0] < 90000 for kind, data in chunks)
        imagecodecs_png = imagecodecs.png_encode(sixteen(images.linear_to_srgb(linear) if said else linear))
        head, rest = imagecodecs_png[:33], imagecodecs_png[33:]
        more = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", PngImagePlugin._crc32(k + d) & 0xFFFFFFFF)
                        for k, d in chunks)  # fmt: skip
        path.with_suffix(".png").write_bytes(head + more + rest)

    return write


def exr(path, linear, profile=None):
    mi.Bitmap(linear.astype(np.float32)).write(str(path.with_suffix(".exr")))


def tiff(pixels, **options):
    return lambda path, linear: tifffile.imwrite(path.with_suffix(".tif"), pixels(linear), **options)


def srgb16(linear):
    return sixteen(images.linear_to_srgb(linear))


SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
FILES = {
    "jpeg": by_pillow(".jpg", quality=100, subsampling=0), "png": by_pillow(".png"), "bmp": by_pillow(".bmp"),
    "webp": by_pillow(".webp", lossless=True), "tiff": by_pillow(".tif"),
    "tiff lzw": by_pillow(".tif", compression="tiff_lzw"),
    "png with profile": by_pillow(".png", icc_profile=SRGB_PROFILE),
    "jpeg p3": lambda path, linear: Image.fromarray(eight(linear @ TO_P3.T)).save(
        path.with_suffix(".jpg"), quality=100, subsampling=0, icc_profile=p3_profile()),
    "png p3": lambda path, linear: Image.fromarray(eight(linear @ TO_P3.T)).save(
        path.with_suffix(".png"), icc_profile=p3_profile()),
    "webp p3": lambda path, linear: Image.fromarray(eight(linear @ TO_P3.T)).save(
        path.with_suffix(".webp"), lossless=True, icc_profile=p3_profile()),
    "tiff16 p3": lambda path, linear: tifffile.imwrite(
        path.with_suffix(".tif"), srgb16(linear @ TO_P3.T), photometric="rgb", iccprofile=p3_profile()),
    "png16 linear": png16(), "png16 srgb": png16((b"sRGB", b"\0")),
    "png16 gamma": png16((b"gAMA", struct.pack(">I", 45455))),
    "png16 gamma 1": png16((b"gAMA", struct.pack(">I", 100000))),
    "tiff16 linear": tiff(sixteen, photometric="rgb"),
    "tiff16 srgb": tiff(srgb16, photometric="rgb", iccprofile=SRGB_PROFILE),
    "tiff float": tiff(lambda a: a.astype(np.float32), photometric="rgb"),
    "tiff half": tiff(lambda a: a.astype(np.float16), photometric="rgb"),
    "tiff planar": tiff(lambda a: eight(a).transpose(2, 0, 1), photometric="rgb", planarconfig="separate"),
    "exr": exr,
}  # fmt: skip


def written(folder, kind, linear=None):
    FILES[kind](folder / "a", stripes() if linear is None else linear)
    return next(file for file in folder.iterdir() if file.stem == "a")


@pytest.mark.parametrize("kind", FILES)
def test_every_kind_of_file_is_read_alike_by_all_commands(tmp_path, kind):
    """By convert and the loader of scenes, undistorted or not, and by photos: the same linear sRGB."""
    close = 0.02 if "jpeg" in kind else 0.006
    for lens in ({}, {"k1": 1e-9}):
        folder = tmp_path / ("lens" if lens else "plain")
        folder.mkdir()
        file = written(folder, kind)
        top = {"fl_x": 70.0, "fl_y": 76.0, "frames": [{"file_path": file.name, "transform_matrix": np.eye(4).tolist()}]}
        (folder / "transforms.json").write_text(json.dumps(top | lens))
        scene = converted("transforms", folder, tmp_path / f"{folder.name}.xml")
        found = scene.observe([0])[0][0].numpy()
        np.testing.assert_allclose(found, stripes(), atol=close)
    if kind not in ("exr", "tiff float", "tiff half"):  # photos takes no floats
        np.testing.assert_allclose(Picture(file).linear(), stripes(), atol=close)


@pytest.mark.parametrize("kind", ["png p3", "tiff16 p3", "png16 srgb"])
def test_what_is_clipped_remains_so(tmp_path, kind):
    linear = stripes(np.array([[1.0, 1, 1], [0.2, 0.3, 0.4], [0, 0, 0], [0.5, 0.5, 0.5]]))
    pixels = pixels_of(written(tmp_path, kind, linear), heed=True)
    assert pixels.dtype == np.uint16 and (pixels[:, :9] == 65535).all() and (pixels[:, 9:] < 60000).all()


def test_an_encoding_that_the_user_says_counts_more_than_the_file(tmp_path):
    file = written(tmp_path, "png16 srgb")
    frames = [{"file_path": file.name, "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 70.0, "frames": frames}))
    scene = converted("transforms", tmp_path, tmp_path / "s.xml", "--encoding", "linear")
    np.testing.assert_allclose(scene.observe([0])[0][0], images.linear_to_srgb(stripes()), atol=1e-3)


def test_primaries_of_openexr(tmp_path):
    assert images.statement_of(written(tmp_path, "exr")) == images.Statement()
    wide = images.as_stated((stripes() @ TO_P3.T).astype(np.float32),
                            images.Statement(primaries_profile((0.3127, 0.3290), P3)))  # fmt: skip
    np.testing.assert_allclose(wide, stripes(), atol=1e-3)


@pytest.mark.parametrize(("write", "pattern"), [
    (tiff(lambda a: (a * 1e6).astype(np.int32)), "has int32 pixels, whose full scale is unknown"),
    (tiff(lambda a: np.repeat(eight(a), 2, 2)[..., :4], photometric="separated"), "CMYK; save it as RGB"),
    (lambda path, a: Image.fromarray(eight(a)).convert("CMYK").save(path.with_suffix(".jpg")), "CMYK; save it as RGB"),
    (by_pillow(".png", icc_profile=SRGB_PROFILE[:16] + b"Lab " + SRGB_PROFILE[20:]), "colour profile is of Lab"),
    (by_pillow(".jpg", icc_profile=SRGB_PROFILE[:90]), "colour profile cannot be used"),
    (lambda path, a: path.with_suffix(".png").write_text("P6 2 2 255"), "none of JPEG, PNG, TIFF, OpenEXR, WebP"),
])  # fmt: skip
def test_what_is_not_read_says_so(tmp_path, write, pattern):
    write(tmp_path / "a", stripes())
    with pytest.raises(InputError, match=pattern):
        pixels_of(next(tmp_path.iterdir()), heed=True)


def test_colours_of_palettes_and_their_alpha(tmp_path):
    alpha = np.repeat([255, 255, 0, 255], [9, 8, 7, 6]).astype(np.uint8)[None].repeat(H, 0)
    rgba = np.dstack([eight(stripes()), alpha])
    Image.fromarray(rgba).quantize(method=Image.Quantize.FASTOCTREE).save(tmp_path / "a.png")
    assert has_alpha(tmp_path / "a.png")
    pixels = pixels_of(tmp_path / "a.png")
    assert pixels.shape == (H, W, 4) and (pixels[:, 17:24, 3] == 0).all() and (pixels[:, :17, 3] == 255).all()
    Image.fromarray(np.dstack([rgba[..., :3], np.full((H, W), 255, np.uint8)])).save(tmp_path / "b.png")
    assert not has_alpha(tmp_path / "b.png")  # opaque: says nothing


def test_a_mask_may_be_in_the_alpha_channel_of_its_file():
    colours, alpha = np.full((2, 3, 3), 90, np.uint8), np.array([[0, 255, 0], [255, 0, 128]], np.uint8)
    assert (images.mask_values(np.dstack([colours, alpha])) == alpha).all()
    opaque = np.dstack([alpha, alpha, alpha, np.full_like(alpha, 255)])
    assert (images.mask_values(opaque) == alpha).all() and (images.mask_values(alpha[..., None]) == alpha).all()


# Exposure


def test_what_no_photograph_says_of_its_exposure_is_the_same_in_all(tmp_path):
    folder = colmap_folder(tmp_path)
    for k, seconds in enumerate((0.02, 0.01, 0.04), 1):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({33434: seconds, 34855: 100, 33437: 0.0})
        file = folder / f"images/sub/{k}.jpg"
        Image.open(file).save(file, exif=exif)
    scene = converted("colmap", folder, tmp_path / "s.xml")
    np.testing.assert_allclose(scene.photographs.lights.rgb()[:, 0], [1, 0.5, 2], rtol=1e-5)


@pytest.mark.parametrize(("said", "expected"), [
    ([{33434: 1, 34855: 100}, {33434: 2, 34855: 200}], [100, 400]), ([{33434: 1}, {33434: 2}], [1, 2]),
    ([{33437: 2}, {33437: 4}], [1 / 4, 1 / 16]), ([{}, {}], [np.nan, np.nan]), ([{33434: 1}, {}], [1, np.nan]),
    ([{33434: 1, 33437: 2}, {33434: 1}], [1 / 4, np.nan]), ([], []),
])  # fmt: skip
def test_exposures(said, expected):
    np.testing.assert_allclose(exposures_of(said), expected)


# Fields


def test_fields_of_neus2_and_instant_ngp(tmp_path):
    K = [[70.0, 0, 12.5, 0], [0, 76.0, 10.25, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    f = 0.5 * W / np.tan(np.deg2rad(20))
    for top, focal, centre, forward in (
        ({"from_na": True, "intrinsic_matrix": K}, (70, 76), (12.5, 10.25), 1),
        ({"x_fov": 40.0}, (f, f), (W / 2, H / 2), -1),
        ({"x_fov": 40.0, "y_fov": 30.0}, (f, 0.5 * H / np.tan(np.deg2rad(15))), (W / 2, H / 2), -1),
    ):
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        source = transforms(folder, top, [{"file_path": "0.png"}], lambda k: eight(stripes()))
        text = json.loads((source / "transforms.json").read_text())
        text["frames"][0]["transform_matrix"] = np.eye(4).tolist()
        (source / "transforms.json").write_text(json.dumps(text))
        camera = converted("transforms", source, Path(f"{folder}.xml")).shots[0].camera
        np.testing.assert_allclose([*camera.focal, *camera.centre], [*focal, *centre], rtol=1e-5)
        np.testing.assert_allclose(camera.forward, [0, 0, forward], atol=1e-6)


def test_unknown_fields_are_named_once_and_unknown_lenses_refused(tmp_path, capsys):
    frames = [{"file_path": f"{k}.png", "lens_shift": 3} for k in range(2)]
    source = transforms(tmp_path / "a", {"fl_x": 70.0, "aabb_scale": 4}, frames, lambda k: eight(stripes()))
    converted("transforms", source, tmp_path / "a.xml")
    printed = capsys.readouterr().out
    assert "not used, because unknown: lens_shift\n" in printed
    frames[1]["rolling_shutter"] = [0, 0, 0.1, 0]
    source = transforms(tmp_path / "b", {"fl_x": 70.0}, frames, lambda k: eight(stripes()))
    with pytest.raises(InputError, match=r"frames\[1\].rolling_shutter: is .*; such lenses are not supported"):
        converted("transforms", source, tmp_path / "b.xml")
