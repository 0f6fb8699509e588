"""Other people's formats: points land on the same pixels before and after, by each format's own formulas."""

import json
import shutil

import mitsuba as mi
import numpy as np
import pytest
from helpers.foreign_captures import (
    DIRECTIONS,
    INTENSITIES,
    POINTS,
    H,
    K,
    W,
    cameras,
    colmap_folder,
    converted,
    diligent_folder,
    disc,
    iron,
    neus,
    noise,
    transforms,
    write,
)
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from mi_ring import convert, foreign
from mi_ring.capture import loading
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.importers import colmap as importer
from mi_ring.importers import reading
from mi_ring.rendering.pinhole import Pinhole
from mi_ring.system import command


def by_hand(R, t, calibration=K):
    """Pixels of the points, by the textbook."""
    x = (POINTS @ R.T + t) @ calibration.T
    return x[:, :2] / x[:, 2:]


def in_scene(shot):
    """Pixels of the points in a photograph of ours, corner of the image at the origin."""
    camera = shot.camera
    camera = Pinhole(mi.Matrix4f(camera.to_world), mi.Point2f(camera.focal), mi.Point2f(camera.centre))
    x, depth = camera.project(mi.Point3f(POINTS.T.astype("f4")))
    assert np.array(depth).min() > 0
    return np.array(x).T


@pytest.fixture
def diligent(tmp_path):
    return diligent_folder(tmp_path)


@pytest.fixture
def colmap(tmp_path):
    return colmap_folder(tmp_path)


# DiLiGenT-MV


def test_diligent_mv(diligent, tmp_path):
    scene = converted("diligent-mv", diligent, tmp_path / "bear.xml", "--views", 1, 3, "--lights", 2, 4)
    assert [shot.name for shot in scene.shots] == ["01_002", "01_004", "03_002", "03_004"]
    poses = list(cameras())
    for shot, (view, light) in zip(scene.shots, [(0, 1), (0, 3), (2, 1), (2, 3)]):
        R, t = poses[view]
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t) + 0.5, atol=0.01)  # Bouguet: integers are centres
        # The light in the camera's axes x right, y up, z back, from the surface to the light.
        towards = R.T @ (DIRECTIONS[light] * [1, -1, -1])
        assert shot.light.kind == "directional"
        np.testing.assert_allclose(shot.light.vector, -towards / np.linalg.norm(towards), atol=1e-5)
        np.testing.assert_allclose(shot.light.rgb, INTENSITIES[light], rtol=1e-5)
    # A camera's photographs share one mask; what is called alike is told apart by its folder.
    assert scene.masks[0] is scene.masks[1] and scene.masks[1] is not scene.masks[2]
    assert scene.names[1:3] == ["view_01/004.png", "view_03/002.png"]
    # 16 bits, linear, in RGB order
    np.testing.assert_allclose(scene.observe([3])[0][0], noise(np.uint16, seed=34) / 65535, rtol=1e-6)
    assert (tmp_path / "bear/truth/mesh.ply").read_bytes() == b"ply"


def test_lines_of_lights_belong_to_those_of_file_names(diligent, tmp_path):
    view = diligent / "view_02"
    (view / "filenames.txt").write_text("004.png\r\n002.png\r\n001.png\r\n003.png\r\n")
    scene = converted("diligent-mv", diligent, tmp_path / "a.xml", "--views", 2, "--lights", 1, 4)
    assert [shot.files.filename.name for shot in scene.shots] == ["004.png", "003.png"]
    np.testing.assert_allclose([shot.light.rgb for shot in scene.shots], INTENSITIES[[0, 3]], rtol=1e-5)
    (view / "filenames.txt").write_text("004.png\n")
    refused(["diligent-mv", diligent], "filenames.txt: has 1 lines, light_directions.txt 4", tmp_path / "b/b.xml")
    (view / "filenames.txt").unlink()
    (view / "light_directions.txt").write_text("0 0 0\n" * 4)
    refused(["diligent-mv", diligent], "001.png: light: its direction is 0 0 0", tmp_path / "b/b.xml")


def test_diligent_mv_takes_all_and_fills_holes_if_asked(diligent, tmp_path):
    scene = converted("diligent-mv", diligent, tmp_path / "bear.xml", "--fill-holes")
    assert len(scene) == 12
    assert (scene.masks[5] == disc()[..., 0]).all()
    assert scene.masks[4] is scene.masks[7] and len(list((tmp_path / "bear/masks").iterdir())) == 3  # one per view
    scene = converted("diligent-mv", diligent, tmp_path / "bear2.xml")
    assert (scene.masks[5] == 0).sum() == (disc() == 0).sum() + 12


# transforms.json


