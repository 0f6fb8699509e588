"""Cameras of photogrammetry: points land where each program's own published formulas put them."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.photogrammetry_files import (
    BROWN,
    DISTORTION,
    FX,
    FY,
    NAMES,
    OFFSET,
    POINTS,
    SENSOR,
    SIZE,
    TERMS,
    H,
    K,
    W,
    alicevision,
    by_opencv,
    cameras,
    capturing_reality,
    csv_table,
    edited,
    llff,
    metashape,
    middlebury,
    openmvg,
    photographs,
    rig_of_angles,
    sidecars,
)
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mi_ring import convert
from mi_ring.errors import InputError
from mi_ring.importers.formats import FORMATS, detect
from mi_ring.importers.frames import require_frames
from mi_ring.importers.llff import Llff
from mi_ring.importers.metashape import Metashape
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.realitycapture import RealityCapture
from mi_ring.importers.sfmdata import SfmData


def landed(frame):
    """Pixels of the points, by our camera's pose and the lens; the first pixel's centre is (0.5, 0.5)."""
    x = (POINTS - frame.pose[:3, 3]) @ frame.pose[:3, :3]
    assert x[:, 2].min() > 0
    pixels = frame.lens.colmap.img_from_cam(x)
    if frame.lens.is_pinhole:  # also by the camera that the rest of the program sees
        to_points = POINTS - frame.camera.position
        along = frame.camera.directions(pixels) * np.linalg.norm(to_points, axis=1, keepdims=True)
        np.testing.assert_allclose(along, to_points, atol=1e-4)
    return pixels


def taken(source):
    frames = list(source.frames())
    require_frames(frames, source.src)
    return frames


# Metashape


def agisoft(R, t, kind="frame", f=0.0, cx=0.0, cy=0.0, b1=0.0, b2=0.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0):
    """Appendix D of Metashape's manual."""
    X, Y, Z = (POINTS @ R.T + t).T
    x, y = X / Z, Y / Z
    if kind == "fisheye":
        r0 = np.sqrt(x**2 + y**2)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.sqrt(x**2 + y**2)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    xd = x * radial + (p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y)
    yd = y * radial + (p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y)
    return np.stack([W * 0.5 + cx + xd * f + xd * b1 + yd * b2, H * 0.5 + cy + yd * f], 1)


@pytest.mark.parametrize(("kind", "terms", "where"), [
    ("frame", SENSOR, "component"), ("frame", SENSOR | BROWN, "chunk"), ("frame", SENSOR | BROWN, ""),
    ("fisheye", SENSOR | BROWN | {"k4": 0.03}, "component"),
])  # fmt: skip
def test_metashape(tmp_path, kind, terms, where):
    source = Metashape(metashape(tmp_path, terms, kind, where), Path())
    frames = taken(source)
    assert [frame.image.name for frame in frames] == NAMES and source.without_pose == {"lost"}
    for frame, (R, t) in zip(frames, cameras()):
        np.testing.assert_allclose(landed(frame), agisoft(R, t, kind, **terms), atol=1e-5)


def test_several_chunks_and_components_of_metashape_are_told(tmp_path, capsys):
    path = metashape(tmp_path)
    text = path.read_text()
    chunk = text[text.index("<chunk") : text.index("</chunk>") + len("</chunk>")]
    fewer = chunk[: chunk.index("<camera ")] + chunk[chunk.index("</camera>") + len("</camera>") :]
    path.write_text(text.replace(chunk, fewer + chunk.replace("component_id='0'", "component_id='7'", 1)))
    convert.main(["metashape", str(path), str(tmp_path / "s.xml")])
    said = capsys.readouterr().out
    assert "of its 2 chunks number 2 is taken, with 3 photographs; not used: number 1 (2)" in said
    assert "component_id: photographs are 2 of 0, 1 of 7; components that are not aligned with each other" in said


def test_metashape_leaves_out_what_is_disabled(tmp_path):
    path = metashape(tmp_path)
    path.write_text(path.read_text().replace("label='b'", "label='b' enabled='0'"))
    source = Metashape(path, Path())
    assert [frame.image.name for frame in taken(source)] == ["a.JPG", "c.jpeg"] and source.without_pose == {"b", "lost"}


