"""Shape-Net and BRDF-Net: the paper's sizes, its encoding, and the flow as an integrator."""

import math

import numpy as np
import pytest
import torch
from helpers.plain_layers import plain
from scipy.integrate import solve_ivp

from mi_ring.geometry.domain import Sphere
from mi_ring.nets import chunks
from mi_ring.nets.brdf_net import BRDFNet, Parameter
from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.shape_net import SPEED, ShapeNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_state


def neurons(net):
    """Outputs of all linear layers: the paper counts the neurons of hidden and output layers."""
    return sum(layer.out_features for layer in net.modules() if isinstance(layer, torch.nn.Linear))


def test_neuron_counts_are_the_papers():
    assert neurons(ShapeNet()) == 771
    assert neurons(BRDFNet()) == 1285
    assert ShapeNet().steps == 20


def test_layer_sizes_are_the_papers():
    sizes = [tuple(p.shape) for name, p in ShapeNet().named_parameters() if name.endswith("weight")]
    assert sizes == [(256, 96), (256, 256), (256, 256), (3, 256)]
    sizes = [tuple(p.shape) for name, p in BRDFNet().named_parameters() if name.endswith("weight")]
    assert sizes == [(256, 96)] + [(256, 256)] * 4 + [(5, 256)]


def test_encoding_is_its_formula():
    x = np.array([[0.3, -1.2, 0.7], [2.0, 0.0, -0.1]])
    expected = [
        [f(omega * value) for f in (np.cos, np.sin) for omega in range(1, 17) for value in point] for point in x
    ]
    found = PosEnc(16)(torch.tensor(x))
    assert found.shape == (2, 96)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


def test_flow_converges_to_the_solution_of_its_differential_equation_at_eulers_rate():
    torch.manual_seed(3)
    net = ShapeNet().double()
    net.output.weight.data.mul_(400)
    x = torch.tensor([[1.0, 0.2, -0.5], [-0.3, 0.8, 0.9]], dtype=torch.float64)

    def velocity(time, point):
        return 2 * plain(net, torch.from_numpy(point)).tanh().detach().numpy()

    ends = [solve_ivp(velocity, (0, 1), point, method="DOP853", rtol=1e-8, atol=1e-8).y[:, -1] for point in x.numpy()]
    exact, errors = torch.from_numpy(np.array(ends)), []
    for net.steps in (40, 80, 160):
        errors.append((net(x) - exact).norm().item())
    assert (exact - x).norm(dim=1).min() > 0.2
    ratios = [before / after for before, after in zip(errors, errors[1:])]
    assert ratios == pytest.approx([2, 2], abs=0.12)  # first order: half the step, half the error


def test_shape_net_takes_its_euler_steps_through_its_velocity():
    net = ShapeNet(steps=3)
    net.output.weight.data.mul_(300)
    x = torch.randn(5, 3)
    expected = x
    for _ in range(3):
        expected = expected + net.velocity(expected) / 3
    torch.testing.assert_close(net(x), expected)
    torch.testing.assert_close(net.flow(x, 1), x + net.velocity(x) / 3)


@pytest.fixture(params=[(1, 0), (2, 0), (2, 100)], ids=["one", "two, anew", "two, kept"])
def threads(request, monkeypatch):
    threads, kept = request.param
    monkeypatch.setattr(chunks, "CHUNK", 16)
    monkeypatch.setattr(chunks, "MAX_STORED", kept)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    yield
    torch.set_num_threads(before)


