"""Every kind of image file is read alike by all commands, and what it says about its colours is heeded."""

import io
import json
import struct
import zlib
from pathlib import Path

import imagecodecs
import mitsuba as mi
import numpy as np
import pytest
import tifffile
from helpers.foreign_captures import colmap_folder, converted, disc, noise, transforms
from PIL import ExifTags, Image, ImageCms, PngImagePlugin

from mi_ring import convert, image_fields, image_headers, images
from mi_ring.colour_profiles import Statement, as_stated, primaries_profile, srgb_to_linear
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


def write_dng(path):
    mosaic = np.random.default_rng(3).integers(0, 30000, (48, 64), np.uint16)
    matrix = np.stack([np.diag([10000] * 3).ravel(), np.full(9, 10000)], 1).ravel().tolist()
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=[
        (33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True), (50706, 1, 4, (1, 4, 0, 0), True),
        (50708, 2, 0, "none", True), (50721, 10, 9, matrix, True), (50728, 5, 3, (1, 1, 1, 1, 1, 1), True),
        (50717, 3, 1, 65535, True),
    ])  # fmt: skip


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


def by_tiff(**options):
    return lambda path, a: tifffile.imwrite(path.with_suffix(".tif"), eight(a), **options)


def exr_of(*names):
    """An OpenEXR file with these channels, of which R, G, B, or the first three, are the stripes; others are 0.3."""

    def write(path, linear):
        first = [name for name in names if name.rpartition(".")[2] in "RGB"] or names
        values = {name: linear[..., k] for k, name in enumerate(first[:3])}
        pixels = np.stack([values.get(name, np.full(linear.shape[:2], 0.3)) for name in names], -1)
        mi.Bitmap(np.float32(pixels), mi.Bitmap.PixelFormat.MultiChannel, channel_names=[*names]).write(
            str(path.with_suffix(".exr")))  # fmt: skip

    return write


def exr_integers(path, linear):
    """An OpenEXR file of integers. Such channels hold numbers of objects, for example, not colours."""
    mi.Bitmap(np.uint32(255 * linear)).write(str(path.with_suffix(".exr")))


def exr_window(path, linear):
    """An OpenEXR file that holds a part of its picture."""
    exr(path, linear)
    content = path.with_suffix(".exr").read_bytes()
    place = content.index(b"displayWindow\0box2i\0") + len(b"displayWindow\0box2i\0") + 4
    path.with_suffix(".exr").write_bytes(content[:place] + struct.pack("<4i", 0, 0, 99, 99) + content[place + 16 :])


def coded(suffix, primaries, curve):
    """A HEIF or AVIF file whose box of colours has these codes of H.273."""

    def write(path, linear):
        path = path.with_suffix(suffix)
        picture = Image.fromarray(np.kron(eight(linear), np.ones((4, 4, 1), np.uint8)))
        if suffix == ".heic":
            pytest.importorskip("pillow_heif").from_pillow(picture).save(path, quality=-1)
        else:
            picture.save(path, quality=100)
        content = path.read_bytes()
        place = content.index(b"colrnclx") + 8
        path.write_bytes(content[:place] + struct.pack(">HH", primaries, curve) + content[place + 4 :])

    return write


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
    "exr": exr, "avif": by_pillow(".avif", quality=100, subsampling="4:4:4"),
    "heic": lambda path, linear: pytest.importorskip("pillow_heif").from_pillow(Image.fromarray(eight(linear))).save(
        path.with_suffix(".heic"), quality=-1, chroma=444),
}  # fmt: skip


def written(folder, kind, linear=None):
    FILES[kind](folder / "a", stripes() if linear is None else linear)
    return next(file for file in folder.iterdir() if file.stem == "a")


