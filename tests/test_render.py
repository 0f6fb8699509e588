"""`mi_ring.render`: films, environments, integrators and files, against what a pencil says of a sphere."""

import contextlib
import resource

import imageio.v2 as imageio
import mitsuba as mi
import numpy as np
import pytest
import torch
from conftest import SCENE, SENSOR
from scipy.spatial.transform import Rotation

from mi_ring import render
from mi_ring.capture import loading
from mi_ring.errors import InputError
from mi_ring.nets.shape_net import SPEED
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import ring_state
from mi_ring.output import camera_paths
from mi_ring.output.film import write_film
from mi_ring.plugins.flash import Flash
from mi_ring.rendering import prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.system import command

CENTER, RADIUS, SHIFT = np.array([400.0, -150.0, 90.0]), 20.0, np.array([0.3, -0.5, 0.2])
MIDDLE = CENTER + RADIUS * SHIFT  #: of the sphere, when the flow has carried it there
ALBEDO = np.array([0.6, 0.4, 0.2])
UP = np.array([0.2, 0.9, -0.4]) / np.linalg.norm([0.2, 0.9, -0.4])


def set_material(ring, diffuse, specular=0.0, roughness=0.5):
    """The same everywhere."""
    value = torch.tensor([*diffuse, specular], dtype=torch.float64).clamp(min=1e-12) / ring.brdf_net.scale
    starts = [p.start for p in ring.brdf_net.bsdf_parameters for _ in range(p.channels)]
    raw = torch.cat([value.expm1().log(), torch.tensor([np.log(roughness / (1 - roughness))])])
    ring.brdf_net.output.weight.data.zero_()
    ring.brdf_net.output.bias.data.copy_(raw - torch.tensor(starts))


def sphere(shift=SHIFT, **material):
    """A matte sphere that the flow moves as a whole, by `shift` times its radius."""
    ring = FittedObject(CENTER, RADIUS, steps=8, subdivisions=4)
    ring.shape_net.output.weight.data.zero_()
    ring.shape_net.output.bias.data.copy_(torch.atanh(torch.tensor(shift) / SPEED))
    set_material(ring, **{"diffuse": ALBEDO / np.pi} | material)
    return ring


def save(ring, path):
    torch.save(ring_state(ring, {"subdivisions": ring.subdivisions}), path)
    return path


def look_at(eye, target, up):
    """Camera-to-world (4, 4): x left, y up, z forward."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    left = np.cross(up, forward) / np.linalg.norm(np.cross(up, forward))
    matrix = np.eye(4)
    matrix[:3] = np.stack([left, np.cross(forward, left), forward, eye], 1)
    return matrix


def project(shot, points):
    """Pixels (N, 2) where a photograph shows points (N, 3)."""
    matrix, focal, centre, *_ = shot.camera
    x, y, z = ((np.atleast_2d(points) - matrix[:3, 3]) @ matrix[:3, :3].astype(float)).T
    return np.stack([centre[0] - focal[0] * x / z, centre[1] - focal[1] * y / z], 1)


def normal_in(shot, x, y, center, radius):
    """Of a sphere, where the middle of pixel (x, y) sees it."""
    matrix, focal, centre, *_ = shot.camera
    d = matrix[:3, :3].astype(float) @ [(centre[0] - x - 0.5) / focal[0], (centre[1] - y - 0.5) / focal[1], 1]
    d, away = d / np.linalg.norm(d), matrix[:3, 3] - center
    b = d @ away
    return (away + (-b - np.sqrt(b * b - away @ away + radius * radius)) * d) / radius


def irradiance(light, point, normal):
    """Of a point light of the scene's strength."""
    to_light = light - point
    return STRENGTH * max(0, normal @ to_light) / np.linalg.norm(to_light) ** 3


#: Where the photographs are taken from, and where their lights are, none of them at the camera.
EYES = MIDDLE + np.array([[90.0, 40.0, 50.0], [-80.0, 60.0, 30.0], [20.0, -50.0, 110.0]])
LIGHTS = MIDDLE + np.array([[40.0, 90.0, 60.0], [-130.0, 0.0, 60.0], [100.0, 10.0, 80.0]])
STRENGTH = 20000.0


def write_scene(folder, size=(7, 5), focal=(9.0, 10.0), extra="", edit=lambda text: text, aim=(5.0, -3.0, 4.0)):
    """A scene file of three photographs that look beside the object, each held in another way."""
    width, height = size
    sensors = []
    for k, (eye, light) in enumerate(zip(EYES, LIGHTS)):
        up = UP + 0.3 * np.eye(3)[k]
        sensors.append(SENSOR.format(
            id=f"{k:03}", mask="", fx=focal[0], fy=focal[1], cx=width / 2 - 0.4, cy=height / 2 + 0.3, width=width,
            height=height, matrix=" ".join(map(str, look_at(eye, MIDDLE + aim, up).ravel())), x=light[0], y=light[1],
            z=light[2], intensity=STRENGTH,
        ))  # fmt: skip
    path = folder / "scene.xml"
    path.write_text(edit(SCENE.format(sensors="".join(sensors)).replace("</scene>", extra + "</scene>")))
    return path