def test_transforms_of_nerf(tmp_path):
    """One angle, no sizes, no suffixes, a light each, and masks in the alpha channel."""
    frames = [
        {"file_path": "./train/r_0", "pl_pos": [1, 2, 3], "pl_intensity": [4, 5, 6]},
        {"file_path": "./train/r_1", "pl_pos": [3, 2, 1]},
        {"file_path": "./train/r_2"},
    ]

    def pixels(k):
        rgba = noise(np.uint8, 4, seed=k)
        rgba[..., 3:] = disc()
        return rgba

    angle = 0.8
    source = transforms(tmp_path / "data", {"camera_angle_x": angle, "pl_intensity": 7}, frames, pixels)
    scene = converted("transforms", source, tmp_path / "nerf.xml")
    f = 0.5 * W / np.tan(angle / 2)
    calibration = np.array([[f, 0, W / 2], [0, f, H / 2], [0, 0, 1]])
    for shot, (R, t) in zip(scene.shots, cameras()):
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t, calibration), atol=0.01)
    lights = scene.photographs.lights
    R, t = list(cameras())[2]
    np.testing.assert_allclose(lights.positions(), [[1, 2, 3], [3, 2, 1], -R.T @ t], rtol=1e-4)
    np.testing.assert_allclose(lights.rgb(), [[4, 5, 6], [7, 7, 7], [7, 7, 7]], rtol=1e-6)
    rgb, _, mask, masked, _ = scene.observe([1])
    inside = disc()[..., 0] > 0
    assert masked.all() and (mask[0].numpy() == inside).all()
    assert not rgb[0].numpy()[~inside].any()  # what is transparent is black
    expected = srgb_to_linear(noise(np.uint8, 4, seed=1)[..., :3] / np.float32(255))
    np.testing.assert_allclose(rgb[0].numpy()[inside], expected[inside], atol=1e-6)


@pytest.mark.parametrize("k1", [0, 0.1])
@pytest.mark.parametrize(("bits", "largest"), [(12, 4095), (12, 3000), (14, 16383), (16, 65535), (16, 16382)])
def test_low_bits_of_sixteen(tmp_path, capsys, bits, largest, k1):
    """Of each photograph a strip is over-exposed, if one is; undistorted files say the same."""
    frames = [{"file_path": f"{k}.png"} for k in range(2)]

    def stored(k):
        pixels = noise(np.uint16, seed=k) // 65535 * 7 + noise(np.uint16, seed=k) % (largest // 2)
        pixels[10:40, 7 + k : 30] = largest - 1 + k  # only the last one has the largest value
        return pixels

    folder = transforms(tmp_path / "in", {"fl_x": 70.0, "fl_y": 76.0, "k1": k1}, frames, stored)
    scene = converted("transforms", folder, tmp_path / "s.xml")
    full = 2**bits - 1
    note = f"No value of 2 photographs of 16 bits is above {largest}: taken for {bits} bits, over-exposed at {full}"
    assert (note in capsys.readouterr().out) == (bits < 16)
    for k in range(2):
        rgb, clipped, _, _, valid = scene.observe([k])
        np.testing.assert_allclose(rgb[0, 25, 20].numpy(), (largest - 1 + k) / 65535, rtol=1e-6)
        assert clipped[0, 25, 20].all() == (k == 1 and largest == full)
        assert not clipped[0][np.ones((H, W), bool) if valid is None else valid[0].numpy()][:W].any()


