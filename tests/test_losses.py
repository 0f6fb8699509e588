"""The terms of the loss, on numbers that can be checked by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.spatial
import torch
import trimesh

from mi_ring import images
from mi_ring.fitting import losses, priors, terms
from mi_ring.fitting.config import Config
from mi_ring.nets.brdf_net import BRDFNet, Parameter


def pixels(*values):
    """A (1, 1, n, 3) picture of grey pixels."""
    return torch.tensor(values).reshape(1, 1, -1, 1).expand(1, 1, len(values), 3)


NONE = torch.zeros(1, 1, 4, 3, dtype=torch.bool)


def test_rgb_loss_by_hand():
    predicted, observed = pixels(0.1, 0.4, 0.0, 1.0), pixels(0.2, 0.2, 0.0, 0.4)
    # in units of the exposure 0.5: differences -0.2, 0.4, 0, 1.2
    assert losses.rgb_loss(predicted, observed, NONE, 0.5, "l2").item() == pytest.approx((0.04 + 0.16 + 1.44) / 4)
    assert losses.rgb_loss(predicted, observed, NONE, 0.5, "l1").item() == pytest.approx((0.2 + 0.4 + 1.2) / 4)
    log = [math.log1p(8 * p) - math.log1p(8 * o) for p, o in ((0.1, 0.2), (0.4, 0.2), (0, 0), (1.0, 0.4))]
    log = sum(map(abs, log)) / 4
    assert losses.rgb_loss(predicted, observed, NONE, 0.5, "log").item() == pytest.approx(log, rel=1e-5)
    assert losses.rgb_loss(predicted, observed, NONE, 0.5, "l1+log").item() == pytest.approx((0.45 + log) / 2, rel=1e-5)


@pytest.mark.parametrize("kind", ["l2", "l1", "log", "l1+log"])
def test_a_clipped_pixel_says_at_least_this_bright(kind):
    clipped = torch.ones(1, 1, 2, 3, dtype=torch.bool)
    observed = pixels(1.0, 1.0)
    brighter = pixels(1.5, 3.0).clone().requires_grad_()
    loss = losses.rgb_loss(brighter, observed, clipped, 0.3, kind)
    loss.backward()
    assert loss == 0 and (brighter.grad == 0).all()
    assert losses.rgb_loss(pixels(0.9, 1.0), observed, clipped, 0.3, kind) > 0


def test_mask_loss_without_blur_is_the_mean_square():
    coverage = torch.tensor([[[1.0, 0.5], [0.0, 0.0]]])
    mask = torch.tensor([[[1.0, 1.0], [0.0, 1.0]]])
    assert losses.mask_loss(coverage, mask, 0.1).item() == pytest.approx((0.25 + 1) / 4)


def test_blur_is_a_gaussian_and_keeps_the_sum():
    image = torch.zeros(1, 31, 41)
    image[0, 14, 22] = 1.0
    found = images.blur(image, 2.0)[0]
    y, x = torch.meshgrid(torch.arange(31.0) - 14, torch.arange(41.0) - 22, indexing="ij")
    expected = torch.exp(-(x**2 + y**2) / 8) / (2 * math.pi * 4)
    assert found.sum().item() == pytest.approx(1, abs=1e-5)
    # The kernel ends at three standard deviations, which leaves 0.5 % of its mass to the rest.
    torch.testing.assert_close(found[8:21, 16:29], expected[8:21, 16:29], rtol=0.01, atol=0)


def test_blur_takes_zero_for_what_is_outside():
    image = torch.rand(2, 5, 7)
    padded = torch.nn.functional.pad(image, (9, 9, 9, 9))
    torch.testing.assert_close(images.blur(image, 2.5), images.blur(padded, 2.5)[:, 9:-9, 9:-9])


def test_mask_loss_feels_a_mask_it_does_not_touch():
    coverage = torch.zeros(1, 20, 20)
    coverage[0, 10, 5] = 1.0
    coverage.requires_grad_()
    mask = torch.zeros(1, 20, 20)
    mask[0, 10, 11] = 1.0
    losses.mask_loss(coverage, mask, 3.0).backward()
    gradient = coverage.grad[0, 10]
    assert gradient[8] < gradient[2]  # growing toward the mask pays, away from it does not


def test_velocity_loss_of_a_plane_wave_is_its_closed_form():
    k = torch.tensor([3.0, -2.0, 6.0], dtype=torch.float64)
    direction = torch.tensor([0.5, 1.0, -2.0], dtype=torch.float64)
    x = torch.randn(50, 3, dtype=torch.float64)
    alpha = 0.01

    def wave(p):
        return torch.sin(p @ k)[..., None] * direction

    # −Δ sin(k·x) = |k|² sin(k·x), so (I − αΔ)V = (1 + α|k|²) V
    expected = ((1 + alpha * 49) ** 2 * wave(x).square().sum(-1)).mean()
    found = losses.velocity_loss(wave, x, alpha)
    # The stencil's relative error in Δ is about (k h)²/12 = 0.2 %, of which a third counts here.
    assert found.item() == pytest.approx(expected.item(), rel=2e-3)


def test_velocity_loss_without_laplacian_is_the_mean_square():
    x = torch.randn(9, 3)
    assert losses.velocity_loss(lambda p: 2 * p, x, 0.0).item() == pytest.approx(
        (4 * x.square().sum(-1)).mean().item(), rel=1e-6
    )


def test_a_mask_that_is_in_doubt_counts_less_the_more_it_differs():
    """Geman and McClure's loss: as least squares where the difference is small, never above doubt²."""
    mask, coverage = torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.01, 1.0]]])
    for doubt in (0.5, 0.2):
        wanted = (0.01**2 / (1 + (0.01 / doubt) ** 2) + 1 / (1 + 1 / doubt**2)) / 3
        assert losses.mask_loss(coverage, mask, 0.1, doubt=doubt).item() == pytest.approx(wanted)


