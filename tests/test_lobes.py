"""Small lights of a room: their reflection in closed form, their shadows, and whether a fit finds them."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.bumpy_ball import Setting, tensor
from helpers.lit_cup import ALBEDO, HEIGHT, INTENSITY, WIDTH, cup, load, material, pictures
from helpers.unknown_light import TINY, TOWARD

import mi_ring
from mi_ring import synthesize
from mi_ring.calibration.room_light import LOBE_RIDGE, RIDGE, RoomLight
from mi_ring.capture.emitter_elements import room_elements
from mi_ring.capture.scenefile import scene_bytes
from mi_ring.fitting import schedule, small_lights
from mi_ring.fitting.lighting import Lighting
from mi_ring.fitting.refinement import finds_small_lights
from mi_ring.images import write_image
from mi_ring.plugins.matte_reflection import softened_cosine, zonal_coefficients
from mi_ring.rendering import indirect_light, lobe_light, prediction
from mi_ring.rendering.lobe_light import LobeLight, sample_lobe
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS, envmap_directions, room_envmap
from mi_ring.scene.lobes import Lobes, lobes_of

GLOSS = 0.1  #: specular reflectance of the ball
LIGHTS = [{"type": "point", "position": p, "intensity": {"type": "rgb", "value": i}}
          for p, i in zip([[0.9, 0.5, 2.0], [-0.6, 0.3, 1.2]], INTENSITY.tolist())]  # fmt: skip


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


def disc(direction, sharpness, count=250):
    """Directions (n, 3) and shares (n,) of a von Mises–Fisher distribution, by equal steps of its two angles."""
    share = (np.arange(count) + 0.5) / count
    cosine = 1 + np.log(share + (1 - share) * np.exp(-2 * sharpness)) / sharpness
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    across = unit(*np.cross(direction, [0.3, 0.5, 0.8]))
    t, a = np.repeat(cosine, count)[:, None], np.tile(turn, count)[:, None]
    around = np.cos(a) * across + np.sin(a) * np.cross(direction, across)
    return t * direction + np.sqrt(1 - t**2) * around


def seen_from(viewer, lanes=1):
    """A surface interaction whose normal is z."""
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.wi = mi.Vector3f(*map(float, viewer))
    si.sh_frame, si.n, si.t = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1), dr.ones(mi.Float, lanes)
    return si


def surface(roughness, diffuse=0.0, specular=0.1, rough_diffuse=0.0, distribution="ggx"):
    return mi.load_dict({
        "type": "cooktorrance", "diffuse": {"type": "rgb", "value": [diffuse, 0.5 * diffuse, 0.0]},
        "specular": specular, "roughness": roughness, "diffuse_roughness": rough_diffuse,
        "distribution": distribution,
    })  # fmt: skip


@pytest.mark.parametrize(("sharpness", "order"), [(0.7, 3), (20.0, 7), (900.0, 12)])
def test_zonal_coefficients_are_mean_legendre_polynomials(sharpness, order):
    x, weight = np.polynomial.legendre.leggauss(500)
    density = weight * np.exp(sharpness * (x - 1))
    polynomials = [np.polynomial.Legendre.basis(degree)(x) for degree in range(order + 1)]
    expected = [(density * values).sum() / density.sum() for values in polynomials]
    np.testing.assert_allclose(zonal_coefficients(np.array([sharpness]), order)[:, 0], expected, rtol=1e-6)


@pytest.mark.parametrize("sharpness", [3.0, 40.0, 2500.0])
def test_a_matte_surface_integrates_the_cosine(sharpness):
    for height in (-0.5, -0.02, 0.3, 0.9):
        direction = np.array([np.sqrt(1 - height**2), 0, height])
        expected = np.maximum(disc(direction, sharpness)[:, 2], 0).mean()
        assert float(softened_cosine(mi.Float(height), mi.Float(sharpness))[0]) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize(("roughness", "sharpness", "error"), [
    (0.1, 2000, 0.03), (0.2, 200, 0.04), (0.4, 30, 0.06), (0.7, 30, 0.06), (0.2, 30, 0.11),
])  # fmt: skip
def test_a_glossy_surface_integrates_its_highlight(roughness, sharpness, error, distribution):
    """Relative root mean square over directions of the light, beside the integral over the light's directions."""
    bsdf, ours, true = surface(roughness, distribution=distribution), [], []
    for viewer in (0.1, 0.8):
        for angle in np.linspace(-1.2, 1.2, 9):
            direction = unit(-np.sin(angle), 0.1, np.cos(angle))
            si = seen_from([np.sin(viewer), 0, np.cos(viewer)])
            ours.append(float(bsdf.reflected_lobe(si, mi.Vector3f(*direction.tolist()), mi.Float(sharpness))[0][0]))
            toward = disc(direction, sharpness).astype(np.float32)
            si = seen_from([np.sin(viewer), 0, np.cos(viewer)], len(toward))
            true.append(np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*toward.T)))[0].mean())
    ours, true = np.array(ours), np.array(true)
    assert np.sqrt(((ours - true) ** 2).mean() / (true**2).mean()) < error