@pytest.fixture
def run(tmp_path):
    """The ring.pt of the sphere."""
    return save(sphere(), tmp_path / "ring.pt")


def arguments(*options):
    return command.parse(render.RenderConfig, ["run", "scene.xml", "out", *map(str, options)], "render")


def frames_of(path, ring, *options):
    return camera_paths.views_of(loading.load_capture(path, images=False), ring, arguments(*options))


def eye_of(frame):
    return frame.shot.camera.to_world[:3, 3].astype(float)


def light_of(frame):
    """Where the light of a frame is, or the direction toward it."""
    light = frame.shot.light
    return light.vector if light.kind == "point" else -light.vector


def read(path):
    return np.array(mi.Bitmap(str(path)))[..., :3].astype(float)


def encoded(linear):
    """8-bit sRGB, by the standard's formula."""
    linear = np.clip(linear, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def distant(text):
    """The same scene in parallel light."""
    for light in LIGHTS:
        x, y, z = MIDDLE - light
        text = text.replace(f'"point"><point name="position" x="{light[0]}" y="{light[1]}" z="{light[2]}"/>',
                            f'"directional"><vector name="direction" x="{x}" y="{y}" z="{z}"/>')  # fmt: skip
    assert text.count("<vector") == 3
    return text.replace('name="intensity"', 'name="irradiance"')


# Films


@pytest.mark.parametrize("up", [UP, None, np.array([0.0, 0.0, -2.0])], ids=["given", "mean", "downward"])
def test_a_turntable_goes_once_around_the_axis_with_its_light(tmp_path, up):
    torch.manual_seed(4)
    ring = sphere()
    ring.shape_net.output.weight.data.normal_(0, 0.03)
    with torch.no_grad():
        vertices = ring.surface(ring.domain.sample(5)[0]).numpy().astype(float)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    assert np.ptp(np.linalg.norm(vertices - middle, axis=1)) > 0.1 * RADIUS  # not just a sphere
    path = write_scene(tmp_path)
    frames = frames_of(path, ring, "--turntable", 8, *([] if up is None else ["--up", *up]))
    axis = loading.load_capture(path, images=False).up if up is None else up / np.linalg.norm(up)
    if up is None:
        assert axis @ UP > 0.9
    assert [frame.name for frame in frames] == [f"{k:03}.png" for k in range(8)]
    eyes = np.array([eye_of(frame) for frame in frames]) - middle
    np.testing.assert_allclose(eyes[0], EYES[0] - middle, atol=1e-3)
    turn = Rotation.from_rotvec(np.pi / 4 * axis)
    for k in range(8):
        np.testing.assert_allclose(eyes[(k + 1) % 8], turn.apply(eyes[k]), atol=0.2)  # the middle, at a coarser level
        np.testing.assert_allclose(eyes[k] + eyes[(k + 4) % 8], 2 * (eyes[k] @ axis) * axis, atol=0.2)
    own = []
    for frame in frames:
        matrix, focal, centre, *_ = frame.shot.camera
        assert frame.shot.size == (7, 5) and centre.tolist() == [3.5, 2.5] and focal[0] == focal[1]
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(project(frame.shot, middle), [[3.5, 2.5]], atol=0.05)
        above = project(frame.shot, middle + axis)[0]
        assert above[0] == pytest.approx(3.5, abs=0.05) and above[1] < 2.48
        pixels = project(frame.shot, vertices)
        assert pixels.min() > 0 and (pixels < [7, 5]).all() and np.ptp(pixels[:, 1]) > 2.5
        own.append((light_of(frame) - eye_of(frame)) @ matrix[:3, :3])
    np.testing.assert_allclose(light_of(frames[0]), LIGHTS[0], atol=1e-3)
    np.testing.assert_allclose(own, [own[0]] * 8, atol=1e-2)  # in the camera's axes it stays where it is


@pytest.mark.parametrize("size", [(7, 5), (5, 7)])
def test_a_film_is_filled_by_what_it_shows(tmp_path, size):
    """A sphere that is where it starts: all of it, and not much else along the shorter side."""
    ring = sphere(shift=[0.0, 0.0, 0.0])
    with torch.no_grad():
        vertices = ring.surface(ring.domain.sample(5)[0]).numpy()
    for option in ("--turntable", "--light-orbit", "--flow"):
        for frame in frames_of(write_scene(tmp_path, size), ring, option, 3):
            pixels = project(frame.shot, vertices)
            assert pixels.min() > 0 and (pixels < size).all()
            np.testing.assert_allclose(np.ptp(pixels, axis=0), 0.94 * 5, rtol=0.01)


def test_a_film_may_be_larger_than_its_photographs(tmp_path):
    """Three times as many pixels both ways: the same picture, three times as large."""
    with torch.no_grad():
        vertices = sphere().surface(sphere().domain.sample(3)[0]).numpy()
    path = write_scene(tmp_path)
    (small,), (large,) = (frames_of(path, sphere(), "--turntable", 1, *more) for more in ((), ("--width", 21)))
    assert small.shot.size == (7, 5) and large.shot.size == (21, 15)
    np.testing.assert_allclose(project(large.shot, vertices), 3 * project(small.shot, vertices), rtol=1e-4)


def test_the_turntable_of_a_camera_on_its_axis_turns_the_picture(tmp_path):
    """There is no up in what it sees but the photograph's own."""
    path, axis = write_scene(tmp_path), EYES[0] - MIDDLE
    frames = frames_of(path, sphere(), "--turntable", 4, "--up", *axis)
    before = loading.load_capture(path, images=False).shots[0].camera.to_world
    matrices = [frame.shot.camera.to_world for frame in frames]
    assert matrices[0][:3, 1] @ before[:3, 1] > 0.99
    for a, b in zip(matrices, matrices[1:]):
        np.testing.assert_allclose(b[:3, 3], EYES[0], atol=1e-3)
        assert abs(a[:3, 1] @ b[:3, 1]) < 1e-3 and a[:3, 2] @ b[:3, 2] == pytest.approx(1)


@pytest.mark.parametrize("parallel", [False, True])
def test_parallel_light_turns_with_the_table_and_from_any_photograph(tmp_path, parallel):
    path = write_scene(tmp_path, edit=distant if parallel else str)
    frames = frames_of(path, sphere(), "--turntable", 2, "--view", "001.png", "--up", *UP)
    np.testing.assert_allclose(eye_of(frames[0]), EYES[1], atol=1e-3)
    toward = LIGHTS[1] - MIDDLE
    half = 2 * (toward @ UP) * UP - toward  # half a turn
    expected = np.array([toward, half])
    expected = expected / np.linalg.norm(toward) if parallel else MIDDLE + expected
    np.testing.assert_allclose([light_of(frame) for frame in frames], expected, atol=1e-3)


@pytest.mark.parametrize("parallel", [False, True])
def test_a_light_orbit_moves_the_light_alone(tmp_path, parallel):
    path = write_scene(tmp_path, edit=distant if parallel else str)
    frames = frames_of(path, sphere(), "--light-orbit", 6, "--view", "002.png")
    line = (EYES[2] - MIDDLE) / np.linalg.norm(EYES[2] - MIDDLE)
    aside = []
    for frame in frames:
        toward = light_of(frame) - (0 if parallel else MIDDLE)
        assert np.linalg.norm(toward) == pytest.approx(1 if parallel else np.linalg.norm(LIGHTS[2] - MIDDLE), rel=1e-5)
        assert toward @ line / np.linalg.norm(toward) == pytest.approx(np.sqrt(0.5), abs=1e-5)
        aside.append(toward - toward @ line * line)
        np.testing.assert_array_equal(*(f.shot.camera.to_world for f in (frame, frames[0])))
        np.testing.assert_allclose(eye_of(frame), EYES[2], atol=1e-3)
        np.testing.assert_allclose(frame.shot.light.rgb, STRENGTH, rtol=1e-6)
    sixty = Rotation.from_rotvec(np.pi / 3 * line)
    turned = [sixty.apply(a) for a in aside]
    back = [sixty.inv().apply(a) for a in aside]
    following = aside[1:] + aside[:1]
    assert np.allclose(turned, following, atol=1e-2) or np.allclose(back, following, atol=1e-2)


def disc(picture):
    """(centre, radius) [px] of what is bright."""
    y, x = np.nonzero(picture.sum(-1) > 0)
    return np.array([x.mean(), y.mean()]) + 0.5, np.sqrt(len(x) / np.pi)


def test_the_flow_begins_with_the_domain_and_ends_with_the_object(tmp_path, run):
    size = (64, 48)
    # A light beside each camera: all that is seen is lit.
    beside = {tuple(light): eye for light, eye in zip(LIGHTS, EYES)}

    def at_camera(text):
        for (x, y, z), eye in beside.items():
            text = text.replace(f'x="{x}" y="{y}" z="{z}"', 'x="{}" y="{}" z="{}"'.format(*(eye + 0.01)))
        return text

    path = write_scene(tmp_path, size, (80, 80), edit=at_camera)
    render.main([str(run), str(path), str(tmp_path / "flow"), "--flow", "5", "--format", "exr", "--spp", "16"])
    frames = frames_of(path, sphere(), "--flow", 5)
    assert [frame.time for frame in frames] == [0, 0.25, 0.5, 0.75, 1]
    for frame in frames:
        centre, radius = disc(read(tmp_path / "flow" / f"{frame.name[:3]}.exr"))
        middle = CENTER + frame.time * RADIUS * SHIFT
        np.testing.assert_allclose(centre, project(frame.shot, middle)[0], atol=0.7)
        sine = RADIUS / np.linalg.norm(EYES[0] - middle)
        focal = frame.shot.camera.focal[0]
        # Pixels that it touches count: half a pixel more all around. Off the middle the disc is an ellipse, barely.
        assert radius == pytest.approx(focal * sine / np.sqrt(1 - sine**2) + 0.5, abs=0.4)
        assert radius < 24
    plain = mi.load_dict({
        "type": "scene", "object": {"type": "shapenet", "weights": str(run), "subdivisions": 4,
                                    "bsdf": {"type": "cooktorrance"}},
    })  # fmt: skip
    last = Photographs.of([frames[-1].shot])
    expected, _ = prediction.draw(Surface(plain, plain.shapes()[0]), last, spp=16)
    np.testing.assert_allclose(read(tmp_path / "flow" / "004.exr"), expected[0].numpy(), rtol=1e-3, atol=1e-5)


def test_time_takes_the_photographs_in_the_midst_of_the_flow(tmp_path, run):
    path = write_scene(tmp_path, (64, 48), (60, 55), aim=(0, 0, 0))
    render.main([str(run), str(path), str(tmp_path / "out"), "--time", "0.3", "--spp", "16", "--envmap",
                 str(environment(tmp_path, lambda up: 0 * up + 0.25)), "--integrator", "direct"])  # fmt: skip
    for shot in loading.load_capture(path, images=False).shots:
        picture = read(tmp_path / "out" / shot.files.filename.name)
        centre, _ = disc(np.where(abs(picture[..., 2:] - encoded(0.25)) > 10, 1, 0))
        np.testing.assert_allclose(centre, project(shot, CENTER + 0.3 * RADIUS * SHIFT)[0], atol=0.8)


# Environments and integrators


def environment(folder, radiance, name="sky.exr"):
    """An environment file; `radiance` of the cosine to its up."""
    cosine = np.cos((np.arange(16) + 0.5) / 16 * np.pi)
    pixels = np.broadcast_to(radiance(cosine)[:, None, None], (16, 32, 3)).astype(np.float32)
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(folder / name))
    return folder / name