# RealityCapture


@pytest.mark.parametrize(("model", "elements", "count"), [
    ("perspective", False, 0), ("brown3", True, 3), ("brown3t2", False, 6),
])  # fmt: skip
def test_realitycapture_sidecars(tmp_path, model, elements, count):
    source = RealityCapture(sidecars(tmp_path, model, elements), Path())
    terms = {name: value * (k < count) for k, (name, value) in enumerate(TERMS.items())}
    frames = taken(source)
    assert source.without_pose == {"lost.png"} and [frame.image.name for frame in frames] == NAMES
    for frame, (R, t) in zip(frames, cameras()):
        np.testing.assert_allclose(landed(frame), capturing_reality(R, t, terms), atol=1e-5)


def test_sidecars_have_any_case_and_those_without_a_photograph_are_told(tmp_path):
    folder = sidecars(tmp_path)
    for file in list(folder.glob("*.xmp")):
        file.rename(file.with_suffix(".XMP"))
    (folder / NAMES[1]).unlink()
    source = RealityCapture(folder, Path())
    assert [frame.image.name for frame in taken(source)] == [NAMES[0], NAMES[2]]
    assert source.without_photograph == [Path(NAMES[1]).stem]


def test_realitycapture_table(tmp_path):
    source = RealityCapture(csv_table(tmp_path), Path())
    frames = taken(source)
    for frame, (R, t) in zip(frames, rig_of_angles(), strict=True):
        np.testing.assert_allclose(landed(frame), capturing_reality(R, t, TERMS), atol=1e-5)