def test_pixels_that_say_nothing_have_no_part_in_the_mask_loss():
    coverage, mask = torch.tensor([[[0.5, 1.0, 0.0]]]), torch.tensor([[[0.0, 0.0, 0.0]]])
    valid = torch.tensor([[[True, False, True]]])
    assert losses.mask_loss(coverage, mask, 0.1, valid).item() == pytest.approx(0.25 / 3)


def test_pixels_that_say_nothing_have_no_part_in_the_colour_loss():
    predicted, observed = torch.rand(1, 2, 3, 3), torch.rand(1, 2, 3, 3)
    telling = torch.tensor([[[True, False, True], [False, False, True]]])
    clipped = torch.zeros(1, 2, 3, 3, dtype=torch.bool)
    loss = losses.rgb_loss(predicted, observed, clipped, 0.5, "l1", telling)
    expected = sum(
        float((predicted - observed)[0, y, x].abs().sum()) / 0.5 for y in range(2) for x in range(3) if telling[0, y, x]
    )
    assert loss.item() == pytest.approx(expected / 18, rel=1e-5)


# Priors.


def grown(mesh, factor):
    return torch.tensor(factor * mesh.vertices), mesh.faces


@pytest.mark.parametrize("cuts", [0, 3])
def test_variation_of_normals_of_a_box_is_that_of_its_edges(cuts):
    """Twelve edges, at each of which normals are √2 apart, however fine the mesh is."""
    mesh = trimesh.creation.box((2.0, 3.0, 5.0))
    for _ in range(cuts):
        mesh = mesh.subdivide()
    found = priors.variation_of_normals(*grown(mesh, 7.0))
    assert found.item() == pytest.approx(7 * 4 * (2 + 3 + 5) * math.sqrt(2))


@pytest.mark.parametrize("level", [3, 4])
def test_variation_of_normals_of_a_sphere(level):
    found = priors.variation_of_normals(*grown(trimesh.creation.icosphere(subdivisions=level), 3.0))
    assert found.item() == pytest.approx(8 * math.pi * 3, rel=0.03)  # triangles are not quite even


def test_variation_of_a_linear_field_is_its_slope():
    """On a flat sheet of uneven triangles, turned in space; 3 channels, of which one is constant."""
    random = np.random.default_rng(2)
    flat = random.random((60, 2)) * [3, 2]
    faces = scipy.spatial.Delaunay(flat).simplices
    values = np.stack([0.3 * flat[:, 0] - 0.4 * flat[:, 1], np.full(60, 7.0), 2 * flat[:, 1]], 1)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    vertices = torch.tensor(4 * np.pad(flat, ((0, 0), (0, 1))) @ turn.T)  # and four times as large
    found = priors.variation_of_values(vertices, faces, torch.tensor(values))
    assert found.item() == pytest.approx((0.5 + 0 + 2) / 4)