@pytest.mark.parametrize("kind", FILES)
def test_every_kind_of_file_is_read_alike_by_all_commands(tmp_path, kind):
    """By convert and the loader of scenes, undistorted or not, and by photos: the same linear sRGB."""
    close = 0.02 if kind in ("jpeg", "jpeg p3", "avif", "heic") else 0.006
    for lens in ({}, {"k1": 1e-9}):
        folder = tmp_path / ("lens" if lens else "plain")
        folder.mkdir()
        file = written(folder, kind)
        top = {"fl_x": 70.0, "fl_y": 76.0, "frames": [{"file_path": file.name, "transform_matrix": np.eye(4).tolist()}]}
        (folder / "transforms.json").write_text(json.dumps(top | lens))
        scene = converted("transforms", folder, tmp_path / f"{folder.name}.xml")
        found = scene.observe([0])[0][0].numpy()
        np.testing.assert_allclose(found, stripes(), atol=close)
        np.testing.assert_allclose(Picture(file).to_linear(Picture(file).pixels), stripes(), atol=close)


@pytest.mark.parametrize("kind", FILES)
def test_every_kind_of_file_is_a_mask_for_all_commands(tmp_path, kind):
    white = np.zeros((H, W, 3))
    white[3:17, 5:11] = white[9:12, 20:28] = 1
    (tmp_path / "masks").mkdir()
    mask = written(tmp_path / "masks", kind, white)
    Image.fromarray(eight(stripes())).save(tmp_path / "a.jpg")
    frames = [{"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 70.0, "frames": frames}))
    for more in ([], ["--masks", tmp_path / "masks"]):
        scene = converted("transforms", tmp_path, tmp_path / f"s{len(more)}.xml", *more)
        assert ((scene.masks[0] > 127) == white[..., 0]).all()
    photograph = Picture(tmp_path / "a.jpg")
    assert photograph.mask_file(tmp_path / "masks") == mask
    assert ((photograph.mask(tmp_path / "masks") > 127) == white[..., 0]).all()


def test_raw_files_are_read_alike_by_all_commands(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng")
    frames = [{"file_path": "a.dng", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 70.0, "frames": frames}))
    scene = converted("transforms", tmp_path, tmp_path / "s.xml")
    picture = Picture(tmp_path / "a.dng", upright=False)
    np.testing.assert_allclose(scene.observe([0])[0][0], picture.to_linear(picture.pixels), atol=1e-6)


def test_floats_are_linear_photographs_for_photos(tmp_path):
    bright = stripes(np.array([[3.0, 0.5, 0.25], [-0.1, 0, 0], [0.2, 0.3, 0.4], [1, 1, 1]]))
    file = written(tmp_path, "tiff float", bright)
    np.testing.assert_allclose(Picture(file).to_linear(Picture(file).pixels), bright.clip(0, 1), atol=1e-5)
    tifffile.imwrite(file, np.full((H, W, 3), np.nan, np.float32), photometric="rgb")
    with pytest.raises(InputError, match="contains pixels that are NaN, infinite or above"):
        _ = Picture(file).pixels


def test_encodings_that_are_assumed(tmp_path):
    kinds = ("jpeg", "png p3", "png16 linear", "png16 srgb", "tiff half")
    for kind in kinds:
        (tmp_path / kind).mkdir()
    assert image_headers.encodings([written(tmp_path / kind, kind) for kind in kinds]) == [
        "2 files of 8 bits are sRGB", "2 files of 16 bits are linear", "1 files of floats are linear",
        "except as 2 of the files say themselves",
    ]  # fmt: skip


# Fields of image files

#: What the specifications name, and what programs add.
SAMPLES = {
    "PNG": """IHDR PLTE IDAT IEND tRNS cHRM gAMA iCCP sBIT sRGB cICP mDCV cLLI tEXt zTXt iTXt bKGD hIST pHYs sPLT eXIf
     tIME acTL fcTL fdAT oFFs pCAL sCAL sTER gIFg gIFx iDOT
     CgBI caNv orNT vpAg""",
    "JPEG": "APP0:JFIF APP0:JFXX APP1:Exif APP1:http://ns.adobe.com/xap/1.0/ APP2:ICC_PROFILE APP2:MPF APP13:Photoshop "
            "APP14:Adobe COM:text APP11:JP APP2:urn:iso:std:iso:ts:21496:-1 APP15:Q",
    "TIFF": """NewSubfileType ImageWidth ImageLength BitsPerSample Compression PhotometricInterpretation FillOrder
     DocumentName ImageDescription Make Model StripOffsets Orientation SamplesPerPixel RowsPerStrip StripByteCounts
     MinSampleValue MaxSampleValue XResolution YResolution PlanarConfiguration PageName XPosition YPosition
     GrayResponseUnit T4Options T6Options ResolutionUnit PageNumber TransferFunction Software DateTime Artist
     HostComputer Predictor WhitePoint PrimaryChromaticities ColorMap HalftoneHints TileWidth TileLength TileOffsets
     TileByteCounts SubIFDs ExtraSamples SampleFormat SMinSampleValue SMaxSampleValue JPEGTables YCbCrCoefficients
     YCbCrSubSampling YCbCrPositioning ReferenceBlackWhite XMP Copyright IPTCNAA ImageResources ExifTag
     InterColorProfile GPSTag ImageSourceData Rating XPTitle GDAL_METADATA ModelPixelScaleTag GeoKeyDirectoryTag
     IJMetadata""",
    "OpenEXR": """channels channel:R channel:G channel:B channel:A channel:Y channel:depth.Z compression dataWindow
     displayWindow lineOrder pixelAspectRatio screenWindowCenter screenWindowWidth tiles type version chunkCount
     chromaticities whiteLuminance adoptedNeutral renderingTransform lookModTransform xDensity owner comments capDate
     utcOffset longitude latitude altitude focus expTime aperture isoSpeed envmap keyCode timeCode wrapmodes
     framesPerSecond multiView worldToCamera worldToNDC preview view BlenderMultiChannel oiio:ColorSpace
     colorInteropID acesImageContainerFlag""",
    "WebP, AVIF, HEIF, BMP": "icc_profile exif xmp loop background timestamp duration dpi compression primary "
                             "bit_depth chroma metadata thumbnails depth_images aux nclx_profile original_orientation",
    "raw": "mosaic black_level Exif",
    "EXIF": "Orientation ColorSpace InteropIndex ExposureTime FNumber ISOSpeedRatings WhiteBalance Gamma MakerNote",
}  # fmt: skip


@pytest.mark.parametrize("kind", image_fields.FIELDS)
def test_every_field_of_image_files_is_declared(kind):
    fields = image_fields.FIELDS[kind]
    assert not [name for name in SAMPLES[kind].split() if fields.kind_of(name)[0] == "unknown"]
    assert len(names := fields.names()) == len({*names})


@pytest.mark.parametrize("kind", FILES)
def test_nothing_is_told_of_ordinary_files(tmp_path, kind):
    file = written(tmp_path, kind)
    assert image_fields.field_names(file)[0] in image_fields.FIELDS and not image_fields.unused_fields(file)


@pytest.mark.parametrize(("write", "told"), [
    (by_pillow(".png", save_all=True, append_images=[Image.new("RGB", SIZE)]),
     "acTL (further pictures; the first is read)"),
    (png16((b"hdRI", bytes(4))), "hdRI (unknown)"), (exr_of("R", "G", "B", "N.X"), "channel:N.X (other channels)"),
    (exr_of("c.R", "c.G", "c.B", "Z"), "channel:Z (other channels)"),
    (by_tiff(photometric="rgb", extratags=[(318, 5, 2, (3127, 10000, 3290, 10000), True)]),
     "WhitePoint (colours are read by the profile alone)"),
])  # fmt: skip
def test_what_image_files_say_that_is_not_used_is_told(tmp_path, capsys, write, told):
    write(tmp_path / "a", stripes())
    file = next(tmp_path.iterdir()).name
    frames = [{"file_path": file, "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 70.0, "frames": frames}))
    converted("transforms", tmp_path, tmp_path / "s.xml")
    assert f"Not used in 1 photographs: {told}\n" in capsys.readouterr().out


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
    assert image_headers.statement_of(written(tmp_path, "exr")) == Statement()
    wide = as_stated((stripes() @ TO_P3.T).astype(np.float32),
                            Statement(primaries_profile((0.3127, 0.3290), P3)))  # fmt: skip
    np.testing.assert_allclose(wide, stripes(), atol=1e-3)


@pytest.mark.parametrize(("write", "close"), [
    (png16((b"cICP", bytes([12, 13, 0, 1]))), 0), (png16((b"cICP", bytes([12, 8, 0, 1]))), 0),
    (by_pillow(".jpg", quality=100, subsampling=0), 0.02), (coded(".avif", 12, 13), 0.02),
    (coded(".heic", 12, 13), 0.02),
])  # fmt: skip
def test_colours_that_are_said_without_a_profile(tmp_path, write, close):
    """Display P3 by the codes of H.273, and Adobe RGB by EXIF, are converted by numpy here."""
    primaries, curve = P3, srgb_to_linear
    encoded = images.linear_to_srgb(stripes())
    write(tmp_path / "a", stripes())
    file = next(tmp_path.iterdir())
    if file.suffix == ".jpg":
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA001] = 65535
        exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
        Image.open(file).save(file, quality=100, subsampling=0, exif=exif)
        primaries, curve = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06), lambda v: v ** (563 / 256)
    elif file.suffix == ".png" and b"cICP\x0c\x08" in file.read_bytes():
        curve = np.array
    expected = (curve(encoded) @ (np.linalg.inv(to_xyz(SRGB)) @ to_xyz(primaries)).T).clip(0, 1)
    found = pixels_of(file, heed=True)
    scale = 4 if file.suffix in (".avif", ".heic") else 1
    inside = [3, 12, 20, 27]  # away from the edges of the stripes, where colours of some formats mix
    np.testing.assert_allclose(
        found[2::scale, 2::scale][:, inside] / 65535,
        expected[:1, inside].repeat(len(found[2::scale]), 0),
        atol=close or 1e-3,
    )


@pytest.mark.parametrize(("kind", "gamma", "exponent"), [
    (np.uint16, 55556, 1.8), (np.uint16, 100000, 1.0), (np.uint16, 40000, 2.5), (np.uint8, 55556, 1.8),
    (np.uint8, 100000, 1.0),
])  # fmt: skip
def test_any_gamma_of_png_is_obeyed_at_any_depth(tmp_path, kind, gamma, exponent):
    """The chunk gAMA holds 100000 / exponent."""
    full = np.iinfo(kind).max
    encoded = (stripes() ** (1 / exponent) * full + 0.5).astype(kind)
    chunk = b"gAMA" + struct.pack(">I", gamma)
    png = imagecodecs.png_encode(encoded)
    (tmp_path / "a.png").write_bytes(png[:33] + struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
                                     + png[33:])  # fmt: skip
    pixels = pixels_of(tmp_path / "a.png", heed=True)
    assert pixels.dtype == np.uint16
    np.testing.assert_allclose(pixels / 65535, (encoded / full) ** exponent, atol=1e-4)


def test_primaries_of_png_chunks(tmp_path):
    places = struct.pack(">8I", *(round(1e5 * value) for value in (0.3127, 0.3290, *P3)))
    for k, (chunks, curve) in enumerate((
        ([(b"cHRM", places)], np.array), ([(b"cHRM", places), (b"gAMA", struct.pack(">I", 50000))], np.square),
    )):  # fmt: skip
        png16(*chunks)(tmp_path / str(k), stripes())
        said = [kind for kind, _ in chunks]
        encoded = images.linear_to_srgb(stripes()) if b"gAMA" in said or b"cHRM" in said else stripes()
        expected = (curve(encoded) @ (np.linalg.inv(to_xyz(SRGB)) @ to_xyz(P3)).T).clip(0, 1)
        np.testing.assert_allclose(pixels_of(tmp_path / f"{k}.png", heed=True) / 65535, expected, atol=1e-3)


@pytest.mark.parametrize(("names", "channels"), [
    ("RGBA", 4), ("BGR", 3), (["R", "G", "B", "depth.Z"], 3), (["R", "G", "B", "A", "N.X", "N.Y"], 4),
    (["View.Combined.R", "View.Combined.G", "View.Combined.B", "View.Combined.A", "View.Depth.Z"], 4),
    (["View.Combined.B", "View.Combined.G", "View.Combined.R"], 3),
])  # fmt: skip
def test_colours_are_found_by_the_names_of_the_channels(tmp_path, names, channels):
    exr_of(*names)(tmp_path / "a", stripes())
    pixels = pixels_of(tmp_path / "a.exr")
    order = [name.rpartition(".")[2] for name in names if name.rpartition(".")[2] in "RGB"]
    assert pixels.shape == (H, W, channels)
    np.testing.assert_allclose(pixels[..., :3], stripes()[..., [order.index(c) for c in "RGB"]], atol=1e-6)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"exif": True}])
