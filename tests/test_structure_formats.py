"""Cameras of Bundler, VisualSFM, OpenSfM, rigs, phones and Blender: points land where the formulas put them."""

from pathlib import Path

import numpy as np
import pytest
from helpers import foreign_captures, photogrammetry_files, structure_files
from helpers.photogrammetry_files import NAMES, edited
from PIL import Image

from mi_ring import convert
from mi_ring.errors import InputError
from mi_ring.importers.bundler import Bundler
from mi_ring.importers.colmap import Colmap
from mi_ring.importers.formats import FORMATS, detect, guess
from mi_ring.importers.frames import adapt_all, frames_of, require_frames
from mi_ring.importers.gltf_cameras import GltfCameras
from mi_ring.importers.metashape import Metashape
from mi_ring.importers.opensfm import OpenSfm
from mi_ring.importers.polycam import Polycam
from mi_ring.importers.record3d import Record3D
from mi_ring.importers.sdfstudio import SdfStudio
from mi_ring.importers.visualsfm import VisualSfm


def taken(source):
    frames = frames_of(source)
    adapt_all(source, frames)
    require_frames(frames, source.src)
    return frames


def landed(frame):
    """Pixels of the points, by our camera's pose and the lens; the first pixel's centre is (0.5, 0.5)."""
    x = (structure_files.POINTS - frame.pose[:3, 3]) @ frame.pose[:3, :3]
    assert x[:, 2].min() > 0
    return frame.lens.colmap.img_from_cam(x)


def agree(frames, expected, names=NAMES):
    assert [frame.image.name for frame in frames] == [*names]
    for frame, pixels in zip(frames, expected, strict=True):
        assert np.ptp(pixels, axis=0).min() > 5
        np.testing.assert_allclose(landed(frame), pixels, atol=1e-5)


def refused(arguments, pattern, folder):
    out = folder / "out" / "scene.xml"
    with pytest.raises(InputError, match=pattern) as error:
        convert.main([*map(str, arguments), str(out)])
    assert "\n" not in str(error.value) and not out.parent.exists()


# Bundler


@pytest.mark.parametrize("lines", ["{} 0 600.5", "{}", "./{}"])
def test_bundler(tmp_path, lines):
    path = structure_files.bundler(tmp_path, lines)
    for src in (path, tmp_path):
        source = Bundler(src, Path())
        agree(taken(source), map(structure_files.bundler_pixels, range(3)))
        assert source.without_pose == {"lost one.jpg"}


def test_the_list_of_a_bundle_file_is_named_like_it(tmp_path):
    path = structure_files.bundler(tmp_path)
    path = path.rename(tmp_path / "pot.bundle.out")
    (tmp_path / "list.txt").rename(tmp_path / "pot.list.txt")
    (tmp_path / "list.txt").write_text("another.jpg\n")
    agree(taken(Bundler(path, Path())), map(structure_files.bundler_pixels, range(3)))


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ("# Bundle file v0.3", "ply", "does not begin with '# Bundle file'"),
    ("4 1\n", "many 1\n", "line 2: is 'many'; must be the number of cameras"),
    ("4 1\n", "0 1\n", "line 2: is '0'; must be the number of cameras"),
    ("4 1\n", "3 1\n", "names 4 photographs, but bundle.out has 3 cameras"),
    ("4 1\n", "400 1\n", "bundle.out: its 400 cameras: is"),
    ("70.0 -0.2", "wide -0.2", "its 4 cameras: is .*; must be 60 numbers"),
    ("70.0 -0.2", "-70.0 -0.2", "focal lengths above 0"),
    ("70.0 -0.2", "70.0 nan", "its 4 cameras: has NaN"),
])  # fmt: skip
def test_mistakes_in_bundle_files(tmp_path, old, new, pattern):
    refused(["bundler", edited(structure_files.bundler(tmp_path), old, new)], pattern, tmp_path)


