"""What the paper's method is compared with: other encodings and networks.

And what shows the difference: triangles turned inside out or crossing others.
"""

import dataclasses
import math
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.plain_layers import plain

from mi_ring import export
from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fit import parse_options
from mi_ring.fitting import checkpoint, terms
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.schedule import Stage
from mi_ring.geometry.domain import Sphere
from mi_ring.metrics.embedding import exactly_crossing, inside_out
from mi_ring.nets import registry
from mi_ring.nets.brdf_net import BRDFNet
from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import plain_autograd
from mi_ring.nets.resnet import ResNet, shape_net_of
from mi_ring.nets.shape_net import SPEED, Flow, ShapeNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit, ring_of, ring_state
from mi_ring.scene.self_intersections import crossing_triangles


def wild(net, seed=0, size=0.1):
    """A network that moves points by some tenths of the sphere's radius."""
    torch.manual_seed(seed)
    for module in net.modules():
        if isinstance(module, torch.nn.Linear):
            module.reset_parameters()  # by this seed
    for module in net.modules():
        if hasattr(module, "velocity") and hasattr(module, "output"):
            torch.nn.init.normal_(module.output.weight, std=size)
    return net


# How the flow is integrated.

#: ẋ = A x: a turn that grows, about an axis of its own, and a shear.
A = torch.tensor([[0.3, -1.9, 0.4], [2.1, 0.2, -0.7], [-0.3, 0.8, -0.5]], dtype=torch.float64)


class Linear(Flow):
    """A flow whose solution is known: Φ(x, t) = exp(t A) x."""

    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def velocity(self, x):
        return x @ A.T


def test_the_flow_converges_to_a_known_one_by_first_order():
    x = torch.tensor([[1.0, 0.2, -0.5], [-0.3, 0.8, 0.9]], dtype=torch.float64)
    for time in (1.0, 0.6):
        exact = x @ torch.linalg.matrix_exp(time * A).T
        errors = [(Linear(steps)(x, time) - exact).norm().item() for steps in (40, 80, 160)]
        ratios = [math.log2(before / after) for before, after in zip(errors, errors[1:])]
        assert ratios == pytest.approx([1, 1], abs=0.1)
    # Between two steps by a shorter one: nothing but its own error, of one order more.
    between = Linear(20)(x, 0.52) - x @ torch.linalg.matrix_exp(0.52 * A).T
    assert 0 < between.norm() < 3 * (Linear(20)(x, 0.5) - x @ torch.linalg.matrix_exp(0.5 * A).T).norm()


# The encoding.


@pytest.mark.parametrize(("spacing", "count", "omegas"), [
    ("linear", 5, [1, 2, 3, 4, 5]), ("octaves", 5, [1, 2, 4, 8, 16]), ("octaves", 1, [1]),
])  # fmt: skip
def test_frequencies_are_those_of_the_formula(spacing, count, omegas):
    x = np.array([[0.3, -1.2, 0.7], [2.0, 0.0, -0.1]])
    expected = [[f(w * value) for f in (np.cos, np.sin) for w in omegas for value in point] for point in x]
    encoding = PosEnc(count, spacing)
    assert encoding.width == 6 * count
    np.testing.assert_allclose(encoding(torch.tensor(x)), expected, atol=1e-12)


@pytest.mark.parametrize("spacing", ["octaves", "none"])
@pytest.mark.parametrize("network", [ShapeNet, BRDFNet])
def test_networks_of_other_encodings_and_their_gradients_are_those_of_torchs_layers(network, spacing):
    net = wild(network(encoding=spacing, frequencies=4)).double()
    assert net.hidden[0].in_features == {"octaves": 24, "none": 3}[spacing]
    x = torch.randn(9, 3, dtype=torch.float64, requires_grad=True)
    values = net.evaluate(x), plain(net, x)
    weight = torch.randn_like(values[0])
    torch.testing.assert_close(*values, rtol=1e-12, atol=1e-12)
    found, expected = (torch.autograd.grad((v * weight).sum(), [x, *net.parameters()]) for v in values)
    for a, b in zip(found, expected):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_without_an_encoding_the_points_are_the_features():
    x = torch.randn(4, 3)
    assert torch.equal(PosEnc(16, "none")(x), x)
    with pytest.raises(ValueError, match="must be linear, octaves or none"):
        PosEnc(16, "powers")


