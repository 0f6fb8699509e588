"""`mi_ring.check`: a good capture passes, each mistake is named with its mend."""

import re
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers.silhouettes import W, ball, silhouettes
from PIL import Image

from mi_ring import check
from mi_ring.capture.loading import load_capture
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.geometry import hull
from mi_ring.metrics import capture_findings, mask_agreement
from mi_ring.metrics.brightness_samples import BrightnessSampler
from mi_ring.output import inspection
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.system import command


def run(path, tmp_path, capsys, *options):
    """Exit status and what is printed."""
    status = check.main([str(path), "--out", str(tmp_path / "sheet.png"), *options])
    return status, capsys.readouterr().out


def edit_matrices(path, change):
    """`change` every to_world matrix (4, 4) of a scene file."""

    def replaced(match):
        matrix = change(np.array([float(v) for v in match[1].split()]).reshape(4, 4))
        return '<matrix value="{}"/>'.format(" ".join(f"{v:.9g}" for v in matrix.ravel()))

    path.write_text(re.sub('<matrix value="([^"]*)"/>', replaced, path.read_text()))


def edit_images(path, change, folder="images", which="*"):
    for file in (path.parent / folder).glob(f"{which}.png"):
        mi.Bitmap(np.ascontiguousarray(change(np.array(mi.Bitmap(str(file)))))).write(str(file))


def test_a_good_capture_passes(small_capture, tmp_path, capsys):
    status, text = run(small_capture, tmp_path, capsys)
    assert status == 0 and "No problems found" in text, text
    rows = [line.split() for line in text.splitlines() if line.split()[:1] and line.split()[0].endswith(".png")]
    assert len(rows) == 12 and {row[-1] for row in rows} <= {"98%", "99%", "100%"}
    sheet = Image.open(tmp_path / "sheet.png")
    assert sheet.width >= 1200
    green = (np.array(sheet) == [60, 255, 60]).all(-1)
    assert green.sum() > 12 * 30  # the masks' outlines
    cells = np.array(sheet)[400:].astype(int)
    assert (cells == [80, 160, 255]).all(-1).sum() > 30  # the hull, where masks do not hide its outline


MATRICES = {
    "opencv": (lambda m: m @ np.diag([-1.0, -1, 1, 1]), r"axes are OpenCV's .* diag\(-1, -1, 1, 1\)"),
    "opengl": (lambda m: m @ np.diag([-1.0, 1, -1, 1]), r"axes are OpenGL's .* diag\(-1, 1, -1, 1\)"),
    "inverse": (np.linalg.inv, "to_world is world-to-camera: invert it"),
    "inverse and opencv": (lambda m: np.linalg.inv(m @ np.diag([-1.0, -1, 1, 1])), "world-to-camera.*OpenCV's"),
    "transposed": (lambda m: np.block([[m[:3, :3].T, m[:3, 3:]], [m[3:]]]), "rotation in to_world is transposed"),
}


