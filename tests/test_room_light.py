"""Light of the room: its emitter, the pictures of its harmonics, and whether least squares finds it."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.lit_cup import ALBEDO, CENTER, HEIGHT, INTENSITY, WIDTH, cup, load, material, photograph, pictures

from mi_ring.calibration.room_light import RoomLight
from mi_ring.capture.emitter_elements import room_element, room_elements
from mi_ring.capture.loading import load_capture
from mi_ring.capture.scenefile import recalibrated_xml, scene_bytes
from mi_ring.rendering import indirect_light
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.image_formation import render_photographs
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import (
    BASIS,
    FRAMES,
    MAX_ORDER,
    PER_FRAME,
    frames_of,
    harmonics_up_to,
    room_of,
)
from mi_ring.scene.xml_elements import load_element
from mi_ring.system import machine

LIGHTS = [{"type": "point", "position": p, "intensity": {"type": "rgb", "value": i}}
          for p, i in zip([[0.9, 0.5, 2.0], [-0.6, 0.3, 1.2]], INTENSITY.tolist())]  # fmt: skip
POSES = np.stack([np.array(mi.ScalarTransform4f(photograph(k, LIGHTS[k])["to_world"]).matrix) for k in (0, 1)])


ALL = harmonics_up_to(2, FRAMES)  #: a room beside the photographs' light has no others


def some_room(seed=3, order=2):
    """(BASIS, 3), nowhere negative."""
    harmonics = np.zeros((BASIS, 3))
    which = harmonics_up_to(order, FRAMES)
    harmonics[which] = np.random.default_rng(seed).normal(0, 0.1 / np.sqrt(len(which)), (len(which), 3))
    harmonics[0] += 0.6
    return harmonics


def shown(channels, which=ALL):
    """Pictures (n, 2, H, W, 3) of each harmonic, and as if nothing were in the way, of `render_indirect`'s channels."""
    both = pictures(channels[4:]).reshape(2, HEIGHT, WIDTH, 2, len(which), 3)
    return np.moveaxis(both, (3, 4), (0, 1))


def emitters(room):
    """Of a scene."""
    camera = np.vstack([[[0.1, 0, 0]], room[PER_FRAME:]])  # of what is the same in both frames, a part in each
    world = np.vstack([room[:1] - camera[:1], room[1:PER_FRAME]])
    return {f"room_{frame}": {"type": "room", "frame": frame, "harmonics": " ".join(map(str, harmonics.ravel()))}
            for frame, harmonics in (("world", world), ("camera", camera))}  # fmt: skip


def harmonics(direction):
    """The nine real harmonics by their formulas, toward unit vectors (…, 3)."""
    x, y, z = np.moveaxis(direction, -1, 0)
    first, second = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    return np.stack([
        np.full_like(x, np.sqrt(1 / (4 * np.pi))), -first * y, first * z, -first * x, second * x * y, -second * y * z,
        np.sqrt(5 / (16 * np.pi)) * (3 * z**2 - 1), -second * x * z, second / 2 * (x**2 - y**2),
    ])  # fmt: skip


def test_a_ball_shows_the_convolution_with_the_cosine():
    """Ramamoorthi and Hanrahan 2001: irradiance is the harmonics times π, 2π/3 and π/4 for l = 0, 1 and 2."""
    ball = {"type": "sphere", "center": CENTER.tolist(), "radius": 0.5, "bsdf": material(ALBEDO / np.pi)}
    scene = load(LIGHTS, ball=ball)
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])
    channels = indirect_light.render_indirect(scene, photographs, spp=256, seed=1, rows=ALL)
    images, free = (np.moveaxis(part, 0, 3) for part in shown(channels))
    inside = pictures(channels[:4])[..., 3] == 1
    assert inside[0].sum() > 60 and inside[1].sum() > 60
    decay = np.array([np.pi] + [2 * np.pi / 3] * 3 + [np.pi / 4] * 5)[:, None]
    for k in range(2):
        i, j = np.nonzero(inside[k])
        (fx, fy), (cx, cy) = (66.0, 58.0), (37.2, 26.8)
        local = np.stack([-(j + 0.5 - cx) / fx, -(i + 0.5 - cy) / fy, np.ones(len(i))], 1)
        away = local @ POSES[k][:3, :3].T
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        to_center = CENTER - POSES[k][:3, 3]
        along = away @ to_center
        distance = along - np.sqrt(along**2 - to_center @ to_center + 0.25)
        normal = (POSES[k][:3, 3] + distance[:, None] * away - CENTER) / 0.5
        own = normal @ POSES[k][:3, :3]
        expected = np.concatenate([decay * harmonics(normal), (decay * harmonics(own))[1:]])
        seen = images[k][inside[k]] / (ALBEDO / np.pi)  # (n, harmonics, 3)
        assert np.abs(seen - expected.T[..., None]).max() < 0.02  # but for where in the pixel
        np.testing.assert_allclose(free[k][inside[k]], images[k][inside[k]], rtol=1e-5, atol=1e-6)