def test_a_step_costs_its_height_however_steep_it_is():
    """Total variation: what is spread over a band costs as much as what is sharp."""
    x = np.linspace(0, 1, 101)
    grid = np.stack(np.meshgrid(x, [0.0, 0.1]), -1).reshape(-1, 2)
    faces = scipy.spatial.Delaunay(grid).simplices
    vertices = torch.tensor(np.pad(grid, ((0, 0), (0, 1))))
    for width in (0.02, 0.2, 0.6):
        ramp = torch.tensor(np.clip((grid[:, :1] - 0.5) / width + 0.5, 0, 1))
        assert priors.variation_of_values(vertices, faces, ramp).item() == pytest.approx(1)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_number_of_bases_counts_materials(count):
    """√k for k orthogonal basis materials of which there is as much of each; less where there is less of one."""
    basis = np.linalg.qr(np.random.default_rng(3).normal(size=(5, 5)))[0][:count]
    mixed = np.repeat(np.eye(count), 40, 0)
    matrix = torch.tensor(6 * mixed @ basis)
    assert priors.number_of_bases(matrix).item() == pytest.approx(math.sqrt(count))
    s = np.array([3.0, 1.0, 0.5])[:count]
    weighed = torch.tensor(mixed * s @ basis)
    assert priors.number_of_bases(weighed).item() == pytest.approx(s.sum() / np.sqrt((s**2).sum()))


def test_gradients_of_priors_are_those_of_finite_differences():
    torch.manual_seed(0)
    mesh = trimesh.creation.icosphere(subdivisions=1)
    vertices = (torch.tensor(mesh.vertices) + 0.1 * torch.randn(42, 3, dtype=torch.float64)).requires_grad_()
    values = torch.rand(42, 5, dtype=torch.float64).requires_grad_()
    check = torch.autograd.gradcheck
    assert check(lambda v: priors.variation_of_normals(v, mesh.faces), vertices)
    assert check(lambda x: priors.variation_of_values(vertices.detach(), mesh.faces, x), values)
    assert check(priors.number_of_bases, values)
    even = torch.ones(42, 5, dtype=torch.float64).requires_grad_()  # where norms are 0
    priors.variation_of_values(vertices.detach(), mesh.faces, even).backward()
    assert (even.grad == 0).all()


def test_columns_are_in_units_of_the_light_or_of_their_range():
    net = BRDFNet(250.0, [Parameter("tint", 3, 0.0, math.inf), Parameter("haze", 1, -0.5, 1.5)])
    material = {"tint": torch.tensor([[250.0, 500.0, 0.0]]), "haze": torch.tensor([1.0])}
    torch.testing.assert_close(priors.columns_of(material, net), torch.tensor([[1.0, 2.0, 0.0, 0.75]]))


def test_priors_are_off_unless_asked_for_and_do_not_depend_on_units():
    names = ["normal_variation", "material_rank"]
    assert all(Config().weights[name] == 0 for name in names)
    mesh = trimesh.creation.icosphere(subdivisions=3)
    for size, scale in ((1.0, 1.0), (50.0, 300.0)):
        ring = SimpleNamespace(radius=torch.tensor(size), brdf_net=BRDFNet(scale))
        tint = torch.tensor(mesh.vertices[:, :1] + 2).expand(-1, 3)
        material = {"diffuse": scale * tint, "specular": scale * tint[:, 0], "roughness": 0.2 * tint[:, 0]}
        vertices = torch.tensor(size * mesh.vertices)
        it = SimpleNamespace(batch=SimpleNamespace(faces=mesh.faces),
                             prediction=SimpleNamespace(vertices=vertices, material=material),
                             context=SimpleNamespace(model=SimpleNamespace(ring=ring)))  # fmt: skip
        assert terms.default_terms["normal_variation"].function(it).item() == pytest.approx(1, rel=0.03)
        assert terms.default_terms["material_rank"].function(it).item() == pytest.approx(1)
        # The gradient of x along a sphere is sin of the angle to the axis, π/4 in the mean.
        columns = priors.columns_of(material, ring.brdf_net)
        slope = size * priors.variation_of_values(vertices, mesh.faces, columns).item()
        assert slope == pytest.approx(4.2 * math.pi / 4, rel=0.01)
