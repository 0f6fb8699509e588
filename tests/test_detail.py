"""Details: grids that are added to the networks."""

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh

from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.fitting import agreeing_adam, result
from mi_ring.fitting.agreeing_adam import AgreeingAdam
from mi_ring.fitting.config import Config
from mi_ring.fitting.detail_stage import add_detail, detail_levels, share_weights, smooth_between, unfold
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.optimisation import detail_steppers
from mi_ring.fitting.schedule import Schedule
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.geometry.meshes import smoothed
from mi_ring.nets.brdf_net import COOK_TORRANCE, BRDFNet
from mi_ring.objects import detail
from mi_ring.objects.detail import DetailedFlow, DetailedMaterial, Grid
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import compact, load_fit, ring_of, ring_state
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.output import results
from mi_ring.system.files import write_state
from mi_ring.system.machine import threads_of


def points_near(n=500, seed=0):
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)), dim=1)


def grid_of(channels=2, cell=0.11, octaves=3):
    return Grid.around(points_near(), cell, octaves, channels)


def corner_places(grid, octave):
    """Where the corners of an octave are, (N, 3), by their keys."""
    keys = grid.keys(octave)
    whole = torch.stack([keys >> 42, (keys >> 21) % 2**21, keys % 2**21], 1) - 2**20
    return whole * grid.cells[octave]


def test_each_octave_reproduces_linear_functions():
    grid, s = grid_of(), points_near()
    for octave in range(3):
        slope = torch.tensor([[0.3, -1.0], [2.0, 0.5], [-0.7, 0.1]])
        for k in range(3):
            grid.values[k].data.zero_()
        grid.values[octave].data = corner_places(grid, octave) @ slope
        assert torch.allclose(grid(s), s @ slope, atol=1e-5)