def test_a_jpeg_that_is_cut_off_is_not_converted(tmp_path, options):
    """A preview in its EXIF data is whole; what follows its pixels is not of them."""
    picture = Image.fromarray(np.random.default_rng(1).integers(0, 255, (40, 60, 3), np.uint8))
    if "exif" in options:
        preview = io.BytesIO()
        picture.resize((8, 6)).save(preview, "JPEG")
        exif = Image.Exif()
        exif[ExifTags.Base.MakerNote] = preview.getvalue()
        options = {"exif": exif}
    picture.save(path := tmp_path / "a.jpg", **options)
    whole = path.read_bytes()
    for content in (whole, whole + bytes(500)):
        path.write_bytes(content)
        image_headers.require_whole(path)
    for end in (-2, -200, 1500):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match="is cut off in its pixels; copy it again"):
            image_headers.require_whole(path)


def test_associated_alpha_of_tiff_is_undone(tmp_path):
    alpha = np.array([255, 128, 0, 60], np.uint8).repeat([9, 8, 7, 6])[None].repeat(H, 0)
    colours = eight(stripes())
    held = (colours * (alpha[..., None] / 255) + 0.5).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", np.dstack([held, alpha]), photometric="rgb", extrasamples=["assocalpha"])
    pixels = pixels_of(tmp_path / "a.tif")
    np.testing.assert_allclose(pixels[:, :17, :3], colours[:, :17], atol=2)
    assert (pixels[..., 3] == alpha).all()