# A plain ResNet in the place of the ring.


def parameters(net):
    return sum(p.numel() for p in net.parameters())


@pytest.mark.parametrize("encoding", ["linear", "none"])
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 20, 40])
def test_a_plain_resnet_has_as_many_parameters_as_the_ring(steps, encoding):
    ring, plain_net = (shape_net_of(kind, steps, encoding, 16) for kind in ("ring", "resnet"))
    assert len(plain_net.blocks) == steps == plain_net.steps
    assert parameters(plain_net) == pytest.approx(parameters(ring), rel=0.003)
    if encoding == "linear":
        assert parameters(ring) == 97 * 256 + 2 * 257 * 256 + 257 * 3
    wide = shape_net_of("wide-resnet", steps, encoding, 16)
    assert parameters(wide) == steps * parameters(ring)


def test_a_plain_resnet_goes_through_its_blocks_one_after_another():
    net, x = wild(ResNet(4), 3), torch.randn(6, 3)
    way = [x]
    for block in net.blocks:
        way.append(way[-1] + SPEED * torch.tanh(plain(block, way[-1])) / 4)
    torch.testing.assert_close(net(x), way[4])
    torch.testing.assert_close(net.flow(x, 3), way[3])
    torch.testing.assert_close(net(x, 0.625), (way[2] + way[3]) / 2)
    assert (way[4] - x).norm(dim=1).mean() > 0.02


def test_a_wide_resnet_of_equal_blocks_is_the_ring():
    ring = wild(ShapeNet(5))
    net = ResNet(5, width=256)
    for block in net.blocks:
        block.load_state_dict(ring.state_dict())
    x = torch.randn(6, 3)
    torch.testing.assert_close(net(x), ring(x))


def test_the_regulariser_of_a_plain_resnet_sees_all_blocks():
    net = ResNet(3)
    model = SimpleNamespace(ring=SimpleNamespace(shape_net=net))
    context = SimpleNamespace(config=Config(laplacian_scale=0.0), autocast=torch.no_grad, model=model)
    batches = [SimpleNamespace(points=torch.randn(20, 3), seeds={"regulariser": seed}) for seed in range(40)]
    its = [SimpleNamespace(batch=batch, stage=Stage(3, 32, 0, 1), context=context) for batch in batches]
    for k, block in enumerate(net.blocks):
        torch.nn.init.zeros_(block.output.weight)
        block.output.bias.data[:] = torch.tensor([0.1 * (k + 1), 0, 0])
    found = {round(terms.velocity(it).item(), 6) for it in its}
    assert found == {round((SPEED * math.tanh(0.1 * (k + 1))) ** 2, 6) for k in range(3)}


# The file.

CHOICES = [
    {"encoding": "octaves", "frequencies": 5},
    {"shape_net": "resnet", "encoding": "none", "steps": 4},
    {"shape_net": "wide-resnet", "resample": False, "weights": {"velocity": 0.0}},
]


@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_choices_survive_the_file(choice, tmp_path):
    config = Config(**choice)
    net = wild(shape_net_of(config.shape_net, config.steps, config.encoding, config.frequencies))
    brdf_net = BRDFNet(3.0, encoding=config.encoding, frequencies=config.frequencies)
    ring = FittedObject([1.0, 2, 3], 4.0, networks=(net, brdf_net))
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    again, (s, _) = load_fit(tmp_path / "ring.pt"), Sphere().sample(1)
    assert registry.architecture_of(again.shape_net) == registry.architecture_of(net)
    with torch.no_grad():
        torch.testing.assert_close(again(s), ring(s), rtol=0, atol=0)


@pytest.mark.parametrize("more", [{}, {"material_at": "domain", "arguments": {"solver": "euler"}}])
def test_files_of_before_are_the_papers_method(more):
    """They say nothing of encodings, or name the solver and the place of the material."""
    ring = FittedObject([1.0, 2, 3], 4.0, networks=(wild(ShapeNet(3)), BRDFNet(3.0)))
    state = ring_state(ring)
    state["shape_net"]["arguments"] = {"steps": 3, **more.get("arguments", {})}
    state["brdf_net"]["arguments"].pop("encoding"), state["brdf_net"]["arguments"].pop("frequencies")
    again, (s, _) = ring_of(state | more), Sphere().sample(1)
    with torch.no_grad():
        torch.testing.assert_close(again(s), ring(s), rtol=0, atol=0)