def test_realitycapture_looks_down_with_the_upper_side_to_y_at_zero_angles(tmp_path):
    path = csv_table(tmp_path, heading=0, pitch=0, roll=0)
    (frame, *_) = RealityCapture(path, Path()).frames()
    np.testing.assert_allclose(frame.camera.forward, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(frame.camera.up, [0, 1, 0], atol=1e-12)


def test_the_longer_side_of_an_upright_photograph_counts(tmp_path):
    photographs(sidecars(tmp_path), size=(52, 90))
    for frame, (R, t) in zip(taken(RealityCapture(tmp_path, Path())), cameras()):
        np.testing.assert_allclose(landed(frame), capturing_reality(R, t, TERMS, (52, 90)), atol=1e-5)


# LLFF


@pytest.mark.parametrize(("images", "factor"), [("images", 1), ("images_2", 2)])
def test_llff(tmp_path, images, factor):
    size = (W // factor, H // factor)
    frames = taken(Llff(llff(tmp_path, images=images, size=size), Path()))
    for frame, (R, t) in zip(frames, cameras(), strict=True):
        x, y, z = (POINTS @ R.T + t).T
        pixels = np.stack([70 * x / z + W / 2, 70 * y / z + H / 2], 1) / factor
        np.testing.assert_allclose(landed(frame), pixels, atol=1e-5)


# Middlebury


def test_middlebury(tmp_path):
    for frame, (R, t) in zip(taken(Middlebury(middlebury(tmp_path), Path())), cameras(), strict=True):
        x = (POINTS @ R.T + t) @ K.T
        np.testing.assert_allclose(landed(frame), x[:, :2] / x[:, 2:] + 0.5, atol=1e-5)  # integers are pixels' centres


def test_the_dinosaur_of_middlebury_fills_the_box_of_its_readme(shared):
    """The hull of the silhouettes, by the recipe of the README, has the bounds that the README states."""
    folder = shared / "data" / "real" / "middlebury"
    if not folder.is_dir():
        pytest.skip("needs Middlebury's dinosaur")
    low, high = np.array([-0.061897, -0.018874, -0.057845]), np.array([0.010897, 0.068227, 0.015495])
    steps = 48
    axes = [np.linspace(a - 0.012, b + 0.012, steps) for a, b in zip(low, high)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    inside, views = np.ones(len(grid), bool), np.zeros(len(grid))
    good = (folder / "dinoSR_good_silhouette_images.txt").read_text().split()
    for frame in taken(Middlebury(folder, Path())):
        if frame.image.name not in good:
            continue
        bright = np.asarray(Image.open(frame.image).convert("L")) > 0.12 * 255
        bright = ndimage.binary_erosion(ndimage.binary_dilation(bright, iterations=10), iterations=7, border_value=1)
        x = (grid - frame.pose[:3, 3]) @ frame.pose[:3, :3]
        u, v = np.floor(x[:, :2] / x[:, 2:] * frame.lens.focal + frame.lens.centre).astype(int).T
        seen = (u >= 0) & (u < frame.lens.size[0]) & (v >= 0) & (v < frame.lens.size[1])
        inside[seen] &= bright[v[seen], u[seen]]
        views += seen
    parts, _ = ndimage.label((inside & (views >= 12)).reshape(3 * [steps]))  # corners that few cameras see remain
    hull = grid[parts.ravel() == np.bincount(parts[parts > 0]).argmax()]
    assert (np.abs(hull.max(0) - high) < 0.003).all()
    assert (np.abs(hull.min(0) - low) < [0.003, 0.009, 0.003]).all()  # nobody looks at the dinosaur's soles


# Meshroom and OpenMVG


@pytest.mark.parametrize(("version", "own", "terms"), [
    ("1.0.0", {"type": "brown", "distortionParams": DISTORTION}, DISTORTION),
    ("1.2.0", {"type": "radial1", "distortionParams": DISTORTION[:1]}, [-0.2, 0, 0, 0, 0]),
    ("1.2.1", {"type": "radial3", "distortionParams": DISTORTION[:3]}, [-0.2, 0.05, 0.02, 0, 0]),
    ("1.2.4", {"type": "radial3"}, [0, 0, 0, 0, 0]),
    ("1.2.5", {"type": "fisheye4", "distortionParams": [0.1, -0.05, 0.02, 0.01]}, [0.1, -0.05, 0.02, 0.01]),
    ("1.2.14", {"distortionType": "radialk3", "distortionParams": DISTORTION[:3]}, [-0.2, 0.05, 0.02, 0, 0]),
])  # fmt: skip
def test_meshroom(tmp_path, version, own, terms):
    source = SfmData(alicevision(tmp_path, version, own), Path())
    frames = taken(source)
    assert source.without_pose == {"lost.png"} and not source.notes
    focal = (FX, FX) if version == "1.0.0" else (FX, FY)
    for frame, (R, t) in zip(frames, cameras(), strict=True):
        pixels = by_opencv(R, t, focal, np.array(SIZE) / 2 + OFFSET, terms, own.get("type") == "fisheye4")
        np.testing.assert_allclose(landed(frame), pixels + 0.5, atol=1e-5)


def test_meshrooms_poses_without_a_position_and_unknown_fields(tmp_path):
    path = alicevision(tmp_path, own={"shear": 0.1, "bend": 2})
    path.write_text(path.read_text().replace('"rotationOnly": "False"', '"rotationOnly": "True"', 1))
    source = SfmData(path, Path())
    assert len(taken(source)) == 2 and source.without_pose == {"a.JPG", "lost.png"}
    assert source.notes == [f"{path}: not used: intrinsics/shear (unknown), intrinsics/bend (unknown)"]


IN_RIG = [([0.05, -0.1, 0.3], [0.1, -0.2, 0.3]), ([-0.1, 0.04, -0.2], [-0.3, 0.2, 0.15])]  #: turns and centres


def meshroom_rig(folder):
    """All photographs have the pose of the first one: two belong to cameras of its rig, the third to an unknown one."""
    path = alicevision(folder, own={"type": "radial3"})
    top = json.loads(path.read_text())
    poses = [(Rotation.from_rotvec(turn).as_matrix(), centre) for turn, centre in [*IN_RIG, IN_RIG[0]]]
    top["rigs"] = [{"rigId": "3", "subPoses": [
        {"status": status, "pose": {"rotation": [*map(str, np.ravel(R, order="F"))], "center": [*map(str, centre)]}}
        for (R, centre), status in zip(poses, ("constant", "estimated", "uninitialized"))
    ]}]  # fmt: skip
    for view, camera in zip(top["views"], (1, 0, 2)):
        view |= {"poseId": "20", "isPoseIndependant": "false", "rigId": "3", "subPoseId": str(camera)}
    path.write_text(json.dumps(top))
    return path


def test_meshrooms_rigs(tmp_path):
    """A point is moved to the rig, then to the camera, each time by x -> R (x - c)."""
    source = SfmData(meshroom_rig(tmp_path), Path())
    frames = taken(source)
    assert [frame.image.name for frame in frames] == ["a.JPG", "b.png"] and not source.notes
    assert source.without_pose == {"c.jpeg", "lost.png"}
    R, t = next(cameras())
    for frame, (turn, centre) in zip(frames, reversed(IN_RIG), strict=True):
        S = Rotation.from_rotvec(turn).as_matrix()
        pixels = by_opencv(S @ R, S @ (t - centre), (FX, FY), np.array(SIZE) / 2 + OFFSET, [0] * 5, False)
        np.testing.assert_allclose(landed(frame), pixels + 0.5, atol=1e-5)


@pytest.mark.parametrize(("kinds", "nested"), [
    (("pinhole_radial_k3", "pinhole_brown_t2", "fisheye"), True), (("pinhole", "pinhole_brown_t2", "pinhole"), False),
])  # fmt: skip
def test_openmvg(tmp_path, kinds, nested):
    terms = {"pinhole": [0] * 5, "pinhole_radial_k3": [*DISTORTION[:3], 0, 0], "pinhole_brown_t2": DISTORTION,
             "fisheye": [0.1, -0.05, 0.02, 0.01]}  # fmt: skip
    source = SfmData(openmvg(tmp_path, kinds, nested), Path())
    frames = taken(source)
    assert source.without_pose == {"lost.png"}
    for frame, kind, (R, t) in zip(frames, kinds, cameras(), strict=True):
        pixels = by_opencv(R, t, (FX, FX), np.array(SIZE) / 2 + OFFSET, terms[kind], kind == "fisheye")
        np.testing.assert_allclose(landed(frame), pixels + 0.5, atol=1e-5)


# The command


def test_the_command_says_what_is_left_out(tmp_path, capsys):
    path = metashape(tmp_path / "scan", SENSOR | BROWN)
    convert.main(["metashape", str(path), str(tmp_path / "made.xml")])
    printed = capsys.readouterr().out
    assert printed.startswith("1 of 4 photographs left out, without a pose: lost\n3 photographs, ")
    path.write_text(path.read_text().replace("transform>", "old>"))
    refused(["metashape", path], "SRC: none of 4 photographs has a pose", tmp_path)


def test_masks_flash_and_exposure_are_as_of_colmap(tmp_path):
    path = metashape(tmp_path)
    for k, name in enumerate(NAMES):
        exif = Image.Exif()
        exif[0x010F] = "maker"
        exif.get_ifd(0x8769).update({33434: 0.01 * (k + 1), 33437: 2.0, 34855: 100})
        Image.new("RGB", SIZE).save(tmp_path / "images" / name, exif=exif)
        Image.new("L", SIZE).save((photographs(tmp_path / "masks", []) / name).with_suffix(".png"))
    source = Metashape(path, Path(), masks=tmp_path / "masks", flash_offset=(0.3, -0.4, 0.1))
    for k, (frame, (R, t)) in enumerate(zip(taken(source), cameras(), strict=True)):
        np.testing.assert_allclose(frame.light.rgb, (k + 1) / 2)
        np.testing.assert_allclose(frame.light.vector, R.T @ ([0.3, -0.4, 0.1] - t))
        assert frame.mask.stem == frame.image.stem


# What lies in or beside a folder of photographs

WRITERS = {  # in the order in which they count
    Metashape: metashape, RealityCapture: sidecars, Llff: llff, Middlebury: middlebury, SfmData: alicevision,
}  # fmt: skip


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_are_detected(tmp_path, kind):
    WRITERS[kind](tmp_path / "images" if kind is RealityCapture else tmp_path)
    folder = tmp_path if kind is Middlebury else tmp_path / "images"
    source = detect(folder)
    assert type(source) is kind and len(taken(source)) == 3
    assert {frame.image.parent for frame in source.frames()} == {folder}


@pytest.mark.parametrize("kind", [Metashape, RealityCapture, Middlebury, SfmData])
def test_cameras_of_photographs_that_are_not_meant_are_left_out(tmp_path, kind):
    WRITERS[kind](tmp_path / "images" if kind is RealityCapture else tmp_path)
    folder = tmp_path if kind is Middlebury else tmp_path / "images"
    whole = {frame.image: frame.pose for frame in detect(folder).frames()}
    gone, *others = whole
    gone.unlink()
    assert [frame.image for frame in detect(folder).frames()] == others
    frames = list(replace(detect(folder), photographs=others).frames())
    assert [frame.image for frame in frames] == others
    assert all((frame.pose == whole[frame.image]).all() for frame in frames)


def test_of_several_cameras_the_first_kind_counts(tmp_path):
    photographs(tmp_path)
    (tmp_path / "broken.xml").write_text("<document><chunk>")
    (tmp_path / "other.xml").write_text("<scene version='3.0.0'/>")
    (tmp_path / "a.xmp").write_text("<x:xmpmeta xmlns:x='adobe:ns:meta/'/>")
    (tmp_path / "list.csv").write_bytes(b"name,x\n\xff")
    (tmp_path / "cameraInit.sfm").write_text('{"views": []}')
    assert detect(tmp_path) is None
    for kind, write in reversed(WRITERS.items()):
        write(tmp_path)
        assert type(detect(tmp_path)) is kind
    (tmp_path / "transforms.json").write_text("{}")
    assert type(detect(tmp_path)) is FORMATS["transforms"]
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/images.txt").touch()
    assert type(detect(tmp_path)) is FORMATS["colmap"]
    assert type(detect(tmp_path / "images")) is FORMATS["colmap"]


def test_a_table_is_detected(tmp_path):
    source = detect(csv_table(tmp_path).parent)
    assert type(source) is RealityCapture and source.src.name == "cameras.csv"


# A user's mistakes


def refused(arguments, pattern, folder):
    out = folder / "out" / "scene.xml"
    with pytest.raises(InputError, match=pattern) as error:
        convert.main([*map(str, arguments), str(out)])
    assert "\n" not in str(error.value) and len(str(error.value)) < 900 and not out.parent.exists()


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ("<document ", "<documents ", "XML"),
    ("document", "doc", "is no <document> with a <chunk>"),
    ('encoding="UTF-8"', 'encoding="KLINGON"', "cannot be read as XML"),
    ('encoding="UTF-8"', 'encoding="UTF-16"', "cannot be read as XML"),
    ("label='b'", "", "camera '1': label: is missing"),
    ("sensor_id='4'", "sensor_id='5'", "sensor_id: is '5'"),
    ("<f>70.0</f>", "", "sensor '4': f: is missing"),
    ("<f>70.0</f>", "<f>wide</f>", "f: is .*; must be a number"),
    ("<f>70.0</f>", "<f>nan</f>", "f: has NaN"),
    ("<f>70.0</f>", "<f>-70</f>", "focal lengths above 0"),
    ("<f>70.0</f>", "<f>70</f><k4>0.1</k4>", "k4: is 0.1"),
    ("<f>70.0</f>", "<f>70</f><p3>0.1</p3>", "p3: is 0.1"),
    ("<f>70.0</f>", "<f>70</f><b2>0.5</b2>", "b2: is 0.5, a skew"),
    (f'width="{W}"', f'width="{10**400}"', "must be 1 to 1000000|infinite"),
    (f'width="{W}"', 'width="61"', "photograph: is 62 x 52 pixels, but its camera 61 x 52"),
    ('type="frame"', 'type="spherical"', "type: is 'spherical'; must be frame or fisheye"),
    ("calibration", "calibrations", "calibration: is missing"),
    ("</sensors>", '<sensor id="4"/></sensors>', "sensor: two have the id '4'"),
    ("<scale>2.5", "<scale>0", "scale: is 0.0; must be above 0"),
    ("<rotation locked='0'>", "<rotation locked='0'>1 ", r"rotation: is of shape \(10,\)"),
])  # fmt: skip
def test_mistakes_in_metashape(tmp_path, old, new, pattern):
    refused(["metashape", edited(metashape(tmp_path), old, new)], pattern, tmp_path)


def test_a_little_shear_does_not_matter(tmp_path):
    taken(Metashape(metashape(tmp_path, SENSOR | {"b2": 0.01}), Path()))


@pytest.mark.parametrize(("fields", "pattern"), [
    ({"Rotation": "1 0 0"}, "a.xmp: xcr:Rotation: is of shape"),
    ({"Position": "1 x 3"}, "xcr:Position: is"),
    ({"FocalLength35mm": None}, "xcr:FocalLength35mm: is missing"),
    ({"FocalLength35mm": "inf"}, "xcr:FocalLength35mm: has NaN or inf"),
    ({"Skew": 0.1}, "xcr:Skew: is 0.1; must be 0"),
    ({"AspectRatio": 1.1}, "xcr:AspectRatio: is 1.1; must be 1"),
    ({"DistortionModel": "division"}, "xcr:DistortionModel: is 'division'; must be one of"),
    ({"DistortionModel": "brown4", "DistortionCoeficients": "0 0 0 1 0 0"}, "k4: is 1.0; must be 0"),
    ({"DistortionCoeficients": "0 0"}, r"xcr:DistortionCoeficients: is of shape \(2,\); must be 6"),
    ({"Rotation": None}, "none of 4 photographs has a pose"),
])  # fmt: skip
def test_mistakes_in_sidecars(tmp_path, fields, pattern):
    refused(["realitycapture", sidecars(tmp_path, **fields)], pattern, tmp_path)


@pytest.mark.parametrize(("changes", "pattern"), [
    ({"drop": ["heading"]}, "cameras.csv: column heading: is missing"),
    ({"heading": "north"}, "camera 1: heading: is north; must be a number"),
    ({"f": "-3"}, "focal lengths above 0"),
    ({"k4": 0.1}, "camera 1: k4: is 0.1"),
    ({"x": "nan"}, "camera 1: x: is nan; must be a number"),
    ({"#name": "gone.jpg"}, "SRC: 3 of 3 cameras have no photograph in .*: gone.jpg; give --images"),
    ({"#name": "a\0/b" + 300 * "c"}, "SRC: 3 of 3 cameras have no photograph"),
])  # fmt: skip
def test_mistakes_in_a_table(tmp_path, changes, pattern):
    refused(["realitycapture", csv_table(tmp_path, **changes)], pattern, tmp_path)


def moved(path, scale, x, y):
    """The table, with places scaled and moved."""
    head, columns, *rows = path.read_text("utf-8-sig").splitlines()
    cells = [row.split(",") for row in rows]
    rows = [",".join([c[0], repr(float(c[1]) * scale + x), repr(float(c[2]) * scale + y), *c[3:]]) for c in cells]
    path.write_text("\n".join([head, columns, *rows]))
    return path


@pytest.mark.parametrize(("x", "y"), [(14.4, 50.1), (50.1, 14.4), (-0.001, 51.48), (-179.5, -0.2)])
def test_a_table_in_degrees_is_refused(tmp_path, x, y):
    path = moved(csv_table(tmp_path), 1e-5, x, y)
    refused(["realitycapture", path], "cameras.csv: columns x, y: are latitudes and longitudes", tmp_path)
    path.write_text(path.read_text().replace("#name,x,y,", "#name,longitude,latitude,"))
    refused([path], "cameras.csv: column longitude: are latitudes and .* local metric system", tmp_path)


@pytest.mark.parametrize(("scale", "x", "y"), [(1, 14.4, 50.1), (1e-3, 0, 0), (1, 458000, 5550000), (0.01, 14.4, 50.1)])
def test_a_table_in_metres_is_none_of_degrees(tmp_path, scale, x, y):
    assert len(taken(RealityCapture(moved(csv_table(tmp_path), scale, x, y), Path()))) == 3


def test_a_sidecar_is_of_one_photograph(tmp_path):
    folder = sidecars(tmp_path / "in")
    refused(
        ["realitycapture", folder / "a.xmp"], "a.xmp: SRC: is the sidecar of one photograph; give its folder", tmp_path
    )
    (folder / "a.png").write_bytes((folder / "b.png").read_bytes())
    refused(["realitycapture", folder], "a.png: may be the same photograph as a.JPG; keep one of them", tmp_path)


def test_alembic_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "sfm.abc").write_bytes(b"Ogawa")
    refused(["sfmdata", tmp_path / "sfm.abc"], "is an Alembic file, .* by Meshroom's node ConvertSfMFormat", tmp_path)