@pytest.mark.parametrize(("write", "pattern"), [
    (by_tiff(photometric="cielab"), "its colours are CIELAB; save it as RGB"),
    (by_tiff(photometric="ycbcr"), "its colours are YCBCR; save it as RGB"),
    (lambda path, a: tifffile.imwrite(path.with_suffix(".tif"), np.stack([eight(a)] * 3), photometric="rgb"),
     "has 3 pictures; save the photograph alone"),
    (tiff(lambda a: np.where(a > 0.5, np.nan, a).astype(np.float32)), "contains pixels that are NaN, infinite"),
    (lambda path, a: exr(path, np.where(a > 0.5, np.inf, a)), "contains pixels that are NaN, infinite or above 1e"),
    (exr_of("N.X", "N.Y", "N.Z"), "has channels N.X, N.Y, N.Z, but no R, G, B"),
    (exr_of("X", "Y", "Z"), "has channels X, Y, Z, but no R, G, B"),
    (exr_integers, "has integers in the channels R, G, B; save them as floats"),
    (exr_of("red", "green", "blue"), "but no R, G, B"), (exr_of("Z"), "has channels Z, but no R, G, B"),
    (exr_of("a.R", "a.G", "a.B", "b.R", "b.G", "b.B"), "has the layers a, b; save the one of the photograph alone"),
    (exr_window, r"its data window \(0, 0, 29, 21\) is not its display window \(0, 0, 99, 99\)"),
    (png16((b"cICP", bytes([9, 16, 0, 1]))), "its colours are PQ, of HDR; save it as sRGB"),
    (coded(".avif", 9, 18), "its colours are HLG, of HDR; save it as sRGB"),
    (tiff(lambda a: (a * 1e6).astype(np.int32)), "has int32 pixels, whose full scale is unknown"),
    (tiff(lambda a: np.repeat(eight(a), 2, 2)[..., :4], photometric="separated"), "CMYK; save it as RGB"),
    (lambda path, a: Image.fromarray(eight(a)).convert("CMYK").save(path.with_suffix(".jpg")), "CMYK; save it as RGB"),
    (by_pillow(".png", icc_profile=SRGB_PROFILE[:16] + b"Lab " + SRGB_PROFILE[20:]), "colour profile is of Lab"),
    (by_pillow(".jpg", icc_profile=SRGB_PROFILE[:90]), "colour profile cannot be used"),
    (lambda path, a: path.with_suffix(".png").write_text("P6 2 2 255"), "none of JPEG, PNG, TIFF, OpenEXR, WebP"),
])  # fmt: skip
def test_what_is_not_read_says_so_and_is_not_converted(tmp_path, write, pattern):
    write(tmp_path / "a", stripes())
    file = next(tmp_path.iterdir())
    with pytest.raises(InputError, match=pattern):
        pixels_of(file, heed=True)
    frame = {"file_path": file.name, "transform_matrix": np.eye(4).tolist(), "fl_x": 50}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    with pytest.raises(InputError, match=pattern):
        convert.main(["transforms", str(tmp_path), str(tmp_path / "s.xml")])
    assert not (tmp_path / "s.xml").exists()