def test_gloss_changes_a_third_as_much_as_colour():
    s, net = points_near(), BRDFNet()
    detailed = DetailedMaterial.of(net, Grid.around(s, 0.11, 3, 5))
    before = net.evaluate(s)
    for values in detailed.grid.values:
        values.data.fill_(0.2)
    expected = torch.tensor([0.6, 0.6, 0.6, 0.2, 0.2]).expand(len(s), 5)  # three octaves
    torch.testing.assert_close(detailed.evaluate(s) - before, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(detailed.evaluate(s[:6].reshape(2, 3, 3)).reshape(6, 5), detailed.evaluate(s[:6]))


def test_many_points_are_evaluated_in_parts(monkeypatch):
    grid, s = grid_of(), points_near()
    for values in grid.values:
        values.data = torch.randn(values.shape, generator=torch.Generator().manual_seed(1))
    whole = grid(s).sum() + grid(s)[250].sum()
    gradients = torch.autograd.grad(whole, grid.values)
    monkeypatch.setattr(detail, "PART", 120)
    assert torch.equal(grid(s).sum() + grid(s)[250].sum(), whole)
    assert max(len(points) for points, *_ in grid.latest) <= 120
    for own, expected in zip(torch.autograd.grad(grid(s).sum() + grid(s)[250].sum(), grid.values), gradients):
        torch.testing.assert_close(own, expected)


def test_a_constant_is_reproduced_also_where_a_corner_is_missing():
    grid = Grid.around(Sphere().sample(5)[0], 0.11, 3, 1)
    for k in range(3):
        grid.values[k].data.fill_(1.0)
    lacking = np.array([(weights.astype(bool).sum(1) < 8).mean() for weights in grid.weights(points_near())])
    assert lacking[-1] > 0
    assert torch.allclose(grid(points_near()), torch.tensor(3.0))


def test_cubes_halve_and_points_beside_them_have_no_value():
    grid = grid_of()
    assert grid.cells == pytest.approx([0.44, 0.22, 0.11])
    for k in range(3):
        grid.values[k].data.fill_(1.0)
    assert torch.allclose(grid(points_near()), torch.tensor(3.0))
    assert not grid(3 * points_near()).any()
    assert not grid(1e9 * points_near()).any()


def test_gradients_are_those_of_finite_differences():
    grid, s = grid_of(), points_near(40)
    target = torch.randn(40, 2)
    (grid(s) * target).sum().backward()
    values = grid.values[1]
    for node in (int(values.grad.abs().sum(1).argmax()), int(values.grad.abs().sum(1).argsort()[-7])):
        with torch.no_grad():
            values[node, 1] += 0.5
            up = float((grid(s) * target).sum())
            values[node, 1] -= 1.0
            down = float((grid(s) * target).sum())
            values[node, 1] += 0.5
        assert float(values.grad[node, 1]) == pytest.approx(up - down, rel=1e-3)


def small(level=4):
    torch.manual_seed(1)
    ring = FittedObject((1.0, 2.0, 3.0), 2.0)
    with torch.no_grad():
        for parameter in ring.parameters():
            parameter += 0.02 * torch.randn_like(parameter)
    return ring


def test_gradients_reach_the_points_as_without_details():
    ring, s, step = small(), points_near(40).requires_grad_(), 1e-3
    add_detail(ring, 3, 10)
    ring.brdf_net = SharpenedMaterial.of(ring.brdf_net, Grid.around(points_near(), 0.2, 1, 3))
    for grid in (ring.shape_net.grid, ring.brdf_net.base.grid, ring.brdf_net.grid):
        for values in grid.values:
            values.data = 0.3 * torch.randn(values.shape)
    for function in (ring.surface, lambda s: ring.material(s)["diffuse"], lambda s: ring.brdf_net.fine(s)["diffuse"]):
        (gradient,) = torch.autograd.grad(function(s).sum(), s)
        with torch.no_grad():
            ahead, behind = function(s + step * s), function(s - step * s)
        expected = (ahead - behind).sum(1) / (2 * step)
        error = (gradient * s).sum(1) - expected  # not where a cube ends between the two points
        assert error.abs().median() < 0.01 * expected.abs().median()


def test_without_values_nothing_changes_and_networks_are_fixed():
    ring, s = small(), points_near()
    before = ring(s)
    add_detail(ring, 4, 20)
    after = ring(s)
    assert torch.equal(before[0], after[0])
    assert all(torch.equal(before[1][name], after[1][name]) for name in before[1])
    assert ring.subdivisions == 4
    free = {name for name, p in ring.named_parameters() if p.requires_grad}
    assert free == {name for name, _ in ring.named_parameters() if ".grid." in name}


@pytest.mark.parametrize("trained", [3, 4])
def test_what_the_flow_does_between_trained_vertices_is_taken_away(trained):
    """Waves of less than two edges of the trained mesh, on a sphere; long waves stay."""
    ring = small()
    s, faces = ring.domain.sample(4)
    edge = float((s[faces[:, 0]] - s[faces[:, 1]]).norm(dim=1).mean())
    waves = [0.1 * edge * torch.cos(2 * math.pi / (edge * length) * s[:, 2]) for length in (3.5, 20.0)]
    ring.shape_net.forward = lambda points, time=1.0: points * (1 + sum(waves))[:, None]
    add_detail(ring, 4, 2.5 / edge)  # cubes of half an edge
    smooth_between(ring, 4, trained)
    left = (ring.shape_net(s) * s).sum(1).detach() - 1
    if trained == 4:
        assert torch.allclose(left, sum(waves), atol=1e-6)
        return
    middle = s[:, 2].abs() < 0.5  # elsewhere waves along z are longer on the surface
    solved = torch.linalg.lstsq(torch.stack(waves, 1)[middle], left[middle, None]).solution
    assert abs(float(solved[0])) < 0.35 and float(solved[1]) == pytest.approx(1, abs=0.1)


def test_smoothing_of_a_cone_is_a_dense_solution():
    """Its vertices have unequal triangles and degrees, unlike those of the sphere."""
    mesh = trimesh.creation.cone(0.5, 1.5, sections=11).subdivide()
    assert mesh.is_watertight and len({*mesh.vertex_degree}) > 2
    linked = np.zeros((len(mesh.vertices),) * 2)
    for a, b in mesh.edges:
        linked[a, b] = linked[b, a] = 1
    root = np.sqrt(linked.sum(1))
    laplacian = np.eye(len(linked)) - linked / np.outer(root, root)
    middle = mesh.vertices.mean(0)
    solved = np.linalg.solve(np.eye(len(linked)) + 3 * laplacian @ laplacian, root[:, None] * (mesh.vertices - middle))
    np.testing.assert_allclose(smoothed(mesh.vertices, mesh.faces, 3.0), solved / root[:, None] + middle, atol=1e-7)


def test_displacement_is_along_the_normal_in_cells():
    ring = small()
    s, faces = ring.domain.sample(4)
    before = ring.surface(s).detach()
    add_detail(ring, 4, 20)
    ring.shape_net.grid.values[-1].data.fill_(0.5)
    moved = (ring.surface(s).detach() - before) / float(ring.radius)
    normals = trimesh.Trimesh(before.numpy(), faces, process=False).vertex_normals
    assert torch.allclose(moved.norm(dim=1), torch.tensor(0.5 * ring.shape_net.grid.cells[-1]), rtol=0.03)
    assert ((moved.numpy() * normals).sum(1) / moved.norm(dim=1).numpy()).min() > 0.97
    half = (ring.surface(s, 0.5) - ring.to_scene(ring.shape_net.base.network(s, 0.5))) / ring.radius
    assert torch.allclose(half, moved / 2, atol=1e-5)


def test_sides_that_cancel_are_not_displaced():
    """Of a wall that is thinner than the cubes. Beside it one side alone has a direction."""
    random, above = np.random.default_rng(5), np.array([0, 0, 0.01])
    wall = np.column_stack([random.uniform(-1, 1, (4000, 2)), np.zeros(4000)])
    points = torch.from_numpy(np.concatenate([wall + above, wall - above, [[3.0, 3.0, 3.0]]])).float()
    normals = torch.tensor([[0.0, 0, 1]] * 4000 + [[0.0, 0, -1]] * 4000 + [[0.0, 1, 0]])
    detailed = DetailedFlow.of(small().shape_net, Grid.around(points, 0.5, 1, 1), points, normals)
    before = detailed(points).detach()
    detailed.grid.values[0].data.fill_(1.0)
    moved = (detailed(points).detach() - before).norm(dim=1) / detailed.grid.cells[0]
    assert moved[:-1].max() < 0.05 and moved[-1] > 0.5


def test_material_stays_in_its_range():
    ring, s = small(), points_near()
    add_detail(ring, 4, 20)
    for values in ring.brdf_net.grid.values:
        values.data = 3 * torch.randn(values.shape)
    found = ring.material(s)
    assert found["roughness"].min() >= 0
    assert found["roughness"].max() <= 1
    assert found["diffuse"].min() >= 0
    raw = ring.brdf_net.base.network.evaluate(s) + ring.brdf_net.grid(s)
    assert torch.allclose(found["diffuse"], float(ring.brdf_net.scale) * torch.log1p(raw[:, :3].exp()), rtol=1e-4)


def test_a_file_holds_details():
    ring, s = small(), points_near()
    add_detail(ring, 4, 20)
    for grid in (ring.shape_net.grid, ring.brdf_net.grid):
        for values in grid.values:
            values.data = torch.randn(values.shape)
    again = ring_of(ring_state(ring))
    assert isinstance(again.shape_net, DetailedFlow)
    assert isinstance(again.brdf_net, DetailedMaterial)
    for a, b in zip((ring.surface(s), *ring.material(s).values()), (again.surface(s), *again.material(s).values())):
        assert torch.equal(a, b)
    assert again.subdivisions == 4
    rounded = ring_of(compact(ring_state(ring)))
    assert all(len(values.unique()) < 2**16 for values in rounded.shape_net.grid.values)
    worst = (ring.surface(s) - rounded.surface(s)).norm(dim=1).max()
    assert 0 < worst < 2e-3 * ring.shape_net.grid.cells[0] * float(ring.radius)


def of_all(**changed):
    return lambda state: [state[name]["arguments"]["grid"].update(changed) for name in ("shape_net", "brdf_net")]


def of_tensor(name, change):
    return lambda state: state["networks"].update({name: change(state["networks"][name])})


def two_channels(state):
    state["brdf_net"]["arguments"]["net"]["arguments"]["parameters"] = [
        ("diffuse", 2, 0.0, math.inf, 0.0), ("specular", 2, 0.0, math.inf, 0.0), ("roughness", 1, 0.0, 1.0, 0.0)
    ]  # fmt: skip


def four_channels(state):
    state["brdf_net"]["arguments"]["grid"]["channels"] = 4
    for k in range(4):
        state["networks"][f"brdf_net.grid.values.{k}"] = state["networks"][f"brdf_net.grid.values.{k}"][:, :4]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (of_tensor("shape_net.grid.keys3", lambda keys: keys.flip(0)), "not in order"),
        (of_tensor("brdf_net.grid.keys3", lambda keys: keys[:1].repeat(len(keys))), "not in order"),
        (of_tensor("brdf_net.grid.keys3", lambda keys: keys[:1].expand(10**9)), "repeats"),
        (lambda state: state["shape_net"]["arguments"].update(flow=copy.deepcopy(state["shape_net"])), "of details"),
        (lambda state: state["brdf_net"]["arguments"].update(net=copy.deepcopy(state["brdf_net"])), "of details"),
        (four_channels, "of 4 channels"),
        (of_tensor("shape_net.grid.keys0", lambda keys: keys + 2**30), "elsewhere"),
        (of_tensor("shape_net.grid.keys3", torch.Tensor.float), "another kind"),
        (of_tensor("shape_net.grid.values.3", torch.Tensor.int), "another kind"),
        (of_tensor("shape_net.directions3", lambda directions: 2 * directions), "longer than 1"),
        *[(of_all(cell=cell), "positive") for cell in (0.0, -0.1, math.nan, math.inf, 1e308)],
        *[(of_all(cell=cell), "elsewhere") for cell in (1e30, 1e-30, 1.0)],
        *[(of_all(nodes=nodes), "sizes") for nodes in ([10**9] * 4, [1] * 2000, [])],
        (of_all(channels=10**9), "sizes"),
        (two_channels, "2 channels"),
    ],
)
def test_damaged_details_are_refused(damage, message):
    ring = small()
    add_detail(ring, 4, 20)
    state = compact(ring_state(ring))
    ring_of(state)
    damage(state)
    with pytest.raises(ValueError, match=message):
        ring_of(state)