@pytest.mark.parametrize(("name", "integrator"), [("sky.exr", []), ("sky.hdr", ["--integrator", "direct"])])
def test_a_matte_sphere_in_an_even_light_has_its_albedo_everywhere(tmp_path, run, name, integrator):
    """The furnace: a convex object sees nothing but the environment, and none of the photographs' lights."""
    path = write_scene(tmp_path, (56, 40), (50, 55), extra='<emitter type="constant"/>', aim=(0, 0, 0))
    sky = environment(tmp_path, lambda up: 0 * up + 1, name)
    options = ["--envmap", str(sky), "--format", "exr", "--spp", "64", *integrator]
    render.main([str(run), str(path), str(tmp_path / "out"), *options])
    for shot in loading.load_capture(path, images=False).shots:
        picture = read(tmp_path / "out" / f"{shot.files.filename.stem}.exr")
        y, x = np.mgrid[:40, :56] + 0.5
        off = np.linalg.norm(np.stack([x, y], -1) - project(shot, MIDDLE)[0], axis=-1)
        inside, outside = picture[off < 6.5], picture[off > 14]  # filters are 2 px wide
        assert len(inside) > 120 and len(outside) > 800
        np.testing.assert_allclose(outside, 1, rtol=1e-3)
        np.testing.assert_allclose(inside.mean(0), ALBEDO, rtol=0.01)
        np.testing.assert_allclose(inside, np.broadcast_to(ALBEDO, inside.shape), rtol=0.25)  # 64 samples