def test_a_bundle_file_without_its_list(tmp_path):
    path = structure_files.bundler(tmp_path)
    (tmp_path / "list.txt").unlink()
    refused(["bundler", path], "bundle.out: list.txt: found neither .*list.txt nor .*list.txt", tmp_path)


@pytest.mark.parametrize("make", [structure_files.bundler, structure_files.visualsfm])
def test_a_byte_order_mark_is_no_part_of_the_content(tmp_path, make):
    path = make(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    name, src = guess(tmp_path)
    assert name == make.__name__
    agree(taken(FORMATS[name](src, Path())), map(getattr(structure_files, f"{name}_pixels"), range(3)))


# VisualSFM


@pytest.mark.parametrize("fixed", [False, True])
def test_visualsfm(tmp_path, fixed):
    source = VisualSfm(structure_files.visualsfm(tmp_path, fixed), Path())
    agree(taken(source), [structure_files.visualsfm_pixels(k, fixed) for k in range(3)])
    assert "of its 2 models number 2 is taken, with 3 photographs; not used: number 1 (1)" in source.notes[0]


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ("NVM_V3", "NVM_V3_R9T", "begins with 'NVM_V3_R9T'; must be a file of VisualSFM's, NVM_V3"),
    ("NVM_V3", "NVM_V3 FixedK 70 0 70 0 0", "FixedK: the principal point, 0 0, is far from the middle"),
    ("NVM_V3", "NVM_V3 FixedK 70 30 70 26 0.3", "a.JPG': radial.* is -0.15, but that of FixedK is 0.3"),
    ("NVM_V3", "NVM_V3 FixedK 70 0", r"FixedK fx cx fy cy: is of shape \(2,\)"),
    ("\n3\n", "\n30\n", "has 7 of the 30 cameras"),
    ("\n3\n", "\nthree\n", "found 'three' where the number of cameras or points must be"),
    ("\t70.0 ", "\t", r"camera .*: is of shape \(9,\); must be 10 numbers"),
    ("70.0 ", "wide ", "a.JPG': is wide|must be 10 numbers"),
    ("70.0 ", "-70.0 ", "focal lengths above 0"),
    ("0.2 0", "9 0", "c.jpeg': radial distortion: is 9, too strong"),
    ("-0.15 0", "-1.5 0", "a.JPG': radial distortion: is -1.5, too strong"),
])  # fmt: skip
def test_mistakes_in_nvm(tmp_path, old, new, pattern):
    refused(["visualsfm", edited(structure_files.visualsfm(tmp_path), old, new)], pattern, tmp_path)


def test_a_quaternion_that_is_none(tmp_path):
    path = structure_files.visualsfm(tmp_path)
    lines = path.read_text().splitlines()
    words = lines[10].split()
    lines[10] = " ".join([*words[:2], "0", "0", "0", "0", *words[6:]])
    path.write_text("\n".join(lines))
    refused(["visualsfm", path], "quaternion: is of length 0; must be 1", tmp_path)


# OpenSfM


@pytest.mark.parametrize("kinds", [
    ("perspective", "brown", "fisheye_opencv"), ("fisheye", "radial", "simple_radial"),
])  # fmt: skip
def test_opensfm(tmp_path, kinds):
    path = structure_files.opensfm(tmp_path, kinds)
    for src in (path, path.parent, tmp_path):
        source = OpenSfm(src, Path())
        agree(taken(source), [structure_files.opensfm_pixels(k, kind) for k, kind in enumerate(kinds)])
        (note,) = source.notes
        assert "of its 2 reconstructions number 2 is taken, with 3 photographs; not used: number 1 (1)" in note


