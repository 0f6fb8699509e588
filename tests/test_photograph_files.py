"""Which file is the photograph of which camera, and what is said of those that are left over."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.foreign_captures import K, cameras, colmap_folder, converted, noise, transforms, write
from helpers.photogrammetry_files import (
    NAMES,
    POINTS,
    SIZE,
    alicevision,
    csv_table,
    edited,
    metashape,
    middlebury,
    openmvg,
)
from PIL import Image

from mi_ring import convert
from mi_ring.errors import InputError
from mi_ring.importers.frames import adapt_all, frames_of, require_frames
from mi_ring.importers.metashape import Metashape
from mi_ring.importers.middlebury import Middlebury
from mi_ring.importers.photograph_files import PhotographFiles, refuse_twins
from mi_ring.importers.realitycapture import RealityCapture
from mi_ring.importers.sfmdata import SfmData
from mi_ring.importers.transforms import Transforms


def files(*names, root="/data/photos"):
    return PhotographFiles([Path(root, name) for name in names], Path(root))


@pytest.mark.parametrize(("path", "found"), [
    ("n-s/1.JPG", "n-s/1.JPG"), ("e-w/1.JPG", "e-w/1.JPG"), (r"D:\drone\e-w\1.JPG", "e-w/1.JPG"),
    ("/home/else/e-w/1.jpg", "e-w/1.JPG"), ("./N-S/1", "n-s/1.JPG"), ("../photos/n-s/1.tif", "n-s/1.JPG"),
    ("2.jpg", "2.png"), ("gone/2.jpg", "2.png"), ("C:2.png", None), ("photos/2", "2.png"), ("3.png", None),
    ("IMG.2", "IMG.2.jpg"), ("IMG.9", None), ("", None), ("/", None), ("e-w", None),
    ("Cafe\u0301.png", "caf\xe9.png"), ("masks/5.png", "masks/5.png"), ("5.png", None), ("other/1.JPG", None),
    ("my%20pot.png", "my pot.png"), ("50%25.png", "50%25.png"), ("x%2Fy.png", None),
])  # fmt: skip
def test_a_photograph_is_found_by_its_name_and_as_many_folders_as_are_needed(path, found):
    folder = files(
        "n-s/1.JPG",
        "e-w/1.JPG",
        "2.png",
        "IMG.2.jpg",
        "IMG.3.jpg",
        "caf\xe9.png",
        "masks/5.png",
        "my pot.png",
        "50%25.png",
        "50%.png",
    )
    file, _ = folder.find(path)
    assert file == (found and Path("/data/photos", found))


@pytest.mark.parametrize(("path", "names"), [
    ("1.jpg", ["a/1.jpg", "b/1.jpg"]), ("1", ["1.jpg", "1.png"]), ("1.tif", ["1.jpg", "1.png"]),
    ("x/1.jpg", ["a/x/1.jpg", "b/x/1.jpg"]),
])  # fmt: skip
def test_nothing_is_matched_by_luck(path, names):
    with pytest.raises(InputError, match=r"may be .*1.jpg or .*; keep one, or give --images"):
        files(*names).find(path)


def test_two_cameras_with_one_photograph_are_refused_unless_one_names_another_folder():
    with pytest.raises(InputError, match="1.jpg: would be the photograph of two cameras, 'a' and 'b'; give --images"):
        refuse_twins([(Path("1.jpg"), "a", True), (Path("1.jpg"), "b", True)])
    assert refuse_twins([(Path("1.jpg"), "x/1.jpg", True), (Path("1.jpg"), "y/1.jpg", False)]) == {"y/1.jpg"}


def in_folders(folder, wrap=lambda name: name):
    """Photographs of equal names in folders below `images`: pairs of new name and old name."""
    new = ["e-w/1.JPG", "n-s/1.JPG", "n-s/2.jpeg"]
    moved = {}
    for path, name in zip(new, NAMES):
        (folder / "images" / path).parent.mkdir(parents=True, exist_ok=True)
        old = next(file for file in (folder / "images" / name, folder / name) if file.exists())
        old.rename(folder / "images" / path)
        moved[name] = wrap(path)
    return moved


def replaced(path, pairs):
    for old, new in pairs.items():
        edited(path, old, new)


def metashape_in_folders(folder):
    path = metashape(folder)
    replaced(path, {f"label='{n.split('.')[0]}'": f"label='{p}'" for n, p in in_folders(folder).items()})
    return Metashape(path, Path())


def meshroom_in_folders(folder):
    path = alicevision(folder)
    replaced(path, in_folders(folder, lambda name: name.replace("/", "\\\\")))
    return SfmData(path, Path())


def openmvg_in_folders(folder):
    path = openmvg(folder)
    replaced(path, in_folders(folder))
    return SfmData(path, Path())


def table_in_folders(folder):
    path = csv_table(folder)
    replaced(path, in_folders(folder, lambda name: f"E:\\job\\{name}".replace("/", "\\")))
    return RealityCapture(path, Path())


def middlebury_in_folders(folder):
    middlebury(folder)
    replaced(folder / "pot_par.txt", in_folders(folder))
    return Middlebury(folder, Path())


@pytest.mark.parametrize("make", [
    metashape_in_folders, meshroom_in_folders, openmvg_in_folders, table_in_folders, middlebury_in_folders,
])  # fmt: skip
def test_photographs_of_equal_names_in_several_folders(tmp_path, make):
    source = make(tmp_path)
    frames = frames_of(source)
    assert [frame.image.relative_to(tmp_path / "images").as_posix() for frame in frames] == [
        "e-w/1.JPG", "n-s/1.JPG", "n-s/2.jpeg"]  # fmt: skip
    assert not source.without_photograph
    object.__setattr__(source, "images", tmp_path / "images/e-w")
    del source.__dict__["photograph_files"]
    with pytest.raises(InputError, match="1.JPG: would be the photograph of two cameras, '.*e-w.*' and '.*n-s.*'"):
        frames_of(source)


def test_deleted_photographs_of_other_folders_do_not_take_those_of_equal_names(tmp_path):
    source = meshroom_in_folders(tmp_path)
    (tmp_path / "images/n-s/1.JPG").unlink()
    frames = frames_of(source)
    assert [frame.image.name for frame in frames] == ["1.JPG", "2.jpeg"] and len(source.without_photograph) == 1


@pytest.mark.parametrize("name", ["images\\{}.png", "D:/else/images/{}.png", "./images/{}", "IMAGES/{}.PNG"])
def test_paths_of_another_computer_in_transforms(tmp_path, name):
    top = {"fl_x": 70.0, "fl_y": 76.0, "cx": 28.5, "cy": 27.25}
    source = transforms(tmp_path / "data", top, [{"file_path": f"images/{k}.png"} for k in range(3)],
                        lambda k: noise(np.uint8, seed=k))  # fmt: skip
    content = json.loads((source / "transforms.json").read_text())
    for k, frame in enumerate(content["frames"]):
        frame["file_path"] = name.format(k)
    (source / "transforms.json").write_text(json.dumps(content))
    (source / "images/._0.png").write_bytes(b"of macOS")
    frames = frames_of(Transforms(source, Path()))
    assert [frame.image for frame in frames] == [source / f"images/{k}.png" for k in range(3)]


# Sizes


def projected(frame):
    """Pixels of the points in the photograph as it is written, by the frame's camera."""
    x = (POINTS - frame.pose[:3, 3]) @ frame.pose[:3, :3]
    return frame.lens.colmap.img_from_cam(x)


