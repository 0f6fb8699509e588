"""The cone of a flash and the contrast of a camera, solved from brightness within photographs."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.quick_fits import posed

from mi_ring.calibration.camera_response import contrast_slope
from mi_ring.capture.observation import Observation
from mi_ring.fitting.brightness_solver import BrightnessSolver, flash_slope, least_squares
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.processes import ALONE
from mi_ring.fitting.schedule import Stage
from mi_ring.scene.tone_curve import contrasted

INDEX = np.arange(12)


@pytest.fixture
def fit(small_capture):
    return posed(small_capture, refine=("falloff",))[0]


def rays(fit):
    """Directions (12, H, W, 3) of the pixels in the axes of their cameras, by the cameras' own rays."""
    result = []
    for k in INDEX:
        camera = fit.capture.shots[k].camera
        width, height = camera.size
        v, u = np.mgrid[:height, :width] + 0.5
        world = camera.directions(np.stack([u.ravel(), v.ravel()], 1))
        result.append((world / np.linalg.norm(world, axis=1, keepdims=True)) @ camera.to_world[:3, :3])
    return torch.from_numpy(np.stack(result)).float().view(len(INDEX), height, width, 3)


def places(fit, apart):
    """Places (12, H, W, 2) of pixels beside the middle of a round object, which is not in the middle of photographs.

    In radii of the object. `apart`: its largest distance from the optical axis.
    """
    middles = apart * torch.rand(len(INDEX), 1, 1, 2, generator=torch.Generator().manual_seed(2)) - apart / 2
    return (rays(fit)[..., :2] - middles) / 0.15


def discs(fit, apart):
    """Squared distances (12, H, W) from the middle of that object, in its radii."""
    return places(fit, apart).square().sum(-1)


def balls(fit, apart):
    """Normals (12, H, W, 3) of that object as a ball, in the axes of the cameras."""
    sides = places(fit, apart)
    return torch.cat([sides, -(1 - sides.square().sum(-1, keepdim=True)).clamp(min=0.04).sqrt()], -1)


def matte(fit, normals, left=0.0, up=0.0):
    """Brightness (12, H, W) of matte points in the distance of the object, under a flash beside the camera."""
    v = torch.tensor([left, up, 0.0]) - rays(fit)
    return (normals * v).sum(-1).clamp(min=0.05) / v.norm(dim=-1) ** 3


def solved(fit, picture, photographed, inside, rounds=40, noise=0.1, looks=0):
    """Exponent, tilts and logarithm of the contrast that are found.

    `picture`, `photographed` (12, H, W): without the cone and the contrast that the fit has.
    """
    calibration, random = fit.model.calibration, torch.Generator().manual_seed(1)
    solver, directions = BrightnessSolver(calibration), rays(fit)
    solver.state[solver.first]["looks"] += looks
    batch = SimpleNamespace(progress=0.5, photographs=INDEX, all_photographs=INDEX, scale=1,
                            share=ALONE.share(len(INDEX)), stage=Stage(2, 28, 0, 9))  # fmt: skip
    inside = inside.float()
    for _ in range(rounds):
        exponent, left, up, contrast = solver.numbers()
        x, y, cosine = directions.unbind(-1)
        shown = contrasted(picture * cosine**exponent * (left * x + up * y).exp(), contrast.exp())
        error = (noise * torch.randn(picture.shape, generator=random)).exp()
        clipped = torch.zeros(*picture.shape, 3, dtype=torch.bool)
        seen = Observation((photographed * error)[..., None].expand(-1, -1, -1, 3), clipped, inside,
                           torch.ones(len(INDEX)).bool(), None)  # fmt: skip
        prediction = SimpleNamespace(rgb=shown[..., None].expand(-1, -1, -1, 3), coverage=inside,
                                     normals=in_world(fit, balls(fit, 0.4)))  # fmt: skip
        solver.look(Iteration(batch, seen, prediction, fit.context()))
        solver.step()
    return solver.numbers().numpy()


