"""`mi-ring join`: photographs with flash and photographs in the light of the room, of one object, in one scene."""

import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from conftest import CENTER

import mi_ring
from mi_ring import join
from mi_ring.capture.pairs import camera_numbers, varies_in_exposure
from mi_ring.errors import InputError
from mi_ring.fitting.refinement import refined_of
from mi_ring.images import read_image

VIEWS = 12
LAMP = '<emitter type="point"><point name="position" x="{}" y="2" z="3"/><rgb name="intensity" value="5"/></emitter>'


def poses_changed(text, change):
    """Text of a scene with other poses: `change` takes and returns a matrix (4, 4)."""

    def new(match):
        matrix = change(np.array(match[1].split(), float).reshape(4, 4))
        return f'matrix value="{" ".join(map("{:.7g}".format, matrix.ravel()))}"'  # fmt: skip

    return re.sub(r'matrix value="(.*?)"', new, text)


@pytest.fixture
def two(small_capture, tmp_path, monkeypatch):
    """Two captures of the same poses, which differ by rounding: with flash, and by the room, in another folder.

    They have the same names. Photographs of the room are brighter.
    """
    monkeypatch.chdir(tmp_path)
    flash, room = Path("flash/small.xml"), Path("of/the room/other.xml")
    for path in (flash, room):
        shutil.copytree(small_capture.parent, path.parent)
    (room.parent / "small.xml").rename(room)
    for file in sorted(room.parent.glob("images/*.png")):
        mi.Bitmap(255 - (255 - read_image(file)) // 2).write(str(file))
    room.write_text(poses_changed(room.read_text(), lambda matrix: matrix))

    def edit(path, *changes):
        text = path.read_text()
        for old, new in changes:
            text, count = re.subn(old, new, text, flags=re.S)
            assert count, old
        path.write_text(text)

    return SimpleNamespace(flash=flash, room=room, out=Path("joined/deep/both.xml"), edit=edit)


def joined(two):
    join.main([str(two.flash), str(two.room), str(two.out)])
    return mi_ring.load_capture(two.out)


def test_photographs_from_the_same_places_are_pairs(two, capsys):
    flash, room = mi_ring.load_capture(two.flash), mi_ring.load_capture(two.room)
    assert {shot.camera.key for shot in flash.shots}.isdisjoint(shot.camera.key for shot in room.shots)
    before = [path.read_bytes() for path in (two.flash, two.room)]
    both = joined(two)
    names = [f"{k:03}" for k in range(VIEWS)]
    assert [shot.name for shot in both.shots] == [*names, *(f"{name}_room" for name in names)]
    assert both.photographs.lit.tolist() == [True] * VIEWS + [False] * VIEWS
    assert camera_numbers(both).tolist() == 2 * [*range(VIEWS)]
    for new, old in zip(both.shots, [*flash.shots, *flash.shots]):
        assert new.camera.key == old.camera.key
    for k, old in enumerate([*flash.shots, *room.shots]):
        assert both.shots[k].files.filename.resolve() == old.files.filename.resolve()
        source = (flash, room)[k // VIEWS]
        np.testing.assert_array_equal(both.images[k], source.images[k % VIEWS])
        np.testing.assert_array_equal(both.masks[k], source.masks[k % VIEWS])
    assert not (both.images[0] == both.images[VIEWS]).all()
    assert 'value="../../flash/images/000.png"' in two.out.read_text()
    assert 'value="../../of/the room/masks/000.png"' in two.out.read_text()
    assert [path.read_bytes() for path in (two.flash, two.room)] == before
    printed = capsys.readouterr().out.splitlines()
    assert printed[-2:] == [
        f"12 photographs with flash, 12 in the light of the room alone, 12 pairs: {two.out}",
        f"Now: python -m mi_ring.fit {two.out}",
    ]  # fmt: skip
    assert printed[0] == f"Photographs of {two.room} whose own light is left out: 12" and len(printed) == 3


def test_exposures_of_the_room_are_free(two):
    both = joined(two)
    assert varies_in_exposure(both)
    assert {"gain", "ambient"} < set(refined_of(both, mi_ring.Config(), "capture", 0.5))


def test_what_a_photograph_says_is_kept(two):
    """Also that of photographs with flash; a camera with another lens is no pair."""
    says = ('<string name="encoding" value="linear"/> <float name="saturation" value="0.9"/> '
            '<float name="gamma" value="1.1"/> <float name="contrast" value="1.2"/> '
            '<float name="vignetting" value="2"/> <string name="gain" value="1 2 0.5"/> '
            '<boolean name="calibrated" value="true"/>')  # fmt: skip
    room = ('<string name="valid" value="masks/002.png"/> <float name="distortion" value="-0.2"/> '
            '<float name="falloff" value="2"/> <string name="tilt" value="1 2"/> ')  # fmt: skip
    for path in (two.flash, two.room):
        file = path.parent / "images/001.png"
        mi.Bitmap(257 * read_image(file).astype(np.uint16)).write(str(file))
    two.edit(two.flash, (r'(id="001">)', rf"\1{says}"), (r'(id="003">)', r'\1<string name="ambient" value="a.png"/>'))
    two.edit(two.room, (r'(id="001">)', rf"\1{room}{says}"))
    shutil.copy(two.flash.parent / "images/003.png", two.flash.parent / "a.png")
    sources, both = [mi_ring.load_capture(path) for path in (two.flash, two.room)], joined(two)
    new, old = both.shots[VIEWS + 1], sources[1].shots[1]
    assert camera_numbers(both).tolist() == [*range(VIEWS), 0, VIEWS, *range(2, VIEWS)]
    assert (new.encoding, new.saturation, new.response, new.calibrated) == (
        "linear",
        old.saturation,
        old.response,
        True,
    )
    assert new.camera.key == old.camera.key and new.camera.distortion != 0
    assert new.falloff == 0 and new.tilt == (0, 0) and not new.light.rgb.any()
    assert new.files.valid.resolve() == old.files.valid.resolve() and both.valid.given.count(True) == 1
    np.testing.assert_array_equal(both.images[VIEWS + 1], sources[1].images[1])
    assert both.shots[1].response == sources[0].shots[1].response and both.shots[1].encoding == "linear"
    assert both.shots[3].files.ambient.resolve() == sources[0].shots[3].files.ambient.resolve()


def test_an_ambient_image_may_be_a_photograph_of_the_room(two):
    """Then it has the exposure of the photograph with flash."""
    two.edit(two.flash, (r'<string name="mask" value="masks/(\d+)', r'<string name="ambient" '
                         rf'value="../{two.room.parent}/images/\1.png"/>\g<0>'))  # fmt: skip
    both = joined(two)
    assert len(both) == 2 * VIEWS and not varies_in_exposure(both)
    assert camera_numbers(both).tolist() == 2 * [*range(VIEWS)]


def test_names_are_unique(two):
    """Photographs without ids are named by their files; what has the name of another one gets a new one."""
    two.edit(two.flash, (' id="00[0-3]"', ""), ('id="004"', 'id="006_room"'))
    two.edit(two.room, ('id="000"', ""), ('id="007"', 'id="object_"'), ('id="008"', 'id="new"'))
    names = [shot.name for shot in joined(two).shots]
    assert names[:VIEWS] == ["000", "001", "002", "003", "006_room", *(f"{k:03}" for k in range(5, 12))]
    assert names[VIEWS:] == ["000_room", "001_room", "002_room", "003_room", "004", "005_room", "006_room_", "object_",
                             "new", "009_room", "010_room", "011_room"]  # fmt: skip


def test_masks_are_lent_to_photographs_from_the_same_place(two, capsys):
    two.edit(two.room, ('<string name="mask".*?/>', ""))
    two.edit(two.room, ('(id="002".*?fx" value=")60', r"\g<1>61"))
    both = joined(two)
    assert both.masks.given == [True] * (VIEWS + 2) + [False] + [True] * (VIEWS - 3)
    assert both.shots[VIEWS].files.mask.resolve() == (two.flash.parent / "masks/000.png").resolve()
    printed = capsys.readouterr().out
    assert f"Photographs of {two.room} that get the mask of the photograph with flash: 11\n" in printed
    assert f"Photographs of {two.room} without a mask, whose background must be black: 1\n" in printed


def test_an_alpha_channel_is_not_lent(two):
    for k in range(VIEWS):
        file = two.flash.parent / f"images/{k:03}.png"
        mask = read_image(two.flash.parent / f"masks/{k:03}.png")[..., :1]
        mi.Bitmap(np.concatenate([read_image(file), mask], 2)).write(str(file))
    two.edit(two.flash, (r"masks/(\d+)", r"images/\1"))
    two.edit(two.room, ('<string name="mask".*?/>', ""))
    both = joined(two)
    assert both.masks.given == [True] * VIEWS + [False] * VIEWS
    assert camera_numbers(both).tolist() == 2 * [*range(VIEWS)]


def test_other_places_and_sizes_are_no_pairs(two, capsys):
    """A hundredth of a pixel is the limit: a turn by a thirtieth of a degree is as much here."""
    for degrees, same in ((0.01, True), (0.1, False)):
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.eye(4)
        turn[:2, :2] = [[cos, -sin], [sin, cos]]
        before = two.room.read_text()
        two.room.write_text(poses_changed(before, lambda matrix, turn=turn: matrix @ turn))
        two.out = Path(f"{degrees}.xml")
        numbers = camera_numbers(joined(two))
        assert (numbers[VIEWS:] == numbers[:VIEWS]).all() == same
        assert ("No camera of" in capsys.readouterr().out) != same
        two.room.write_text(before)


def test_what_lights_all_stays(two, capsys):
    for path in (two.flash, two.room):
        two.edit(path, ("</scene>", LAMP.format("1" if path == two.flash else "1.000000001") + "</scene>"))
    both = joined(two)
    assert both.xml.count(b"<emitter") == 2 * VIEWS + 1
    assert f"The emitters of {two.flash} light the photographs of {two.room}, too." in capsys.readouterr().out


def moved(shift):
    def change(matrix):
        return matrix + np.outer([*shift, 0], [0, 0, 0, 1])

    return change


def scaled(matrix):
    """Cameras three times as far away, as if the unit was another one."""
    result = matrix.copy()
    result[:3, 3] = CENTER + 3 * (matrix[:3, 3] - CENTER)
    return result


@pytest.mark.parametrize("change, message", [
    (moved([300, 0, 0]), r"other.xml: ROOM.xml: its object is 300 scene units away from that of flash/small.xml, with "
     "radii of .* and .*: frames or objects differ; calibrate all photographs together"),
    (scaled, r"other.xml: ROOM.xml: its masks agree to \d+% only with those of flash/small.xml: frames or objects"),
])  # fmt: skip
def test_captures_in_other_frames_are_refused(two, change, message):
    two.room.write_text(poses_changed(two.room.read_text(), change))
    with pytest.raises(InputError, match=message):
        joined(two)
    assert not two.out.parent.exists()


def test_masks_that_do_not_agree_are_named(two, capsys):
    two.room.write_text(poses_changed(two.room.read_text(), moved([8, 0, 0])))
    joined(two)
    assert re.match(f"Warning: the masks of {two.room} agree to [5-8].% only with those of {two.flash}. Do both show",
                    capsys.readouterr().out.split("\n", 1)[1])  # fmt: skip


@pytest.mark.parametrize("which, changes, message", [
    ("room", [("</scene>", f"{LAMP.format(1)}</scene>")], "other.xml: emitter point: flash/small.xml says nothing of "
     "it, but counts for all photographs; remove it, or write the same in both"),
    ("room", [("<bsdf ", '<point name="ground" x="0" y="0" z="0"/><bsdf ')], "other.xml: shapenet, ground: flash/"),
    ("room", [('<bsdf type="cooktorrance"/>', '<bsdf type="cooktorrance"><boolean name="fresnel" value="true"/></bsdf>'
               )], "other.xml: shapenet, bsdf: flash/small.xml says something else of it"),
    ("room", [('type="photometric"', 'type="path"')], "other.xml: integrator path: flash/small.xml says nothing of it"),
    ("flash", [('rgb name="intensity" value="[^"]*"', 'rgb name="intensity" value="0"')],
     "small.xml: FLASH.xml: no photograph has a light of its own; exchange FLASH.xml and ROOM.xml"),
    ("room", [('"images/005.png"', '"../../flash/images/004.png"')],
     'other.xml: photograph "005", filename: .*004.png is photograph "004" of flash/small.xml, too; remove one'),
    ("room", [('(id="001">)', r'\1<string name="ambient" value="images/002.png"/>')],
     'other.xml: photograph "001", ambient: is for photographs with a flash; exchange FLASH.xml and ROOM.xml'),
    ("room", [('<sensor type="photograph" id="002".*</sensor>', "")],
     "other.xml: ROOM.xml: has 2 photographs; a fit needs at least 3 in the light of the room alone"),
    ("room", [('"images/005.png"', '"images/gone.png"')], 'photograph "005", filename: no such file: .*gone.png'),
    ("room", [('width" value="56"', 'width" value="55"')], "filename: is 56 x 40 pixels, but the film says 55 x 40"),
    ("flash", [('"masks/005.png"', '"masks/gone.png"')], 'photograph "005", mask: no such file: .*gone.png'),
    ("flash", [("<sensor", '<default name="a" value="1"/><sensor')], "small.xml: <default>: a fit needs a scene wi"),
    ("room", [("</scene>", "")], "other.xml: is no XML"),
])  # fmt: skip
def test_what_cannot_be_joined(two, which, changes, message):
    two.edit(getattr(two, which), *changes)
    with pytest.raises(InputError, match=message):
        joined(two)
    assert not two.out.parent.exists()


def test_files_that_cannot_be_joined_or_written(two):
    def refused(message, *paths):
        with pytest.raises(InputError, match=message):
            join.main([*map(str, paths)])

    before, files = two.flash.read_bytes(), os.listdir(two.flash.parent)
    refused("small.xml: OUT.xml: exists already; give another name", two.flash, two.room, two.flash)
    refused("both.txt: OUT.xml: must end in .xml", two.flash, two.room, "both.txt")
    refused("small.xml: ROOM.xml: is FLASH.xml itself", two.flash, two.flash, two.out)
    refused("gone.xml: no such file", two.flash, "gone.xml", two.out)
    refused("000.png: is a photograph", two.flash, two.room.parent / "images/000.png", two.out)
    Path("file").touch()
    refused("file/both.xml: OUT.xml: cannot be written", two.flash, two.room, "file/both.xml")
    copy = shutil.copy(two.flash, two.flash.with_name("copy.xml"))
    refused('photograph "000", filename: .* is photograph "000" of flash/small.xml, too', two.flash, copy, two.out)
    shutil.copytree(two.room.parent, "a$b")
    refused(r"a\$b/images/000.png: has a \$ in its path, which scene files take for a parameter", two.flash,
            "a$b/other.xml", two.out)  # fmt: skip
    assert two.flash.read_bytes() == before and not two.out.exists()
    assert {*os.listdir(two.flash.parent)} == {"copy.xml", *files}


def test_a_third_capture_may_follow(two, capsys):
    """A joined scene is one of photographs with flash."""
    joined(two)
    third = Path("third")
    shutil.copytree(two.room.parent, third)
    join.main([str(two.out), str(third / "other.xml"), "all.xml"])
    everything = mi_ring.load_capture("all.xml")
    assert camera_numbers(everything).tolist() == 3 * [*range(VIEWS)]
    assert [shot.name for shot in everything.shots[::VIEWS]] == ["000", "000_room", "000_room_"]
    assert "12 photographs with flash, 24 in the light of the room alone, 24 pairs:" in capsys.readouterr().out
