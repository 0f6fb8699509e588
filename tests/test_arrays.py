"""Captures from arrays: the same as from a scene file, what is refused, a fit from the first array to the results."""

import re
from dataclasses import FrozenInstanceError, replace

import mitsuba as mi
import numpy as np
import pytest
import torch
from conftest import CENTER

import mi_ring
from mi_ring import Camera, Capture, InputError, Light, Response
from mi_ring.capture.scenefile import recalibrated_xml
from mi_ring.synthesis.viewpoints import look_at

WIDTH, HEIGHT = 7, 5
POSE = look_at(np.array([1.0, -2.0, 9.0]), np.array([0.3, 0.1, 0.0]), np.array([0.1, 1.0, 0.2]))
CAMERA = Camera(POSE, np.array([8.0, 9.0]), np.array([3.2, 2.9]), (WIDTH, HEIGHT))
IMAGE = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def arrays_of(capture):
    """What `from_arrays` takes, of a capture."""
    return {"images": list(capture.images), "masks": list(capture.masks),
            "cameras": [shot.camera for shot in capture.shots], "lights": [shot.light for shot in capture.shots],
            "names": [shot.name for shot in capture.shots]}  # fmt: skip


def made(**changes):
    """A capture of one photograph."""
    return Capture.from_arrays(**{"images": [IMAGE], "cameras": [CAMERA], **changes})


def test_a_capture_from_arrays_is_that_of_the_scene_file(small_capture):
    read = mi_ring.load_capture(small_capture)
    made = Capture.from_arrays(**arrays_of(read))
    assert made.in_memory and not read.in_memory
    assert made.names == [shot.name for shot in read.shots] and made.sizes.keys() == read.sizes.keys()
    for ours, theirs in zip(made.shots, read.shots, strict=True):
        assert ours.camera.key == theirs.camera.key
        assert ours.light.kind == theirs.light.kind
        np.testing.assert_array_equal(ours.light.vector, theirs.light.vector)
        np.testing.assert_array_equal(ours.light.rgb, theirs.light.rgb)
    for name in ("cameras", "intrinsics"):
        np.testing.assert_array_equal(getattr(made.photographs.views, name), getattr(read.photographs.views, name))
    for scale in (1, 4):
        for one, other in zip(made.observe([7, 2, 5], scale)[:4], read.observe([7, 2, 5], scale)[:4], strict=True):
            assert torch.equal(one, other)
    assert made.exposure() == read.exposure()
    (center, radius), (other, reach) = made.sphere(), read.sphere()
    assert center.tolist() == other.tolist() and radius == reach


def test_pixels_are_decoded_by_their_type():
    kinds = {np.uint8: 255, np.uint16: 65535, np.float32: 1}
    images = [(IMAGE / 255 * full).astype(kind) for kind, full in kinds.items()]
    capture = Capture.from_arrays(images, cameras=[CAMERA] * 3, saturation=0.5)
    v = IMAGE / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    for k, expected in enumerate((linear, v, v)):
        seen = capture.observe([k])
        np.testing.assert_allclose(seen.rgb[0], expected, atol=1e-4)
        np.testing.assert_array_equal(seen.clipped[0, ..., 1], images[k][..., 1] / kinds[images[k].dtype.type] >= 0.5)
    again = Capture.from_arrays(images[1:], cameras=[CAMERA] * 2, encoding="srgb")
    np.testing.assert_allclose(again.observe([0, 1]).rgb, np.stack([linear, linear]), atol=1e-4)


def test_masks_may_be_bool_and_some_may_be_missing():
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[1:4, 2:6] = True
    shown = np.ones((HEIGHT, WIDTH), np.uint8) * 255
    shown[:, 0] = 0
    labelled = made(masks=[inside * np.uint8(3)])
    np.testing.assert_array_equal(labelled.observe([0]).mask[0] == 1, inside)
    capture = made(images=[IMAGE, IMAGE], cameras=[CAMERA] * 2, masks=[None, inside], valid=[shown, None])
    seen = capture.observe([0, 1])
    assert seen.masked.tolist() == [False, True] and not seen.mask[0].any()
    np.testing.assert_array_equal(seen.mask[1] == 1, inside)
    assert not seen.valid[0, :, 0].any() and seen.valid[0, :, 1:].all() and seen.valid[1].all()
    assert not seen.rgb[0, :, 0].any() and seen.clipped[0, :, 0].all()