def in_world(fit, vectors):
    """Turn vectors (12, H, W, 3) from the cameras' axes to those of the world."""
    cameras = torch.from_numpy(np.stack([fit.capture.shots[k].camera.to_world for k in INDEX])).float()
    return torch.einsum("nij,nhwj->nhwi", cameras[:, :3, :3], vectors)


def texture(fit):
    x, y, _ = rays(fit).unbind(-1)
    return 0.3 * (1.5 * torch.sin(40 * x + 3 * torch.arange(12.0)[:, None, None]) * torch.cos(31 * y + 1)).exp()


@pytest.mark.parametrize("cone", [(12.0, 0.9, -1.4), (0.0, 0.0, 0.0), (1.5, 0.0, 0.2)], ids=["narrow", "none", "phone"])
def test_a_cone_is_found_whatever_each_photographs_exposure(fit, cone):
    x, y, cosine = rays(fit).unbind(-1)
    exponent, left, up = cone
    exposures = torch.linspace(0.6, 1.8, 12)[:, None, None]
    photographed = exposures * texture(fit) * cosine**exponent * (left * x + up * y).exp()
    found = solved(fit, texture(fit), photographed, discs(fit, 0.4) < 1, noise=0.02)
    np.testing.assert_allclose(found, [*cone, 0], rtol=0.05, atol=0.2)


def test_a_cone_is_found_beside_a_flash_whose_place_is_wrong(small_capture):
    """By a tenth of the distance. If the place counted as known, the tilt would be wrong by more than two."""
    fit, _ = posed(small_capture, refine=("falloff", "light"))
    fit.model.calibration.rig.flash.zero_()
    normals, (x, y, cosine) = balls(fit, 0.4), rays(fit).unbind(-1)
    assumed, lit = (texture(fit) * matte(fit, normals, *place) for place in ((0.0, 0.0), (0.08, -0.06)))
    photographed = lit * cosine**12.0 * (0.9 * x - 1.4 * y).exp()
    found = solved(fit, assumed, photographed, discs(fit, 0.4) < 0.9, noise=0.02)
    np.testing.assert_allclose(found, [12, 0.9, -1.4, 0], rtol=0.05, atol=0.3)


def test_slope_by_the_flashs_place_is_that_of_matte_brightness(fit):
    """By finite differences, in points with normals of all sides."""
    fit.model.calibration.rig.flash.zero_()
    normals = torch.nn.functional.normalize(balls(fit, 0.4) + torch.tensor([0.3, -0.2, -0.4]), dim=-1)
    found = flash_slope(fit.model.calibration, INDEX, rays(fit), in_world(fit, normals))
    lit = -(normals * rays(fit)).sum(-1) > 0.25
    for k, step in enumerate(([0.01, 0.0], [0.0, 0.01])):
        low, high = (matte(fit, normals, *(sign * s for s in step)).log() for sign in (-1, 1))
        torch.testing.assert_close(found[..., k][lit], ((high - low) / 0.02)[lit], rtol=2e-3, atol=2e-3)


def test_a_contrast_is_solved_for_in_no_more_than_eighty_iterations(small_capture):
    fit, _ = posed(small_capture, refine=("contrast",))
    shown, inside = texture(fit).clamp(max=0.9), discs(fit, 0.4) < 1
    now = solved(fit, shown, contrasted(shown, 1.25), inside, rounds=1, looks=79)
    np.testing.assert_array_equal(solved(fit, shown, contrasted(shown, 1.25), inside, rounds=2, looks=80), now)
    assert now[3] > 0.05


@pytest.mark.parametrize("contrast", [1.25, 1.0, 0.9])
def test_a_contrast_is_found_whatever_each_photographs_exposure(small_capture, contrast):
    """A flatter curve is not looked for: a surface that is not right yet looks like one."""
    fit, _ = posed(small_capture, refine=("contrast",))
    exposures = torch.linspace(0.4, 1.6, 12)[:, None, None]
    photographed = contrasted((exposures * texture(fit)).clamp(max=0.9), contrast)
    shown = (exposures * texture(fit)).clamp(max=0.9)  # of known powers
    found = solved(fit, shown, photographed, discs(fit, 0.4) < 1, noise=0.02)
    np.testing.assert_allclose(np.exp(found), [1, 1, 1, max(contrast, 1)], rtol=0.01)