def test_unknown_fields_of_opensfm_are_named_once(tmp_path):
    def edit(models):
        for shot in models[1]["shots"].values():
            shot["shear"] = 1
        models[1]["cameras"]["v2 0"]["k3"] = 0.1  # a perspective camera has none
        models[1]["cameras"]["v2 0"]["k1_prior"] = 0.1

    source = OpenSfm(structure_files.opensfm(tmp_path, edit=edit), Path())
    taken(source)
    assert source.notes[1:] == [f"{source.src}: not used: shots/shear (unknown), cameras/perspective/k3 (unknown)"]


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda models: models.clear(), "SRC: must be a list of reconstructions"),
    (lambda models: models.append(3), r"\[2\]: is no object"),
    (lambda models: models[1].pop("cameras"), r"\[1\].cameras: is missing"),
    (lambda models: models[1]["cameras"].pop("v2 1"), "shots 'b.png'.camera: is missing"),
    (lambda models: models[1]["cameras"]["v2 1"].update(projection_type="spherical"),
     "cameras 'v2 1'.projection_type: is 'spherical'; must be one of perspective, "),
    (lambda models: models[1]["cameras"]["v2 0"].pop("focal"), "cameras 'v2 0'.focal_x: is missing; must be a number"),
    (lambda models: models[1]["cameras"]["v2 0"].update(k1="a"), "cameras 'v2 0'.k1: is a; must be a number"),
    (lambda models: models[1]["shots"]["a.JPG"].update(rotation=[1, 2]), r"shots 'a.JPG'.rotation: is of shape \(2,\)"),
    (lambda models: models[1]["shots"]["a.JPG"].pop("translation"), "shots 'a.JPG'.translation: is missing"),
])  # fmt: skip
def test_mistakes_in_reconstructions(tmp_path, edit, pattern):
    refused(["opensfm", structure_files.opensfm(tmp_path, edit=edit)], pattern, tmp_path)


# Rigs


@pytest.mark.parametrize("binary", [False, True])
def test_rigs_of_colmap_are_composed(tmp_path, binary):
    model = structure_files.colmap_rig(tmp_path)
    if binary:
        pycolmap = pytest.importorskip("pycolmap")
        reconstruction = pycolmap.Reconstruction(str(model))
        for path in model.iterdir():
            path.unlink()
        reconstruction.write_binary(str(model))
    frames = {frame.said: frame for frame in taken(Colmap(tmp_path, Path()))}
    agree(
        [frames[name] for name in structure_files.RIG],
        structure_files.rig_pixels(),
        ["1.png", "1.png", "2.png", "2.png"],
    )


def test_a_camera_without_a_pose_in_its_rig(tmp_path):
    structure_files.colmap_rig(tmp_path, calibrated=False)
    refused(["colmap", tmp_path], "rigs: camera 2 of rig/right/1.png has no pose in its rig; let", tmp_path)


def test_a_camera_without_a_rotation_in_its_rig(tmp_path):
    rigs = structure_files.colmap_rig(tmp_path) / "rigs.txt"
    words = rigs.read_text().split()
    rigs.write_text(" ".join([*words[:7], "0 0 0 0", *words[11:]]))
    refused(["colmap", tmp_path], "rigs: the quaternion of camera 2 is 0 0 0 0; must have length 1", tmp_path)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_rigs_of_metashape_are_composed(tmp_path, scale):
    source = Metashape(structure_files.metashape_rig(tmp_path, scale), Path())
    frames = taken(source)
    for frame in frames:
        frame.pose[:3, 3] /= scale
    agree(frames, structure_files.rig_pixels(), ["1.png", "1.png", "2.png", "2.png"])
    assert [note for note in source.notes if "in units of the chunk, not scaled" in note] == source.notes
    assert len(source.notes) == (scale != 1)


@pytest.mark.parametrize(("old", "new", "pattern"), [
    ('master_id="2"', 'master_id="9"', "camera 'right/2.png': master_id: is '9'; there is no such <camera>"),
    ("location>", "place>", "sensor '1': location: is missing; must be 3 numbers"),
    ('type="frame" master_id="0"', 'type="frame" master_id="1"', "sensor '1': master_id: is '1', but the master of"),
])  # fmt: skip
def test_mistakes_in_rigs_of_metashape(tmp_path, old, new, pattern):
    refused(["metashape", edited(structure_files.metashape_rig(tmp_path), old, new)], pattern, tmp_path)