def test_a_rough_matte_surface_integrates_its_brdf():
    bsdf, direction = surface(0.3, 0.4, 0.0, 0.8), unit(-0.4, 0.3, 0.8)
    toward = disc(direction, 50.0).astype(np.float32)
    for viewer in ([0.3, 0.1, 0.95], [0.8, 0, 0.6]):
        ours = bsdf.reflected_lobe(seen_from(unit(*viewer)), mi.Vector3f(*direction.tolist()), mi.Float(50.0))
        true = bsdf.eval(mi.BSDFContext(), seen_from(unit(*viewer), len(toward)), mi.Vector3f(*toward.T))
        np.testing.assert_allclose(np.array(ours).ravel(), np.array(true).mean(1), rtol=0.02, atol=1e-6)


def test_gradients_of_a_reflected_lobe_are_finite_differences():
    """By direction, sharpness, roughness and the normal's tilt."""
    bsdf = surface(0.35, 0.3, 0.08)
    start = np.array([-0.5, 0.2, 25.0, 0.35, 0.05])

    def reflected(values):
        x, y, sharpness, roughness, tilt = values
        mi.traverse(bsdf)["roughness.value"] = roughness
        si = seen_from(unit(0.4, 0.1, 0.9))
        normal = dr.normalize(mi.Vector3f(tilt, 0.02, 1))
        si.sh_frame = mi.Frame3f(normal)
        si.wi = si.to_local(mi.Vector3f(*unit(0.4, 0.1, 0.9).tolist()))
        direction = dr.normalize(mi.Vector3f(x, y, 0.9))
        return dr.sum(bsdf.reflected_lobe(si, direction, sharpness) * mi.Color3f(1, 2, 3))

    values = [mi.Float(v) for v in start]
    dr.enable_grad(values)
    dr.backward(reflected(values))
    ours = np.array([float(dr.grad(v)[0]) for v in values])
    steps = np.array([0.02, 0.02, 1.0, 0.02, 0.02])
    theirs = []
    for k, step in enumerate(steps):
        sides = [reflected([mi.Float(v) for v in start + sign * step * np.eye(5)[k]]) for sign in (1, -1)]
        theirs.append((float(sides[0][0]) - float(sides[1][0])) / (2 * step))
    np.testing.assert_allclose(ours, theirs, rtol=0.05, atol=1e-4)


def test_drawn_directions_have_the_density_of_the_lobe():
    """Their mean cosine is coth κ − 1/κ, and their mean the direction."""
    random = np.random.default_rng(0).random((2, 200_000)).astype(np.float32)
    direction = unit(0.3, -0.5, 0.6)
    for sharpness in (2.0, 500.0):
        drawn = sample_lobe(mi.Vector3f(*direction.tolist()), mi.Float(sharpness), mi.Point2f(*random))
        mean = np.array(drawn).mean(1)
        np.testing.assert_allclose(mean, (1 / np.tanh(sharpness) - 1 / sharpness) * direction, atol=4e-3)