@pytest.mark.parametrize("up", [UP, -UP, [0, -1, 0]])
def test_the_upper_half_of_an_environment_is_where_up_is(tmp_path, run, up):
    """A face of normal n sees the share (1 + n·up) / 2 of an even sky, weighted by the cosine."""
    path = write_scene(tmp_path, (56, 40), (50, 55), aim=(0, 0, 0))
    sky = environment(tmp_path, lambda up: (up > 0) * 1.0)
    options = ["--envmap", str(sky), "--format", "exr", "--spp", "128", "--up", *map(str, up)]
    render.main([str(run), str(path), str(tmp_path / "out"), *options])
    for shot in loading.load_capture(path, images=False).shots:
        picture = read(tmp_path / "out" / f"{shot.files.filename.stem}.exr")
        eye = shot.camera.to_world[:3, 3].astype(float)
        toward = (eye - MIDDLE) / np.linalg.norm(eye - MIDDLE)
        sideways = np.cross(toward, [0.3, 0.5, 0.6])
        for normal in (toward, toward + 0.6 * sideways, toward - 0.6 * sideways):
            normal = normal / np.linalg.norm(normal)
            x, y = np.floor(project(shot, MIDDLE + RADIUS * normal)[0]).astype(int)
            found = picture[y - 1 : y + 2, x - 1 : x + 2].mean((0, 1))
            np.testing.assert_allclose(found, ALBEDO * (1 + normal @ up) / 2, atol=0.03)