def textured(channels=3, nodes=None, depth=1, named="diffuse"):
    """The state of an object whose material has a texture, in which some things may be wrong."""
    ring = small()
    ring.brdf_net.set_parameters([p._replace(name=named) if p.channels == 3 else p for p in COOK_TORRANCE], 1)
    add_detail(ring, 3, 10)
    state, grid = ring_state(ring), Grid.around(points_near(), 0.2, 1, channels)
    for _ in range(depth):
        places = {f"brdf_net.grid.{name}": value for name, value in grid.state_dict().items()}
        places["brdf_net.scale"] = torch.tensor(1.0)
        state["networks"] = {k.replace("brdf_net.", "brdf_net.base."): v for k, v in state["networks"].items()} | places
        arguments = {"net": state["brdf_net"], "grid": grid.arguments() | ({"nodes": nodes} if nodes else {})}
        state["brdf_net"] = {"name": "sharpened-material", "arguments": arguments}
    return state


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"channels": 1}, "of 1 channels"), ({"nodes": [10**9]}, "sizes"), ({"depth": 100}, "details of details"),
     ({"named": "transmittance"}, "does not suit")],
)  # fmt: skip
def test_damaged_textures_are_refused(wrong, message):
    assert isinstance(ring_of(textured()).brdf_net, SharpenedMaterial)
    with pytest.raises(ValueError, match=message):
        ring_of(textured(**wrong))