def test_the_emitter_is_to_stock_integrators_what_lobes_are_to_ours():
    """A glossy cup with a ball in it: light in both axes, with shadows and interreflection."""
    ball = {"type": "sphere", "center": [0.5, -0.3, -0.1], "radius": 0.3, "bsdf": material([0.1, 0.2, 0.2], 0.05)}
    parts = {"cup": cup(material(0.8 * ALBEDO / np.pi, 0.04)), "ball": ball}
    rooms = {
        "a": {"type": "room", "harmonics": "0 0 0", "lobes": "0.5 0.6 1 60 4 5 6  -1 .3 .8 25 2 1 1"},
        "b": {"type": "room", "harmonics": "0 0 0", "frame": "camera", "lobes": ".1 .9 -1.2 40 3 4 8"},
    }
    lit, dark = load(LIGHTS, **parts, **rooms), load(LIGHTS, **parts)
    photographs = Photographs.of([sensor.shot for sensor in dark.sensors()], None, lobes_of(lit))
    which = photographs.room_rows
    assert which == [BASIS, BASIS + 1, BASIS + 2]

    def path(scene, seed):
        integrator = mi.load_dict({"type": "path", "max_depth": 4, "rr_depth": 100})
        return np.stack([np.array(mi.render(scene, sensor=k, integrator=integrator, spp=64, seed=seed + k))[..., :3]
                         for k in range(2)])  # fmt: skip

    channels = indirect_light.render_indirect(dark, photographs, 64, 1, rows=which)
    both = np.moveaxis(pictures(channels[4:]).reshape(2, HEIGHT, WIDTH, 2, 3, 3), (3, 4), (0, 1))
    ours, once = np.einsum("sjnhwc,jc->snhwc", both, photographs.room_strengths[which]).mean((2, 3))
    theirs = (path(lit, 7) - path(dark, 7)).mean((1, 2))
    np.testing.assert_allclose(ours, theirs, rtol=0.04)
    assert (once < 0.9 * ours).all()  # interreflection counts


def test_gradients_of_pictures_by_directions_and_sharpness(monkeypatch):
    """Against central differences with the same random numbers. Gradients leave shadows out, so there are none."""
    monkeypatch.setattr(lobe_light, "light_visible", lambda scene, si, ds, active=True: mi.Bool(True))
    setting = Setting([None, None], shadows=False)
    lobes = Lobes(np.stack([unit(0.4, 0.5, 1), unit(-1, 0.2, 0.7)]), np.array([30.0, 8.0]),
                  np.array([[2.0, 1, 1], [0.5, 1, 2]]), np.array([False, True]))  # fmt: skip
    photographs = replace(setting.photographs, lobes=LobeLight.of(lobes))

    def loss(toward, sharpness):
        rgb, _ = prediction.render(setting.surface, photographs, setting.vertices, setting.material, 4, 3, False,
                                   lobes=[toward, sharpness])  # fmt: skip
        return (setting.radiance_weight * rgb).sum()

    toward, sharpness = tensor(lobes.toward).requires_grad_(), tensor(lobes.sharpness).requires_grad_()
    loss(toward, sharpness).backward()
    with torch.no_grad():
        for value, at, step in ((toward, (0, 1), 0.02), (toward, (1, 0), 0.02), (sharpness, (0,), 1.0)):
            sides = []
            for sign in (1, -1):
                changed = value.clone()
                changed[at] += sign * step
                sides.append(float(loss(*[changed if v is value else v for v in (toward, sharpness)])))
            assert float(value.grad[at]) == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=0.05, abs=0.05)