def test_colours_of_palettes_and_their_alpha(tmp_path):
    alpha = np.repeat([255, 255, 0, 255], [9, 8, 7, 6]).astype(np.uint8)[None].repeat(H, 0)
    rgba = np.dstack([eight(stripes()), alpha])
    Image.fromarray(rgba).quantize(method=Image.Quantize.FASTOCTREE).save(tmp_path / "a.png")
    assert has_alpha(tmp_path / "a.png")
    pixels = pixels_of(tmp_path / "a.png")
    assert pixels.shape == (H, W, 4) and (pixels[:, 17:24, 3] == 0).all() and (pixels[:, :17, 3] == 255).all()
    Image.fromarray(np.dstack([rgba[..., :3], np.full((H, W), 255, np.uint8)])).save(tmp_path / "b.png")
    assert not has_alpha(tmp_path / "b.png")  # opaque: says nothing


@pytest.mark.parametrize(("kind", "count"), [(["unspecified"], 3), (["unassalpha"], 4), (None, 4)])
@pytest.mark.parametrize("plane", ["contig", "separate"])
def test_a_channel_more_of_tiff_is_alpha_unless_it_is_unspecified(tmp_path, kind, count, plane):
    pixels = np.random.default_rng(2).integers(0, 255, (H, W, 4), np.uint8)
    stored = pixels if plane == "contig" else np.moveaxis(pixels, -1, 0)
    options = {"photometric": "rgb", "planarconfig": plane, "extrasamples": kind or ["unassalpha"]}
    tifffile.imwrite(path := tmp_path / "a.tif", stored, **options)
    if kind is None:  # some programs do not write the field
        content = path.read_bytes()
        path.write_bytes(content.replace((338).to_bytes(2, "little"), (65000).to_bytes(2, "little"), 1))
    assert (pixels_of(path) == pixels[..., :count]).all() and has_alpha(path) == (count == 4)
    assert ("ExtraSamples=unspecified" in image_fields.unused_fields(path)) == (count == 3)


