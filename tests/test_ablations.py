"""What the paper's method is compared with: other solvers, encodings, networks, places of the material.

And what shows the difference: triangles turned inside out or crossing others.
"""

import dataclasses
import math
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from test_networks import plain

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
from mi_ring.nets import registry, solvers
from mi_ring.nets.brdf_net import BRDFNet
from mi_ring.nets.encoding import PosEnc
from mi_ring.nets.mlp import plain_autograd
from mi_ring.nets.resnet import ResNet, shape_net_of
from mi_ring.nets.shape_net import SPEED, Flow, ShapeNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.material_edits import MaterialOptions, edit_material
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

    def __init__(self, steps, solver):
        super().__init__()
        self.steps, self.solver = steps, solver

    def velocity(self, x):
        return x @ A.T


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
def test_solvers_converge_to_a_known_flow_by_their_order(solver, order):
    x = torch.tensor([[1.0, 0.2, -0.5], [-0.3, 0.8, 0.9]], dtype=torch.float64)
    for time in (1.0, 0.6):
        exact = x @ torch.linalg.matrix_exp(time * A).T
        errors = [(Linear(steps, solver)(x, time) - exact).norm().item() for steps in (40, 80, 160)]
        ratios = [math.log2(before / after) for before, after in zip(errors, errors[1:])]
        assert ratios == pytest.approx([order] * 2, abs=0.1)
    # Between two steps by a shorter one: nothing but its own error, of one order more.
    between = Linear(20, solver)(x, 0.52) - x @ torch.linalg.matrix_exp(0.52 * A).T
    assert 0 < between.norm() < 3 * (Linear(20, solver)(x, 0.5) - x @ torch.linalg.matrix_exp(0.5 * A).T).norm()


@pytest.mark.parametrize("time", [1.0, 0.37])
def test_the_adaptive_solver_is_as_near_as_its_tolerance(time):
    pytest.importorskip("torchdiffeq")
    x = torch.tensor([[1.0, 0.2, -0.5], [-0.3, 0.8, 0.9]], dtype=torch.float64)
    exact = x @ torch.linalg.matrix_exp(time * A).T
    error = (Linear(3, "dopri5")(x, time) - exact).norm().item()
    assert error < 10 * solvers.TOLERANCE < (Linear(3, "euler")(x, time) - exact).norm().item()
    assert torch.equal(Linear(3, "dopri5").flow(x, 0), x)


def test_the_adaptive_solver_agrees_with_small_steps_of_another_also_in_its_gradient(monkeypatch):
    pytest.importorskip("torchdiffeq")
    one, other = wild(ShapeNet(3, "dopri5", frequencies=3), size=0.3), ShapeNet(40, "rk4", frequencies=3)
    other.load_state_dict(one.state_dict())
    one, other = one.double(), other.double()
    s, _ = Sphere().sample(1)
    weight = torch.randn(len(s), 3, dtype=torch.float64)

    def there_and_back(net):
        x = s.double().requires_grad_()
        y = net(x)
        return y.detach(), *torch.autograd.grad((y * weight).sum(), [x, net.hidden[1].weight])

    rough, exact = there_and_back(one), there_and_back(other)
    with plain_autograd():
        torch.testing.assert_close(there_and_back(one), rough, rtol=1e-9, atol=1e-12)
    monkeypatch.setattr(solvers, "TOLERANCE", 1e-7)
    fine = there_and_back(one)
    moved = (exact[0] - s).norm()
    assert moved > 0.1 * len(s) ** 0.5 and (rough[0] - exact[0]).norm() < 3e-3 * moved
    # Leaky ReLUs have kinks, so that gradients come nearer more slowly than points.
    for a, b, bound in zip(fine, exact, (1e-4, 0.03, 0.03)):
        assert (a - b).norm() < bound * b.norm()


def test_the_adaptive_solver_computes_in_float32_under_autocast():
    pytest.importorskip("torchdiffeq")
    net, (s, _) = wild(ShapeNet(3, "dopri5")), Sphere().sample(1)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):  # of which no tolerance could be had
        rough = net(s)
    assert rough.dtype == torch.float32 and torch.equal(rough, net(s))