def test_raw_files_use_all_bits(tmp_path):
    """Developed ones are scaled, so that small values are those of dark photographs. They are not even opened."""
    file = tmp_path / "a.png"
    write(file, noise(np.uint16) // 16)
    found, note = reading.saturations_of({file: "auto", tmp_path / "b.nef": "auto"})
    assert found == {file: 4094.5 / 65535} and note.startswith("No value of 1 photographs")


def test_low_bits_of_a_curve_are_refused(tmp_path):
    folder = transforms(tmp_path / "in", {"fl_x": 70.0}, [{"file_path": "0.png"}], lambda k: noise(np.uint16) // 16)
    refused(["transforms", folder, "--encoding", "srgb"], "0.png: has values of 12 bits, at most 4095, but colours "
            "that need 16 bits; multiply the values by 16", tmp_path / "out/s.xml")  # fmt: skip


def test_masks_of_several_labels_are_refused_with_their_values(tmp_path):
    folder = transforms(tmp_path / "in", {"fl_x": 70.0}, [{"file_path": "a.png"}], lambda k: noise(np.uint8))
    write(folder / "masks/a.png", disc() // 255 + disc()[::-1] // 255 * np.uint8(2))
    refused(["transforms", folder], "masks/a.png: mask: has the values 0, 1, 2, 3; save the object as 255, and all "
            "else as 0", tmp_path / "out/s.xml")  # fmt: skip


@pytest.mark.parametrize("top", [{"fl_x": 1.1, "cx": 0.5, "cy": 0.5}, {"fl_x": 70.0, "cx": 0, "cy": 0}])
def test_intrinsics_that_are_not_in_pixels_are_refused(tmp_path, top):
    folder = transforms(tmp_path / "in", top, [{"file_path": "0.png"}], lambda k: noise(np.uint8))
    pattern = (
        r"0.png: camera: its focal lengths and principal point are \S+ \S+ \S+ \S+, but its photograph has 62 x 52"
    )
    refused(["transforms", folder], pattern, tmp_path / "out/scene.xml")


@pytest.mark.parametrize("place", ["", "images/"])
def test_no_photograph_is_taken_for_a_mask_that_is_missing(tmp_path, place):
    frames = [{"file_path": f"{place}{k}.png", "mask_path": f"D:/x/masks/{k}.png"} for k in range(2)]
    folder = transforms(tmp_path / "in", {"fl_x": 70.0}, frames, lambda k: noise(np.uint8))
    refused(["transforms", folder], r"frames\[0\].mask_path: no mask 'D:/x/masks/0.png'", tmp_path / "out/scene.xml")
    for k in range(2):
        write(folder / f"masks/{k}.png", disc())
    assert all((mask == disc()[..., 0]).all() for mask in converted("transforms", folder, tmp_path / "s.xml").masks)


def test_a_frame_may_have_another_kind_of_focal_length_than_the_file(tmp_path, capsys):
    frames = [{"file_path": f"train/{k}"} for k in range(3)]
    frames[1] |= {"camera_angle_x": 1.2}
    frames[2] |= {"intrinsic_matrix": K.tolist()}
    folder = transforms(tmp_path / "in", {"fl_x": 50.0, "fl_y": 55.0}, frames, lambda k: noise(np.uint8, seed=k))
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    (folder / "transforms_test.json").write_text("{}")
    scene = converted("transforms", folder, tmp_path / "scene.xml")
    angle = W / 2 / np.tan(0.6)
    expected = [[50, 55], [angle, angle], [70, 76]]
    np.testing.assert_allclose([shot.camera.focal for shot in scene.shots], expected, rtol=1e-6)
    assert f"{folder}: not used: transforms_test.json; convert each to a scene" in capsys.readouterr().out


def test_transforms_of_nerfstudio(tmp_path):
    """Intrinsics in the file, overridden by a frame's own; masks in files; no distortion: nothing is resampled."""
    top = {"fl_x": 70.0, "fl_y": 76.0, "cx": 28.5, "cy": 27.25, "w": W, "h": H, "camera_model": "OPENCV",
           "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}  # fmt: skip
    frames = [{"file_path": f"images/{k}.png", "mask_path": f"masks/{k}.png"} for k in range(3)]
    frames[1] |= {"fl_x": 71.0, "cx": 30.0}
    frames[2]["camera_intrinsics"] = [20, 21, 80, 81]
    source = transforms(tmp_path / "data", top, frames, lambda k: noise(np.uint8, seed=k))
    for k in range(3):
        write(source / f"masks/{k}.png", disc())
    scene = converted("transforms", source / "transforms.json", tmp_path / "studio.xml", "--encoding", "linear")
    own = [K, np.array([[71.0, 0, 30], [0, 76, 27.25], [0, 0, 1]]), np.array([[80.0, 0, 20], [0, 81, 21], [0, 0, 1]])]
    for shot, (R, t), calibration in zip(scene.shots, cameras(), own):
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t, calibration), atol=0.01)
    assert (scene.masks[1] == disc()[..., 0]).all()
    np.testing.assert_allclose(scene.observe([0])[0][0], noise(np.uint8) / 255, atol=1e-6)
    assert not (tmp_path / "studio/masks").exists()
    assert scene.images[0].dtype == np.uint16  # linear data of 8 bits is written anew, with more of them


#: Kannala–Brandt and Brown–Conrady: where rays (x, y, 1) go, written out from OpenCV's documentation.
def fisheye(x, y, k):
    r = np.hypot(x, y)
    theta = np.arctan(r)
    scale = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8) / r
    return x * scale, y * scale


def brown(x, y, k, p):
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    return (x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x),
            y * radial + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y)  # fmt: skip


@pytest.mark.parametrize(("model", "terms"), [
    ("OPENCV", {"k1": -0.3, "k2": 0.1, "k3": 0.05, "p1": 0.02, "p2": -0.03}),
    ("OPENCV_FISHEYE", {"k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": 0.01}),
])  # fmt: skip
def test_distortion_is_undone(tmp_path, model, terms):
    """A spot where the lens puts a ray comes to where a pinhole puts it."""
    size, f, c = (310, 260), np.array([350.0, 380.0]), np.array([150.0, 136.0])
    ray = np.array([[0.21, -0.17], [-0.3, 0.12], [0.05, 0.28]])
    k = [terms.get(f"k{i}", 0.0) for i in range(1, 5)]
    distort = brown(*ray.T, k, [terms.get("p1"), terms.get("p2")]) if model == "OPENCV" else fisheye(*ray.T, k)
    spots, straight = np.stack(distort, 1) * f + c, ray * f + c
    assert np.abs(spots - straight).max() > 2
    y, x = np.mgrid[: size[1], : size[0]] + 0.5
    picture = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in spots)
    top = {"fl_x": f[0], "fl_y": f[1], "cx": c[0], "cy": c[1], "w": 310, "h": 260, "camera_model": model, **terms}
    sixteen = (60000 * picture).astype(np.uint16)[..., None].repeat(3, 2)
    source = transforms(tmp_path / "data", top, [{"file_path": "a.png"}], lambda k: sixteen)
    write(source / "m.png", (255 * (picture > 0.5)).astype(np.uint8)[..., None])
    text = (source / "transforms.json").read_text()
    (source / "transforms.json").write_text(text.replace('"a.png"', '"a.png", "mask_path": "m.png"'))
    scene = converted("transforms", source, tmp_path / "lens.xml")
    found = scene.observe([0])[0][0, ..., 1].numpy().astype(float)
    for u, v in straight:
        near = found * (np.hypot(x - u, y - v) < 12)
        assert (near * x).sum() / near.sum() == pytest.approx(u, abs=0.03)
        assert (near * y).sum() / near.sum() == pytest.approx(v, abs=0.03)
        assert scene.masks[0][int(v), int(u)] == 255
    np.testing.assert_allclose(scene.shots[0].camera.focal, f)
    assert scene.images[0].dtype == np.uint16  # all bits are kept