def test_there_is_no_table_and_there_are_no_sidecars(tmp_path):
    refused(["realitycapture", photographs(tmp_path)], "no XMP sidecars in this folder", tmp_path)
    refused(["realitycapture", tmp_path / "gone.csv"], "gone.csv: text: no such file", tmp_path)
    (tmp_path / "empty.csv").touch()
    refused(["realitycapture", tmp_path / "empty.csv"], "column name: is missing", tmp_path)
    (tmp_path / "wide.csv").write_text("#name," + 200000 * "x")
    refused(["realitycapture", tmp_path / "wide.csv"], "cannot be read as a table", tmp_path)
    (tmp_path / "short.csv").write_text("#name,x,y,alt,heading,pitch,roll,f\na,1\n")
    refused(["realitycapture", tmp_path / "short.csv"], "camera 1: has 2 columns; must have 8", tmp_path)


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda a: a[:, :15], r"is of shape \(3, 15\); must be N x 17"),
    (lambda a: a[:2], "has 3 photographs, poses_bounds.npy 2 poses"),
    (lambda a: a * np.nan, "NaN"),
    (lambda a: np.array(["a"] * 17)[None], "poses_bounds.npy: "),
    (lambda a: np.where(a == 70, 0, a), "not proportional"),
    (lambda a: np.where(a == H, 40, a), "is 62 x 52 pixels, not proportional to the 62 x 40 of pose 0"),
    (lambda a: np.vstack([a[:1] * 0, a[1:]]), "not proportional"),
])  # fmt: skip
def test_mistakes_in_poses_bounds(tmp_path, edit, pattern):
    refused(["llff", llff(tmp_path, edit)], pattern, tmp_path)


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda text: "", "line 1: is ''; must be the number of cameras"),
    (lambda text: "4" + text[1:], "line 1: is '4'; must be the number of cameras, of which 3 follow"),
    (lambda text: text.replace("b.png", "d.png").replace("c.jpeg", "e.png"), "SRC: 2 of 3 cameras have no photograph"),
    (lambda text: text.replace("70.0", "x", 1), "a.JPG: K, R, t: is"),
    (lambda text: text.replace(" 70.0", "", 1), r"a.JPG: K, R, t: is of shape \(20,\); must be 21"),
    (lambda text: text.replace("70.0 0.0", "70.0 9.0"), "has skew"),
    (lambda text: "\udcff" + text, "cannot be read as text"),
])  # fmt: skip
def test_mistakes_in_par_txt(tmp_path, edit, pattern):
    folder = middlebury(tmp_path, lambda text: text)
    path = folder / "pot_par.txt"
    path.write_bytes(edit(path.read_text()).encode("utf-8", "surrogateescape"))
    refused(["middlebury", folder], pattern, tmp_path)