def test_a_number_without_end_is_refused_in_one_line(tmp_path):
    state = textured()
    state["brdf_net"]["arguments"]["grid"]["cell"] = 10**400
    write_state(state, tmp_path / "ring.pt")
    with pytest.raises(InputError, match=r"ring\.pt: damaged"):
        load_fit(tmp_path)


def test_materials_with_other_details_keep_their_own_weights():
    shape, material, s = small(), small(), points_near()
    add_detail(shape, 4, 20)
    add_detail(material, 4, 33)
    for values in material.brdf_net.grid.values:
        values.data = torch.randn(values.shape, generator=torch.Generator().manual_seed(5))
    expected = material.material(s)
    shape.brdf_net = material.brdf_net
    share_weights(shape)
    shape.surface(s)
    assert all(torch.equal(value, expected[name]) for name, value in shape.material(s.clone()).items())


@pytest.mark.parametrize("resolution", [10, 55, 220])
def test_the_finest_mesh_has_about_a_vertex_for_each_pixel(resolution):
    coarse, fine = detail_levels(small(), resolution)
    assert fine == coarse + 1
    spacing = math.sqrt(4 * math.pi / (10 * 4**fine)) * resolution
    assert 0.6 < spacing < 2.4


def test_levels_end_at_eight():
    assert detail_levels(small(), 5000) == [7, 8]