@pytest.mark.parametrize("make", [metashape, alicevision])
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_cameras_are_scaled_to_reduced_photographs(tmp_path, make, factor):
    kind = Metashape if make is metashape else SfmData
    before = frames_of(kind(path := make(tmp_path), Path()))
    for file in (tmp_path / "images").iterdir():
        Image.open(file).resize((int(SIZE[0] * factor), int(SIZE[1] * factor))).save(file)
    after = frames_of(source := kind(path, Path()))
    adapt_all(source, after)
    require_frames(after, path)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_allclose(projected(b), factor * projected(a), atol=1e-5)
    small = " x ".join(str(int(factor * side)) for side in SIZE)
    assert source.notes == [f"3 cameras scaled from 62 x 52 to the {small} pixels of their photographs"]


def test_cameras_of_colmap_are_scaled_to_reduced_photographs(tmp_path, capsys):
    folder = colmap_folder(tmp_path)
    for file in (folder / "images").rglob("*.jpg"):
        picture = Image.open(file)
        picture.resize((31, 26)).save(file)
    shutil.rmtree(folder / "masks")
    scene = converted("colmap", folder, tmp_path / "small.xml", "--no-exif")
    for shot in scene.shots:
        np.testing.assert_allclose([*shot.camera.focal, *shot.camera.centre], K[[0, 1, 0, 1], [0, 1, 2, 2]] / 2)
    assert "3 cameras scaled from 62 x 52 to the 31 x 26 pixels" in capsys.readouterr().out