def test_the_emitter_is_to_stock_integrators_what_the_harmonics_are_to_ours():
    """A glossy cup with a ball in it, by `path`: the room's light, once reflected and more often."""
    ball = {"type": "sphere", "center": [0.5, -0.3, -0.1], "radius": 0.3, "bsdf": material([0.1, 0.2, 0.2], 0.05)}
    parts = {"cup": cup(material(0.8 * ALBEDO / np.pi, 0.04)), "ball": ball}
    room, which = some_room(order=MAX_ORDER), harmonics_up_to(MAX_ORDER, FRAMES)
    lit, dark = load(LIGHTS, **parts, **emitters(room)), load(LIGHTS, **parts)
    np.testing.assert_allclose(room_of(lit), room, atol=1e-6)
    assert room_of(dark) is None
    photographs = Photographs.of([sensor.shot for sensor in dark.sensors()], room)

    def path(scene, seed):
        integrator = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 100})
        return np.stack([np.array(mi.render(scene, sensor=k, integrator=integrator, spp=64, seed=seed + k))[..., :3]
                         for k in range(2)])  # fmt: skip

    def ours(seed):
        channels = indirect_light.render_indirect(dark, photographs, 64, seed, rows=which)
        return np.einsum("jnhwc,jc->nhwc", shown(channels, which)[0], room[which])

    def regions(picture):
        halves = picture[..., : WIDTH // 2, :], picture[..., WIDTH // 2 :, :]
        return np.stack([half.mean((1, 2)) for half in halves])

    a = np.stack([regions(ours(seed)) for seed in range(5)])
    b = np.stack([regions(path(lit, 100 + 10 * n) - path(dark, 100 + 10 * n)) for n in range(5)])
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 5)
    assert (np.abs(a.mean(0) - b.mean(0)) < 5 * error + 1e-4).all(), (a.mean(0) - b.mean(0)) / error
    assert (error < 0.05 * b.mean(0)).all()


def test_photometric_shows_it_on_the_object_alone_and_has_its_gradient():
    """A convex object, so that light is reflected once; the picture is linear in the harmonics."""
    ball = {"type": "sphere", "center": CENTER.tolist(), "radius": 0.5, "bsdf": material(ALBEDO / np.pi)}
    room = some_room()
    scene = load(LIGHTS, ball=ball, **emitters(room))
    dark = load(LIGHTS, ball=ball)
    photometric = mi.load_dict({"type": "photometric"})
    image = mi.render(scene, sensor=1, integrator=photometric, spp=64, seed=2)
    plain = np.array(mi.render(dark, sensor=1, integrator=photometric, spp=64, seed=2))
    added = np.array(image)[..., :3] - plain[..., :3]
    assert (added[:8] == 0).all() and (added[:, :8] == 0).all()  # beside the object
    channels = indirect_light.render_indirect(
        dark, Photographs.of([sensor.shot for sensor in dark.sensors()]), 64, 5, rows=ALL
    )
    ours = np.einsum("jnhwc,jc->nhwc", shown(channels)[0], room[ALL])[1]
    np.testing.assert_allclose(added.mean((0, 1)), ours.mean((0, 1)), rtol=0.02)

    params = mi.traverse(scene)
    key = "room_camera.harmonics"
    values = np.array(params[key])
    step = 0.02 * np.random.default_rng(5).normal(size=len(values))
    weight = mi.TensorXf(np.random.default_rng(6).normal(1, 0.5, (HEIGHT, WIDTH, 3)).astype(np.float32))

    def loss():
        image = mi.render(scene, params, sensor=1, integrator=photometric, spp=256, seed=2)
        return dr.sum(image[..., :3] * weight, axis=None).array

    sides = []
    for sign in (1, -1):
        params[key] = mi.Float(values + sign * 0.5 * step)
        params.update()
        sides.append(float(loss()[0]))
    params[key] = mi.Float(values)
    dr.enable_grad(params[key])
    params.update()
    dr.backward(loss())
    assert np.array(dr.grad(params[key])) @ step == pytest.approx(sides[0] - sides[1], rel=2e-2)  # other samples