@pytest.mark.parametrize("write", [
    by_tiff(photometric="rgb"), exr_of("R", "G", "B"), exr_of("R", "G", "B", "Z"), by_pillow(".jpg"), by_pillow(".png"),
])  # fmt: skip
def test_whether_there_is_alpha_is_seen_without_pixels(tmp_path, monkeypatch, write):
    write(tmp_path / "a", stripes())
    monkeypatch.setattr(images, "read_image", lambda *_: pytest.fail("was asked"))
    assert not has_alpha(next(tmp_path.iterdir()))


def test_a_mask_may_be_in_the_alpha_channel_of_its_file():
    colours, alpha = np.full((2, 3, 3), 90, np.uint8), np.array([[0, 255, 0], [255, 0, 128]], np.uint8)
    assert (images.mask_values(np.dstack([colours, alpha]), "m") == alpha).all()
    opaque = np.dstack([alpha, alpha, alpha, np.full_like(alpha, 255)])
    assert (images.mask_values(opaque, "m") == alpha).all() and (
        images.mask_values(alpha[..., None], "m") == alpha
    ).all()


def test_the_object_in_a_mask_may_have_any_label_or_colour():
    shown = np.array([[0, 1, 0], [1, 0, 1]], bool)
    for kind, label in ((np.uint8, 1), (np.uint8, 128), (np.uint16, 1), (np.uint16, 65535), (np.float32, 0.25)):
        mask = images.mask_values((shown * label).astype(kind)[..., None], "m")
        assert mask.dtype == np.uint8 and (mask == 255 * shown).all()
    for colour in ([0, 255, 0], [0, 0, 200, 255], [255, 0, 0]):
        assert (images.mask_values((shown[..., None] * colour).astype(np.uint8), "m") == 255 * shown).all()
    soft = np.array([[[0], [3], [200]]], np.uint8)
    assert (images.mask_values(soft, "m") == soft[..., 0]).all()