def test_names_may_come_from_an_iterator():
    capture = made(images=[IMAGE] * 2, cameras=[CAMERA] * 2, names=iter(["b", "a"]))
    assert [shot.name for shot in capture.shots] == ["b", "a"]


def test_without_light_it_is_a_point_light_of_intensity_one_at_the_camera():
    capture = made()
    light = capture.photographs.lights[0]
    assert capture.photographs.colocated and light.kind == "point"
    np.testing.assert_allclose(light.vector, POSE[:3, 3], rtol=1e-6)
    assert light.rgb.tolist() == [1, 1, 1]


def test_a_distant_light_need_not_have_unit_length():
    capture = made(lights=[Light("directional", np.array([0.0, 3.0, -4.0]), np.array([1.0, 2.0, 3.0]))])
    light = capture.photographs.lights[0]
    np.testing.assert_allclose(light.vector, [0, 0.6, -0.8], rtol=1e-6)
    np.testing.assert_allclose(capture.photographs.irradiance(np.zeros(3)), [[1, 2, 3]], rtol=1e-6)


def test_center_radius_and_room_are_those_of_the_scene():
    capture = made(center=[1, 2, 3], radius=4.5, room=[[0.5, 0.6, 0.7], [0, 0, 0], [0.1, 0, 0], [0, 0, 0]])
    center, radius = capture.sphere()
    assert center.tolist() == [1, 2, 3] and radius == 4.5
    np.testing.assert_allclose(capture.room[:4, 0], [0.5, 0, 0.1, 0], rtol=1e-6)
    assert not capture.room[4:].any() and capture.photographs.room is capture.room


WRONG = {
    "no images": ({"images": [], "cameras": []}, "images: is empty"),
    "a float64 image": ({"images": [IMAGE / 255]}, r"images\[0\]: is float64 of shape \(5, 7, 3\)"),
    "a grey image": ({"images": [IMAGE[..., 0]]}, r"images\[0\]: is uint8 of shape \(5, 7\); must be \(H, W, 3\)"),
    "a flat image": ({"images": [IMAGE[:, :1].repeat(60, 0)]}, r"images\[0\]: is 1 x 300 pixels; the sides must be"),
    "a nan": ({"images": [np.full((5, 7, 3), np.nan, np.float32)]}, r"images\[0\]: contains pixels that are NaN"),
    "8 linear bits": ({"encoding": "linear"}, r"images\[0\]: is uint8, which is sRGB"),
    "an encoding": ({"encoding": "gamma"}, "encoding: is 'gamma'"),
    "a saturation": ({"saturation": 0}, "saturation: is 0"),
    "no list": ({"images": 7}, "images: is int; must be a list, one item for each photograph"),
    "an image of ragged rows": ({"images": [[[[1, 2, 3]], [[4]]]]}, r"images\[0\]: is no array"),
    "a mask alone": ({"masks": True}, "masks: is bool; must be a list"),
    "too many masks": ({"masks": [None, None]}, "masks: has 2 for 1 images"),
    "a turned mask": ({"masks": [np.ones((7, 5), bool)]}, r"masks\[0\]: is bool of shape \(7, 5\); must be \(5, 7\)"),
    "a mask of ones": ({"masks": [np.ones((5, 7), np.uint8)]}, r"masks\[0\]: has the values 1; save"),
    "no camera": ({"cameras": []}, "cameras: has 0 for 1 images"),
    "a matrix": ({"cameras": [np.eye(4)]}, r"cameras\[0\]: is ndarray; must be a mi_ring.Camera"),
    "a size": ({"cameras": [CAMERA._replace(size=(5, 7))]}, r"cameras\[0\]: size is \(5, 7\).*its image is 7 x 5"),
    "a focal length": ({"cameras": [CAMERA._replace(focal=np.array([8.0, -9]))]}, r"cameras\[0\]: focal"),
    "one focal length": ({"cameras": [CAMERA._replace(focal=8.0)]}, r"cameras\[0\]: focal: is of shape \(\)"),
    "a mirror": ({"cameras": [CAMERA._replace(to_world=np.diag([-1.0, 1, 1, 1]))]}, "without scale or mirror"),
    "a transposed pose": ({"cameras": [CAMERA._replace(to_world=POSE.T)]}, "last row.*is it transposed"),
    "a far principal point": ({"cameras": [CAMERA._replace(centre=np.array([900.0, 2]))]}, "cx is 900"),
    "a folding lens": ({"cameras": [CAMERA._replace(distortion=-9.0)]}, r"cameras\[0\]: distortion is -9"),
    "a tuple": ({"lights": [((0, 0, 1), (1, 1, 1))]}, r"lights\[0\]: is tuple; must be a mi_ring.Light"),
    "a spot": ({"lights": [Light("spot", np.zeros(3), np.ones(3))]}, r'lights\[0\]: is of kind "spot"'),
    "a number": ({"lights": [Light("point", np.zeros(3), 7.0)]}, r"lights\[0\]: rgb: is of shape \(\)"),
    "no direction": ({"lights": [Light("directional", np.zeros(3), np.ones(3))]}, r"lights\[0\]: vector is 0"),
    "an infinite place": ({"lights": [Light("point", np.full(3, np.inf), np.ones(3))]}, "must be finite"),
    "a dark light": ({"lights": [Light("point", np.zeros(3), -np.ones(3))]}, 'lights: photograph "000".*strong'),
    "a path": ({"names": ["a/b"]}, r"names\[0\]: is 'a/b'"),
    "a variable of Mitsuba": ({"names": ["a$b"]}, r"names\[0\]: is 'a\$b'"),
    "half a character": ({"names": ["a\ud800"]}, r"names\[0\]: is 'a.ud800'"),
    "the object": ({"names": ["object"]}, r"names\[0\]: is 'object'"),
    "twins": ({"images": [IMAGE] * 2, "cameras": [CAMERA] * 2, "names": ["a", "a"]}, r"names\[1\]: 'a' occurs twice"),
    "a centre": ({"center": [1, 2]}, r"center: is of shape \(2,\); must be \(3,\)"),
    "a radius": ({"radius": -1}, "radius: is -1, must be above 0"),
    "rooms of ragged rows": ({"room": [[1, 2, 3], [1]]}, "room: is no array"),
    "the name of a room": ({"room": "dark"}, r"room: is of shape \(\)"),
    "a room": ({"room": np.ones((5, 3))}, r"room: is of shape \(5, 3\); must be \(n, 3\), n one of 1, 4, 9, 16, 25"),
}