def test_a_camera_of_a_rig_whose_master_has_no_pose(tmp_path):
    path = edited(structure_files.metashape_rig(tmp_path), 'label="left/2.png"><transform>', 'label="left/2.png"><old>')
    source = Metashape(edited(path, '</transform></camera><camera id="3"', '</old></camera><camera id="3"'), Path())
    assert len(taken(source)) == 2 and source.without_pose == {"left/2.png", "right/2.png"}


# Polycam


@pytest.mark.parametrize("kind", ["corrected_", ""])
def test_polycam(tmp_path, kind):
    structure_files.polycam(tmp_path, kind)
    (tmp_path / "keyframes" / "cameras").mkdir(exist_ok=True)
    for src in (tmp_path, tmp_path / "keyframes"):
        source = Polycam(src, Path())
        pixels = [structure_files.pinhole_pixels(k, lens) for k, lens in enumerate(structure_files.LENSES)]
        frames = taken(source)
        agree(frames, pixels, ["7.jpg", "8.jpg", "9.jpg"])
        assert {frame.image.parent.name for frame in frames} == {f"{kind}images"}
        assert ["Polycam has not corrected these cameras" in note for note in source.notes] == [True] * (not kind)


@pytest.mark.parametrize(("edit", "pattern"), [
    (list.clear, "corrected_cameras: SRC: found no"),
    (lambda cameras: cameras[1].pop("t_12"), "8.json: t_12: is missing; must be a number"),
    (lambda cameras: cameras[1].update(fx="a"), "8.json: fx: is a; must be a number"),
    (lambda cameras: cameras[1].update(t_00=9), "its pose is no rotation and translation"),
    (lambda cameras: cameras.__setitem__(1, [1]), "8.json: is no object"),
])  # fmt: skip
def test_mistakes_in_polycam(tmp_path, edit, pattern):
    refused(["polycam", structure_files.polycam(tmp_path, edit=edit)], pattern, tmp_path)


def test_unknown_fields_of_polycam_are_named_once(tmp_path):
    source = Polycam(
        structure_files.polycam(tmp_path, edit=lambda own: [camera.update(k1=0) for camera in own]), Path()
    )
    taken(source)
    assert source.notes == [f"{tmp_path}/keyframes/corrected_cameras: not used: k1 (unknown)"]


# Record3D


@pytest.mark.parametrize("varying", [False, True])
def test_record3d(tmp_path, varying):
    source = Record3D(structure_files.record3d(tmp_path, varying), Path())
    pixels = [structure_files.pinhole_pixels(k, structure_files.LENSES[varying * k]) for k in range(3)]
    agree(taken(source), pixels, ["0.jpg", "1.jpg", "2.jpg"])
    assert not source.notes


def test_record3d_is_found_by_its_file_and_has_one_photograph_of_a_number(tmp_path):
    folder = structure_files.record3d(tmp_path)
    assert guess(folder) == guess(folder / "metadata.json") == ("record3d", folder / "metadata.json")
    (folder / "rgb" / "01.png").write_bytes((folder / "rgb" / "1.jpg").read_bytes())
    refused([folder], "1.jpg: may be the same photograph as 01.png; keep one of them", tmp_path)


def test_photographs_of_record3d_may_be_reduced_and_padded(tmp_path):
    structure_files.record3d(tmp_path, edit=lambda own: own.update(w=124, h=104))
    for k in range(3):
        (tmp_path / "rgb" / f"{k}.jpg").rename(tmp_path / "rgb" / f"{k:05}.png")
    pixels = [structure_files.pinhole_pixels(k, np.array(lens) / 2) for k, lens in enumerate(structure_files.LENSES)]
    agree(taken(Record3D(tmp_path, Path())), pixels, ["00000.png", "00001.png", "00002.png"])