@pytest.mark.parametrize("frames", [("camera",), ("world", "camera")])
def test_least_squares_finds_the_room_among_wrong_pixels(frames):
    """In the axes that it is in; what is not in these stays as it was. What is missing is then as the room makes it.

    Of pictures by `path`, of which some pixels show something else.
    """
    ball = {"type": "sphere", "center": [0.5, -0.3, -0.1], "radius": 0.3, "bsdf": material([0.1, 0.2, 0.2], 0.05)}
    parts = {"cup": cup(material(0.8 * ALBEDO / np.pi, 0.04)), "ball": ball}
    truth, free = some_room(), sorted({k for frame in frames for k in FRAMES[frame]})
    truth[np.setdiff1d(np.arange(BASIS), free)] = 0
    lit, dark = load(LIGHTS, **parts, **emitters(truth)), load(LIGHTS, **parts)
    photographs = Photographs.of([sensor.shot for sensor in dark.sensors()])
    path = mi.load_dict({"type": "path", "max_depth": 5, "rr_depth": 100})
    observed = np.stack([np.array(mi.render(lit, sensor=k, integrator=path, spp=256, seed=k))[..., :3] for k in (0, 1)])
    observed[:, ::9, ::7] *= 30
    observed = torch.from_numpy(observed).to(machine.device())
    direct = torch.from_numpy(pictures(render_photographs(dark, photographs, 64, 0))).to(machine.device())
    room = RoomLight(torch.zeros(BASIS, 3), float(observed.mean()), frames).to(machine.device())
    surface = SimpleNamespace(scene=dark, table=None, unit=1.0)
    for seed in range(6):
        around = GlobalIllumination.of(surface, photographs, direct[..., 3], seed, 70, 64, rows=room.which)
        predicted = direct[..., :3] + around.interreflection
        lit_so_far = replace(photographs, room=room.harmonics.double().cpu().numpy())
        free = torch.from_numpy(pictures(render_photographs(dark, lit_so_far, 64, 0))).to(direct) - direct
        room.solve(around, predicted + free[..., :3], observed, direct[..., 3] > 0.99)
    good = (direct[..., 3] == 1) & ((observed - predicted).abs() < 1).all(-1)
    missing, added = (  # in blocks of 7 × 10 pixels: single ones are noisy
        torch.nn.functional.avg_pool2d((picture * good[..., None]).movedim(-1, 1), (7, 10))
        for picture in (observed - predicted, around.room_light(room.harmonics))
    )
    assert float((added - missing).abs().mean()) < 0.13 * float(missing.abs().mean())
    assert not room.harmonics[truth.sum(1) == 0].any()


def test_without_anything_seen_the_room_is_as_given():
    given = torch.from_numpy(some_room()).float()
    room = RoomLight(given, 0.3, ("world", "camera"))
    dark = torch.zeros(len(ALL), 1, 5, 7, 3)
    around = GlobalIllumination(torch.zeros(1, 5, 7, 3), ALL, dark, dark, torch.ones(1, 5, 7), torch.ones(1, 10, 14),
                                 2)  # fmt: skip
    room.solve(around, torch.zeros(1, 10, 14, 3), torch.ones(1, 10, 14, 3), torch.ones(1, 10, 14) > 0)
    torch.testing.assert_close(room.harmonics, given)