@pytest.mark.parametrize("changes, message", WRONG.values(), ids=WRONG)
def test_what_no_fit_could_use_is_refused_with_the_argument(changes, message):
    with pytest.raises(InputError, match=message):
        made(**changes)


def test_captures_and_photographs_never_change():
    capture = made()
    for value, name in ((capture, "shots"), (capture, "masks"), (capture.shots[0], "camera"), (Response(), "gain")):
        with pytest.raises(FrozenInstanceError):
            setattr(value, name, None)
    bright = replace(capture, shots=(replace(capture.shots[0], response=Response(gain=(2.0, 2.0, 2.0))),))
    np.testing.assert_allclose(2 * bright.observe([0]).rgb, capture.observe([0]).rgb, rtol=1e-6)


def test_visual_hulls_are_shared_by_captures_of_the_same_masks_and_cameras(small_capture):
    capture = mi_ring.load_capture(small_capture)
    lit = replace(capture, shots=tuple(replace(shot, light=None) for shot in capture.shots))
    assert lit.hull is capture.hull is not None
    moved = capture.moved(1.0, np.eye(3), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(moved.hull.center - capture.hull.center, [1, 0, 0], atol=1e-3)


def test_a_fit_of_arrays_is_saved_with_its_photographs(small_capture, tmp_path):
    """The same fit as of the scene file; its scene opens in Mitsuba, and is a capture again."""
    read = mi_ring.load_capture(small_capture)
    config = mi_ring.Config.preset("fast", iterations=4, levels=(2,), widths=(28,), shares=(1,), subdivisions=3,
                                    domain="sphere")  # fmt: skip
    fits = [mi_ring.Fit(capture, config) for capture in (read, Capture.from_arrays(**arrays_of(read)))]
    losses = [[it.loss for it in fit] for fit in fits]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)
    for _ in range(2):  # the second time the first results are moved aside
        fits[1].save(tmp_path / "run")
    assert (tmp_path / "run.1" / "ring.pt").is_file()
    again = mi_ring.load_capture(tmp_path / "run" / "scene.xml")
    for k in (0, 7):
        np.testing.assert_array_equal(again.images[k], read.images[k])
        np.testing.assert_array_equal(again.masks[k], read.masks[k])
    calibrated = fits[1].calibrated()
    for found, written in zip(calibrated.photographs.lights, again.photographs.lights):
        np.testing.assert_allclose(found.vector, written.vector, rtol=1e-5)
    scene = mi.load_file(str(tmp_path / "run" / "scene.xml"), parallel=False)
    picture = np.array(mi.render(scene, sensor=3, spp=4))
    assert picture.shape == (40, 56, 3) and picture.max() > 0.05
    assert mi_ring.load_fit(tmp_path / "run").center.numpy() == pytest.approx(CENTER, abs=5)


