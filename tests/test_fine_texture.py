"""Textures from photographs at their own size, which may be larger than those of the fit."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from helpers.matte_ball import MATTE, PALE, pale_ball, photographed, plain

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import load_capture
from mi_ring.capture.observation import Observation
from mi_ring.capture.pixels import Pixels
from mi_ring.capture.reduction import reduced
from mi_ring.fitting import fine_texture
from mi_ring.fitting.config import Config
from mi_ring.fitting.surface_ratios import LowPass, PatchRatios, Points, Ratios, bilinear
from mi_ring.fitting.validation import texture_helps
from mi_ring.nets.brdf_net import BRDFNet, Parameter
from mi_ring.objects.detail import Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import EditedMaterial
from mi_ring.objects.ring_file import compact, ring_of, ring_state
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.output.atlas import reflectances
from mi_ring.output.exporting import resolution_of
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface
from mi_ring.scene.mesh_texture import remove_texture
from mi_ring.scene.shot import Response
from mi_ring.scene.tone_curve import ToneCurve


def printed(points):
    """Reflectance (V, 3) at points of the unit sphere: waves 12 pixels long in photographs of 160 pixels."""
    x, y, z = points.T
    return PALE * (1 + 0.5 * np.sin(33 * x + 3 * z + 1) * np.sin(31 * y - 2))[:, None]


def sharpened(capture, ring, width=40, fitted=range(100)):
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    fitted = [k for k in fitted if k < len(capture)]
    return fine_texture.sharpened(capture, capture, capture, surface, ring, fitted, width)


@pytest.fixture(scope="module")
def print_scene(tmp_path_factory):
    return photographed(tmp_path_factory.mktemp("print"), printed)


@pytest.fixture(scope="module")
def sharp(print_scene):
    return sharpened(load_capture(print_scene, width=40), pale_ball())


def on_the_ball(count=4000):
    points = np.random.default_rng(3).normal(size=(count, 3))
    return (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)


def test_print_that_the_fit_has_not_seen_is_found(sharp):
    """Photographs of 160 px, a fit of 40 px, in which the waves are 3 pixels long."""
    s = on_the_ball()
    found = reflectances(sharp, s)["diffuse"] / MATTE - 1
    true = printed(s) / PALE - 1
    for channel in range(3):
        assert np.corrcoef(found[:, channel], true[:, channel])[0, 1] > 0.99
        assert (found * true).sum() / (true**2).sum() == pytest.approx(1, abs=0.1)


def test_meshes_keep_the_colours_that_they_can_show(sharp):
    s = torch.from_numpy(on_the_ball())
    np.testing.assert_allclose(sharp.material(s)["diffuse"].detach(), plain(s) / np.pi, rtol=1e-5)


def test_pictures_and_maps_show_it(sharp, print_scene):
    capture = load_capture(print_scene)
    surface = Surface(capture.scene, capture.shape, sharp)
    surface.show(sharp, *sharp.domain.sample(5))
    pictures = [prediction.draw(surface, capture.photograph(0))[0][0].numpy() for _ in range(2)]
    diffuse = prediction.maps(surface, capture.photograph(0))["diffuse"][0]
    remove_texture(surface.shape)
    plain = prediction.draw(surface, capture.photograph(0))[0][0].numpy()
    seen = capture.observe([0]).rgb[0].numpy()
    inside = plain.min(-1) > 0.1 * np.quantile(plain, 0.9)
    textured, smooth = (
        np.square(np.log(picture[inside] / seen[inside])).mean() ** 0.5 for picture in (pictures[0], plain)
    )
    assert textured < 0.06 < 0.2 < smooth
    np.testing.assert_array_equal(pictures[1], pictures[0])
    ratio = (diffuse / MATTE)[inside] / (pictures[0] / np.maximum(plain, 1e-9))[inside]
    assert np.quantile(np.abs(ratio - 1), 0.99) < 0.1  # maps are those of pixel centres


def test_held_out_photographs_decide(sharp, print_scene):
    """The texture stays; the opposite of it, as of photographs in wrong places, does not. Without any, it stays."""
    capture, ring = load_capture(print_scene, width=160), pale_ball()
    wrong = copy.deepcopy(sharp)
    wrong.brdf_net.grid.values[0].data.neg_()
    surface = Surface(capture.scene, capture.shape, ring)
    problem = SimpleNamespace(held_out=np.array([1, 6]), config=Config(widths=(40, 80, 160)))
    assert texture_helps(problem, capture, surface, ring, sharp)
    assert not texture_helps(problem, capture, surface, ring, wrong)
    none = SimpleNamespace(held_out=np.array([], int), config=problem.config)
    assert texture_helps(none, capture, surface, ring, wrong)


class Doubled(EditedMaterial):
    """A material with a texture that doubles the albedo."""

    def texture(self, s):
        return torch.full_like(s, 2.0)

    def texture_cell(self):
        return 0.1


def test_it_is_as_strong_at_outlines(print_scene):
    """A texture that doubles the albedo doubles the pixels of a matte ball."""
    capture, ring = load_capture(print_scene), pale_ball()
    surface = Surface(capture.scene, capture.shape, ring)
    surface.show(ring, *ring.domain.sample(5))
    plain, coverage = prediction.draw(surface, capture.photograph(0))
    ring.brdf_net = Doubled(ring.brdf_net, {}, {})
    surface.show(ring, *ring.domain.sample(5))
    double, _ = prediction.draw(surface, capture.photograph(0))
    outline = (coverage > 0.3) & (coverage < 0.9) & (plain > 0).all(-1)
    assert outline.sum() > 50
    np.testing.assert_allclose(double[outline], 2 * plain[outline], rtol=1e-4)
    with torch.no_grad():
        surface.write(*ring(ring.domain.sample(5)[0]))  # without the texture, which belongs to what `show` has shown
    np.testing.assert_allclose(prediction.draw(surface, capture.photograph(0))[0], plain, rtol=1e-4)


def test_a_photograph_that_misses_the_object_does_no_harm(print_scene):
    capture = load_capture(print_scene, width=40)
    shot = capture.shots[3]
    turned = shot.camera.to_world.copy()
    turned[:3, :3] = turned[:3, :3] @ np.diag([-1, 1, -1])
    away = replace(shot, camera=shot.camera._replace(to_world=turned))
    changed = replace(capture, shots=[*capture.shots[:3], away, *capture.shots[4:]])
    assert isinstance(sharpened(changed, pale_ball()).brdf_net, SharpenedMaterial)


def test_photographs_in_wrong_places_hardly_count(tmp_path):
    """Two of sixteen, off by four pixels. If they counted as the others do, the error would be 0.32."""
    capture = load_capture(photographed(tmp_path, printed, 16), width=40)
    shots, wrong = list(capture.shots), (3, 10)
    for k in wrong:
        pose = shots[k].camera.to_world.copy()
        pose[:3, 3] += 4 * 3 / 300 * (pose[:3, 0] * np.cos(k) + pose[:3, 1] * np.sin(k))
        shots[k] = replace(shots[k], camera=shots[k].camera._replace(to_world=pose))
    s = on_the_ball()
    true = printed(s) / PALE - 1

    def error(fitted):
        ring = sharpened(replace(capture, shots=shots), pale_ball(), fitted=fitted)
        return np.square(reflectances(ring, s)["diffuse"] / MATTE - 1 - true).mean() ** 0.5 / true.std()

    best = error([k for k in range(16) if k not in wrong])
    assert best < 0.11
    assert error(range(16)) < best + 0.05


def test_it_does_not_change_highlights(sharp, print_scene):
    """Where nothing is matte, there is nothing to see of a texture."""
    capture, ring = load_capture(print_scene), ring_of(ring_state(sharp))
    surface = Surface(capture.scene, capture.shape, ring)
    with torch.no_grad():
        last = [p for p in ring.brdf_net.parameters() if p.shape == (5,)][-1]
        last.copy_(torch.tensor([-30.0, -30.0, -30.0, 0.0, 0.0]))
    surface.show(ring, *ring.domain.sample(5))
    pictures = [prediction.draw(surface, capture.photograph(0))[0][0].numpy() for _ in range(2)]
    remove_texture(surface.shape)
    plain = prediction.draw(surface, capture.photograph(0))[0][0].numpy()
    assert plain.max() > 0.1
    for picture in pictures:  # the second shows that the first has brought the highlights back
        np.testing.assert_allclose(picture, plain, atol=1e-6)


def test_exported_textures_are_as_fine_as_it(sharp):
    """The ball has an area of 4 π: of 2048² texels, three fifths of which show it, each is 0.0022 wide."""
    assert resolution_of(pale_ball()) == 2048
    for cell, resolution in ((0.0024, 2048), (0.0021, 4096)):
        grid = Grid.around(torch.zeros(1, 3), cell, 1, 3)
        ring = pale_ball()
        ring.brdf_net = EditedMaterial(SharpenedMaterial.of(ring.brdf_net, grid), {}, {})
        assert resolution_of(ring) == resolution


def test_a_ball_of_one_colour_keeps_it(tmp_path):
    """Though its surface has ripples that the fit has not found, which darken and brighten it."""

    def rippled(points):
        return points * (1 + 0.004 * np.sin(30 * points[:, :1]) * np.sin(28 * points[:, 1:2]))

    capture = load_capture(photographed(tmp_path, plain, 14, rippled), width=40)
    colours = reflectances(sharpened(capture, pale_ball()), on_the_ball())["diffuse"]
    assert (colours / MATTE).std(0).max() < 0.02


def test_it_is_in_the_file_and_edits_reach_it(sharp):
    s = on_the_ball(500)
    again = ring_of(compact(ring_state(sharp)))
    assert isinstance(again.brdf_net, SharpenedMaterial)
    np.testing.assert_allclose(reflectances(again, s)["diffuse"], reflectances(sharp, s)["diffuse"], atol=2e-3)
    again.brdf_net = EditedMaterial(again.brdf_net, {"diffuse": (0.5, 1.0, 1.0)}, {})
    halved = reflectances(again, s)["diffuse"] / reflectances(sharp, s)["diffuse"]
    np.testing.assert_allclose(halved, np.tile([0.5, 1, 1], (500, 1)), atol=0.02)


def test_high_photographs_are_as_large_as_wide_ones():
    """A reduced one is at most 1.5 times as high as the width says."""
    shots = [SimpleNamespace(window=None, size=size) for size in ((600, 2400), (700, 500))]
    assert fine_texture.texture_width(SimpleNamespace(shots=shots), [0, 1]) == 1600
    assert fine_texture.texture_width(SimpleNamespace(shots=shots), [1]) == 700
    assert fine_texture.texture_width(SimpleNamespace(shots=shots), []) == 0


def test_nothing_changes_without_photographs(print_scene):
    ring, capture = pale_ball(), load_capture(print_scene, width=40)
    assert sharpened(capture, ring, 40, []) is ring
    assert fine_texture.texture_seconds(capture, []) == 0
    twice, once = (fine_texture.texture_seconds(capture, range(n)) for n in (12, 6))
    assert twice == 2 * once > 0


def test_photographs_as_small_as_those_of_the_fit_count(tmp_path):
    """Waves of 6 pixels, of which the fit has found nothing."""

    def fine_print(points):
        return PALE * (1 + 0.3 * np.sin(66 * points[:, :1]))

    ring = sharpened(load_capture(photographed(tmp_path, fine_print)), pale_ball(), 160)
    s = on_the_ball()
    found, true = reflectances(ring, s)["diffuse"] / MATTE - 1, fine_print(s) / PALE - 1
    wide = np.abs(s[:, 0]) < 0.5  # elsewhere they are longer
    assert (found * true)[wide].sum() / (true**2)[wide].sum() == pytest.approx(1, abs=0.25)


def test_parts_of_the_surface_give_the_texture_of_the_whole(print_scene, sharp, monkeypatch):
    monkeypatch.setattr(fine_texture, "AT_ONCE", 1000)
    parts = sharpened(load_capture(print_scene, width=40), pale_ball())
    assert torch.equal(parts.brdf_net.grid.values[0], sharp.brdf_net.grid.values[0])


def test_photographs_in_arrays_give_the_texture_of_those_in_files(print_scene, sharp):
    whole, ring = load_capture(print_scene), pale_ball()
    arrays = Capture.from_arrays(
        [whole.images[k] for k in range(len(whole))], cameras=[shot.camera for shot in whole.shots],
        lights=[shot.light for shot in whole.shots],
    )  # fmt: skip
    before = reduced(arrays, 40)
    surface = Surface(before.scene, before.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    found = fine_texture.sharpened(arrays, before, before, surface, ring, range(len(whole)), 40)
    assert torch.equal(found.brdf_net.grid.values[0], sharp.brdf_net.grid.values[0])


def test_of_many_photographs_some_are_used(print_scene, monkeypatch):
    capture = load_capture(print_scene, width=40)
    monkeypatch.setattr(fine_texture, "MOST_PHOTOGRAPHS", 4)
    assert fine_texture.chosen_photographs(capture, range(12)) == [0, 3, 6, 9]
    assert fine_texture.chosen_photographs(capture, [1, 5, 6]) == [1, 5, 6]
    assert fine_texture.texture_seconds(capture, range(12)) == fine_texture.texture_seconds(capture, range(4))


@pytest.mark.parametrize("name", ["masks", "valid"])
def test_only_valid_pixels_of_the_object_count(print_scene, name):
    capture, ring = load_capture(print_scene, width=40), pale_ball()
    none = Pixels.of([np.zeros(shot.size[::-1], np.uint8) for shot in capture.shots])
    assert sharpened(replace(capture, **{name: none}), ring) is ring


def test_a_material_without_albedo_has_no_texture(print_scene):
    ring = pale_ball()
    ring.brdf_net = BRDFNet(parameters=[Parameter("specular_reflectance", 3, 0.0, 1.0)])
    capture = load_capture(print_scene, width=40)
    assert fine_texture.sharpened(capture, capture, capture, None, ring, range(12), 40) is ring


def test_highlights_are_subtracted_and_strong_ones_left_out(print_scene):
    capture, ring = load_capture(print_scene, width=160), pale_ball()
    with torch.no_grad():
        [p for p in ring.brdf_net.parameters() if p.shape == (5,)][-1][3:] = torch.tensor([0.0, -2.0])
        surface, shot = Surface(capture.scene, capture.shape, ring), capture.shots[0]
        s, faces = ring.domain.sample(5)
        surface.show(ring, s, faces)
        predicted = fine_texture.Predictor(surface, ring, capture).of(shot)
    highlights, diffuse = (torch.from_numpy(picture[None, ..., :3])
                           for picture in (predicted.highlights, predicted.diffuse))  # fmt: skip
    whole = torch.zeros(diffuse.shape, dtype=torch.bool)
    mask = torch.ones(whole.shape[:3])
    seen = Observation(highlights + 2 * diffuse, whole, mask, torch.tensor([False]), None)
    points = Points.of(faces, 1)
    triangles = np.flatnonzero(predicted.visible[faces].all(1))
    photograph = fine_texture.with_usable_pixels(seen)
    logarithms, usable = fine_texture.ratios_of(predicted, photograph, points, triangles, predicted.pixels)
    at = points.at(predicted.pixels, triangles)[:, 0]
    strong = bilinear((highlights > diffuse).any(-1)[0].numpy().astype(np.float32)[..., None], at)[:, 0] == 1
    assert usable.sum() > 1000 and strong.sum() > 20 and not (strong & usable[:, 0]).any()
    np.testing.assert_allclose(logarithms[usable], np.log(2), atol=1e-3)


def test_photographs_are_decoded_with_the_curve_that_the_fit_has_found(print_scene):
    capture = load_capture(print_scene, width=40)
    given = capture.shots[0]
    changed = (replace(given, response=Response(curve)) for curve in (ToneCurve(), ToneCurve(gamma=2)))
    plain, curved = (
        fine_texture.enlarged(capture, capture, 0, *fine_texture.at_width(given, shot, 160)) for shot in changed
    )
    assert plain.rgb.shape == (1, 148, 160, 3)  # what the fit sees at 40 px: whole blocks of 4 × 4 px
    np.testing.assert_allclose(curved.rgb, plain.rgb**0.5, atol=2e-3)


def halves(shown, photographs=8):
    """Ratios at the points of a ball of what `shown(points (N, 3))` returns for each photograph, with its low-pass."""
    s, faces = FittedObject(np.zeros(3), 1.0).domain.sample(5)
    ratios = Ratios(Points.of(faces, 2))
    places = ratios.points.at(s.numpy())
    for photograph in range(photographs):
        ratios.add(photograph % 2, np.arange(len(faces)), shown(places), np.ones(places.shape[:2], np.float32))
    return ratios, LowPass(ratios.points, s, 0.2), places


def test_noise_alone_is_no_texture():
    random = np.random.default_rng(1)
    ratios, low_pass, _ = halves(lambda places: random.normal(0, 0.3, places.shape))
    assert ratios.agreed(low_pass) is None


def test_what_disagrees_is_trusted_less():
    """The fourth of six photographs shows something else, the fifth is only brighter from below."""
    sphere = trimesh.creation.icosphere(4)
    points, rng = Points.of(sphere.faces, 1), np.random.default_rng(1)
    true = rng.normal(size=(len(sphere.faces), 1, 3))
    patches, triangles = PatchRatios(points, sphere.vertices, 6), np.arange(len(sphere.faces))
    for k in range(6):
        found = true + 0.05 * rng.normal(size=true.shape)
        if k == 3:
            found = rng.normal(size=true.shape)
        if k == 4:
            found += 0.1 * sphere.triangles_center[:, None, 2:]
        for part in np.array_split(triangles, 3):
            patches.add(k, part, found[part], np.ones((len(part), 1)))
    assert patches.trust().tolist() == pytest.approx([1, 1, 1, 0.01, 1, 1])


def test_a_label_and_a_sharp_minority_are_no_reason_to_doubt():
    """Photographs that see a print differ more than those that see none. If most are blurred, the sharp ones differ."""
    sphere = trimesh.creation.icosphere(5)
    points, rng = Points.of(sphere.faces, 1), np.random.default_rng(2)
    centres, count = sphere.triangles_center, 24
    printed = centres[:, 2] > 0.5
    labelled, sharp = (PatchRatios(points, sphere.vertices, count) for _ in range(2))
    true = rng.normal(size=(len(sphere.faces), 1, 3))
    for k in range(count):
        toward = rng.normal(size=3)
        shown = np.flatnonzero(centres @ toward / np.linalg.norm(toward) > 0.3)
        noise = rng.normal(size=(len(shown), 1, 3))
        error = np.where(printed[shown, None, None], 0.2, 0.015)
        labelled.add(k, shown, true[shown] * printed[shown, None, None] + error * noise, np.ones((len(shown), 1)))
        contrast = 1.0 if k < 4 else 0.3
        sharp.add(k, shown, contrast * true[shown] + 0.05 * noise, np.ones((len(shown), 1)))
    assert labelled.trust().min() > 0.6
    assert sharp.trust()[:4].tolist() == [1, 1, 1, 1]


def test_equal_photographs_are_trusted(recwarn):
    sphere = trimesh.creation.icosphere(3)
    patches, everywhere = PatchRatios(Points.of(sphere.faces, 1), sphere.vertices, 4), np.arange(len(sphere.faces))
    for k in range(4):
        patches.add(k, everywhere, np.ones((len(everywhere), 1, 3)), np.ones((len(everywhere), 1)))
    assert patches.trust().tolist() == [1, 1, 1, 1]
    assert not recwarn


def test_what_cannot_be_compared_is_trusted():
    sphere = trimesh.creation.icosphere(3)
    patches = PatchRatios(Points.of(sphere.faces, 1), sphere.vertices, 4)
    patches.add(0, np.arange(0), np.zeros((0, 1, 3)), np.zeros((0, 1)))
    for k in (1, 2):
        patches.add(k, np.arange(500), np.random.default_rng(k).normal(size=(500, 1, 3)), np.ones((500, 1)))
    assert patches.trust().tolist() == [1, 1, 1, 1]


def test_what_both_halves_show_is_taken_but_not_what_is_coarse():
    random = np.random.default_rng(1)

    def waves(places):
        return 0.3 * np.sin(60 * places[..., :1])

    ratios, low_pass, places = halves(
        lambda places: waves(places) + 0.5 * places[..., :1] + random.normal(0, 0.3, places.shape)
    )
    values, fine = ratios.agreed(low_pass), waves(places)
    # Wiener's filter: of the mean of eight, noise has 0.3² / 8, the waves have 0.3² / 2.
    share = 0.5 / (0.5 + 1 / 8)
    assert (values * fine).sum() / (3 * (fine**2).sum()) == pytest.approx(share, abs=0.08)
    assert abs((values * places[..., :1]).sum() / (3 * np.square(places[..., 0]).sum())) < 0.03


def test_the_mean_colour_of_a_print_stays():
    """A part is ink, a fifth as bright as the paper."""

    def printed_at(places):
        return np.sin(60 * places[..., :1]) * np.sin(65 * places[..., 1:2] + 1) > 0.4

    def shown(places):
        ratios = np.where(printed_at(places), 0.2, 1)
        return np.log(np.tile(ratios / ratios.mean(), 3))

    ratios, low_pass, places = halves(shown)
    found, ink = np.exp(ratios.agreed(low_pass))[..., 0], printed_at(places)[..., 0]
    assert np.median(found[~ink]) / np.median(found[ink]) == pytest.approx(5, rel=0.02)
    assert found.mean() == pytest.approx(1, abs=0.01)


def test_what_has_nothing_around_it_is_not_coarse():
    """On triangles larger than its cubes, the low-pass finds nothing; all is fine then."""
    ratios, *_ = halves(lambda places: 0.2 * np.sin(9 * places))
    s, _ = FittedObject(np.zeros(3), 1.0).domain.sample(5)
    values = ratios.agreed(LowPass(ratios.points, s, 0.005))
    np.testing.assert_allclose(np.abs(values).max(), 0, atol=0.21)


def test_a_grid_represents_what_points_show():
    """Waves of 0.1 on cubes of 0.02, seen at some triangles only."""
    s, faces = FittedObject(np.zeros(3), 1.0).domain.sample(5)
    ratios = Ratios(Points.of(faces, 3))
    places = ratios.points.at(s.numpy())
    waves = np.sin(2 * np.pi / 0.1 * places) * [0.2, 0.3, 0.1]
    some = np.flatnonzero(places[:, 0, 2] > 0.2)
    for half in range(2):
        ratios.add(half, some, waves[some], np.full((len(some), 9), 0.5 + half, np.float32))
    grid = ratios.texture(s, 0.5, 0.02)
    inside = places[:, 0, 2] > 0.3
    with torch.no_grad():
        found = grid(torch.from_numpy(places[inside].reshape(-1, 3))).numpy()
        assert not grid(torch.tensor([[0.0, 0.0, -1.0]])).any()
    np.testing.assert_allclose(found.std(0), waves[inside].std((0, 1)), rtol=0.05)
    assert np.abs(found - waves[inside].reshape(-1, 3)).mean() < 0.02


@pytest.mark.parametrize("divisions", [1, 2, 5])
def test_points_divide_triangles_evenly(divisions):
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    vertices = np.array([[0, 0, 0], [1, 0, 0.5], [0, 2, 1], [3, 3, 0]])
    points = Points.of(faces, divisions)
    places = points.at(vertices)
    assert places.shape == (2, divisions**2, 3)
    assert len(np.unique(places.reshape(-1, 3).round(5), axis=0)) == 2 * divisions**2
    np.testing.assert_array_equal(points.at(vertices, np.array([1])), places[1:])
    np.testing.assert_allclose(points.shares.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(places.mean(1), vertices[faces].mean(1), rtol=1e-5)
    # The second moment of points at the centres of n² equal parts: that of the triangle, less that of a part.
    spread = np.square(places - vertices[faces].mean(1)[:, None]).sum(2).mean(1)
    whole = np.square(vertices[faces] - vertices[faces].mean(1)[:, None]).sum((1, 2)) / 12
    np.testing.assert_allclose(spread, whole * (1 - divisions**-2), rtol=1e-4, atol=1e-12)


def test_a_picture_is_interpolated_linearly():
    y, x = np.mgrid[:20, :30] + 0.5  # centres of pixels
    picture = np.stack([x, 3 * y, x - y], -1).astype(np.float32)
    at = np.random.default_rng(0).uniform([1, 1], [29, 19], (5000, 2))
    expected = np.stack([at[:, 0], 3 * at[:, 1], at[:, 0] - at[:, 1]], -1)
    assert bilinear(picture, at[:0]).shape == (0, 3)
    np.testing.assert_allclose(bilinear(picture, at), expected, atol=0.12)  # OpenCV has 32 steps a pixel