def solved_room(*shares):
    """Light of the room that least squares finds, and the true one, in photographs of which it is these shares."""
    random = torch.Generator().manual_seed(0)
    harmonics = torch.rand(len(ALL), 1, 5, 7, 1, generator=random).expand(-1, -1, -1, -1, 3)
    around = GlobalIllumination(torch.zeros(1, 5, 7, 3), ALL, harmonics, harmonics, torch.ones(1, 5, 7),
                                 torch.ones(1, 10, 14), 2)  # fmt: skip
    truth = torch.from_numpy(some_room()).float()[:, :1].repeat(1, 3)
    truth[PER_FRAME:] = 0
    light = torch.einsum("jnhwc,jc->nhwc", harmonics, truth[ALL])
    truth *= torch.tensor(shares) / light.mean()
    missing = (light * torch.tensor(shares) / light.mean()).repeat_interleave(2, 1).repeat_interleave(2, 2)
    room = RoomLight(torch.zeros(BASIS, 3), 0.3)
    room.solve(around, torch.ones(1, 10, 14, 3), 1 + missing, torch.ones(1, 10, 14) > 0)
    found, missing = (torch.einsum("jnhwc,jc->nhwc", harmonics, part[ALL]) for part in (room.harmonics, truth))
    return room, found, missing


def test_a_room_takes_no_light_away():
    """Photographs that are a little too dark in red, too bright in green and blue."""
    room, found, missing = solved_room(-0.02, 0.3, 0.3)
    assert not room.harmonics[:, 0].any()
    assert float(found[..., 1].mean() / missing[..., 1].mean()) == pytest.approx(1, abs=0.05)
    before = {name: value.clone() for name, value in room.state_dict().items()}
    around = GlobalIllumination(torch.zeros(1, 5, 7, 3), ALL, *(torch.ones(len(ALL), 1, 5, 7, 3) for _ in range(2)),
                                 torch.ones(1, 5, 7), torch.ones(1, 10, 14), 2)  # fmt: skip
    broken = torch.full((1, 10, 14, 3), torch.nan)
    room.solve(around, broken, broken + 1, torch.ones(1, 10, 14) > 0)  # a photograph that is no number tells nothing
    assert all(torch.equal(value, before[name]) for name, value in room.state_dict().items())


@pytest.mark.parametrize(("field", "value"), [("frame", "lamp"), ("harmonics", "0.1 0.1"), ("harmonics", "a " * 27)])
def test_wrong_fields_are_named(field, value):
    good = {"type": "room", "harmonics": " ".join(["0.1"] * 27)}
    with pytest.raises((ValueError, RuntimeError), match=field):
        mi.load_dict(good | {field: value})


@pytest.mark.parametrize("frames", [("world",), ("camera",), ("world", "camera")])
def test_a_scene_says_in_which_axes_its_room_is(frames):
    room = some_room()
    room[np.setdiff1d(np.arange(BASIS), [k for frame in frames for k in FRAMES[frame]])] = 0
    written = {str(k): load_element(element) for k, element in enumerate(room_elements(room))}
    scene = load(LIGHTS, **written)
    assert frames_of(scene) == set(frames)
    np.testing.assert_allclose(room_of(scene), room, atol=1e-6)
    assert frames_of(load(LIGHTS)) == {"world"}


@pytest.mark.parametrize("light", [0.0, 0.3])
def test_a_turntable_stays_one_though_its_room_is_dark_or_alike_from_all_sides(small_capture, light):
    """It is told by a room in the camera's axes."""
    sensors = load_capture(small_capture, images=False).shots
    root = ElementTree.fromstring(small_capture.read_bytes())
    root.append(room_element("camera", np.zeros((PER_FRAME, 3))))
    room = np.zeros((BASIS, 3))
    room[0] = light
    fitted = ElementTree.fromstring(recalibrated_xml(scene_bytes(root), sensors, room))
    assert [string.get("value") for string in fitted.findall("emitter/string[@name='frame']")] == ["camera"]
