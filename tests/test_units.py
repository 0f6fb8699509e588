"""Degenerate geometry and extreme units of length: numbers are finite, and do not depend on the unit."""

import re
import shutil

import numpy as np
import pytest
import torch
from helpers.bumpy_ball import COUNT, OFF_CAMERA, Setting, tensor

from mi_ring.capture.loading import load_capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import unit_for
from mi_ring.system.machine import threads_of

UNITS = [1e-12, 1e-9, 1e-6, 1e6, 1e9, 1e12]


def in_units(scene, folder, unit):
    """A copy of a capture whose lengths are this many times as large as numbers; its pictures stay the same."""
    shutil.copytree(scene.parent, folder)

    def pose(match):
        matrix = np.array(match[2].split(), float).reshape(4, 4)
        matrix[:3, 3] *= unit
        return match[1] + " ".join(map(repr, matrix.ravel().tolist())) + '"'

    def place(match):
        return "{}{!r}{}{!r}{}{!r}".format(*(float(x) * unit if k % 2 else x for k, x in enumerate(match.groups())))

    text = re.sub(r'(<matrix value=")([^"]*)"', pose, scene.read_text())
    text = re.sub(r'(<point name="position" x=")([^"]*)(" y=")([^"]*)(" z=")([^"]*)', place, text)
    text = re.sub(r'(name="intensity" value=")([^"]*)', lambda m: f"{m[1]}{float(m[2]) * unit**2!r}", text)
    (folder / scene.name).write_text(text)
    return folder / scene.name


def first_losses(scene):
    """Of three iterations, and how far the surface has moved then, in radii."""
    settings = dict(
        iterations=3, levels=(2,), widths=(28,), shares=(1.0,), batch=4, subdivisions=2, domain="sphere",
        refine=("light", "power"),
    )  # fmt: skip
    capture = load_capture(scene)
    with threads_of(1):
        fit = Fit(capture, Config(**settings, deterministic=True))
        losses = [it.loss for it in fit]
        s, _ = fit.ring.domain.sample(2)
        with torch.no_grad():
            moved = (fit.ring.surface(s) - fit.ring.center) / fit.ring.radius
    return losses, moved.numpy()


def test_a_fit_does_not_depend_on_the_unit_of_length(small_capture, tmp_path):
    """With light and power refined: losses and surface as in units of 1.

    What float32 rounds moves samples across edges, in units of 0.03 as well: 0.4 % of the loss.
    """
    losses, surface = first_losses(small_capture)
    assert np.isfinite(losses).all()
    for unit in (1e-9, 1e9):
        own, other = first_losses(in_units(small_capture, tmp_path / f"{unit:g}", unit))
        np.testing.assert_allclose(own, losses, rtol=1e-2)
        np.testing.assert_allclose(other, surface, atol=1e-2)


class Alone(Setting):
    """The bumpy ball as a ring has it, which may be drawn in a unit of its own."""

    def __init__(self, unit):
        super().__init__(OFF_CAMERA, shadows=True, unit=unit)
        self.surface.unit = unit_for(unit)


@pytest.fixture(scope="module")
def usual():
    return gradients(Alone(1.0))


def gradients(setting, vertices=None):
    """Pictures, and gradients [per unit] by vertices and material, of both losses together."""
    vertices = (setting.vertices if vertices is None else vertices).clone().requires_grad_()
    material = {name: value.clone().requires_grad_() for name, value in setting.material.items()}
    rgb, alpha = prediction.render(setting.surface, setting.photographs, vertices, material, 4, 3, setting.shadows)
    ((setting.radiance_weight * rgb).sum() + (setting.coverage_weight * alpha).sum()).backward()
    return rgb.detach(), vertices.grad * setting.unit, [value.grad for value in material.values()]


@pytest.mark.parametrize("unit", UNITS)
def test_pictures_and_gradients_do_not_depend_on_the_unit_of_length(unit, usual):
    rgb, by_vertices, by_material = gradients(Alone(unit))
    np.testing.assert_allclose(rgb.numpy(), usual[0].numpy(), atol=2e-3 * float(usual[0].max()))
    assert (by_vertices - usual[1]).norm() < 2e-3 * usual[1].norm()
    for own, expected in zip(by_material, usual[2]):
        assert (own - expected).norm() < 2e-3 * expected.norm()


def degenerate(name, setting):
    """Vertices of the ball, with something wrong, or the setting with its lights elsewhere."""
    vertices = setting.vertices.clone()
    faces = np.asarray(setting.faces)
    ball = vertices.mean(0)
    if name == "a triangle that is a point":
        vertices[faces[40]] = vertices[faces[40, 0]].clone()
    elif name == "a triangle that is a line":
        vertices[faces[40, 2]] = (vertices[faces[40, 0]] + vertices[faces[40, 1]]) / 2
    elif name == "all vertices in one point":
        vertices[:] = ball
    elif name == "a flat surface":
        vertices[:, 2] = ball[2]
    elif name == "a vertex on the camera":
        vertices[7] = tensor(setting.scene.sensors()[0].camera.position)
    elif name == "a surface around the camera":
        vertices += tensor(setting.scene.sensors()[0].camera.position) - ball
    elif name == "needles":
        vertices[::9] = ball + 100 * (vertices[::9] - ball)
    return vertices


@pytest.mark.parametrize("name", [
    "a triangle that is a point", "a triangle that is a line", "all vertices in one point", "a flat surface",
    "a vertex on the camera", "a surface around the camera", "needles",
])  # fmt: skip
def test_degenerate_surfaces_have_finite_gradients(name):
    setting = Setting(OFF_CAMERA, shadows=True)
    rgb, by_vertices, by_material = gradients(setting, degenerate(name, setting))
    assert rgb.isfinite().all() and by_vertices.isfinite().all() and all(g.isfinite().all() for g in by_material)


@pytest.mark.parametrize("where", ["on a vertex", "inside a triangle", "grazing"])
def test_lights_on_the_surface_have_finite_gradients(where):
    base = Setting([None, None], shadows=False)
    corners = base.vertices[torch.as_tensor(np.asarray(base.faces[40]))].cpu().numpy().astype(float)
    place = {"on a vertex": corners[0], "inside a triangle": corners.mean(0)}.get(where)
    if place is None:  # in the plane of a triangle
        place = corners[0] + 3 * (corners[1] - corners[0])
    light = {"type": "point", "position": place.tolist(), "intensity": {"type": "rgb", "value": [2.0, 1.5, 1.0]}}
    rgb, by_vertices, by_material = gradients(Setting([light, light], shadows=True))
    assert rgb.isfinite().all() and by_vertices.isfinite().all() and all(g.isfinite().all() for g in by_material)
    assert len(rgb) == COUNT