@pytest.mark.parametrize(("edit", "pattern"), [
    (dict.clear, "metadata.json: w, h: "),
    (lambda own: own.update(poses=3), "poses: found none; must be a list of 7 numbers"),
    (lambda own: own["poses"].__setitem__(1, [1, 2]), r"poses\[1\]: is of shape \(2,\); must be 7 numbers"),
    (lambda own: own["poses"].__setitem__(1, [0] * 7), r"poses\[1\]: its quaternion: is of length 0; must be 1"),
    (lambda own: own["perFrameIntrinsicCoeffs"].pop(), r"perFrameIntrinsicCoeffs: is of shape \(2, 4\); must be 3 x 4"),
    (lambda own: own.update(perFrameIntrinsicCoeffs=None, K=[1]), r"K: is \[1\]; must be 9 numbers"),
    (lambda own: own.update(perFrameIntrinsicCoeffs=None, K=[70, 0, 28, 0, 76, 27, 0, 0, 1]), "K: is .*by columns"),
])  # fmt: skip
def test_mistakes_in_record3d(tmp_path, edit, pattern):
    refused(["record3d", structure_files.record3d(tmp_path, edit=edit)], pattern, tmp_path)


# SDFStudio


def test_sdfstudio(tmp_path):
    folder = structure_files.sdfstudio(tmp_path)
    pixels = [structure_files.pinhole_pixels(k, lens) for k, lens in enumerate(structure_files.LENSES)]
    for src in (folder, folder / "meta_data.json"):
        frames = taken(source := SdfStudio(src, Path()))
        agree(frames, pixels, ["000000_rgb.png", "000001_rgb.png", "000002_rgb.png"])
        assert [frame.mask and frame.mask.name for frame in frames] == [None, "000001_foreground_mask.png", None]
        told = "worldtogt (the frame of the true mesh; the cameras keep theirs)"
        assert f"{folder}/meta_data.json: not used: {told}" in source.notes


def test_of_sdfstudio_only_what_may_matter_is_named(tmp_path):
    def edit(own):
        own["worldtogt"] = np.eye(4).tolist()
        own["frames"][2]["distortion"] = [0.1]

    source = SdfStudio(structure_files.sdfstudio(tmp_path, edit), Path())
    taken(source)
    assert [note.partition("not used: ")[2] for note in source.notes if "not used: " in note] == [
        "frames/distortion (unknown)"
    ]


@pytest.mark.parametrize(("edit", "pattern"), [
    (dict.clear, "meta_data.json: frames: found none"),
    (lambda own: own.update(camera_model="FISHEYE"), "camera_model: is 'FISHEYE'; must be OPENCV"),
    (lambda own: own.update(width="wide"), "width, height: is "),
    (lambda own: own["frames"].__setitem__(1, 3), r"frames\[1\]: is no object"),
    (lambda own: own["frames"][1].pop("rgb_path"), r"frames\[1\].rgb_path: missing"),
    (lambda own: own["frames"][1].pop("camtoworld"), r"frames\[1\].camtoworld: is missing; must be 4 x 4 numbers"),
    (lambda own: own["frames"][1].update(intrinsics=[1, 2]), r"frames\[1\].intrinsics: is of shape \(2,\)"),
    (lambda own: own["frames"][1]["intrinsics"][0].__setitem__(1, 9), "has skew"),
    (lambda own: own["frames"][1].update(foreground_mask="no.png"), r"frames\[1\].foreground_mask: no mask 'no.png'"),
])  # fmt: skip
def test_mistakes_in_sdfstudio(tmp_path, edit, pattern):
    refused(["sdfstudio", structure_files.sdfstudio(tmp_path, edit)], pattern, tmp_path)


# glTF


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("by_camera", [False, True])
def test_cameras_of_blender(tmp_path, suffix, by_camera):
    def edit(content):
        for node in content["nodes"] * by_camera:
            if "camera" in node:
                content["cameras"][node["camera"]]["name"] = node["name"].removesuffix("_Orientation")
                node["name"] = f"object {node['camera']}"

    source = GltfCameras(structure_files.gltf(tmp_path, suffix, edit), Path())
    frames = sorted(taken(source), key=lambda frame: frame.image)
    agree(frames, map(structure_files.gltf_pixels, range(3)))