@pytest.mark.parametrize(("change", "words"), [
    ({"material_at": "surface"}, "material_at: is surface, only domain is supported; fit again, or use the version"),
    ({"shape_net": {"name": "shapenet", "arguments": {"steps": 3, "solver": "rk4"}}}, "solver: is rk4, only euler is"),
])  # fmt: skip
def test_files_of_choices_that_are_gone_are_refused(change, words, tmp_path):
    torch.save(ring_state(FittedObject([0.0, 0, 0], 1.0)) | change, tmp_path / "ring.pt")
    with pytest.raises(InputError, match=f"ring.pt: {words}"):
        load_fit(tmp_path / "ring.pt")


def test_checkpoints_of_before_go_with_the_settings_of_before(tmp_path):
    config = Config()
    state = {"format": checkpoint.FORMAT, "settings": config.settings(), "files": {}, "fit": {}}
    for name in ("shape_net", "encoding", "frequencies", "resample"):
        del state["settings"][name]
    state["settings"]["weights"] = {"rgb": 1.0, "mask": 5.0, "velocity": 0.01, "calibration": 1e-3}
    torch.save(state, tmp_path / "checkpoint.pt")
    assert checkpoint.read_checkpoint(tmp_path, config)["format"] == checkpoint.FORMAT
    for change, told in (
        ({"shape_net": "resnet"}, "--shape-net: was ring before, is resnet now"),
        ({"weights": {"material_rank": 0.1}}, "--weights.material-rank: was 0.0 before, is 0.1 now"),
    ):
        with pytest.raises(InputError, match=told):
            checkpoint.read_checkpoint(tmp_path, Config(**change))


# A fit.


@pytest.mark.parametrize(("choice", "words"), [
    ({"encoding": "octaves", "frequencies": 17}, "--frequencies: is 17, must be 1 to 16 for octaves"),
    ({"frequencies": 0}, "--frequencies: is 0, must be 1 to 64"),
    ({"shape_net": "moon"}, "--shape-net: is moon, must be one of ring, resnet, wide-resnet"),
])  # fmt: skip
def test_choices_that_do_not_go_together_are_refused(choice, words):
    with pytest.raises(InputError, match=words):
        Config(**choice)


SMALL = {"iterations": 2, "levels": (2,), "widths": (28,), "shares": (1.0,), "subdivisions": 2, "domain": "sphere",
         "precision": "float32", "indirect": False, "refine": ("none",)}  # fmt: skip


@pytest.fixture(scope="module")
def capture(small_capture):
    return load_capture(small_capture)


@pytest.mark.parametrize("choice", [*CHOICES, {"steps": 40}], ids=str)
def test_fits_with_each_choice_descend_and_go_on_from_their_state(choice, capture):
    config = Config(**SMALL | choice)
    fit = Fit(capture, config)
    first = {name: p.detach().clone() for name, p in fit.ring.named_parameters()}
    it = fit.step()
    assert ("velocity" in it.terms) == bool(config.weights["velocity"]) and math.isfinite(it.loss)
    assert all(not torch.equal(p, first[name]) for name, p in fit.ring.named_parameters())  # all of it learns
    again = Fit(capture, config, state=fit.state())
    assert again.step().loss == pytest.approx(fit.step().loss, rel=1e-4)


def test_without_resampling_the_vertices_stay_at_the_same_points(capture):
    points = {}
    for resample in (True, False):
        fit = Fit(capture, Config(**SMALL, resample=resample))
        points[resample] = [it.batch.points for it in fit]
    assert torch.equal(*points[False]) and torch.equal(points[False][0], Sphere().sample(2)[0])
    assert not torch.equal(*points[True])