def test_a_fisheye_without_coefficients_is_no_pinhole(tmp_path):
    top = {"fl_x": 70.0, "fl_y": 76.0, "cx": 28.5, "cy": 27.25, "camera_model": "OPENCV_FISHEYE"}
    source = transforms(tmp_path / "data", top, [{"file_path": "a.png"}], lambda k: noise(np.uint8))
    scene = converted("transforms", source, tmp_path / "lens.xml")
    assert scene.shots[0].files.filename.parts[-3:] == ("lens", "images", "a.png")  # written anew: straightened


@pytest.mark.parametrize("scene", ["pot.xml", "pot/scene.xml"])
def test_photographs_of_the_source_are_never_overwritten(tmp_path, scene):
    """The scene is to be where its files get the very names that the source's have."""
    pytest.importorskip("pycolmap")
    top = {"fl_x": 70.0, "fl_y": 76.0, "cx": 28.5, "cy": 27.25, "k1": -0.2}
    source = transforms(tmp_path / "pot", top, [{"file_path": "images/a.png"}], lambda k: noise(np.uint8))
    before = (source / "images/a.png").read_bytes()
    with pytest.raises(InputError, match=r"images/a.png: exists already, with other content; remove it"):
        convert.main(["transforms", str(source), str(tmp_path / scene)])
    assert (source / "images/a.png").read_bytes() == before
    assert sorted(p.name for p in source.iterdir()) == ["images", "transforms.json"]


@pytest.mark.parametrize("out", ["out", "out/deeper"])
def test_a_failure_halfway_leaves_nothing(tmp_path, out):
    pytest.importorskip("pycolmap")
    top = {"fl_x": 70.0, "fl_y": 76.0, "cx": 28.5, "cy": 27.25, "k1": -0.2, "w": W, "h": H}
    frames = [{"file_path": "a.png"}, {"file_path": "b.png"}]
    source = transforms(tmp_path / "data", top, frames, lambda k: noise(np.uint8, seed=k))
    content = (source / "b.png").read_bytes()
    (source / "b.png").write_bytes(content[: len(content) // 2])  # its header tells the size, its pixels are missing
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match=r"b.png: cannot be read as image"):
        convert.main(["transforms", str(source), str(tmp_path / out / "lens.xml")])
    assert list((tmp_path / "out").iterdir()) == []


def test_an_existing_scene_is_not_overwritten(tmp_path):
    source = neus(tmp_path / "dtu")
    (tmp_path / "dtu.xml").write_text("mine")
    with pytest.raises(InputError, match=r"dtu.xml: SCENE.xml: exists already"):
        convert.main(["neus", str(source), str(tmp_path / "dtu.xml")])
    with pytest.raises(InputError, match=r"out: SCENE.xml: must end in .xml"):
        convert.main(["neus", str(source), str(tmp_path / "out")])


# COLMAP


@pytest.mark.parametrize("model", ["", "text"])
def test_colmap(colmap, tmp_path, model):
    offset = [0.3, -0.4, 0.1]
    scene = converted("colmap", colmap / model, tmp_path / "scan.xml", "--masks", colmap / "masks",
                      "--flash-offset", *offset, "--copy")  # fmt: skip
    lights = scene.photographs.lights
    for shot, place, (R, t) in zip(scene.shots, lights.positions(), cameras()):
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t), atol=0.01)
        np.testing.assert_allclose(place, R.T @ (offset - t), rtol=1e-4)
    # exposure time · ISO: 1/50 · 100, 1/100 · 400, 1/150 · 900; brought to the median
    np.testing.assert_allclose(lights.rgb()[:, 0], [0.5, 1.0, 1.5], rtol=1e-5)
    assert (tmp_path / "scan/images/sub_1.jpg").read_bytes() == (colmap / "images/sub/1.jpg").read_bytes()
    assert (scene.masks[2] == disc()[..., 0]).all()