@pytest.mark.parametrize("case", MATRICES)
def test_wrong_conventions_are_recognised(case, broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    change, words = MATRICES[case]
    edit_matrices(path, change)
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and re.search(f"Problem: The masks agree to .*{words}", text), text


def test_exchanged_principal_point(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    path.write_text(re.sub(r'name="cx" value="(\S+)"/> <float name="cy" value="(\S+)"/>',
                           r'name="cx" value="\2"/> <float name="cy" value="\1"/>', path.read_text()))  # fmt: skip
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "cx and cy are exchanged" in text, text


def test_principal_points_off_by_half_a_pixel(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    path.write_text(path.read_text().replace('"cx" value="30.5"', '"cx" value="30"').replace('"18.0"', '"17.5"'))
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "half a pixel: add 0.5 to cx and cy" in text, text


@pytest.mark.parametrize("scale", [1, 4])
@pytest.mark.parametrize(("shift", "words"), [(-0.5, "add 0.5 to"), (0.5, "subtract 0.5 from"), (0.0, None)])
def test_half_a_pixel_either_way(shift, words, scale):
    views = [mask_agreement.with_camera(s, centre=s.camera.centre + shift) for s in silhouettes(ball(4.0), 12, scale)]
    found = mask_agreement.half_pixel(hull.Hull(views, "scene.xml"))
    assert words in found if words else found is None


@pytest.mark.parametrize(("change", "words"), [
    (lambda image: image[::-1], "upside down"), (lambda image: image[:, ::-1], "mirrored"),
])  # fmt: skip
def test_flipped_photographs(change, words, broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    for folder in ("images", "masks"):
        edit_images(path, change, folder)
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and f"photographs or masks are {words}" in text, text


@pytest.mark.parametrize(("factor", "words"), [(0.5, "half the size: double"), (2, "twice the size: halve")])
def test_intrinsics_of_another_size(factor, words, broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    path.write_text(re.sub(r'name="([fc][xy])" value="(\S+)"',
                           lambda m: f'name="{m[1]}" value="{factor * float(m[2])}"', path.read_text()))  # fmt: skip
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and words in text, text


def test_an_empty_mask_is_named_and_the_rest_is_looked_at(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_images(path, np.zeros_like, "masks", "005")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and text.count("Problem") == 1 and "Problem: 005.png: its mask is empty" in text, text


def test_masks_of_several_labels_are_named_with_their_values(broken_capture, tmp_path, capsys):
    """The object and what it stands on: nobody knows which is which."""
    path, _ = broken_capture

    def labels(mask):
        mask = np.where(mask > 127, 2, 0).astype(np.uint8)
        mask[-9:, :13] = 3
        return mask

    edit_images(path, labels, "masks", "004")
    with pytest.raises(InputError, match='004.png: photograph "004", mask: has the values 0, 2, 3; save the object as'):
        run(path, tmp_path, capsys)
    with pytest.raises(InputError, match='004.png: photograph "004", mask: has the values 0, 2, 3; save the object as'):
        load_capture(path)  # as a fit does
    edit_images(path, lambda mask: np.where(mask == 3, 0, mask), "masks", "004")
    assert run(path, tmp_path, capsys)[0] == 0


@pytest.mark.parametrize(("bits", "saturation", "words"), [
    (12, "", "is 4095, as of 12 bits: over-exposed pixels are not known; .* saturation 0.06248"),
    (14, "", "is 16383, as of 14 bits.* saturation 0.25$"),
    (12, '<float name="saturation" value="0.06248"/>', None), (16, "", None),
])  # fmt: skip
def test_photographs_of_fewer_bits_in_files_of_sixteen(broken_capture, tmp_path, capsys, bits, saturation, words):
    """A part of the object is over-exposed; its values are linear, and relative."""
    path, _ = broken_capture
    path.write_text(re.sub(r'(value="images/\d+.png"/>)', rf"\1{saturation}", path.read_text()))

    def stored(image):
        linear = srgb_to_linear(image / 255)
        return (np.minimum(linear / np.quantile(linear, 0.99), 1) * (2**bits - 1) + 0.5).astype(np.uint16)

    edit_images(path, stored)
    status, text = run(path, tmp_path, capsys)
    found = [line for line in text.splitlines() if " bits" in line]
    if words:
        assert status == 1 and len(found) == 1 and re.search(f"Problem: the largest value .* {words}", found[0]), text
    else:
        assert not found, text
    clipped = [float(line.split()[5].rstrip("%")) for line in text.splitlines() if re.match(r" *\d{3}.png", line)]
    assert len(clipped) == 12 and (max(clipped) > 1) == (words is None)


@pytest.mark.parametrize("wrong", [lambda mask: 255 - mask, lambda mask: np.full_like(mask, 255)])
def test_masks_that_agree_but_cover_the_border_are_named(broken_capture, tmp_path, capsys, wrong):
    """The background is all around the cameras, so that the masks of all photographs confirm it."""
    path, _ = broken_capture
    edit_images(path, wrong, "masks")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "inverted" in text and "255 is to be the object, 0 the background" in text, text


@pytest.mark.parametrize(("square", "quarters"), [(True, 1), (True, 2), (True, 3), (False, 2)])
def test_a_turned_mask_is_recognised(square, quarters):
    views = list(silhouettes(ball(4.0), 12))
    if square:
        rows = [(0, views[0].mask.shape[1] - views[0].mask.shape[0]), (0, 0)]
        views = [mask_agreement.with_camera(s, size=(W, W))._replace(mask=np.pad(s.mask, rows)) for s in views]
    wrong = views[4]._replace(mask=np.rot90(views[4].mask, quarters))
    found = mask_agreement.turns(wrong, hull.Hull(views, "scene.xml"))
    assert found == [f"mask 4: mask or camera is turned by {90 * quarters} degrees counterclockwise: turn it back"]


def test_a_mask_on_its_head_is_named(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_images(path, lambda mask: mask[::-1, ::-1], "masks", "004")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "Problem: 004.png: mask or camera is turned by 180 degrees counter" in text, text


def test_few_photographs(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    text = path.read_text()
    path.write_text(text[: text.index('  <sensor type="photograph" id="005"')] + "</scene>")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "5 views are too few" in text, text


def test_one_wrong_pose_is_named(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    count = iter(range(100))
    turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    edit_matrices(path, lambda m: m @ turn if next(count) == 4 else m)  # the camera upright
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "Problem: 004.png: the others agree to" in text and text.count("Problem") <= 2, text


def test_one_wrong_place_is_named(broken_capture, tmp_path, capsys):
    """It spoils the hull of all, so that nothing agrees any more."""
    path, _ = broken_capture
    count = iter(range(100))
    move = np.zeros((4, 4))
    move[:3, 3] = 25, -10, 20
    edit_matrices(path, lambda m: m + move if next(count) == 4 else m)
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and re.findall("Problem: (.*): the others agree to", text) == ["004.png"], text


def test_cameras_that_look_away(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_matrices(path, lambda m: m @ np.diag([-1.0, 1, -1, 1]))
    path.write_text(re.sub(r'<string name="mask"[^>]*>', "", path.read_text()))
    status, text = run(path, tmp_path, capsys, "--masks", "given")
    assert status == 1 and re.search(r"12 of 12 cameras look away .*diag\(-1, 1, -1, 1\)", text), text


def test_more_photographs_than_the_hull_is_made_of(broken_capture, tmp_path, capsys, monkeypatch):
    path, _ = broken_capture
    monkeypatch.setattr(hull, "MAX_MASKS", 5)
    edit_images(path, lambda mask: np.roll(mask, 9, 1), "masks", "008")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "Problem: 008.png: the others agree to" in text, text
    assert all(line.endswith("%") for line in text.splitlines() if re.match(r"0\d\d.png", line.strip()))


def test_lights_in_other_units(broken_capture, tmp_path, capsys):
    path, _ = broken_capture

    def tenth(match):
        return 'position" ' + re.sub(r'"([^"]*)"', lambda v: f'"{float(v[1]) / 10}"', match[1])

    path.write_text(re.sub('position" (x=[^/]*)', tenth, path.read_text()))
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "lights are in other units than cameras: multiply their positions by 10 " in text, text


def test_one_exposure_that_is_wrong(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_images(path, lambda image: image // 4, which="007")
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and re.search(r"Problem: 007.png: is 0.0\d+ times as bright as the others", text), text


def test_over_exposed(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_images(path, lambda image: np.clip(image.astype(int) * 3, 0, 255).astype(np.uint8))
    status, text = run(path, tmp_path, capsys)
    assert status == 1 and "of the object is over-exposed" in text, text


def test_a_bright_background_harms_nothing_with_masks_and_is_an_error_without(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    edit_images(path, lambda image: np.maximum(image, 70))
    status, text = run(path, tmp_path, capsys)
    assert status == 0 and "room" not in text, text
    for masks in ("none", "given"):
        path.write_text(re.sub(r'<string name="mask"[^>]*>', "", path.read_text()))
        status, text = run(path, tmp_path, capsys, "--masks", masks)
        assert status == 1 and "Problem: no masks, and the background is not dark" in text and "mi-ring photos" in text


def test_brightness_is_sampled_with_the_light_that_points_get(small_capture):
    """Points of a matt object reflect one share of their irradiance, but where the hull is not the object."""
    capture = load_capture(small_capture)
    center, radius = capture.sphere()
    sampler = BrightnessSampler.of(capture, center, radius)
    capture_findings.measure(capture, center, radius, {}, sampler)
    samples = sampler.samples(center)
    shown = np.isfinite(samples.brightness) & (samples.cosine > 0.5)
    with np.errstate(invalid="ignore"):
        reflected = np.where(shown, np.log(samples.brightness / samples.irradiance / samples.cosine), np.nan)
    often = shown.sum(0) >= 3
    assert len(samples.falloff) == len(capture) and shown.sum(1).min() >= 50 and often.sum() > 100
    assert np.median(np.nanstd(reflected[:, often], 0)) < 0.1 < 0.2 < np.nanstd(np.log(samples.brightness[shown]))
    assert not BrightnessSampler.of(replace(capture, room=np.ones((BASIS, 3))), center, radius)  # a room is known


def test_what_brightness_tells_is_a_finding(small_capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(inspection, "light_findings", lambda samples: [f"{len(samples.falloff)} photographs are odd"])
    status, text = run(small_capture, tmp_path, capsys)
    assert status == 1 and "Problem: 12 photographs are odd" in text


def test_without_masks(broken_capture, tmp_path, capsys):
    path, _ = broken_capture
    status, text = run(path, tmp_path, capsys, "--masks", "none")
    assert status == 0 and "Masks: found by brightness" in text
    path.write_text(re.sub(r'<string name="mask"[^>]*>', "", path.read_text()))
    status, text = run(path, tmp_path, capsys, "--masks", "given")
    assert status == 0 and "Masks: 0 of 12 photographs" in text


def test_mistakes_of_the_user(tmp_path, small_capture, capsys):
    for arguments, words in (
        ([tmp_path / "gone.xml"], "gone.xml: no such file"),
        ([small_capture, "--out", small_capture / "sheet.png"], "--out: cannot be written"),
        ([small_capture, "--out", small_capture], "--out: must end in .png"),
        ([small_capture, "--out", small_capture.parent / "images/003.png"], "--out: is one of the scene's own"),
    ):
        with pytest.raises(SystemExit) as stop:
            command.run("mi_ring.check", check.main, [str(a) for a in arguments])
        message = capsys.readouterr().err
        assert stop.value.code == 2 and message.count("\n") == 1 and words in message


def test_exposures_are_not_judged_where_photographs_have_no_lights(broken_capture, tmp_path, capsys):
    """A camera may look at the side that the room's light does not reach."""
    path, _ = broken_capture
    edit_images(path, lambda image: image // 5, which="007")
    path.write_text(re.sub('(name="intensity" value=)"[^"]*"', r'\1"0"', path.read_text()))
    _, text = run(path, tmp_path, capsys)
    assert "007.png" in text and "times as bright as the others" not in text, text