def test_rims_that_are_darker_than_predicted_are_no_contrast(small_capture):
    fit, _ = posed(small_capture, refine=("contrast",))
    squared = discs(fit, 0.4)
    found = solved(fit, texture(fit), texture(fit) * (-0.7 * squared).exp(), squared < 1, noise=0.03)
    np.testing.assert_allclose(found, 0, atol=0.02)


@pytest.mark.parametrize("gamma", [1.0, 1.3])
def test_slope_by_the_contrast_is_the_difference_of_two_curves(fit, gamma):
    """Of values without the gain and the vignetting that the capture knows: the curve sees both."""
    values, cosines = torch.linspace(0.0005, 0.9, 120).view(2, 5, 4, 3), torch.linspace(0.8, 1, 40).view(2, 5, 4, 1)
    gains = torch.rand(12, 3, generator=torch.Generator().manual_seed(1)) + 0.1
    response = fit.model.calibration.rig.response._replace(
        gammas=torch.full((12,), gamma), gains=gains, known_vignetting=torch.full((12,), 1.5))  # fmt: skip
    low, high = (response._replace(contrast=torch.tensor(c)).recorded(values, [4, 7], cosines).log()
                 for c in (-0.01, 0.01))  # fmt: skip
    found = contrast_slope(values, response, np.array([4, 7]), cosines)
    torch.testing.assert_close(found, (high - low) / 0.02, rtol=1e-3, atol=1e-3)


def test_rims_that_are_darker_than_predicted_are_no_cone(fit):
    """By half; and by a contrast that the prediction lacks. Alone, the first looks like an exponent of 62."""
    squared = discs(fit, 0.4)
    ball = texture(fit) ** 0.3 * (1.2 - squared).clamp(min=0.03)
    found = solved(fit, ball, ball**1.3 * (-0.7 * squared).exp(), squared < 1, noise=0.03)
    np.testing.assert_allclose(found, 0, atol=1)


def test_a_cone_that_photographs_do_not_tell_stays_as_the_scene_says(fit):
    """The object is always in the middle: darker rims and a cone are the same."""
    squared, (_, _, cosine) = discs(fit, 0.0), rays(fit).unbind(-1)
    found = solved(fit, texture(fit), texture(fit) * cosine**6, squared < 1)
    np.testing.assert_allclose(found, 0, atol=0.8)


def test_the_flash_of_a_camera_on_its_side_has_the_same_cone(fit):
    """The tilt is in the axes of a camera that is held upright."""
    turned = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    fit.model.calibration.rig.held = turned.expand(len(fit.capture), 3, 3).clone()
    x, y, _ = rays(fit).unbind(-1)
    left, up = (turned[:2, :2] @ torch.tensor([0.8, -0.5])).tolist()
    # One step: the rays of `rays` are not turned, so `solved` cannot show what the fit predicts after it.
    lit = texture(fit) * (left * x + up * y).exp()
    found = solved(fit, texture(fit), lit, discs(fit, 0.4) < 1, rounds=1, noise=0)
    assert found[1] / found[2] == pytest.approx(0.8 / -0.5, rel=0.05) and found[1] > 0


def test_covariance_is_that_of_errors_which_a_photographs_pixels_share():
    """By 2,000 repetitions: each photograph has a slope of its own."""
    random = np.random.default_rng(0)
    found, stated = [], []
    for _ in range(2000):
        x = random.normal(size=(30, 50))
        y = 1.5 * x + 0.4 * random.normal(size=(30, 1)) * x + 0.1 * random.normal(size=x.shape)
        moments = torch.from_numpy(np.stack([(x * x).mean(1), (x * y).mean(1)], 1))[:, None]
        solution, covariance = least_squares(moments)
        found.append(float(solution))
        stated.append(float(covariance))
    assert np.mean(found) == pytest.approx(1.5, abs=0.01)
    assert np.sqrt(np.mean(stated)) == pytest.approx(np.std(found), rel=0.06)