def test_a_camera_without_an_aspect_ratio_has_that_of_its_photograph(tmp_path):
    def edit(content):
        content["extensionsUsed"] = ["KHR_lights_punctual", "KHR_materials_ior"]
        for camera in content["cameras"]:
            del camera["perspective"]["aspectRatio"]

    folder = tmp_path / "alone"  # beside tmp_path are folders of other tests, which may look like folders of masks
    folder.mkdir()
    source = GltfCameras(structure_files.gltf(folder, edit=edit), Path())
    agree(sorted(taken(source), key=lambda frame: frame.image), map(structure_files.gltf_pixels, range(3)))
    assert source.notes == [f"{source.src}: not used: KHR_lights_punctual (the light is where the options say)"]


@pytest.mark.parametrize(("edit", "pattern"), [
    (lambda own: own.update(nodes=[]), "SRC: has no node with a camera"),
    (lambda own: own["nodes"][0].update(camera=7), r"nodes\[0\].camera: is 7; there is none of this number"),
    (lambda own: own["nodes"][2].update(children=[0, 9]), r"nodes\[9\]: is 9; there is none of this number"),
    (lambda own: own["nodes"][2].update(children=[0, 0]), "nodes: some are children of several nodes"),
    (lambda own: own["nodes"][0].update(rotation=[0, 0, 0, 0]), r"nodes\[0\].rotation: is of length 0; must be 1"),
    (lambda own: own["nodes"][1].update(matrix=[1, 2]), r"nodes\[1\].matrix: is of shape \(2,\)"),
    (lambda own: own["nodes"][2].update(scale=[1, 2, 1]), "camera 'b': scale: it and its parents scale axes diff"),
    (lambda own: own["nodes"][2].update(scale=[-1, 1, 1]), "camera 'b': scale: it and its parents scale axes diff"),
    (lambda own: own["cameras"][0].update(type="orthographic", perspective=None),
     "camera 'a': type: is 'orthographic'; must be perspective"),
    (lambda own: own["cameras"][0]["perspective"].update(yfov=4), "camera 'a': yfov: is 4; must be between 0 and pi"),
    (lambda own: own["cameras"][0]["perspective"].update(yfov=None), "camera 'a': yfov: is missing"),
    (lambda own: own["cameras"][0]["perspective"].update(aspectRatio=2),
     "camera 'a': aspectRatio: is 2, but a.JPG has 62 x 52 pixels"),
])  # fmt: skip
def test_mistakes_in_gltf(tmp_path, edit, pattern):
    refused(["gltf", structure_files.gltf(tmp_path, edit=edit)], pattern, tmp_path)


# Photographs that are not as their cameras


SIZED = {
    "opensfm": lambda: [structure_files.opensfm_pixels(k, kind)
                        for k, kind in enumerate(("perspective", "brown", "fisheye_opencv"))],
    "polycam": lambda: [structure_files.pinhole_pixels(k, lens) for k, lens in enumerate(structure_files.LENSES)],
}  # fmt: skip