@pytest.mark.parametrize("solver", ["midpoint", "rk4"])
def test_gradients_through_other_steps_are_those_of_torchs_layers(solver):
    net = wild(ShapeNet(3, solver)).double()
    x, weight = torch.randn(2, 9, 3, dtype=torch.float64)
    x.requires_grad_()
    way = x
    for _ in range(3):
        way = solvers.SOLVERS[solver](lambda p: SPEED * torch.tanh(plain(net, p)), way, 1 / 3)
    torch.testing.assert_close(net(x), way)
    found, expected = (torch.autograd.grad((y * weight).sum(), [x, *net.parameters()]) for y in (net(x), way))
    for a, b in zip(found, expected):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_what_the_adaptive_solver_needs_is_told_when_it_is_not_there(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchdiffeq", None)
    ShapeNet(3, "rk4")
    with pytest.raises(InputError, match="dopri5: needs the package torchdiffeq, which is not installed; try `pip"):
        ShapeNet(3, "dopri5")


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
    ring, plain_net = (shape_net_of(kind, steps, "euler", encoding, 16) for kind in ("ring", "resnet"))
    assert len(plain_net.blocks) == steps == plain_net.steps
    assert parameters(plain_net) == pytest.approx(parameters(ring), rel=0.003)
    if encoding == "linear":
        assert parameters(ring) == 97 * 256 + 2 * 257 * 256 + 257 * 3
    wide = shape_net_of("wide-resnet", steps, "euler", encoding, 16)
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
    class Iteration:
        s, stage = torch.randn(20, 3), Stage(3, 32, 0, 1)
        fit = type("Fit", (), {"config": Config(laplacian_scale=0.0), "autocast": torch.no_grad})()

    fit = Iteration.fit
    fit.ring, fit.random = type("FittedObject", (), {"shape_net": ResNet(3)})(), torch.Generator().manual_seed(0)
    for k, block in enumerate(fit.ring.shape_net.blocks):
        torch.nn.init.zeros_(block.output.weight)
        block.output.bias.data[:] = torch.tensor([0.1 * (k + 1), 0, 0])
    found = {round(terms.velocity(Iteration).item(), 6) for _ in range(40)}
    assert found == {round((SPEED * math.tanh(0.1 * (k + 1))) ** 2, 6) for k in range(3)}


# The material on the surface.


def test_a_material_on_the_surface_is_that_of_the_deformed_points():
    ring = FittedObject([4.0, -3.0, 2.0], 2.5, networks=(wild(ShapeNet(3)), BRDFNet()), material_at="surface")
    s, _ = Sphere().sample(2)
    with torch.no_grad():
        moved = (ring.surface(s) - ring.center) / ring.radius
        expected, domain = ring.brdf_net(moved), ring.brdf_net(s)
        for found in (ring.material(s), ring(s)[1], ring(s, 0.5)[1]):
            torch.testing.assert_close(found, expected)
        assert (expected["diffuse"] - domain["diffuse"]).abs().max() > 1e-3
        torch.testing.assert_close(ring(s, 0.5)[0], ring.surface(s, 0.5))
        ring.material_at = "domain"
        assert torch.equal(ring(s)[1]["diffuse"], domain["diffuse"])


def test_a_material_on_the_surface_moves_to_another_shape_as_it_was(tmp_path):
    other = FittedObject([0.0, 0, 0], 1.0, networks=(wild(ShapeNet(3)), BRDFNet()), material_at="surface")
    torch.save(ring_state(other), tmp_path / "ring.pt")
    for material_at in ("domain", "surface"):
        ring = FittedObject([1.0, 2, 3], 5.0, networks=(wild(ShapeNet(3), 7), BRDFNet()), material_at=material_at)
        edit_material(ring, MaterialOptions(material=tmp_path / "ring.pt"))
        s, _ = Sphere().sample(1)
        with torch.no_grad():
            torch.testing.assert_close(ring.material(s), other.material(s))


# The file.

CHOICES = [
    {"solver": "midpoint", "encoding": "octaves", "frequencies": 5},
    {"shape_net": "resnet", "encoding": "none", "steps": 4, "material_at": "surface"},
    {"shape_net": "wide-resnet", "resample": False, "weights": {"velocity": 0.0}},
]


@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_choices_survive_the_file(choice, tmp_path):
    config = Config(**choice)
    net = wild(shape_net_of(config.shape_net, config.steps, config.solver, config.encoding, config.frequencies))
    brdf_net = BRDFNet(3.0, encoding=config.encoding, frequencies=config.frequencies)
    ring = FittedObject([1.0, 2, 3], 4.0, networks=(net, brdf_net), material_at=config.material_at)
    torch.save(ring_state(ring), tmp_path / "ring.pt")
    again, (s, _) = load_fit(tmp_path / "ring.pt"), Sphere().sample(1)
    assert registry.architecture_of(again.shape_net) == registry.architecture_of(net)
    with torch.no_grad():
        torch.testing.assert_close(again(s), ring(s), rtol=0, atol=0)


def test_files_of_before_are_the_papers_method():
    """They say nothing of encodings, solvers and where the material is."""
    ring = FittedObject([1.0, 2, 3], 4.0, networks=(wild(ShapeNet(3)), BRDFNet(3.0)))
    state = ring_state(ring)
    state["shape_net"]["arguments"] = {"steps": 3}
    state["brdf_net"]["arguments"].pop("encoding"), state["brdf_net"]["arguments"].pop("frequencies")
    del state["material_at"]
    again, (s, _) = ring_of(state), Sphere().sample(1)
    assert again.shape_net.solver == "euler" and again.material_at == "domain"
    with torch.no_grad():
        torch.testing.assert_close(again(s), ring(s), rtol=0, atol=0)


def test_a_file_with_a_material_elsewhere_is_refused(tmp_path):
    torch.save(ring_state(FittedObject([0.0, 0, 0], 1.0)) | {"material_at": "moon"}, tmp_path / "ring.pt")
    with pytest.raises(InputError, match="material at moon"):
        load_fit(tmp_path / "ring.pt")


def test_checkpoints_of_before_go_with_the_settings_of_before(tmp_path):
    config = Config()
    state = {"format": checkpoint.FORMAT, "settings": config.settings(), "files": {}, "fit": {}}
    for name in ("solver", "shape_net", "encoding", "frequencies", "material_at", "resample"):
        del state["settings"][name]
    state["settings"]["weights"] = {"rgb": 1.0, "mask": 5.0, "velocity": 0.01, "calibration": 1e-3}
    torch.save(state, tmp_path / "checkpoint.pt")
    assert checkpoint.read_checkpoint(tmp_path, config)["format"] == checkpoint.FORMAT
    for change, told in (
        ({"solver": "rk4"}, "--solver: was euler before, is rk4 now"),
        ({"weights": {"material_rank": 0.1}}, "--weights.material-rank: was 0.0 before, is 0.1 now"),
    ):
        with pytest.raises(InputError, match=told):
            checkpoint.read_checkpoint(tmp_path, Config(**change))


# A fit.


@pytest.mark.parametrize(("choice", "words"), [
    ({"shape_net": "resnet", "solver": "rk4"}, "--solver: is rk4, must be euler for --shape-net resnet"),
    ({"encoding": "octaves", "frequencies": 17}, "--frequencies: is 17, must be 1 to 16 for octaves"),
    ({"frequencies": 0}, "--frequencies: is 0, must be 1 to 64"),
    ({"solver": "heun"}, "--solver: is heun, must be one of euler, midpoint, rk4, dopri5"),
    ({"material_at": "moon"}, "--material-at: is moon, must be one of domain, surface"),
])  # fmt: skip
def test_choices_that_do_not_go_together_are_refused(choice, words):
    with pytest.raises(InputError, match=words):
        Config(**choice)


SMALL = {"iterations": 2, "levels": (2,), "widths": (28,), "shares": (1.0,), "subdivisions": 2, "domain": "sphere",
         "precision": "float32", "indirect": False, "refine": ("none",)}  # fmt: skip


@pytest.fixture(scope="module")
def capture(small_capture):
    return load_capture(small_capture)


@pytest.mark.parametrize("choice", [*CHOICES, {"steps": 40}, {"solver": "dopri5"}], ids=str)
def test_fits_with_each_choice_descend_and_go_on_from_their_state(choice, capture):
    if choice.get("solver") == "dopri5":
        pytest.importorskip("torchdiffeq")
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
        points[resample] = [it.s for it in fit]
    assert torch.equal(*points[False]) and torch.equal(points[False][0], Sphere().sample(2)[0])
    assert not torch.equal(*points[True])


def test_the_command_takes_the_choices_and_others_those_of_the_file(small_capture, capture, tmp_path):
    config = parse_options([
        str(small_capture), "--shape-net", "resnet", "--material-at", "surface", "--encoding", "octaves",
        "--frequencies", "4", "--no-resample", "--weights.material-rank", "0.1",
    ])  # fmt: skip
    choice = {f.name: getattr(config, f.name) for f in dataclasses.fields(Config)} | SMALL
    fit = Fit(capture, Config(**choice))
    entry = [it.entry() for it in fit][-1]
    assert 1 <= entry["material_rank"] <= math.sqrt(5) and entry["weights"]["material_rank"] == 0.1
    run = tmp_path / "run"
    run.mkdir()
    torch.save(ring_state(fit.ring, fit.config.settings()), run / "ring.pt")
    ring = load_fit(run)
    assert type(ring.shape_net) is ResNet and ring.material_at == "surface"
    assert ring.brdf_net.encoding.spacing == "octaves" and ring.shape_net.encoding.frequencies == 4
    s, _ = ring.domain.sample(2)
    with torch.no_grad():
        expected = ring.brdf_net(ring.shape_net(s))["diffuse"].numpy()
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
    folded, flow = wild(ResNet(3, frequencies=3), 2, 1.0), wild(ShapeNet(6, "rk4", frequencies=3))
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