def test_what_else_is_in_the_scene_stays_with_an_environment(tmp_path, run):
    """A lamp, a glowing ball and a matte one, a mesh called as the object often is; not the scene's own environment."""
    left, right = MIDDLE + 60 * np.eye(3)[1], MIDDLE - 60 * np.eye(3)[1]
    ball = '<shape type="sphere" id="{}"><point name="center" x="{}" y="{}" z="{}"/><float name="radius" value="{}"/>{}'
    far = '<transform name="to_world"><translate x="-9e4"/></transform>'
    lamp = LIGHTS[0]
    extra = (
        ball.format("glow", *left, 8, '<emitter type="area"><rgb name="radiance" value="0.7"/></emitter></shape>')
        + f'<shape type="cube" id="cube">{far}</shape>'
        + ball.format("matte", *right, 16, '<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>')
        + '<emitter type="constant"><rgb name="radiance" value="9"/></emitter>'
        + '<emitter type="point"><point name="position" x="{}" y="{}" z="{}"/>'.format(*lamp)
        + f'<rgb name="intensity" value="{STRENGTH}"/></emitter>'
    )

    def rename(text):
        return text.replace('id="object"', 'id="pot"').replace('id="cube"', 'id="object"')

    path = write_scene(tmp_path, (56, 40), (25, 28), extra=extra, edit=rename, aim=(0, 0, 0))
    sky = environment(tmp_path, lambda up: 0 * up + 0.1)
    render.main([str(run), str(path), str(tmp_path / "out"), "--envmap", str(sky), "--format", "exr", "--spp", "512"])
    shot = loading.load_capture(path, images=False).shots[0]
    picture = read(tmp_path / "out" / "000.exr")

    def pixel(point):
        return np.floor(project(shot, point)[0]).astype(int)

    x, y = pixel(left)
    np.testing.assert_allclose(picture[y, x], 0.7, rtol=0.01)
    np.testing.assert_allclose(picture[1, 1], 0.1, rtol=0.01)
    for middle, radius, albedo in ((right, 16, 0.5), (MIDDLE, RADIUS, ALBEDO)):
        x, y = pixel(middle)
        normal = normal_in(shot, x, y, middle, radius)
        expected = albedo * (0.1 + irradiance(lamp, middle + radius * normal, normal) / np.pi)
        np.testing.assert_allclose(picture[y, x], expected, rtol=0.06)  # the balls light each other a little


@pytest.mark.parametrize("shadows", ["true", "false"])
def test_path_sees_the_photographs_own_lights(tmp_path, run, shadows):
    """By hand, at the point nearest to the camera; and as `photometric`, all over a convex object."""
    path = write_scene(tmp_path, (56, 40), (50, 55), aim=(0, 0, 0), edit=lambda text: text.replace(
        '"photometric"/>', f'"photometric"><boolean name="shadows" value="{shadows}"/></integrator>'))  # fmt: skip
    for name in ("path", "photometric"):
        options = ["--integrator", name, "--format", "exr", "--spp", "256"]
        render.main([str(run), str(path), str(tmp_path / name), *options])
    for k, shot in enumerate(loading.load_capture(path, images=False).shots):
        pictures = [read(tmp_path / name / f"{k:03}.exr") for name in ("path", "photometric")]
        x, y = np.floor(project(shot, MIDDLE)[0]).astype(int)
        normal = normal_in(shot, x, y, MIDDLE, RADIUS)
        expected = ALBEDO / np.pi * irradiance(LIGHTS[k], MIDDLE + RADIUS * normal, normal)
        for picture in pictures:
            np.testing.assert_allclose(picture[y, x], expected, rtol=0.02)
            assert picture[0, 0].max() == 0
        mean = pictures[1].mean()
        assert abs(pictures[0] - pictures[1]).mean() < 0.05 * mean  # pixels' filters differ at the outline
        assert pictures[0].mean() == pytest.approx(mean, rel=0.01)