def test_a_model_that_keeps_its_reader_busy_for_ever_is_refused(colmap, tmp_path, monkeypatch):
    """The number of frames, with a bit too many: COLMAP's own reader goes through 2^40 of them."""
    path = next(colmap.rglob("frames.bin"))
    content = bytearray(path.read_bytes())
    content[5] = 1
    path.write_bytes(content)
    monkeypatch.setattr(foreign, "READ_SECONDS", 3.0)
    with pytest.raises(InputError, match="not a COLMAP model, or damaged"):
        convert.main(["colmap", str(path.parent), str(tmp_path / "scan.xml"), "--images", str(colmap / "images")])
    assert not (tmp_path / "scan.xml").exists()


@pytest.mark.parametrize("form", ["sparse/0/images.bin", "text/images.txt"])
def test_a_name_in_a_model_that_is_no_text(colmap, tmp_path, form):
    path = colmap / form
    path.write_bytes(path.read_bytes().replace(b"sub/1", b"sub/\xb2"))
    refused(["colmap", path.parent, "--images", colmap / "images"], "not a COLMAP model .*can't decode byte 0xb2",
            tmp_path / "new/scan.xml")  # fmt: skip


def test_the_largest_of_models_in_sparse_and_below_is_taken(colmap, tmp_path, capsys):
    import pycolmap

    model = pycolmap.Reconstruction(str(colmap / "text"))
    model.deregister_frame(2)
    model.write_binary(str(colmap / "sparse"))
    assert len(converted("colmap", colmap, tmp_path / "scan.xml").shots) == 3
    said = f"Of COLMAP's models {colmap / 'sparse/0'} is taken, with 3 photographs; not used: {colmap / 'sparse'} (2)"
    assert said in capsys.readouterr().out


def test_names_with_spaces_in_text(colmap, tmp_path):
    (colmap / "images/sub/2.jpg").rename(colmap / "images/sub/my best photo.jpg")
    path = colmap / "text/images.txt"
    path.write_text(path.read_text().replace("sub/2.jpg", "sub/my best photo.jpg"))
    scene = converted("colmap", colmap / "text", tmp_path / "scan.xml", "--images", colmap / "images")
    assert [shot.name for shot in scene.shots] == ["sub_1", "sub_3", "sub_my best photo"]
    for shot, k in zip(scene.shots, (0, 2, 1)):
        np.testing.assert_allclose(in_scene(shot), by_hand(*list(cameras())[k]), atol=1e-4)


def test_a_model_with_a_rotation_that_is_none(colmap, tmp_path):
    path = colmap / "text/frames.txt"
    lines = path.read_text().splitlines()
    words = lines[-1].split()
    path.write_text("\n".join([*lines[:-1], " ".join([*words[:2], "1e300", *words[3:]])]))
    refused(["colmap", path.parent, "--images", colmap / "images"], "its pose is no rotation and translation",
            tmp_path / "new/scan.xml")  # fmt: skip


def test_what_strangers_files_do_to_their_readers_is_one_line(colmap, tmp_path, monkeypatch):
    for error in (OverflowError("int too large"), KeyError(3), UnicodeDecodeError("utf-8", b"x", 0, 1, "bad")):
        monkeypatch.setattr(importer.Colmap, "posed", lambda self, error=error: (_ for _ in ()).throw(error))
        with pytest.raises(InputError, match=f"SRC: is damaged, or not of this format .{type(error).__name__}"):
            convert.main(["colmap", str(colmap), str(tmp_path / "scan.xml")])


def test_colmap_without_masks_and_exif(colmap, tmp_path):
    (colmap / "masks").rename(tmp_path / "aside")
    scene = converted("colmap", colmap, tmp_path / "scan.xml", "--no-exif")
    assert list(scene.masks) == [None] * 3
    lights = scene.photographs.lights
    np.testing.assert_allclose(lights.rgb(), 1)
    np.testing.assert_allclose(lights.positions(), [-R.T @ t for R, t in cameras()], rtol=1e-4)


# NeuS, IDR, WildLight


@pytest.mark.parametrize("mask", ["mask/{:03}.png", "masks/{:03}.png", "mask/m{:03}.png", "mask/{:03}_mask.png", None])
def test_masks_of_neus_are_found_by_name_or_order_or_in_alpha(tmp_path, mask, capsys):
    source = neus(tmp_path / "dtu")
    shutil.rmtree(source / "mask")
    (source / "image/001.png").unlink()
    for k in (0, 2):
        shown = np.roll(disc(), 3 * k, 1)
        image = source / f"image/{k:03}.png"
        if mask:
            write(source / mask.format(k), shown)
        else:
            write(image, np.dstack([np.array(Image.open(image)), shown]))
    scene = converted("neus", source, tmp_path / "dtu.xml")
    assert [(m == np.roll(disc(), s, 1)[..., 0]).all() for m, s in zip(scene.masks, (0, 6), strict=True)] == [True] * 2
    for shot, k in zip(scene.shots, (0, 2)):
        np.testing.assert_allclose(in_scene(shot), by_hand(*list(cameras())[k]) + 0.5, atol=1e-4)
    assert "1 camera left out, without a photograph" in capsys.readouterr().out