def test_networks_that_no_file_can_hold_get_no_details():
    class Own(torch.nn.Module):
        pass

    ring = small()
    ring.brdf_net = Own()
    assert detail_levels(ring, 100) == []


def test_a_stretched_domain_has_smaller_cells():
    sphere = Sphere()
    tall = Domain(sphere.sample(3)[0].numpy() * np.array([1, 1, 3], np.float32), sphere.sample(3)[1])
    torch.manual_seed(0)
    ring = FittedObject((0.0, 0.0, 0.0), 1.0, domain=tall)
    add_detail(ring, 4, 20)
    assert ring.shape_net.grid.cells[-1] == pytest.approx(1.25 / 20, rel=0.05)


def descend(gradients, **options):
    """Values after steps with these gradients (T, N)."""
    values = torch.nn.Parameter(torch.zeros(gradients.shape[1]))
    optimizer = AgreeingAdam([values], lr=0.01, **options)
    for values.grad in gradients:
        optimizer.step()
    return values.detach()


def test_values_move_where_gradients_agree_and_stay_where_they_do_not():
    torch.manual_seed(0)
    noise = torch.randn(200, 1000)
    moved = descend(noise, doubt=2.0)
    steady = descend(torch.full((200, 3), -1.0) * torch.tensor([1e-9, 1.0, 1e6]), doubt=2.0)
    assert torch.allclose(steady, steady[1])  # whatever the scale
    # The first steps wait: until then one sign says nothing. Later each is lr (1 - doubt σ), σ² = (1 - β) / (1 + β).
    deviation = [math.sqrt(0.1 / 1.9 * (1 + 0.9**t) / (1 - 0.9**t)) for t in range(1, 201)]
    assert float(steady[1]) == pytest.approx(0.01 * sum(max(0, 1 - 2 * d) for d in deviation), rel=1e-4)
    assert moved.abs().mean() < 0.05 * steady[1]


def test_values_in_parts_move_as_all_at_once(monkeypatch):
    gradients = torch.randn(30, 50, generator=torch.Generator().manual_seed(2)) + 0.5
    whole = descend(gradients)
    monkeypatch.setattr(agreeing_adam, "AT_ONCE", 7)
    assert whole.any() and torch.equal(descend(gradients), whole)


@pytest.mark.parametrize(("kind", "expected"), [("shape", [0.2]), ("texture", [0.6]), ("both", [0.2, 0.6])])
def test_textures_change_three_times_as_fast_as_displacements(kind, expected):
    ring = small()
    add_detail(ring, 4, 20)
    [stepper] = detail_steppers(ring, dataclasses.replace(SMALL, detail=kind, detail_rate=0.2))
    assert [rate.initial for rate in stepper.rates] == pytest.approx(expected)
    nets = [net for net, name in ((ring.shape_net, "shape"), (ring.brdf_net, "texture")) if kind in (name, "both")]
    for group, net in zip(stepper.optimizer.param_groups, nets, strict=True):
        assert [id(p) for p in group["params"]] == [id(p) for p in net.grid.parameters()]


def test_iterations_that_do_not_show_a_value_change_nothing_of_it():
    often = torch.sign(torch.randn(40, 5, generator=torch.Generator().manual_seed(3)) + 0.5)
    seldom = torch.zeros(120, 5)
    seldom[::3] = often
    assert torch.equal(descend(often), descend(seldom))


def test_adam_without_doubt():
    gradients = torch.randn(50, 20, generator=torch.Generator().manual_seed(4)) + 1
    values = torch.nn.Parameter(torch.zeros(20))
    adam = torch.optim.Adam([values], lr=0.01, betas=(0.9, 0.99), eps=1e-12)
    for values.grad in gradients:
        adam.step()
    ours = descend(gradients, doubt=0.0)
    assert torch.allclose(ours, values.detach(), atol=0.02)  # its steps are not cut off at lr
    assert (values.detach() < -0.1).all()


def least_cosine(ring):
    """The least cosine between a triangle with and without details, at level 4."""
    s, faces = ring.domain.sample(4)
    points = ring.shape_net(s), ring.shape_net.base.network(s)
    a, b = (trimesh.Trimesh(p.detach().numpy(), faces, process=False).face_normals for p in points)
    return (a * b).sum(1).min()