def test_a_fitted_object_beside_others_in_a_scene_of_ones_own(tmp_path, run):
    """Under a sky: it has its albedo, hides what is behind it, and darkens the ground that it stands on."""
    ground = mi.ScalarTransform4f().translate((MIDDLE - [0, RADIUS, 0]).tolist()).rotate([1, 0, 0], -90).scale(500)
    eye = MIDDLE + np.array([0, 40, -150])
    camera = mi.ScalarTransform4f().look_at(eye.tolist(), MIDDLE.tolist(), [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "object": {"type": "shapenet", "weights": str(run), "subdivisions": 4, "flash": False,
                   "bsdf": {"type": "cooktorrance"}},
        "ground": {"type": "rectangle", "to_world": ground,
                   "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3}}},
        "sky": {"type": "constant"},
        "camera": {"type": "perspective", "fov": 60, "to_world": camera,
                   "film": {"type": "hdrfilm", "width": 56, "height": 40}},
    })  # fmt: skip
    assert not any(isinstance(emitter, Flash) for emitter in scene.emitters())
    picture = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=512))[..., :3]
    local = mi.ScalarTransform4f().look_at(eye.tolist(), MIDDLE.tolist(), [0, 1, 0]).inverse()

    def at(point):
        x, y, z = np.array(local @ mi.ScalarPoint3f(*map(float, point)))
        focal = 28 / np.tan(np.radians(30))
        return picture[int(20 - focal * y / z), int(28 - focal * x / z)]

    top = MIDDLE + RADIUS * np.array([0, 1, 0])
    np.testing.assert_allclose(at(top - [0, 0.5, 8]), ALBEDO, rtol=0.1)  # sees the sky alone, all but a little
    # Of the sky over a point of the ground at distance d the sphere takes the share (R / D)² cos θ: a form factor.
    for d in (25.0, 40.0):
        point = MIDDLE + np.array([d, -RADIUS, 0])
        square = d**2 + RADIUS**2
        hidden = RADIUS**2 / square * RADIUS / np.sqrt(square)
        np.testing.assert_allclose(at(point), 0.3 * (1 - hidden), rtol=0.05)


# Files


def test_pictures_are_called_as_the_scene_or_the_format_says(tmp_path, run):
    path = write_scene(tmp_path, edit=lambda text: text.replace("001.png", "001.exr").replace("002.png", "002.JPG"))
    render.main([str(run), str(path), str(tmp_path / "a"), "--spp", "4"])
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["000.png", "001.exr", "002.JPG"]
    render.main([str(run), str(path), str(tmp_path / "b" / "c"), "--spp", "4", "--format", "exr"])
    assert sorted(p.name for p in (tmp_path / "b/c").iterdir()) == ["000.exr", "001.exr", "002.exr"]
    np.testing.assert_allclose(read(tmp_path / "a" / "001.exr"), read(tmp_path / "b/c" / "001.exr"), rtol=1e-5)
    linear = read(tmp_path / "b/c" / "000.exr")
    assert linear.max() > 0.05 and linear.shape == (5, 7, 3)
    np.testing.assert_allclose(read(tmp_path / "a" / "000.png"), encoded(linear), atol=0.51)
    np.testing.assert_allclose(read(tmp_path / "a" / "002.JPG").shape, (5, 7, 3))


