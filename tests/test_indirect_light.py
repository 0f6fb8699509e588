"""`render_indirect`: interreflection as in a spherical cup, where it has a closed form, and as in Mitsuba's `path`."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
from helpers.lit_cup import ALBEDO, CENTER, HEIGHT, INTENSITY, RADIUS, SHARE, WIDTH, cup, load, material, pictures

from mi_ring.rendering import indirect_light
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.image_formation import render_photographs
from mi_ring.rendering.photographs import Photographs
from mi_ring.system import machine


@pytest.fixture(scope="module")
def diffuse_cup():
    """A diffuse cup, each photograph with a lamp at the centre of the sphere."""
    lights = [{"type": "point", "position": CENTER.tolist(), "intensity": {"type": "rgb", "value": i}}
              for i in INTENSITY.tolist()]  # fmt: skip
    scene = load(lights, cup=cup(material(ALBEDO / np.pi)))
    return scene, Photographs.of([sensor.shot for sensor in scene.sensors()])


def series(bounces):
    """Radiance (photograph, rgb) of that cup after 1 to `bounces` more reflections.

    Any two points of a sphere see each other under the same conditions: each patch sends the share of its light that
    its area has in the whole sphere's to every place. So all of the cup is equally bright, and
    L = ALBEDO / π · intensity / RADIUS² · Σ (ALBEDO · SHARE)ⁿ.
    """
    direct = ALBEDO / np.pi * INTENSITY / RADIUS**2
    return direct * sum((ALBEDO * SHARE) ** n for n in range(1, bounces + 1))


@pytest.mark.parametrize("bounces", [1, 2, 4])
def test_a_spherical_cup_is_evenly_lit_by_a_geometric_series(bounces, diffuse_cup):
    scene, photographs = diffuse_cup
    picture = pictures(indirect_light.render_indirect(scene, photographs, spp=512, seed=bounces, bounces=bounces))
    inside = picture[..., 3] == 1
    assert 0.3 < inside.mean() < 0.9
    for k, expected in enumerate(series(bounces)):
        # 512 samples, of which a third bring light, in each of a thousand pixels: 0.2 % by chance, 0.05 % by facets.
        np.testing.assert_allclose(picture[k][inside[k], :3].mean(0), expected, rtol=0.008)
        left = picture[k, :, : WIDTH // 2][inside[k, :, : WIDTH // 2], :3].mean(0)
        np.testing.assert_allclose(left, expected, rtol=0.012)


def test_coverage_is_that_of_the_picture_and_the_background_is_black(diffuse_cup):
    scene, photographs = diffuse_cup
    picture = pictures(indirect_light.render_indirect(scene, photographs, spp=9, seed=3))
    direct = pictures(render_photographs(scene, photographs, spp=9, seed=3))
    np.testing.assert_array_equal(picture[..., 3], direct[..., 3])
    assert (picture[picture[..., 3] == 0] == 0).all() and (picture[..., 3] == 0).any()


@pytest.mark.parametrize("light", ["point", "distant"])
def test_it_is_what_path_finds_beyond_direct_light(light):
    """A glossy cup with a ball in it, two photographs under different lamps and a sky, which must not count twice."""
    positions = [[0.9, 0.5, 2.0], [-0.6, 0.3, 1.2]]
    if light == "point":
        lights = [{"type": "point", "position": p, "intensity": {"type": "rgb", "value": i}}
                  for p, i in zip(positions, INTENSITY.tolist())]  # fmt: skip
    else:
        lights = [{"type": "directional", "direction": [-c for c in p], "irradiance": {"type": "rgb", "value": i}}
                  for p, i in zip(positions, INTENSITY.tolist())]  # fmt: skip
    ball = {"type": "sphere", "center": [0.5, -0.3, -0.1], "radius": 0.3,
            "bsdf": material([0.1, 0.2, 0.2], 0.05)}  # fmt: skip
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    scene = load(lights, cup=cup(material(0.8 * ALBEDO / np.pi, 0.04)), ball=ball, sky=sky)
    photographs = Photographs.of([sensor.shot for sensor in scene.sensors()])

    def regions(picture):
        """Means of the left and right halves of each photograph."""
        return np.stack([picture[..., : WIDTH // 2, :3].mean((1, 2)), picture[..., WIDTH // 2 :, :3].mean((1, 2))])

    def path(depth, seed):
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
        return np.stack([np.array(mi.render(scene, sensor=k, integrator=integrator, spp=64, seed=seed + k))[..., :3]
                         for k in range(2)])  # fmt: skip

    ours = np.stack(
        [regions(pictures(indirect_light.render_indirect(scene, photographs, 64, seed))) for seed in range(8)]
    )
    theirs = np.stack([regions(path(5, 100 + 10 * n) - path(2, 500 + 10 * n)) for n in range(8)])
    error = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / 8)
    assert (np.abs(ours.mean(0) - theirs.mean(0)) < 5 * error).all(), (ours.mean(0) - theirs.mean(0)) / error
    assert (error < 0.05 * theirs.mean(0)).all()


def test_a_convex_object_has_none():
    lights = [{"type": "point", "position": [1.0, 2.0, 3.0], "intensity": 4.0}] * 2
    ball = {"type": "shapenet", "subdivisions": 3, "center": CENTER.tolist(), "bsdf": material(ALBEDO, 0.1)}
    scene = load(lights, ball=ball)
    picture = pictures(
        indirect_light.render_indirect(
            scene, Photographs.of([sensor.shot for sensor in scene.sensors()]), spp=64, seed=1
        )
    )
    assert (picture[..., :3] == 0).all() and picture[..., 3].max() == 1


@pytest.mark.parametrize("width", [20, 64])
def test_interreflection_is_spread_over_what_the_object_covers(width, diffuse_cup):
    """Of an evenly lit cup it is even up to the rim, whatever the size at which it is rendered (49 is no multiple)."""
    scene, photographs = diffuse_cup
    photographs = photographs.select([1, 0], (WIDTH, HEIGHT))
    drawn = pictures(render_photographs(scene, photographs, 16, 0))
    coverage = torch.from_numpy(drawn[..., 3]).to(machine.device()).requires_grad_()
    surface = SimpleNamespace(scene=scene, table=None, unit=1.0)
    added = GlobalIllumination.of(surface, photographs, coverage, 5, width, 1024).interreflection
    assert added.shape == (2, HEIGHT, WIDTH, 3)
    for k, expected in zip((0, 1), series(indirect_light.BOUNCES)[::-1]):
        even, found = expected * drawn[k, ..., 3:], added[k].detach().cpu().numpy()
        assert np.abs(found - even).max() < 0.12 * expected.max()
        assert np.abs((found - even).sum((0, 1)) / even.sum((0, 1))).max() < 0.01
    added[0, :, :, 1].sum().backward()
    seen = coverage[0] == 1
    np.testing.assert_allclose(coverage.grad[0][seen].mean().item(), series(indirect_light.BOUNCES)[1, 1], rtol=0.01)


def test_it_can_be_rendered_between_a_picture_and_its_gradient(diffuse_cup):
    """It must not disturb what Dr.Jit has recorded, nor have gradients itself."""
    scene, photographs = diffuse_cup
    params = mi.traverse(scene)
    gradients = []
    for disturb in (False, True):
        positions = mi.Float(dr.detach(params["cup.vertex_positions"]))
        dr.enable_grad(positions)
        params["cup.vertex_positions"] = positions
        params.update()
        channels = render_photographs(scene, photographs, 4, 7)
        dr.eval(channels)
        if disturb:
            extra = indirect_light.render_indirect(scene, photographs, 4, 8)
            dr.eval(extra)
            assert not any(dr.grad_enabled(c) for c in extra)
        dr.backward(channels[0] * dr.linspace(mi.Float, 0, 1, dr.width(channels[0])))
        gradients.append(np.array(dr.grad(positions)))
    assert np.abs(gradients[0]).max() > 0
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-3, atol=1e-5 * np.abs(gradients[0]).max())