def test_there_are_two_par_txt(tmp_path):
    (middlebury(tmp_path) / "other_par.txt").touch()
    refused(["middlebury", tmp_path], "has 2 files", tmp_path)


@pytest.mark.parametrize(("own", "pattern"), [
    ({"type": "3deradial4"}, "the camera is of type '3deradial4'; must be one of"),
    ({"distortionType": "radialk3pt"}, "the camera is of type 'radialk3pt'"),
    ({"undistortionType": "3declassicld"}, "undistortionType: is '3declassicld'; must be none"),
    ({"type": "brown", "distortionParams": [1, 2]}, r"distortionParams: is of shape \(2,\); must be 5 numbers"),
    ({"focalLength": "long"}, "intrinsic '5': focalLength: is long; must be a number"),
    ({"pixelRatio": 0}, "pixelRatio: are 23.5 and 0; must be above 0"),
    ({"width": 10**300, "type": "radial3"}, "must be 1 to 1000000"),
    ({"principalPoint": None}, "principalPoint: is"),
    ({"intrinsicId": 6}, r"views\[0\]: intrinsics '5': is missing"),
])  # fmt: skip
def test_mistakes_in_meshrooms_intrinsics(tmp_path, own, pattern):
    refused(["sfmdata", alicevision(tmp_path, own=own)], pattern, tmp_path)


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ('"rigId": "3", "subPoses"', '"rigId": "4", "subPoses"', r"views\[0\]: rigs '3': is missing"),
    ('"subPoseId": "1"', '"subPoseId": "9"', r"views\[0\]: subPoseId: is 9; rig 3 has no such camera"),
    ('"subPoseId": "1"', '"subPoseId": "0.5"', "subPoseId: is 0.5; rig 3 has no such camera"),
    ('"center": ["-0.3"', '"center": ["far"', r"views\[0\]: subPoses\[1\].pose.center: is .*far"),
])  # fmt: skip
def test_mistakes_in_meshrooms_rigs(tmp_path, old, new, pattern):
    refused(["sfmdata", edited(meshroom_rig(tmp_path), old, new, 1)], pattern, tmp_path)