def test_folds_are_smoothed_and_nothing_else():
    ring = small()
    add_detail(ring, 4, 20)
    s, _ = ring.domain.sample(4)
    values = ring.shape_net.grid.values[-1]
    values.data[:] = 0.05 * torch.randn(values.shape, generator=torch.Generator().manual_seed(2))
    gentle = values.detach().clone()
    unfold(ring, 4)
    assert torch.equal(values, gentle)
    peak = int(ring.shape_net.grid.weights(s)[-1].sum(0).argmax())
    values.data[peak] = 40
    assert least_cosine(ring) < 0.2
    unfold(ring, 4)
    assert least_cosine(ring) >= 0.2 - 1e-5
    assert abs(float(values[peak].detach())) < 20
    assert (values == gentle)[:, 0].float().mean() > 0.9


def test_no_fold_is_left_and_smoothing_again_changes_nothing():
    for seed in (1, 2):
        ring = small()
        add_detail(ring, 4, 20)
        for values in ring.shape_net.grid.values:
            values.data = 30 * torch.randn(values.shape, generator=torch.Generator().manual_seed(seed))
        unfold(ring, 4)
        assert least_cosine(ring) >= 0.2 - 1e-5
        before = [values.detach().clone() for values in ring.shape_net.grid.values]
        unfold(ring, 4)
        assert all(torch.equal(a, b) for a, b in zip(before, ring.shape_net.grid.values))


def test_points_and_networks_that_change_in_place_are_noticed():
    ring, s = small(), points_near()
    add_detail(ring, 4, 20)
    for grid in (ring.shape_net.grid, ring.brdf_net.grid):
        for values in grid.values:
            values.data = torch.randn(values.shape, generator=torch.Generator().manual_seed(8))

    def current():
        return torch.equal(ring.surface(s), ring.surface(s.clone())) and all(
            torch.equal(a, b) for a, b in zip(ring.material(s).values(), ring.material(s.clone()).values())
        )

    ring(s)
    s *= -1
    assert current()
    ring(s)
    with torch.no_grad():
        for parameter in [*ring.shape_net.base.parameters(), *ring.brdf_net.base.parameters()]:
            parameter += 0.01
    assert current()
    elsewhere = ring_state(ring)["networks"]
    elsewhere = {name: v + 2**43 if ".keys" in name else v.clone() for name, v in elsewhere.items()}
    ring(s)
    ring.load_state_dict(elsewhere)
    assert current()


def test_details_come_last_and_only_if_photographs_can_agree():
    stages = Schedule.of(Config(iterations=100, detail_share=0.31), settling=True, detail=[6, 7]).stages
    assert [stage.detail for stage in stages[-3:]] == [False, True, True]
    assert stages[-3].settles
    assert [(stage.level, stage.last - stage.first) for stage in stages[-2:]] == [(6, 21), (7, 10)]
    for none in (Config(iterations=100, detail_share=0.09), Config(iterations=100, detail="none")):
        assert not any(stage.detail for stage in Schedule.of(none, detail=[6, 7]).stages)
    schedule = Schedule(stages)
    first = stages[-2].first
    assert [schedule.detail_progress(k) for k in (0, first, schedule.iterations)] == [0, 0, 1]
    assert schedule.progress(first) == 1


SMALL = Config(iterations=24, levels=(2,), widths=(32,), shares=(1.0,), detail_share=0.5, batch=4, deterministic=True,
               subdivisions=3, domain="sphere", refine=("none",), indirect=False, lobes="1")  # fmt: skip


STOPS = 24, 31, 32, 35  #: before the first stage for details, in it, before the second, in it


@pytest.fixture(scope="module")
def detailed(small_capture):
    with threads_of(1):
        fit = Fit(load_capture(small_capture), SMALL)
        states = {}
        for it in fit:
            if it.number in STOPS:
                states[it.number] = fit.state()
    return fit, states


@pytest.mark.parametrize("number", STOPS)
def test_a_fit_with_details_goes_on_where_it_stopped(detailed, small_capture, number):
    fit, states = detailed
    assert [stage.first for stage in fit.schedule.stages if stage.detail] == [24, 32]
    with threads_of(1):
        again = Fit(load_capture(small_capture), SMALL, state=states[number])
        assert again.iteration == number
        again.run()
    found, expected = again.ring.state_dict(), fit.ring.state_dict()
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in found)
    assert all(any(values.any() for values in net.grid.values) for net in (again.ring.shape_net, again.ring.brdf_net))
    assert [{**entry, "seconds": 0} for entry in again.course.log] == [{**e, "seconds": 0} for e in fit.course.log]