def test_the_command_takes_the_choices_and_others_those_of_the_file(small_capture, capture, tmp_path):
    config = parse_options([
        str(small_capture), "--shape-net", "resnet", "--encoding", "octaves", "--frequencies", "4",
        "--no-resample", "--weights.material-rank", "0.1",
    ])  # fmt: skip
    choice = {f.name: getattr(config, f.name) for f in dataclasses.fields(Config)} | SMALL
    fit = Fit(capture, Config(**choice))
    list(fit)
    entry = fit.course.log[-1]
    assert 1 <= entry["material_rank"] <= math.sqrt(5) and entry["weights"]["material_rank"] == 0.1
    run = tmp_path / "run"
    run.mkdir()
    torch.save(ring_state(fit.ring, fit.problem.config.settings()), run / "ring.pt")
    ring = load_fit(run)
    assert type(ring.shape_net) is ResNet
    assert ring.brdf_net.encoding.spacing == "octaves" and ring.shape_net.encoding.frequencies == 4
    s, _ = ring.domain.sample(2)
    with torch.no_grad():
        expected = ring.brdf_net(s)["diffuse"].numpy()
    export.main([str(run), str(tmp_path / "again.ply"), "--subdivisions", "2"])
    mesh = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "again.ply")}))
    shape = mi.traverse(mi.load_dict({"type": "shapenet", "weights": str(run / "ring.pt"), "subdivisions": 2}))
    for params in (mesh, shape):
        np.testing.assert_allclose(np.array(params["vertex_diffuse"]).reshape(-1, 3), expected, rtol=1e-5)


# What shows the difference.


class Folded(Flow):
    """(x, y, z) → (x, y, f(z)) with f' = 1 − 2 sin(4 z), which is below 0 for some z. Or a mirror."""

    def __init__(self, mirror=False):
        super().__init__()
        self.mirror = torch.nn.Parameter(torch.tensor(float(mirror)))

    def forward(self, x, time=1.0):
        z = x[..., 2:]
        return torch.cat([x[..., :2], -z if self.mirror else z + (torch.cos(4 * z) - 1) / 2], -1)


def test_triangles_turned_inside_out_are_those_of_negative_jacobians():
    ring = FittedObject([5.0, 1, 2], 3.0, networks=(Folded(), BRDFNet()))
    s, faces = Sphere().sample(4)
    corners = s[torch.as_tensor(faces)]
    slope = 1 - 2 * torch.sin(4 * corners[..., 2])  # of f, at the corners: with one sign on all of most triangles
    found = torch.from_numpy(inside_out(ring, s, faces))
    clear = (slope < -0.2).all(1), (slope > 0.2).all(1)
    assert found[clear[0]].all() and not found[clear[1]].any()
    assert clear[0].sum() > 500 and clear[1].sum() > 500
    assert inside_out(FittedObject([0.0, 0, 0], 1.0, networks=(Folded(True), BRDFNet())), s, faces).all()
    assert not inside_out(FittedObject([0.0, 0, 0], 1.0), s, faces).any()


def test_a_wild_resnet_turns_triangles_inside_out_and_a_flow_solved_well_does_not():
    """By torch's own Jacobians of the networks, a second way."""
    s, faces = Sphere().sample(3)
    folded, flow = wild(ResNet(3, frequencies=3), 2, 1.0), wild(ShapeNet(40, frequencies=3))
    for net, some in ((folded, True), (flow, False)):
        found = inside_out(FittedObject([0.0, 0, 0], 1.0, networks=(net, BRDFNet())), s, faces)
        centres = s[torch.as_tensor(faces)].mean(1)[::13]
        with plain_autograd():
            determinant = torch.func.vmap(torch.func.jacrev(lambda x, net=net: net(x[None])[0]))(centres).det()
        assert ((determinant < 0).numpy() == found[::13]).mean() > (0.9 if some else 0.999)
        assert found.mean() > 0.03 if some else not found.any()


@pytest.mark.parametrize("shape", ["crumpled", "two"])
def test_crossing_triangles_are_those_of_exact_arithmetic(shape):
    pytest.importorskip("igl")
    mesh = trimesh.creation.icosphere(subdivisions=3)
    random = np.random.default_rng(4)
    if shape == "crumpled":
        vertices, faces = mesh.vertices + random.normal(0, 0.2, mesh.vertices.shape), mesh.faces
    else:
        other = trimesh.creation.icosphere(subdivisions=3, radius=0.7)
        other.apply_transform(trimesh.transformations.random_rotation_matrix(random.random(3)))
        both = mesh + other.apply_translation([0.5, 0.2, 0.1])
        vertices, faces = both.vertices, both.faces
    exact = exactly_crossing(30 * vertices, faces)
    assert np.array_equal(exact, crossing_triangles(30 * vertices, faces)) and exact.sum() > 100
    assert not exactly_crossing(mesh.vertices, mesh.faces).any()