@pytest.mark.parametrize(("kind", "values", "words"), [
    (np.uint8, [0, 1, 2, 3], "0, 1, 2, 3; save the object as 255"), (np.uint8, [7, 7], "7; save the object as 255"),
    (np.uint16, [0, 1, 1000], "0, 1, 1000; save the object as 65535"),
    (np.float32, [0, 1, 2.5], "0, 1, 2.5; save the object as 1"),
    (np.uint8, range(9), "0, 1, 2, 3, 4, 5, …; save the object as 255"),
])  # fmt: skip
def test_a_mask_of_several_labels_is_refused(kind, values, words):
    with pytest.raises(InputError, match=f"^masks/a.png: mask: has the values {words}, and all else as 0"):
        images.mask_values(np.array([values, values], kind)[..., None], "masks/a.png: mask")


def test_a_dim_mask_of_many_values_is_empty():
    dim = np.arange(100, dtype=np.uint8).reshape(10, 10, 1)
    assert (images.mask_values(dim, "m") == dim[..., 0]).all()


@pytest.mark.parametrize("label", [1, 255])
@pytest.mark.parametrize("alpha", [False, True])
def test_masks_are_undistorted_whatever_their_channels(tmp_path, label, alpha):
    frames = [{"file_path": f"images/{k}.png"} for k in range(3)]
    top = {"fl_x": 40.0, "fl_y": 44.0, "cx": 28.5, "cy": 27.25, "k1": 0.3}
    folder = transforms(tmp_path, top, frames, lambda k: noise(np.uint8, seed=k))
    shown = disc()[..., 0] > 0
    channels = [shown * label] * 3 + [np.full(shown.shape, 255)] if alpha else [shown * label]
    for k in range(3):
        (folder / "masks").mkdir(exist_ok=True)
        Image.fromarray(np.dstack(channels).astype(np.uint8).squeeze()).save(folder / f"masks/{k}.png")
    scene = converted("transforms", folder, tmp_path / "s.xml")
    rows, columns = np.indices(shown.shape) + 0.5
    x, y = (columns - 28.5) / 40, (rows - 27.25) / 44
    factor = 1 + 0.3 * (x**2 + y**2)
    u, v = 40 * x * factor + 28 - 33, 44 * y * factor + 26.75 - 24  # from the disc's centre, in the distorted mask
    distance2 = u**2 + v**2
    clear = np.abs(distance2 - 200) > 40  # the border is blurred
    assert ((scene.masks[1] > 127) == (distance2 < 200))[clear].all()


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
    ([{37377: 3.0, 37378: 2.0, 34855: 100}, {37377: -1.0, 37378: 3, 34855: 50}], [100 / 8 / 4, 50 * 2 / 8]),
    ([{33434: 1, 37377: 5.0}, {37377: -2.0}, {37377: 10**400}], [1, 4, np.nan]),
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
    assert "not used: lens_shift (unknown)\n" in printed
    frames[1]["rolling_shutter"] = [0, 0, 0.1, 0]
    source = transforms(tmp_path / "b", {"fl_x": 70.0}, frames, lambda k: eight(stripes()))
    with pytest.raises(
        InputError, match=r"frames\[1\].rolling_shutter: is .*, which is not supported: a camera that moved"
    ):
        converted("transforms", source, tmp_path / "b.xml")