def test_files_have_all_bits_of_the_arrays(tmp_path):
    random = np.random.default_rng(3)
    images = [random.integers(0, 65535, (HEIGHT, WIDTH, 3), np.uint16),
              random.uniform(0, 3, (HEIGHT, WIDTH, 3)).astype(np.float32)]  # fmt: skip
    shown = random.uniform(size=(HEIGHT, WIDTH)) < 0.6
    capture = Capture.from_arrays(images, valid=[None, shown], cameras=[CAMERA, CAMERA._replace(distortion=0.05)],
                                  names=["left", "right"], saturation=2.5, calibrated=True,
                                  room=[[0.1, 0.2, 0.3]])  # fmt: skip
    saved = capture.save(tmp_path / "deep" / "pair.xml")
    assert saved.path == tmp_path / "deep" / "pair.xml" and not saved.in_memory
    read = mi_ring.load_capture(saved.path)
    for k, image in enumerate(images):
        np.testing.assert_array_equal(read.images[k], image)
        assert read.shots[k].camera.key == capture.shots[k].camera.key and read.shots[k].calibrated
        assert read.shots[k].files == saved.shots[k].files and read.shots[k].saturation == 2.5
    assert read.valid[0] is None and ((read.valid[1] == 255) == shown).all()
    np.testing.assert_allclose(read.room[0], [0.1, 0.2, 0.3], rtol=1e-6)
    with pytest.raises(InputError, match="has the scene file .*pair.xml"):
        read.save(tmp_path / "copy.xml")


def test_what_was_replaced_is_saved(tmp_path):
    sixteen = (IMAGE.astype(np.uint16) * 257, IMAGE[::-1].astype(np.uint16) * 257)
    capture = Capture.from_arrays(sixteen, cameras=[CAMERA] * 2, names=["first", "second"])
    changes = {"encoding": "srgb", "saturation": 0.7, "calibrated": True}
    capture = replace(capture, shots=tuple(replace(shot, **changes) for shot in capture.shots))
    read = mi_ring.load_capture(capture.save(tmp_path / "two.xml").path)
    for ours, theirs in zip(capture.shots, read.shots, strict=True):
        assert {name: getattr(theirs, name) for name in changes} == changes
        assert ours.name == theirs.name
    torch.testing.assert_close(read.observe([0, 1]).rgb, capture.observe([0, 1]).rgb, rtol=0, atol=0)


def test_a_part_of_a_capture_is_saved_alone(tmp_path):
    images = [np.roll(IMAGE, k, 0) for k in range(3)]
    part = Capture.from_arrays(images, cameras=[CAMERA] * 3, names=list("abc")).part([2, 0])
    read = mi_ring.load_capture(part.save(tmp_path / "part.xml").path)
    assert [shot.name for shot in read.shots] == ["c", "a"]
    for k, image in enumerate((images[2], images[0])):
        np.testing.assert_array_equal(read.images[k], image)


def test_a_scene_file_of_more_photographs_is_written_for_a_part(small_capture):
    capture = mi_ring.load_capture(small_capture)
    part = capture.part([3, 1])
    names = re.findall(rb'<sensor[^>]* id="([^"]+)"', recalibrated_xml(capture.xml, part.shots))
    assert sorted(names) == sorted(shot.name.encode() for shot in part.shots)
    unnamed = re.sub(rb'(<sensor[^>]*) id="[^"]+"', rb"\1", capture.xml)
    with pytest.raises(InputError, match="have no ids"):
        recalibrated_xml(unnamed, part.shots)