@pytest.mark.parametrize("masks", ["stored", "upright", "some", "none"])
def test_photographs_are_turned_as_their_cameras_are(tmp_path, masks, capsys):
    """Cameras are for upright photographs, files are stored on their sides: a spot comes where the camera puts it.

    Masks are as the photographs are stored, or upright; or the first has none, whose size alone shows which it is.
    """
    R, t = next(cameras())
    x = POINTS @ R.T + t
    size, f, c = (52, 62), (70.0, 76.0), (27.25, 28.5)
    spot = np.floor(x[0, :2] / x[0, 2] * f + c).astype(int)
    upright = np.zeros((size[1], size[0], 3), np.uint8)
    upright[spot[1], spot[0]] = 255
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    pose = pose @ np.diag([1.0, -1, -1, 1])
    for orientation, turn in ((6, lambda p: np.rot90(p)), (8, lambda p: np.rot90(p, -1))):
        folder = tmp_path / str(orientation)
        folder.mkdir()
        exif = Image.Exif()
        exif[274] = orientation
        Image.fromarray(np.ascontiguousarray(turn(upright))).save(folder / "a.png", exif=exif)
        exif[274] = 3  # its size says nothing, but the others' do
        Image.fromarray(np.ascontiguousarray(upright[::-1, ::-1])).save(folder / "b.png", exif=exif)
        exif[274] = orientation  # nor does the size of a square
        square = np.ascontiguousarray(turn(upright[5:57]))
        Image.fromarray(square).save(folder / "c.png", exif=exif)
        expected = upright, upright, upright[5:57]
        frames = [{"file_path": "a.png"}, {"file_path": "b.png"},
                  {"file_path": "c.png", "w": 52, "h": 52, "cy": c[1] - 5}]  # fmt: skip
        for frame, pixels in zip(frames, expected) if masks != "none" else ():
            name, picture, own = frame["file_path"], Image.fromarray(pixels), Image.Exif()
            if masks == "stored" or (masks == "some" and name == "b.png"):
                with Image.open(folder / name) as stored:
                    picture = Image.fromarray(np.array(stored))
                    own = stored.getexif() if masks == "some" else own
            if masks != "some" or name != "a.png":
                frame["mask_path"] = f"m_{name}"
                picture.save(folder / f"m_{name}", exif=own)
        frames = [frame | {"transform_matrix": pose.tolist()} for frame in frames]
        top = {"fl_x": f[0], "fl_y": f[1], "cx": c[0], "cy": c[1], "w": size[0], "h": size[1], "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(top))
        scene = converted("transforms", folder, tmp_path / f"{orientation}.xml")
        assert all((image == pixels).all() for image, pixels in zip(scene.images, expected, strict=True))
        for mask, pixels in zip(scene.masks, expected):
            assert mask is None or (mask == pixels[..., 0]).all()
        assert [mask is None for mask in scene.masks] == [masks in ("none", "some"), *2 * [masks == "none"]]
        assert ("1 masks of photographs that EXIF turns are taken to be upright" in capsys.readouterr().out) == (
            masks == "some")  # fmt: skip


def test_an_orientation_that_changes_no_size_is_not_applied_but_told(tmp_path, capsys):
    folder = colmap_folder(tmp_path)
    file = folder / "images/sub/2.jpg"
    exif = Image.Exif()
    exif[274] = 3
    Image.open(file).save(file, exif=exif)
    stored = np.array(Image.open(file))
    scene = converted("colmap", folder, tmp_path / "s.xml", "--no-exif")
    assert (scene.images[1] == stored).all()
    assert "1 photographs not turned by their EXIF orientation" in capsys.readouterr().out


def test_photographs_of_another_size_are_refused_with_what_to_do(tmp_path):
    path = metashape(tmp_path)
    for size, pattern in (((52, 62), "the sides are exchanged"), ((61, 52), "give photographs of the size of")):
        for file in (tmp_path / "images").iterdir():
            Image.new("RGB", size).save(file)
        with pytest.raises(InputError, match=f"photograph: is {size[0]} x {size[1]} pixels, but its camera 62 x 52; "
                           f"{pattern}"):  # fmt: skip
            convert.main(["metashape", str(path), str(tmp_path / "a.xml")])


# Masks


def test_folders_of_masks_have_any_case_and_others_are_told(tmp_path, capsys):
    folder = colmap_folder(tmp_path)
    (folder / "masks").rename(folder / "Masks")
    assert all(converted("colmap", folder, tmp_path / "a.xml").masks.given)
    (folder / "Masks/sub").rename(folder / "object_mask")
    scene = converted("colmap", folder, tmp_path / "b.xml", "--images", folder / "images/sub")
    assert not any(scene.masks.given) and "object_mask" not in capsys.readouterr().out  # two levels above
    (folder / "object_mask").rename(folder / "images/object_mask")
    converted("colmap", folder, tmp_path / "c.xml", "--images", folder / "images/sub")
    assert "images/object_mask: not used; give --masks if it holds the masks" in capsys.readouterr().out


def test_masks_of_reduced_photographs(tmp_path):
    folder = colmap_folder(tmp_path)
    shown = Image.open(folder / "masks/sub/1.jpg.png").resize((31, 26), Image.Resampling.NEAREST)
    for file in (folder / "images/sub").iterdir():
        for name, picture in (("images_2", Image.open(file).resize((31, 26))), ("masks_2", shown)):
            (folder / name / "sub").mkdir(parents=True, exist_ok=True)
            picture.save(folder / name / "sub" / f"{file.name}{'.png' * (name == 'masks_2')}")
    small = "colmap", folder, tmp_path / "s.xml", "--no-exif", "--images", folder / "images_2"
    assert all((mask == np.array(shown)).all() for mask in converted(*small).masks)
    (tmp_path / "s.xml").unlink()
    shutil.rmtree(folder / "masks_2")
    with pytest.raises(InputError, match="mask: is 62 x 52 pixels, but its camera 31 x 26; give masks of the size of"):
        convert.main([str(word) for word in small])


@pytest.mark.parametrize("names", ["{}.png", "{}.jpg.PNG", "{}.JPG", "sub/{}.png"])
@pytest.mark.parametrize("kind", ["metashape", "transforms", "sfmdata"])
def test_masks_beside_the_photographs_are_found(tmp_path, kind, names, capsys):
    if kind == "metashape":
        source = metashape(tmp_path)
        stems = [name.split(".")[0] for name in NAMES]
    elif kind == "sfmdata":
        source = alicevision(tmp_path)
        stems = [name.split(".")[0] for name in NAMES]
    else:
        top = {"fl_x": 70.0, "fl_y": 76.0}
        source = transforms(tmp_path, top, [{"file_path": f"images/{k}.png"} for k in range(3)],
                            lambda k: noise(np.uint8, seed=k))  # fmt: skip
        stems = ["0", "1", "2"]
    if ".jpg." in names and kind == "transforms":
        names = names.replace(".jpg", ".png")
    for k, stem in enumerate(["other", *stems[:2]]):
        file = tmp_path / "masks" / names.format(stem)
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", SIZE, (0, 150, 200)[k]).save(file)
    if ".jpg." in names:
        (tmp_path / "masks/b.jpg.PNG").rename(tmp_path / "masks/b.png.PNG")
    scene = converted(kind, source, tmp_path / "s.xml")
    assert [None if mask is None else int(mask[0, 0]) for mask in scene.masks] == [150, 200, None]
    printed = capsys.readouterr().out
    assert "1 photograph without a mask in" in printed and "1 mask in" in printed and "2 with masks" in printed


@pytest.mark.parametrize("names", ["{}_mask.png", "mask_{}.PNG", "{}.mask.tif"])
@pytest.mark.parametrize("place", ["masks", "images"])
def test_masks_may_have_mask_in_their_names(tmp_path, names, place, capsys):
    """Metashape exports x_mask.png, RealityCapture takes x.jpg.mask.png."""
    path = metashape(tmp_path)
    (tmp_path / place).mkdir(exist_ok=True)
    for level, name in zip((10, 20, 30), NAMES):
        stem = name if names.startswith("{}.") else name.split(".")[0]
        pixels = np.full(SIZE[::-1], level, np.uint8)
        pixels[0, 0] = 200
        Image.fromarray(pixels).save(tmp_path / place / names.format(stem))
    options = [["--masks", str(tmp_path / place)], []]
    for k, more in enumerate(options):
        scene = converted("metashape", path, tmp_path / f"{k}.xml", *more)
        assert [int(mask[1, 1]) for mask in scene.masks] == [10, 20, 30]
    assert "without a camera" not in capsys.readouterr().out


def test_masks_that_are_named_otherwise_are_told(tmp_path, capsys):
    path = metashape(tmp_path)
    (tmp_path / "masks").mkdir()
    Image.new("L", SIZE).save(tmp_path / "masks/other.png")
    convert.main(["metashape", str(path), str(tmp_path / "s.xml")])
    assert "masks: none of its 1 images is named after a photograph; not used" in capsys.readouterr().out
    with pytest.raises(InputError, match="--masks: has no mask of a.JPG, such as a.JPG.png or a.png"):
        convert.main(["metashape", str(path), str(tmp_path / "t.xml"), "--masks", str(tmp_path / "masks")])


@pytest.mark.parametrize("place", ["masks", "silhouettes"])
def test_one_mask_is_not_that_of_photographs_from_two_places(tmp_path, place):
    """Photographs of two folders have equal names, and one folder of masks has none of the folders."""
    shots = [{"file_path": f"images/{k}/1.png"} for k in "ab"]
    source = transforms(tmp_path, {"fl_x": 70.0, "fl_y": 76.0}, shots, lambda k: noise(np.uint8, seed=k))
    write(tmp_path / place / "1.png", np.full((SIZE[1], SIZE[0], 1), 209, np.uint8))
    options = [] if place == "masks" else ["--masks", str(tmp_path / place)]
    with pytest.raises(InputError, match="1.png: would be the mask of two photographs, '.*a/1.png' and '.*b/1.png'; "):
        convert.main(["transforms", str(source), str(tmp_path / "s.xml"), *options])
    file = source / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"][1]["transform_matrix"] = content["frames"][0]["transform_matrix"]
    file.write_text(json.dumps(content))
    assert [int(mask[0, 0]) for mask in converted("transforms", source, tmp_path / "s.xml", *options).masks] == [
        209,
        209,
    ]
    for k in "ab":
        write(tmp_path / place / k / "1.png", np.full((SIZE[1], SIZE[0], 1), 100 + ord(k), np.uint8))
    scene = converted("transforms", source, tmp_path / "t.xml", *options)
    assert [int(mask[0, 0]) for mask in scene.masks] == [197, 198]


# What is left out


def test_photographs_in_another_folder_are_not_said_to_be_without_a_camera(tmp_path, capsys):
    shots = [{"file_path": "../images/0.png"}]
    transforms(tmp_path / "model", {"fl_x": 70.0, "fl_y": 76.0}, shots, lambda k: noise(np.uint8, seed=k))
    convert.main(["transforms", str(tmp_path / "model"), str(tmp_path / "s.xml")])
    assert "without a camera" not in capsys.readouterr().out


def test_what_is_left_out_is_said(tmp_path, capsys):
    path = metashape(tmp_path)
    (tmp_path / "images/b.png").unlink()
    Image.new("RGB", SIZE).save(tmp_path / "images/new.png")
    convert.main(["metashape", str(path), str(tmp_path / "s.xml")])
    printed = capsys.readouterr().out
    assert "1 of 3 photographs left out, without a pose: lost\n" in printed
    assert f"1 camera left out, without a photograph in {tmp_path / 'images'}: b\n" in printed
    assert f"1 image in {tmp_path / 'images'} left out, without a camera: new.png\n" in printed
    assert "2 photographs, 0 with masks, of 2 cameras" in printed


def test_the_largest_model_of_colmap_is_taken(tmp_path, capsys):
    folder = colmap_folder(tmp_path)
    (folder / "sparse/0").rename(folder / "sparse/1")
    shutil.copytree(folder / "text", folder / "sparse/0")
    path = folder / "sparse/0/images.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-2]))
    converted("colmap", folder, tmp_path / "s.xml")
    printed = capsys.readouterr().out
    assert f"{folder / 'sparse/1'} is taken, with 3 photographs; not used: {folder / 'sparse/0'} (2)" in printed
    for suffix in (".bin", ".txt"):
        for file in (folder / "sparse/1").glob(f"*{suffix}"):
            file.unlink()


def test_cameras_of_colmap_without_lines_of_points_are_refused(tmp_path):
    folder = colmap_folder(tmp_path) / "text"
    path = folder / "images.txt"
    lines = [line for line in path.read_text().splitlines() if line.startswith("#") or line.endswith(".jpg")]
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"images.txt: line \d+: must be the points of the camera in the line before"):
        converted("colmap", folder, tmp_path / "s.xml", "--images", folder.parent / "images")