def test_neus(tmp_path):
    scene = converted("neus", neus(tmp_path / "dtu"), tmp_path / "dtu.xml")
    for shot, (R, t) in zip(scene.shots, cameras()):
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t) + 0.5, atol=0.01)  # integers are pixels' centres
    assert (scene.masks[0] == disc()[..., 0]).all()
    assert [image.dtype for image in scene.images] == [np.uint8] * 3  # sRGB, unless they say otherwise


def test_wildlight(tmp_path):
    """Energies are for the unit sphere, radiance is linear, photographs without flash are left out."""
    energies = {"light_energy_0": [2.0, 3.0, 4.0], "light_energy_1": [0.0, 0, 0], "light_energy_2": [1.0, 1.0, 1.0]}
    scene = converted("neus", neus(tmp_path / "wild", max_intensity=0.9, **energies), tmp_path / "wild.xml")
    assert [shot.name for shot in scene.shots] == ["000", "002"]
    lights = scene.photographs.lights
    np.testing.assert_allclose(lights.rgb(), 36 * np.array([[2, 3, 4], [1, 1, 1]]), rtol=1e-6)
    np.testing.assert_allclose(scene.observe([0])[0][0], noise(np.uint8) / 255, atol=1e-6)
    assert scene.shots[0].saturation == pytest.approx(0.9)


def test_a_number_of_neus_is_of_one_photograph(tmp_path):
    folder = neus(tmp_path / "in")
    (folder / "image").rename(folder / "images")
    assert len(converted("neus", folder, tmp_path / "scene.xml").shots) == 3
    shutil.copyfile(folder / "images/001.png", folder / "images/1.png")
    refused(["neus", folder], "images/1.png: may be the same photograph as 001.png; keep one", tmp_path / "b/b.xml")


@pytest.mark.parametrize("names", ["{:03}", "IMG_{}"])
def test_photographs_of_neus_may_be_numbered_otherwise(tmp_path, names):
    """From 1, or not at all: their order counts, as the cameras' does."""
    source = neus(tmp_path / "dtu")
    for folder in ("image", "mask"):
        for k in (2, 1, 0):
            (source / f"{folder}/{k:03}.png").rename(source / f"{folder}/{names.format(k + 7)}.png")
    scene = converted("neus", source, tmp_path / "dtu.xml")
    for k, (R, t) in enumerate(cameras()):
        np.testing.assert_allclose(in_scene(scene.shots[k]), by_hand(R, t) + 0.5, atol=0.01)
        assert (scene.images[k] == noise(np.uint8, seed=k)[..., :3]).all()


def test_wildlight_photographs_in_one_array(tmp_path):
    source = neus(tmp_path / "wild", **{f"light_energy_{k}": [1.0, 1, 1] for k in range(3)}, max_intensity=7.0)
    stack = np.random.default_rng(1).uniform(0, 7, (3, H, W, 3)).astype(np.float32)
    np.save(source / "images.npy", stack)
    scene = converted("neus", source, tmp_path / "wild.xml")
    np.testing.assert_allclose(scene.observe([2])[0][0], stack[2], rtol=1e-3)
    assert scene.shots[0].saturation == pytest.approx(7)


# IRON


def test_iron(tmp_path):
    scene = converted("iron", iron(tmp_path / "dragon"), tmp_path / "iron.xml")
    for shot, (R, t) in zip(scene.shots, cameras()):
        np.testing.assert_allclose(in_scene(shot), by_hand(R, t), atol=0.01)
    np.testing.assert_allclose(scene.observe([1])[0][0], noise(np.uint8, seed=1), rtol=1e-3)


# A user's mistakes