def test_scene_files_say_lobes_and_environment_maps_show_them():
    toward = np.stack([unit(0.3, -0.4, 0.5), unit(0, 0.8, -0.6), unit(1, 1, 0)])
    lobes = Lobes(
        toward,
        np.array([90.0, 7.0, 300.0]),
        np.array([[1.0, 2, 3], [0.3, 0.2, 0.1], [0.5, 0.5, 0.4]]),
        np.array([False, True, False]),
    )
    room = np.zeros((BASIS, 3))
    room[0] = 0.2
    root = ElementTree.Element("scene", version="3.0.0")
    root.extend(room_elements(room, (), lobes))
    read = lobes_of(mi.load_string(scene_bytes(root).decode(), parallel=False))
    order = np.argsort(lobes.in_camera, kind="stable")
    for name, value in vars(lobes).items():
        np.testing.assert_allclose(getattr(read, name), value[order], rtol=1e-5)
    _, angles = envmap_directions(256)
    pose = np.eye(4)
    pose[:3, :3] = pose[[2, 0, 1], :3]
    radiance = room_envmap(0 * room, pose, 256, lobes).reshape(-1, 3)
    np.testing.assert_allclose(angles @ radiance, lobes.flux.sum(0), rtol=1e-3)
    away, _ = envmap_directions(256)
    only = room_envmap(0 * room, pose, 256, lobes.selected(lobes.in_camera)).reshape(-1, 3)
    assert away[only[:, 0].argmax()] @ (pose[:3, :3] @ lobes.toward[1]) > 0.999


@pytest.mark.parametrize(("lobes", "message"), [
    ("1 0 0 20 1 1", "must be 0 or 7"), ("0 0 0 20 1 1 1", "must not be 0"), ("1 0 0 0 1 1 1", "sharpness is 0"),
    ("1 0 0 20 1 -1 1", "must not be negative"),
])  # fmt: skip
def test_wrong_lobes_are_refused(lobes, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "room", "harmonics": "0 0 0", "lobes": lobes})


def test_fluxes_are_not_negative():
    """Of two lobes one would need to be negative: the solution is that of the other alone."""
    room = RoomLight(torch.zeros(BASIS, 3), 1.0, ("world",), True)
    random = np.random.default_rng(0)
    basis = torch.from_numpy(random.random((60, 4)))
    seen = basis @ torch.tensor([0.5, 0.2, 0.9, -0.4], dtype=torch.float64)
    rows = torch.tensor([0, 1, BASIS, BASIS + 1])
    matrix, vector = torch.zeros_like(room.matrix).double(), torch.zeros_like(room.vector).double()
    for colour in range(3):
        matrix[colour, rows[:, None], rows], vector[colour, rows] = basis.T @ basis, basis.T @ seen
    harmonics, flux = room.solved_with_lobes(matrix, vector, [0, 1], 2)
    assert (flux[1] == 0).all()
    used = basis[:, :3].numpy()
    gram = used.T @ used
    ridge = [RIDGE * (gram[0, 0] + gram[1, 1]) / len(room.used)] * 2 + [LOBE_RIDGE * gram[2, 2]]
    expected = np.linalg.solve(gram + np.diag(ridge), used.T @ seen.numpy())
    np.testing.assert_allclose(np.append(harmonics[:, 1], flux[0, 1]), expected, rtol=1e-5)


LAMP = 60 * 2 * np.pi * (1 - np.cos(np.radians(5)))  #: flux of the lamp of `in_the_sun`, in light of 0.3
SHARE = LAMP / (LAMP + 0.3 * 4 * np.pi)


@pytest.fixture(scope="module")
def in_the_sun(tmp_path_factory):
    """Path of a scene of a glossy ball in grey light with a small lamp toward `TOWARD`, of which it says nothing."""
    folder = tmp_path_factory.mktemp("sun")
    trimesh.creation.icosphere(subdivisions=4).export(folder / "ball.ply")
    away, _ = envmap_directions(64)
    radiance = 0.3 + 60 * (away @ TOWARD > np.cos(np.radians(5)))
    write_image(radiance.reshape(64, 128, 1).repeat(3, -1).astype(np.float32), folder / "sun.exr")
    synthesize.main([
        str(folder / "ball.ply"), str(folder / "capture"), "--views", "10", "--novel", "0", "--size", "40", "32",
        "--spp", "25", "--material", f"cooktorrance diffuse=0.11,0.1,0.09 specular={GLOSS} roughness=0.36",
        "--environment", str(folder / "sun.exr"), "--wrong-room",
    ])  # fmt: skip
    return folder / "capture/scene.xml"