def leaves(value, path=()):
    """Where the entries of a JSON file are, inner ones too."""
    for key, own in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield (*path, key)
        yield from leaves(own, (*path, key))


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("write", [alicevision, lambda folder: alicevision(folder, "1.2.0"), openmvg])
def test_no_value_in_a_scene_is_a_surprise(tmp_path, write):
    """Whatever stands where, it is read or refused."""
    path = write(tmp_path)
    good = json.loads(path.read_text())
    surprises = [None, True, -1, 0, 10**400, "x\n" * 99, "a\0/b", "c" * 300, [], [[1], 2], {}, {"a": 1}, 1e300, 0.5]
    places = [where for where in leaves(good) if not any(isinstance(key, int) and key > 0 for key in where)]
    outcomes = set()
    for where in places:
        for value in [*surprises, json.loads("NaN"), json.loads("Infinity")]:
            bad = copy.deepcopy(good)
            inner = bad
            for key in where[:-1]:
                inner = inner[key]
            inner[where[-1]] = value
            path.write_text(json.dumps(bad))
            try:
                taken(SfmData(path, Path()))
                outcomes.add("read")
            except InputError as error:
                outcomes.add("refused")
                assert "\n" not in str(error), (where, value)
    assert outcomes == {"read", "refused"} and len(places) > 30


@pytest.mark.parametrize("write", [metashape, sidecars])
def test_no_value_in_xml_is_a_surprise(tmp_path, write):
    path = write(tmp_path)
    kind = Metashape if path.is_file() else RealityCapture
    file = path if path.is_file() else path / "a.xmp"
    good = ElementTree.fromstring(file.read_text())
    outcomes = set()
    for k, element in enumerate(good.iter()):
        for field in (None, *element.attrib):
            for value in ("", "x\ny", "-1", "1e999", "1" * 400, "1 2", "0 " * 9, "0 " * 16):
                bad = copy.deepcopy(good)
                own = [*bad.iter()][k]
                if field is None:
                    own.text = value
                else:
                    own.set(field, value)
                file.write_bytes(ElementTree.tostring(bad))
                try:
                    taken(kind(path, Path()))
                    outcomes.add("read")
                except InputError as error:
                    outcomes.add("refused")
                    assert "\n" not in str(error), (element.tag, field, value)
    assert outcomes == {"read", "refused"}