def test_mistakes_are_one_line_and_leave_nothing(diligent, colmap, tmp_path, capsys):
    good = neus(tmp_path / "neus")
    cases = []

    def case(pattern, *arguments):
        cases.append((pattern, [str(a) for a in arguments]))

    out = tmp_path / "out/scene.xml"
    case("FORMAT: is nerf; must be one of diligent-mv", "nerf", good, out)
    case("--views: 9: is not in", "diligent-mv", diligent, out, "--views", 9)
    case("--lights: 0: is not in", "diligent-mv", diligent, out, "--lights", 0)
    case("Calib_Results.mat: MATLAB file: no such file", "diligent-mv", colmap, out)
    case("transforms_train.json", "transforms", colmap, out)
    case("neither images.bin nor images.txt", "colmap", good, out)
    case("cameras.npz", "neus", colmap, out)
    case("cam_dict_norm.json", "iron", colmap, out)
    for pattern, arguments in cases:
        with pytest.raises(SystemExit) as stop:
            command.run("mi_ring.convert", convert.main, arguments)
        message = capsys.readouterr().err
        assert stop.value.code == 2 and message.count("\n") == 1 and pattern in message, message
    assert not out.parent.exists()


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda d: d.update(frames=[]), "frames: found none"),
    (lambda d: d["frames"][1].pop("file_path"), r"frames\[1\].file_path: missing"),
    (lambda d: [f.update(file_path="gone") for f in d["frames"][1:]], "SRC: 2 of 3 cameras have no photograph"),
    (lambda d: d["frames"][2].pop("transform_matrix"), r"frames\[2\].transform_matrix: is missing; must be 4 x 4"),
    (lambda d: d["frames"][0]["transform_matrix"][1].pop(), r"frames\[0\].transform_matrix"),
    (lambda d: d["frames"][0]["transform_matrix"].__setitem__(1, [float("nan")] * 4), "NaN"),
    (lambda d: d["frames"][0]["transform_matrix"].__setitem__(0, [2, 0, 0, 0]), "no rotation"),
    (lambda d: d["frames"][0].update(transform_matrix=np.transpose(d["frames"][0]["transform_matrix"]).tolist()),
     "the last row of its pose is .* must be 0 0 0 1; is it transposed"),
    (lambda d: [row.__setitem__(0, -row[0]) for row in d["frames"][0]["transform_matrix"]], "left-handed"),
    (lambda d: d.pop("camera_angle_x"), r"frames\[0\].fl_x: is missing"),
    (lambda d: d.update(camera_angle_x="wide"), "camera_angle_x: is wide; must be a number"),
    (lambda d: d.update(camera_angle_x=0), "camera_angle_x: is 0.0; must be between 0 and pi"),
    (lambda d: d.update(fl_x=-3.0), "focal lengths"),
    (lambda d: d.update(w=99, h=52), "is 62 x 52 pixels, but its camera 99 x 52"),
    (lambda d: d.update(w=62), r"frames\[0\].h: is missing"),
    (lambda d: d["frames"].append(d["frames"][0]), "0.png: would be the photograph of two cameras: '0' is named twice"),
    (lambda d: d.update(k4=0.1), r"frames\[0\].k4"),
    (lambda d: d.update(camera_model="FOV"), "camera_model: is FOV"),
    (lambda d: d["frames"][1].update(pl_pos=[1, 2]), r"frames\[1\].pl_pos: is of shape \(2,\); must be 3 numbers"),
    (lambda d: d["frames"][1].update(pl_pos=[1, 2, 3], pl_intensity=-2), "not negative"),
])  # fmt: skip
def test_mistakes_in_transforms(tmp_path, edit, pattern):
    frames = [{"file_path": f"{k}"} for k in range(3)]
    source = transforms(tmp_path / "data", {"camera_angle_x": 0.7}, frames, lambda k: noise(np.uint8))
    content = json.loads((source / "transforms.json").read_text())
    edit(content)
    (source / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=pattern) as error:
        convert.main(["transforms", str(source), str(tmp_path / "out/scene.xml")])
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ('"fl_x": 50', '"fl_x": 50, "fl_x": 60', "an object has the key 'fl_x' twice"),
    ('"a.png"', '"a\\u0001.png"', "this name is not UTF-8, or has control characters"),
])  # fmt: skip
def test_what_other_readers_would_read_otherwise(tmp_path, old, new, pattern):
    name = "a\x01.png" if "u0001" in new else "a.png"
    source = transforms(tmp_path / "data", {"fl_x": 50}, [{"file_path": name}], lambda k: noise(np.uint8))
    path = source / "transforms.json"
    path.write_text(path.read_text().replace(old, new))
    refused(["transforms", source], pattern, tmp_path / "out/scene.xml")


def refused(arguments, pattern, out):
    with pytest.raises(InputError, match=pattern) as error:
        convert.main([*map(str, arguments), str(out)])
    assert "\n" not in str(error.value) and not out.parent.exists()


@pytest.mark.parametrize(("more", "pattern"), [
    ({"world_mat_1": np.full((4, 4), np.nan)}, "world_mat_1.*NaN"),
    ({"world_mat_1": np.eye(3)}, r"world_mat_1: is of shape \(3, 3\); must be 4 x 4"),
    ({"world_mat_1": np.zeros((4, 4))}, "world_mat_1: .*singular"),
    ({"world_mat_1": np.array("none")}, "world_mat_1"),
    ({"light_energy_0": [-1.0, 1, 1]}, "light.*not negative"),
    ({"light_energy_0": [1.0, 1]}, r"light_energy_0: is of shape \(2,\); must be 3"),
    ({"light_energy_0": [1.0, 1, 1], "max_intensity": [0.0]}, "max_intensity: is 0.0; must be positive"),
    ({"light_energy_0": ["a", "b", "c"]}, "light_energy_0: is .*must be 3 numbers"),
    ({"light_energy_0": [1.0, 1, 1], "max_intensity": np.array("much")}, "max_intensity: is much; must be a number"),
])  # fmt: skip
def test_mistakes_in_cameras_sphere(tmp_path, more, pattern):
    source = neus(tmp_path / "dtu")
    with np.load(source / "cameras_sphere.npz") as arrays:
        np.savez(source / "cameras_sphere.npz", **{**arrays, **more})
    refused(["neus", source], pattern, tmp_path / "out/scene.xml")