def test_gradient_of_the_flow_is_that_of_plain_euler_steps(threads):
    torch.manual_seed(1)
    net = ShapeNet(steps=7).double()
    net.output.weight.data.mul_(100)
    x, weight = torch.randn(2, 45, 3, dtype=torch.float64)
    x.requires_grad_()
    found = torch.autograd.grad((net(x) * weight).sum(), [x, *net.parameters()])
    way = x
    for _ in range(7):
        way = way + SPEED * torch.tanh(plain(net, way)) / 7
    expected = torch.autograd.grad((way * weight).sum(), [x, *net.parameters()])
    for a, b in zip(found, expected):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_a_network_and_its_gradient_are_those_of_torchs_layers(threads):
    torch.manual_seed(4)
    net = BRDFNet().double()
    x, weight = torch.randn(5, 7, 3, dtype=torch.float64), torch.randn(5, 7, 5, dtype=torch.float64)
    x.requires_grad_()
    values = net.evaluate(x), plain(net, x)
    torch.testing.assert_close(*values, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(net.evaluate(x[3, 2]), values[1][3, 2], rtol=1e-12, atol=1e-12)
    found, expected = (torch.autograd.grad((v * weight).sum(), [x, *net.parameters()]) for v in values)
    for a, b in zip(found, expected):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_flow_in_bfloat16_is_near_the_flow_in_float32():
    torch.manual_seed(2)
    net = ShapeNet()
    net.output.weight.data.mul_(100)
    s, _ = Sphere().sample(2)
    exact = net(s)
    with torch.autocast("cpu", torch.bfloat16):
        rough = net(s)
    moved = (exact - s).norm(dim=1).mean()
    # bfloat16 keeps 8 bits: half a per cent of each of the few dozen layers that a point passes, mostly averaging out.
    assert rough.dtype == torch.float32 and not torch.equal(rough, exact)
    assert (rough - exact).norm(dim=1).mean() < 0.02 * moved


@pytest.mark.parametrize("network", [ShapeNet, BRDFNet])
def test_gradients_in_bfloat16_are_near_those_in_float32(network):
    torch.manual_seed(5)
    net, (s, _) = network(), Sphere().sample(3)

    def gradients(rough):
        with torch.autocast("cpu", torch.bfloat16, enabled=rough):
            y = net.evaluate(s)
        assert y.dtype == (torch.bfloat16 if rough else torch.float32)
        return torch.autograd.grad(y.float().sum(), list(net.parameters()))

    for exact, rough in zip(gradients(False), gradients(True)):
        assert rough.dtype == torch.float32 and (rough - exact).norm() < 0.03 * exact.norm()


@pytest.mark.parametrize("network", [ShapeNet, BRDFNet])
def test_gradients_in_bfloat16_are_summed_in_float32(network, threads):
    net, (s, _) = network(), Sphere().sample(3)
    with torch.autocast("cpu", torch.bfloat16):
        y = net.evaluate(s)
    (gradient,) = torch.autograd.grad(y.float().sum(), [net.output.bias])
    assert (gradient == 642).all()  # one each; in bfloat16 one cannot count beyond 256


@pytest.mark.parametrize("evaluate", [lambda net, x: net(x), lambda net, x: net.evaluate(x)], ids=["flow", "mlp"])
def test_a_way_back_that_would_be_wrong_is_an_error(evaluate):
    net, x = ShapeNet(steps=2), torch.randn(5, 3)
    for retain in (False, True):
        once = evaluate(net, x).sum()
        once.backward(retain_graph=retain)
        with pytest.raises(RuntimeError, match="second (time|backward pass)"):
            once.backward()
    changed = evaluate(net, x).sum()
    with torch.no_grad():
        net.hidden[1].weight.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        changed.backward()


@pytest.mark.parametrize("seed", range(5))
def test_start_surface_is_the_domain(seed):
    torch.manual_seed(seed)
    ring = FittedObject(center=[10.0, -4.0, 7.0], radius=50.0)
    s, _ = Sphere().sample(3)
    with torch.no_grad():
        moved = (ring.surface(s) - (torch.tensor([10.0, -4.0, 7.0]) + 50.0 * s)).norm(dim=1)
    assert moved.max() < 0.02 * 50  # 2 % of the radius


def test_nothing_is_below_the_ground():
    """What is above stays where it is; what is below lies on the plane, straight above."""
    up = torch.tensor([2.0, -1.0, 2.0]) / 3
    place = torch.tensor([9.0, 4.0, -1.0])
    torch.manual_seed(3)
    ring = FittedObject([10.0, -4.0, 7.0], 50.0, ground=torch.stack([place, up]))
    free = FittedObject(ring.center, 50.0, networks=(ring.shape_net, ring.brdf_net))
    s, _ = Sphere().sample(3)
    with torch.no_grad():
        before, after = free.surface(s), ring.surface(s)
    height = (before - place) @ up
    assert 0.1 < (height < 0).float().mean() < 0.9
    assert ring.state_dict()["ground"].shape == (2, 3)
    torch.testing.assert_close(after, before - height.clamp(max=0)[:, None] * up)
    assert ((after - place) @ up)[height < 0].abs().max() < 2e-5


def test_brdf_net_predicts_positive_reflectance_and_roughness_below_one():
    net = BRDFNet(scale=7.0)
    for parameter in net.parameters():
        parameter.data.mul_(4)
    diffuse, specular, roughness = net(torch.randn(100, 3)).values()
    assert diffuse.shape == (100, 3) and specular.shape == (100,) and roughness.shape == (100,)
    assert (diffuse >= 0).all() and (specular >= 0).all()
    assert ((roughness >= 0) & (roughness <= 1)).all() and roughness.std() > 0.1


def test_brdf_net_keeps_the_ranges_of_other_parameters():
    """Begins where it is told to, stays between low and high, colours apart from numbers."""
    torch.manual_seed(0)
    tint, colour = Parameter("tint", 1, -0.5, 2.0, 1.5), Parameter("colour", 3, 0.2, 0.7)
    net = BRDFNet(50.0, [tint, colour, Parameter("haze", 1, 1.0, math.inf)])
    net.output.weight.data.zero_()
    net.output.bias.data.zero_()
    first = net(torch.randn(2, 5, 3))
    assert {name: value.shape for name, value in first.items()} == {
        "tint": (2, 5), "colour": (2, 5, 3), "haze": (2, 5)
    }  # fmt: skip
    assert first["tint"][0, 0].item() == pytest.approx(-0.5 + 2.5 / (1 + math.exp(-1.5)))
    assert first["colour"][0, 0, 1].item() == pytest.approx(0.45)
    assert first["haze"][0, 0].item() == pytest.approx(1 + 50 * math.log(2))
    net = BRDFNet(50.0, [tint, colour, Parameter("haze", 1, 1.0, math.inf)])
    for parameter in net.parameters():
        parameter.data.mul_(4)
    wild = net(torch.randn(1000, 3))
    assert wild["tint"].min() >= -0.5 and wild["tint"].max() <= 2.0 and wild["tint"].std() > 0.1
    assert wild["colour"].min() >= 0.2 and wild["colour"].max() <= 0.7 and wild["colour"].std(1).max() > 0.02
    assert wild["haze"].min() >= 1 and wild["haze"].max() > 60


def test_brdf_scale_only_scales():
    torch.manual_seed(0)
    one, many = BRDFNet(1.0), BRDFNet(250.0)
    many.load_state_dict({**one.state_dict(), "scale": torch.tensor(250.0)})
    s = torch.randn(7, 3)
    one, many = one(s), many(s)
    torch.testing.assert_close(250 * one["diffuse"], many["diffuse"])
    torch.testing.assert_close(250 * one["specular"], many["specular"])
    torch.testing.assert_close(one["roughness"], many["roughness"])


@pytest.mark.parametrize("level", [0, 3])
def test_icosphere_has_the_documented_size_and_rotates(level):
    plain, faces = Sphere().sample(level)
    turned, same = Sphere().sample(level, torch.Generator().manual_seed(3))
    assert plain.shape == (10 * 4**level + 2, 3) and faces.shape == (20 * 4**level, 3)
    torch.testing.assert_close(plain.norm(dim=1), torch.ones(len(plain)))
    rotation = torch.linalg.lstsq(plain, turned).solution
    torch.testing.assert_close(plain @ rotation, turned)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3))
    assert rotation.det() > 0 and rotation.trace() < 2.9
    assert (faces == same).all()


def test_state_survives_the_file(tmp_path):
    ring = FittedObject(center=[1.0, 2.0, 3.0], radius=4.0, scale=5.0, steps=7)
    torch.nn.init.normal_(ring.shape_net.output.weight)  # else no step would lead anywhere
    torch.save(ring_state(ring, {"seed": 3}), tmp_path / "ring.pt")
    again = load_fit(tmp_path / "ring.pt")
    s = torch.randn(6, 3)
    assert torch.equal(again.surface(s), ring.surface(s))
    assert all(torch.equal(value, ring.brdf_net(s)[name]) for name, value in again.brdf_net(s).items())