def test_the_networks_stay_as_they_were(detailed, small_capture):
    fit, _ = detailed
    with threads_of(1):
        alone = Fit(load_capture(small_capture), dataclasses.replace(SMALL, detail="none"))
        alone.run()
    for name, value in alone.ring.shape_net.state_dict().items():
        assert torch.equal(value, fit.ring.shape_net.base.network.state_dict()[name])
    assert any(values.any() for values in fit.ring.brdf_net.grid.values)


def test_a_finished_fit_asks_for_a_texture_in_its_own_light(detailed, small_capture, monkeypatch, capsys):
    asked = []

    def gone(given, before, refined, surface, ring, fitted, width):
        asked.append((surface, ring, len(fitted), width))
        raise InputError("000.png: no such file")

    monkeypatch.setattr(result, "sharpened", gone)
    fit, states = detailed
    assert fit.result().ring is fit.ring  # all else can be saved
    assert asked == [(fit.renderer.surface, fit.ring, 12, SMALL.widths[-1])]
    assert "no texture: 000.png" in capsys.readouterr().out
    Fit(load_capture(small_capture), SMALL, state=states[31]).result()  # not at its end
    assert len(asked) == 1


def test_the_scene_shows_the_object_at_the_level_of_its_details(detailed, small_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(results.report, "report_html", lambda *_: "")
    monkeypatch.setattr(results, "viewed", lambda *_: None)
    monkeypatch.setattr(result, "sharpened", lambda given, before, refined, surface, ring, *_: ring)
    at_the_start = results.fitted_scene(load_capture(small_capture), small(), tmp_path)
    results.write(tmp_path, detailed[0].result(), at_the_start)
    level = detailed[0].ring.subdivisions
    assert level != small().subdivisions
    assert f'name="subdivisions" value="{level}"' in (tmp_path / "scene.xml").read_text()


@pytest.mark.parametrize("kind", ["texture", "shape"])
def test_one_of_the_two(kind, small_capture):
    """Of the other one nothing changes. The displacements begin with what smooths the flow."""
    fit = Fit(load_capture(small_capture), dataclasses.replace(SMALL, detail=kind))
    while not fit.model.detailed:
        fit.step()
    nets = fit.ring.shape_net, fit.ring.brdf_net
    before = [[v.detach().clone() for v in net.grid.values] for net in nets]
    fit.run()
    shape, texture = (any((a != b).any() for a, b in zip(own, net.grid.values)) for own, net in zip(before, nets))
    assert (shape, texture) == (kind == "shape", kind == "texture")


def test_networks_with_details_are_refused(detailed, small_capture):
    ring = detailed[0].ring
    with pytest.raises(InputError, match="networks: have details"):
        Fit(load_capture(small_capture), SMALL, networks=(ring.shape_net, ring.brdf_net))


def test_details_that_do_not_help_are_removed(small_capture):
    fit = Fit(load_capture(small_capture), dataclasses.replace(SMALL, holdout=3))
    while fit.iteration < fit.iterations - 1:
        fit.step()
    smooth = fit.ring.shape_net.base.network
    for values in fit.ring.brdf_net.grid.values:
        values.data = 3 * torch.randn(values.shape, generator=torch.Generator().manual_seed(1))
    fit.step()
    assert "detail" in fit.course.validation["put_back"]
    assert fit.ring.shape_net is smooth
    assert all(parameter.requires_grad for parameter in fit.ring.parameters())  # as without details
    again = Fit(load_capture(small_capture), fit.problem.config, state=fit.state())
    assert again.iteration == again.iterations
    s = points_near()
    assert torch.equal(again.ring.surface(s), fit.ring.surface(s))


def test_a_state_that_has_details_of_one_network_alone_is_refused(detailed, small_capture):
    state = copy.deepcopy(detailed[1][31])
    ring = state["ring"]
    ring["brdf_net"] = ring["brdf_net"]["arguments"]["net"]
    tensors = {name: value for name, value in ring["networks"].items() if not name.startswith("brdf_net.grid")}
    ring["networks"] = {name.replace("brdf_net.base.network.", "brdf_net."): value for name, value in tensors.items()}
    with pytest.raises(InputError, match="state: is of a fit with other settings"):
        Fit(load_capture(small_capture), SMALL, state=state)