@pytest.mark.parametrize("name", SIZED)
def test_reduced_photographs(tmp_path, name):
    NEW[name][0](tmp_path)
    source = FORMATS[name](tmp_path, Path())
    expected = []
    for frame, pixels in zip(frames_of(source), SIZED[name]()):
        picture = Image.open(frame.image)
        small = [-(-side // 2) for side in picture.size]
        expected.append(pixels * small / picture.size)
        picture.resize(small).save(frame.image)
    frames = taken(FORMATS[name](tmp_path, Path()))
    agree(frames, expected, [frame.image.name for frame in frames])


@pytest.mark.parametrize("name", SIZED)
def test_photographs_that_exif_turns(tmp_path, name):
    NEW[name][0](tmp_path)
    source = FORMATS[name](tmp_path, Path())
    exif = Image.Exif()
    exif[0x0112] = 6
    for frame in frames_of(source):
        picture = Image.open(frame.image)
        picture.transpose(Image.Transpose.ROTATE_90).save(frame.image, exif=exif)
    frames = taken(FORMATS[name](tmp_path, Path()))
    agree(frames, SIZED[name](), [frame.image.name for frame in frames])
    assert [frame.orientation for frame in frames] == [6, 6, 6]


# Without a format

NEW = {
    "bundler": (structure_files.bundler, "bundle/bundle.out"), "visualsfm": (structure_files.visualsfm, "model.nvm"),
    "opensfm": (structure_files.opensfm, "opensfm/reconstruction.json"), "polycam": (structure_files.polycam, ""),
    "record3d": (structure_files.record3d, "metadata.json"), "gltf": (structure_files.gltf, "cameras.gltf"),
    "sdfstudio": (structure_files.sdfstudio, "meta_data.json"),
}  # fmt: skip
OTHERS = {
    "colmap": (structure_files.colmap_rig, ""), "metashape": (photogrammetry_files.metashape, "cameras.xml"),
    "realitycapture": (photogrammetry_files.csv_table, "cameras.csv"), "llff": (photogrammetry_files.llff, ""),
    "middlebury": (photogrammetry_files.middlebury, "pot_par.txt"),
    "sfmdata": (photogrammetry_files.alicevision, "cameras.sfm"), "neus": (foreign_captures.neus, ""),
    "iron": (foreign_captures.iron, ""),
    "transforms": (lambda folder: foreign_captures.transforms(folder, {}, [], None), "transforms.json"),
    "diligent-mv": (lambda folder: foreign_captures.diligent_folder(folder).parent / "bearPNG", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_is_guessed_from_the_folder_or_the_file(tmp_path, name):
    write, src = (NEW | OTHERS)[name]
    write(tmp_path)
    folder = tmp_path / "bearPNG" if name == "diligent-mv" else tmp_path
    assert guess(folder) == (name, folder / src)
    if src:
        assert guess(folder / src) == (name, folder / src)


@pytest.mark.parametrize("name", NEW)
def test_convert_needs_no_format(tmp_path, capsys, name):
    write, src = NEW[name]
    write(tmp_path / "scan")
    convert.main([str(tmp_path / "scan"), str(tmp_path / "made.xml"), "--flash-offset", "1", "2", "3"])
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'scan' / src}: taken for {name}\n")
    assert (tmp_path / "made.xml").is_file()


@pytest.mark.parametrize("name", NEW)
def test_cameras_beside_photographs_are_detected(tmp_path, name):
    write, _ = NEW[name]
    write(tmp_path)
    assert type(detect(tmp_path)) is FORMATS[name]
    folder = taken(FORMATS[name](guess(tmp_path)[1], Path()))[0].image.parent
    assert type(source := detect(folder)) is FORMATS[name]
    assert {frame.image.parent for frame in taken(source)} == {folder} and len(taken(source)) == 3


def test_what_may_be_several_formats_or_none_is_one_line(tmp_path):
    refused([tmp_path], "SRC: found no cameras; looked for a model of COLMAP, transforms.json, ", tmp_path)
    refused([tmp_path / "gone"], "FORMAT: is .*gone; must be one of .*, or SRC, a file or folder", tmp_path)
    structure_files.visualsfm(tmp_path)
    (tmp_path / "list.txt").touch()
    refused([tmp_path / "list.txt"], "list.txt: SRC: found no cameras", tmp_path)
    (tmp_path / "model.nvm").rename(tmp_path / "b.nvm")
    structure_files.visualsfm(tmp_path)
    structure_files.gltf(tmp_path)
    pattern = (
        "may be of 3 kinds; give one of these instead: visualsfm .*/b.nvm, visualsfm .*/model.nvm, gltf .*/cameras"
    )
    refused([tmp_path], pattern, tmp_path)


def test_damaged_files_are_not_taken_for_cameras(tmp_path):
    of_json = "reconstruction.json", "metadata.json", "meta_data.json", "a.sfm"
    for name in ("bundle.out", "a.nvm", "a.glb", "a.gltf", "a.xml", *of_json):
        (tmp_path / name).write_bytes(b"[3, 4]")
    refused([tmp_path], "SRC: found no cameras", tmp_path)