@pytest.mark.parametrize(("file", "change", "words"), [
    ("images.txt", str.rstrip, r"images.txt: line \d+: must be the points of the camera in the line before"),
    ("images.txt", "\ufeff{}".format, "images.txt: begins with a byte order mark"),
    ("cameras.txt", "\ufeff{}".format, "cameras.txt: begins with a byte order mark"),
    ("cameras.txt", lambda text: text.replace("27.25", "27,25"), "cameras.txt: has 27,25; must have decimal points"),
    ("images.txt", lambda text: re.sub(r"(?m)^(\d+) 0\.", r"\1 0,", text), r"images.txt: line \d+: has 0,\d+; must be"),
    ("images.txt", lambda text: re.sub(r"(?m)^(\d+) \S+ \S+ \S+ \S+", r"\1 0 0 0 0", text), "of sub/1.jpg is 0 0 0 0"),
])  # fmt: skip
def test_what_colmap_would_misread_is_refused(tmp_path, file, change, words):
    folder = colmap_folder(tmp_path) / "text"
    for name in ("rigs.txt", "frames.txt"):  # as of versions before rigs
        (folder / name).unlink()
    (folder / file).write_text(change((folder / file).read_text()))
    with pytest.raises(InputError, match=words):
        converted("colmap", folder, tmp_path / "s.xml", "--images", folder.parent / "images")