def test_wrong_counts_of_photographs_and_masks(tmp_path):
    source, out = neus(tmp_path / "dtu"), tmp_path / "out/scene.xml"
    (source / "mask/001.png").rename(source / "mask/aside")
    refused(["neus", source], "mask: no mask of photograph 1, 001.png; give all or none", out)
    (source / "image/001.png").rename(tmp_path / "aside.png")  # as many masks now, but the names differ in one
    (source / "mask/002.png").unlink()
    (source / "mask/aside").rename(source / "mask/001.png")
    refused(["neus", source], "mask: no mask of photograph 2, 002.png; give all or none", out)
    write(source / "mask/002.png", disc())
    (tmp_path / "aside.png").rename(source / "image/001.png")
    for k in (3, 4):
        write(source / f"image/{k:03}.png", noise(np.uint8))
    refused(["neus", source], "world_mat: there are 3, but 5 photographs", out)
    for file in (source / "image").iterdir():
        file.unlink()
    refused(["neus", source], "image: no photographs in this folder", out)
    np.save(source / "images.npy", np.zeros((2, H, W, 3), np.float32))
    refused(["neus", source], r"images.npy: is of shape \(2, .* must be \(3, H, W, 3\)", out)
    np.save(source / "images.npy", np.full((3, H, W, 3), b"x"))
    refused(["neus", source], r"images.npy: is of shape \(3, .* must be \(3, H, W, 3\) numbers", out)


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda d: d["1.png"]["K"].pop(), r"1.png.K: is of shape \(15,\); must be 16"),
    (lambda d: d["1.png"].pop("W2C"), "1.png.W2C: is missing"),
    (lambda d: d["1.png"]["W2C"].__setitem__(0, "x"), "1.png.W2C"),
    (lambda d: d["1.png"]["W2C"].__setitem__(3, float("inf")), "1.png"),
    (lambda d: d["1.png"].update(img_size=[9, 9]), "1.exr: photograph: is 62 x 52 pixels, but its camera 9 x 9"),
    (lambda d: d["1.png"].update(img_size="large"), "1.png.img_size"),
    (lambda d: d["1.png"].update(K=[0] * 16), "1.png.K"),
    (lambda d: d.update({"7.png": d.pop("1.png"), "8.png": d.pop("2.png")}), "2 of 3 cameras have no photograph in"),
    (lambda d: d.update({"1.png": 3}), "must be an object"),
    (lambda d: d.clear(), "no photographs"),
])  # fmt: skip
def test_mistakes_in_cam_dict(tmp_path, edit, pattern):
    refused(["iron", iron(tmp_path / "dragon", edit)], pattern, tmp_path / "out/scene.xml")


@pytest.mark.parametrize(("own", "found"), [
    ({33434: IFDRational(0, 0), 33437: 2.8, 34855: 100}, "nan, 100, 2.8"), ({33437: 2.8}, "missing, missing, 2.8"),
])  # fmt: skip
def test_exif_that_is_no_number_or_missing(colmap, tmp_path, own, found):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(own)
    Image.fromarray(noise(np.uint8)).save(colmap / "images/sub/2.jpg", exif=exif)
    pattern = f"2.jpg: EXIF: exposure time, ISO and aperture are {found}; other photographs have more"
    refused(["colmap", colmap], pattern, tmp_path / "out/scene.xml")


def test_an_empty_list_of_lights(diligent, tmp_path):
    (diligent / "view_02/light_directions.txt").write_text("\n")
    refused(["diligent-mv", diligent], "light_directions.txt: is empty", tmp_path / "out/scene.xml")


def test_truncated_files(diligent, colmap, tmp_path):
    out = tmp_path / "out/scene.xml"
    for path in (colmap / "sparse/0/images.bin", colmap / "text/cameras.txt", diligent / "Calib_Results.mat",
                 diligent / "view_02/mask.png"):  # fmt: skip
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        kind, source = ("colmap", path.parent) if "colmap" in str(path) else ("diligent-mv", diligent)
        with pytest.raises(InputError) as error:
            convert.main(
                [kind, str(source), str(out), *(["--images", str(colmap / "images")] if kind == "colmap" else [])]
            )
        assert "\n" not in str(error.value) and str(path.parent) in str(error.value)
        path.write_bytes(content)
    assert not out.parent.exists()


@pytest.mark.parametrize("name", ["bunny", "teapot"])
def test_both_formats_of_a_capture_agree(shared, tmp_path, name):
    """The captures come as scene.xml and as transforms.json."""
    folder = shared / "data/captures" / name
    ours, theirs = (
        converted("transforms", folder, tmp_path / "a.xml"),
        loading.load_capture(folder / "scene.xml", images=False),
    )
    for a, b in zip(ours.shots, theirs.shots):
        np.testing.assert_allclose(a.camera.to_world, b.camera.to_world, rtol=1e-4, atol=1e-5)
        assert a.files.filename.resolve() == b.files.filename.resolve()
    for a, b in zip(ours.photographs.lights, theirs.photographs.lights, strict=True):
        assert a.kind == b.kind
        np.testing.assert_allclose(a.vector, b.vector, rtol=1e-4)
        np.testing.assert_allclose(a.rgb, b.rgb, rtol=1e-4)