def test_a_film_plays_in_browsers_and_shows_the_pictures(tmp_path, run):
    path = write_scene(tmp_path, (57, 41))
    common = [str(run), str(path)]
    options = ["--turntable", "7", "--spp", "4"]
    render.main([*common, str(tmp_path / "new" / "film.MP4"), *options, "--fps", "12.5"])
    render.main([*common, str(tmp_path / "pictures"), *options])
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["film.MP4"]
    film = imageio.get_reader(tmp_path / "new" / "film.MP4", format="FFMPEG")
    about = film.get_meta_data()
    assert about["codec"] == "h264" and about["fps"] == 12.5
    assert about["pix_fmt"].startswith("yuv420p") and "bt709/bt709/iec61966-2-1" in about["pix_fmt"]
    assert about["size"] == (58, 42)
    pictures = [picture for picture in film]  # list() believes its length, which is infinite
    film.close()
    assert len(pictures) == 7
    content = (tmp_path / "new" / "film.MP4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # plays before all of it is there
    for k, picture in enumerate(pictures):
        expected = read(tmp_path / "pictures" / f"{k:03}.png")
        difference = picture[:41, :57] - expected
        assert abs(difference).mean() < 3 and abs(difference.mean((0, 1))).max() < 0.7  # colours at half the resolution
        np.testing.assert_allclose(picture[41, :57], picture[40, :57], atol=16)


def test_a_film_of_photographs_shows_them_as_their_camera_records_them(tmp_path, run):
    def darker(text):
        return text.replace("</sensor>", '<string name="gain" value="0.4"/></sensor>')

    path = write_scene(tmp_path, (64, 48), (120.0, 120.0), edit=darker, aim=(0.0, 0.0, 0.0))
    render.main([str(run), str(path), str(tmp_path / "film.mp4"), "--spp", "4"])
    render.main([str(run), str(path), str(tmp_path / "pictures"), "--spp", "4", "--format", "png"])
    film = imageio.get_reader(tmp_path / "film.mp4", format="FFMPEG")
    for k, picture in enumerate(film):
        expected = read(tmp_path / "pictures" / f"{k:03}.png")
        assert expected.mean() > 10 and abs(picture.mean() - expected.mean()) < 1
    film.close()


def test_an_interrupted_film_leaves_the_old_one(tmp_path, run, capsys):
    film = tmp_path / "film.mp4"
    film.write_bytes(b"before")

    def pictures(error):
        yield np.random.default_rng(1).random((40, 56, 3))
        raise error

    for error in (KeyboardInterrupt(), MemoryError()):
        with pytest.raises(type(error)):
            write_film(pictures(error), film, (56, 40), 24)
        assert film.read_bytes() == b"before" and {p.name for p in tmp_path.iterdir()} == {"film.mp4", "ring.pt"}
    assert capsys.readouterr().err == f"{film}: interrupted; no film is written\n"


@contextlib.contextmanager
def small_files(size):
    """No file may grow beyond `size` bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("count", [3, 300])
def test_a_film_that_does_not_fit_on_the_disk_is_one_line(tmp_path, count):
    """Of few pictures nothing is written before the last."""
    film = tmp_path / "film.mp4"
    film.write_bytes(b"before")
    random = np.random.default_rng(1)
    with small_files(4000), pytest.raises(InputError) as error:
        write_film((random.random((40, 56, 3)) for _ in range(count)), film, (56, 40), 24)
    message = str(error.value)
    assert "film.mp4: cannot be written" in message and "\n" not in message and len(message) < 400
    assert film.read_bytes() == b"before" and [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    with pytest.raises(InputError, match="cannot be written"):
        write_film(iter([]), tmp_path / "gone" / "film.mp4", (56, 40), 24)


def second(old, new):
    """Change what is said of the second photograph."""

    def edit(text):
        head, tail = text.split('id="001"')
        assert old in tail
        return head + 'id="001"' + tail.replace(old, new, 1)

    return edit


#: Options, what is done to the scene, words of the complaint.
BROKEN = {
    "two films": (["--turntable", "3", "--flow", "2"], str, ["--turntable", "--flow", "one"]),
    "fewer than no pictures": (["--light-orbit", "-3"], str, ["--light-orbit", "-3"]),
    "a view without a film": (["--view", "001.png"], str, ["--view", "--turntable"]),
    "a view that is none": (["--flow", "3", "--view", "009.png"], str, ["scene.xml", "--view", "009.png", "000.png"]),
    "a moment of all": (["--flow", "3", "--time", "0.5"], str, ["--time", "--flow"]),
    "photographs of another width": (["--width", "9"], str, ["--width", "--turntable"]),
    "no width": (["--flow", "2", "--width", "0"], str, ["--width", "is 0", "8 to 8192"]),
    "too many pictures": (["--turntable", "100000"], str, ["--turntable", "must be 0 to 10000"]),
    "no such environment": (["--envmap", "gone.exr"], str, ["gone.exr", "--envmap", "no such file"]),
    "no samples": (["--spp", "0"], str, ["--spp", "0", "at least 1"]),
    "after the end": (["--time", "1.5"], str, ["--time", "1.5", "0 to 1"]),
    "at no time": (["--time", "nan"], str, ["--time", "nan"]),
    "a still film": (["--fps", "0"], str, ["--fps", "above 0"]),
    "no direction": (["--up", "0", "0", "0"], str, ["--up", "direction"]),
    "NaN for a direction": (["--up", "0", "nan", "0"], str, ["--up", "direction"]),
    "too fine": (["--subdivisions", "9"], str, ["--subdivisions", "0 to 8"]),
    "unknown format": (["--format", "gif"], str, ["--format", "gif"]),
    "unknown integrator": (["--integrator", "pathh"], str, ["--integrator", "pathh"]),
    "no integrator": (["--integrator", "sphere"], str, ["--integrator", "sphere", "path or direct"]),
    "not from the camera": (["--integrator", "ptracer"], str, ["--integrator", "ptracer", "path or direct"]),
    "an integrator with needs": (["--integrator", "aov"], str, ["--integrator", "aov"]),
    "no environment": (["--envmap", "gone.exr"], str, ["gone.exr", "--envmap"]),
    "environment of words": (["--envmap", "words.exr"], str, ["words.exr", "--envmap"]),
    "photometric environment": (["--envmap", "gone.exr", "--integrator", "photometric"], str, ["--integrator", "path"]),
    "a light that is off": (["--envmap", "gone.exr", "--light-orbit", "3"], str, ["--light-orbit", "--envmap"]),
    "names that clash": (["--format", "exr"], second("001.png", "000.jpg"), ["scene.xml", "000.exr", "twice"]),
    "a suffix for nothing": ([], second("001.png", "001.tif"), ["scene.xml", "001.tif", "--format"]),
    "format of a film": (["--format", "exr", "OUT.mp4"], str, ["--format", "exr", ".mp4"]),
    "film of two sizes": (["OUT.mp4"], second('"width" value="7"', '"width" value="9"'),
                          ["scene.xml", "(7, 5)", "(9, 5)"]),
    "film onto a folder": (["--flow", "2", "FOLDER.mp4"], str, ["FOLDER.mp4", "is a folder"]),
    "onto a file": (["words"], str, ["words", "cannot be written"]),
    "another kind of film": (["words.gif"], str, ["words.gif", "ends in .mp4"]),
    "into a file": (["words.exr/film.mp4"], str, ["film.mp4", "cannot be written"]),
    "onto the photographs": (["images"], str, ["images", "own photographs"]),
    "another run": (["--material", "gone"], str, ["gone", "no such file"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_users_mistake_is_one_line_before_anything_is_written(case, tmp_path, run, monkeypatch):
    options, edit, words = BROKEN[case]
    write_scene(tmp_path, edit=edit)
    for name in ("words", "words.exr"):
        (tmp_path / name).write_text("words")
    (tmp_path / "FOLDER.mp4").mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    places = [o for o in options if o.endswith(".mp4") or o == "images" or (o in ("words", "words.gif"))]
    rest = [o for o in options if o not in places]
    with pytest.raises(InputError) as error:
        render.main(["ring.pt", "scene.xml", *(places or ["out"]), *rest])
    message = str(error.value)
    assert "\n" not in message and all(word in message for word in words), message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("folder", "words"), [("run", "--integrator: x: "), ("nothing", "nothing: no such file")])
def test_its_status_is_2(folder, words, tmp_path, run, capsys):
    (tmp_path / "run").symlink_to(run)
    arguments = [str(tmp_path / folder), str(write_scene(tmp_path)), str(tmp_path / "out"), "--integrator", "x"]
    with pytest.raises(SystemExit) as stop:
        command.run("mi_ring.render", render.main, arguments)
    complaint = capsys.readouterr().err
    assert stop.value.code == 2 and complaint.count("\n") == 1
    assert complaint.startswith("mi_ring.render: ") and words in complaint


def test_pictures_by_other_integrators_are_made_in_passes_of_bounded_size(monkeypatch):
    """Their mean is what many samples at once give, and a pass has no more than so many rays."""
    scene = mi.load_dict({
        "type": "scene", "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}}, "sky": {"type": "constant"},
        "camera": {"type": "photograph", "filename": "none", "fx": 9.0, "fy": 9.0,
                   "to_world": mi.ScalarTransform4f().look_at([0, 0.5, 5], [0.2, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 7, "height": 5}},
    })  # fmt: skip
    integrator, (sensor,) = mi.load_dict({"type": "path"}), scene.sensors()
    genuine, passes = mi.render, []
    monkeypatch.setattr(mi, "render", lambda *a, **k: passes.append((k["spp"], k["seed"])) or genuine(*a, **k))
    whole = camera_paths.render_passes(scene, sensor, integrator, 400, seed=3)
    monkeypatch.setattr(camera_paths, "LANES", 7 * 5 * 150)
    parts = camera_paths.render_passes(scene, sensor, integrator, 400, seed=3)
    assert [spp for spp, _ in passes] == [400, 150, 150, 100] and len({seed for _, seed in passes[1:]}) == 3
    assert whole.shape == parts.shape == (5, 7, 3)
    np.testing.assert_allclose(parts, whole, atol=0.05)
    np.testing.assert_allclose(parts.mean(), whole.mean(), rtol=0.01)