def test_a_search_finds_a_small_light_and_none_in_smooth_light(in_the_sun, in_an_environment, monkeypatch):
    """On the surface from which a fit starts, with the highlights of the ball, or without them."""
    for path, lamps in ((in_the_sun, 1), (in_an_environment, 0)):
        config = mi_ring.Config.preset("fast", **TINY, light="environment")
        fit = mi_ring.Fit(mi_ring.load_capture(path), config, lighting=Lighting("environment"))
        show = fit.renderer.show
        if lamps:
            fit.ring.radius.fill_(50.0)
            fit.ring.center.zero_()

        def glossy(model, level, lamps=lamps, show=show):
            surface = show(model, level)
            count = len(surface.shape.vertex_positions_buffer()) // 3
            surface.write_arrays({"vertex_specular": dr.full(mi.Float, GLOSS * lamps, count)})
            return surface

        fit.renderer.show = glossy
        found = small_lights.find_lobes(fit.problem, fit.model, fit.renderer, 3, 5).lobes
        assert (0 if found is None else len(found)) == lamps
        if found is not None:
            assert np.degrees(np.arccos(found.toward[0] @ TOWARD)) < 4
            assert (found.flux > 0).all() and found.sharpness[0] > 20
            search = small_lights.LobeSearch(fit.problem, fit.model, fit.renderer.show(fit.model, 3), 5)
            assert search.add() and search.share() == pytest.approx(SHARE, abs=0.1)
            with monkeypatch.context() as patch:
                patch.setattr(small_lights, "FIRST", 0.5)  # a fainter one is not believed
                assert small_lights.find_lobes(fit.problem, fit.model, fit.renderer, 3, 5).lobes is None


def test_a_fit_moves_lobes_continues_with_them_and_writes_them(in_the_sun, tmp_path, monkeypatch):
    """From one 10° off. No search helps."""
    monkeypatch.setattr(schedule, "LIGHTS_SOUGHT", ())
    capture = mi_ring.load_capture(in_the_sun)
    config = mi_ring.Config.preset("fast", **TINY | {"iterations": 3}, light="environment")
    fit = mi_ring.Fit(capture, config, lighting=Lighting("environment"))
    start = Lobes(unit(*np.add(TOWARD, [0, 0, 0.18]))[None], np.array([40.0]), np.ones((1, 3)), np.array([False]))
    fit.model.calibration.room.place(start)
    fit.step()
    resumed = mi_ring.Fit(capture, config, state=fit.state())
    assert resumed.step().loss == pytest.approx(fit.step().loss, rel=1e-4)
    found, again = fit.calibrated().lobes, resumed.calibrated().lobes
    np.testing.assert_allclose(again.values(), found.values(), rtol=1e-3, atol=1e-5)
    assert np.abs(found.toward - start.toward).max() > 1e-3 and abs(found.sharpness[0] - 40) > 0.1
    fit.save(tmp_path)
    read = mi_ring.load_capture(tmp_path / "scene.xml", images=False)
    np.testing.assert_allclose(read.lobes.values(), found.values(), rtol=1e-4, atol=1e-6)
    assert "brightest light" in (tmp_path / "report.html").read_text()


def test_none_are_sought_beside_a_flash_and_by_the_papers_method(small_capture):
    config = mi_ring.Config.preset("fast", **TINY)
    assert config.small_lights and not mi_ring.Config.preset("paper").small_lights
    assert not finds_small_lights(mi_ring.Fit(mi_ring.load_capture(small_capture), config).model.calibration, config)


def test_lobes_beside_a_flash_stay_as_given():
    """The normal equations have no rows for them, and nothing of them is trained."""
    lobes = Lobes(unit(1, 2, 3)[None], np.array([50.0]), np.ones((1, 3)), np.array([False]))
    room = RoomLight(torch.zeros(BASIS, 3), 1.0, lobes=lobes)
    assert room.matrix.shape == (3, BASIS, BASIS) and not list(room.parameters())
    np.testing.assert_allclose(room.lobes().values(), lobes.values(), rtol=1e-5)
