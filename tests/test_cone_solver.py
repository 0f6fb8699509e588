"""The cone of a flash, solved from brightness within photographs: known cones, no cone, and darker rims."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.quick_fits import posed

from mi_ring.capture.observation import Observation
from mi_ring.fitting.cone_solver import ConeSolver
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.processes import ALONE
from mi_ring.fitting.schedule import Stage

INDEX = np.array([4, 7, 2, 9])


@pytest.fixture
def fit(small_capture):
    return posed(small_capture, refine=("falloff",))[0]


def rays(fit):
    """Directions (4, H, W, 3) of the pixels in the axes of their cameras, by the cameras' own rays."""
    result = []
    for k in INDEX:
        camera = fit.capture.shots[k].camera
        width, height = camera.size
        v, u = np.mgrid[:height, :width] + 0.5
        world = camera.directions(np.stack([u.ravel(), v.ravel()], 1))
        result.append((world / np.linalg.norm(world, axis=1, keepdims=True)) @ camera.to_world[:3, :3])
    return torch.from_numpy(np.stack(result)).float().view(len(INDEX), height, width, 3)


def solved(fit, picture, photographed, rounds=40, noise=0.1):
    """Exponent and tilts that are found. `picture`, `photographed` (4, H, W): without the cone that the fit has."""
    calibration, random = fit.model.calibration, torch.Generator().manual_seed(1)
    solver, directions = ConeSolver(calibration), rays(fit)
    batch = SimpleNamespace(progress=0.5, photographs=INDEX, scale=1, share=ALONE.share(len(INDEX)),
                            stage=Stage(2, 28, 0, 9))  # fmt: skip
    inside = torch.ones(picture.shape)
    for _ in range(rounds):
        exponent, left, up = solver.numbers()
        x, y, cosine = directions.unbind(-1)
        shown = picture * cosine**exponent * (left * x + up * y).exp()
        error = (noise * torch.randn(picture.shape, generator=random)).exp()
        clipped = torch.zeros(*picture.shape, 3, dtype=torch.bool)
        seen = Observation((photographed * error)[..., None].expand(-1, -1, -1, 3), clipped, inside,
                           torch.ones(len(INDEX)).bool(), None)  # fmt: skip
        prediction = SimpleNamespace(rgb=shown[..., None].expand(-1, -1, -1, 3), coverage=inside)
        solver.look(Iteration(batch, seen, prediction, fit.context()))
        solver.step()
    return solver.numbers().numpy()


def texture(fit):
    x, y, _ = rays(fit).unbind(-1)
    return 0.3 * (1.5 * torch.sin(40 * x + 3 * torch.arange(4.0)[:, None, None]) * torch.cos(31 * y + 1)).exp()


@pytest.mark.parametrize("cone", [(12.0, 0.9, -1.4), (0.0, 0.0, 0.0), (1.5, 0.0, 0.3)], ids=["narrow", "none", "phone"])
def test_a_cone_is_found_whatever_each_photographs_exposure(fit, cone):
    x, y, cosine = rays(fit).unbind(-1)
    exponent, left, up = cone
    exposures = torch.tensor([1.3, 0.7, 1.0, 1.8])[:, None, None]
    photographed = exposures * texture(fit) * cosine**exponent * (left * x + up * y).exp()
    np.testing.assert_allclose(solved(fit, texture(fit), photographed), cone, rtol=0.03, atol=0.15)


def test_rims_that_are_darker_than_predicted_are_no_cone(fit):
    """A ball in the middle of the photograph, whose photograph has more contrast: a factor of log radiance."""
    x, y, _ = rays(fit).unbind(-1)
    ball = 0.3 * (1 - (x**2 + y**2) / 0.4).clamp(min=0.03) * texture(fit) ** 0.2
    np.testing.assert_allclose(solved(fit, ball, ball**1.4, noise=0.02), 0, atol=0.15)


def test_the_flash_of_a_camera_on_its_side_has_the_same_cone(fit):
    """The tilt is in the axes of a camera that is held upright."""
    calibration = fit.model.calibration
    turned = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    calibration.rig.held = turned.expand(len(fit.capture), 3, 3).clone()
    x, y, _ = rays(fit).unbind(-1)
    left, up = (turned[:2, :2] @ torch.tensor([0.8, -0.5])).tolist()
    # One step: the rays of `rays` are not turned, so `solved` cannot show what the fit predicts after it.
    found = solved(fit, texture(fit), texture(fit) * (left * x + up * y).exp(), rounds=1, noise=0)
    assert found[1] / found[2] == pytest.approx(0.8 / -0.5, rel=0.02) and found[1] > 0
