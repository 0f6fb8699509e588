"""Gauss-Newton steps of the cameras: how pictures move with them, and where the steps lead."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.quick_fits import iteration_of, posed
from scipy.spatial.transform import Rotation
from torch.nn import functional as F

import mi_ring
from mi_ring.calibration.calibration import Calibration
from mi_ring.calibration.rig import Rig
from mi_ring.capture.capture import Observation
from mi_ring.fitting import losses, pose_solver, schedule
from mi_ring.fitting.exposure_solver import ExposureSolver, quarters, shared_part
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.pose_solver import Pull, derivatives, motion, pull, remaining_shifts, slopes
from mi_ring.fitting.processes import ALONE
from mi_ring.fitting.schedule import Stage
from mi_ring.geometry.camera import Camera

SIZE = (7, 5)


def on_sphere(camera, center, radius):
    """Points (H·W, 3) of a sphere that the pixels see, None for those that miss it."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = camera.directions(np.stack([x.ravel(), y.ravel()], 1))
    away = camera.position - center
    along = rays @ away
    inside = along**2 - (away @ away - radius**2)
    return [camera.position + (-b - np.sqrt(d)) * ray if d > 0 else None for ray, b, d in zip(rays, along, inside)]


def test_pixels_move_as_points_of_a_sphere_do_when_the_camera_does():
    to_world = np.eye(4)
    to_world[:3, :3] = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    to_world[:3, 3] = 30, -20, 11
    camera = Camera(to_world, np.array([9.0, 11.0]), np.array([3.0, 2.9]), SIZE)
    inside = np.array([1.0, -2.0, 40.0])  # in the camera's axes
    center, radius = to_world[:3, :3] @ inside + to_world[:3, 3], 9.0
    points = on_sphere(camera, center, radius)
    seen = [k for k, point in enumerate(points) if point is not None]
    assert 5 < len(seen) < 30
    found = motion(torch.tensor([9.0, 11.0, 3.0, 2.9]), SIZE, torch.tensor(inside).float(), radius)
    found = found.reshape(-1, 2, 6).numpy()
    for j, step in enumerate(1e-5 * np.eye(6)):
        moved = to_world.copy()
        moved[:3, :3] = to_world[:3, :3] @ Rotation.from_rotvec(step[:3]).as_matrix()
        moved[:3, 3] = to_world[:3, 3] + to_world[:3, :3] @ step[3:]
        for k in seen:
            before, after = (c.project(points[k][None])[0][0] for c in (camera, camera._replace(to_world=moved)))
            np.testing.assert_allclose(found[k, :, j], (after - before) / 1e-5, rtol=1e-3, atol=2e-4)
    assert np.isfinite(found).all()  # of those that miss it, too


def test_slopes_are_those_of_a_plane():
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(7.0), indexing="ij")
    found = slopes(torch.stack([2 * x - 3 * y, 0.5 * y], -1))
    torch.testing.assert_close(found[1:-1, 1:-1], torch.tensor([[2.0, -3.0], [0.0, 0.5]]).expand(3, 5, 2, 2))


@pytest.mark.parametrize("loss", ["l1+log", "l2"])
def test_cameras_go_where_photographs_were_taken(small_capture, loss):
    fit, index = posed(small_capture, loss=loss)
    calibration, center = fit.model.calibration, fit.model.calibration.rig.center
    random = torch.Generator().manual_seed(1)
    with torch.no_grad():
        calibration.turn += 2 * torch.randn(calibration.turn.shape, generator=random)
        calibration.move += 2 * torch.randn(calibration.move.shape, generator=random)
    untouched = np.setdiff1d(np.arange(len(fit.capture)), index)
    before = calibration.turn.detach().clone()

    def pixels():
        """How far the object's centre is from where it was, in photographs of 56 × 40 [px]: (4,)."""
        cameras = calibration()[0].detach()[index]
        found = torch.einsum("nji,nj->ni", cameras[:, :, :3], center - cameras[:, :, 3])
        base = calibration.rig.views.cameras[index]
        true = torch.einsum("nji,nj->ni", base[:, :, :3], center - base[:, :, 3])
        return 60 * (found[:, :2] / found[:, 2:] - true[:, :2] / true[:, 2:]).norm(dim=1)

    first = pixels()
    assert first.mean() > 1
    for _ in range(8):
        fit.step()
    assert pixels().max() < 0.1 * first.mean()
    assert torch.equal(calibration.turn[untouched], before[untouched])


def test_right_cameras_stay(small_capture):
    fit, _ = posed(small_capture)
    for _ in range(8):
        fit.step()
    # About and along the optical axis pictures tell the least: a quarter moves the rim by a twentieth of a pixel.
    calibration = fit.model.calibration
    assert calibration.turn.abs().max() < 0.25 and calibration.move.abs().max() < 0.25


@pytest.mark.parametrize("kind", ["colours", "silhouettes", "both", "partly valid"])
def test_curvature_and_shifts_are_those_of_the_loss(small_capture, kind):
    """Second differences of the loss of pictures that move as a sphere's do: of squares, Gauss-Newton is exact."""
    capture, radius = mi_ring.load_capture(small_capture, images=False), 25.0
    rig = Rig(capture, np.array([400.0, -150.0, 90.0]), 0.3)
    calibration, index = Calibration(capture, ["cameras"], rig), np.array([3, 8])
    weights = {"rgb": 1.0, "mask": 2.0, "calibration": 0.5}
    weights |= {"colours": {"mask": 0.0}, "silhouettes": {"rgb": 0.0}}.get(kind, {})
    width, height = capture.shots[0].size
    context = SimpleNamespace(model=SimpleNamespace(calibration=calibration, ring=SimpleNamespace(radius=radius)),
                              config=mi_ring.Config(loss="l2"), exposure=0.3,
                              capture=SimpleNamespace(lit_room=False, threshold=None),
                              schedule=SimpleNamespace(outline_blur=lambda progress, width: 1.5))  # fmt: skip
    batch = SimpleNamespace(progress=0.5, photographs=index, all_photographs=index, size=(width, height), scale=1,
                            stage=Stage(2, 28, 0, 9), share=ALONE.share(len(index)))  # fmt: skip
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")

    def pictures(shift):
        """Radiance (2, H, W, 3) and coverage (2, H, W) that have moved by `shift` (2, H, W, 2) [px]."""
        u, v = x + shift[..., 0], y + shift[..., 1]
        colours = [0.5 + 0.3 * torch.sin(a * u + b * v + c) for a, b, c in ((0.2, 0.1, 0), (-0.1, 0.2, 1), (0.1, 0, 2))]
        return torch.stack(colours, -1), torch.sigmoid(7 - ((u - 28) ** 2 / 250 + (v - 19) ** 2 / 120) * 6)

    def loss(step):
        shift = torch.stack([torch.einsum("hwaj,j->hwa", one, step.to(one)) for one in moving])
        rgb, coverage = pictures(shift)
        same = torch.zeros_like(rgb, dtype=torch.bool)
        value = weights["rgb"] * losses.rgb_loss(rgb, seen.rgb, same, 0.3, "l2")
        value = value + weights["mask"] * losses.mask_loss(coverage, seen.mask, 1.5, valid)
        return float(value) + weights["calibration"] * float(2 * step.square().sum()) / 2 / len(rig)

    unit = torch.tensor([calibration.widths["turn"]] * 3 + [rig.distance * calibration.widths["move"]] * 3)
    with torch.no_grad():
        views = calibration()
    moving = []
    for k in index:
        center = views.cameras[k, :, :3].T @ (rig.center - views.cameras[k, :, 3])
        moving.append((motion(views.intrinsics[k], (width, height), center, radius) * unit).double())
    rgb, coverage = pictures(torch.zeros(2, height, width, 2).double())
    seen = Observation(rgb, torch.zeros_like(rgb, dtype=torch.bool), coverage, torch.ones(2).bool(), None)
    shown = SimpleNamespace(rgb=rgb.float(), coverage=coverage.float())
    valid = torch.ones(2, height, width, dtype=torch.bool)
    valid[:, :13, 24:40] = kind != "partly valid"  # a part of the outline, where masks are wrong
    as_seen = seen._replace(rgb=shown.rgb, mask=torch.where(valid, shown.coverage, 1), valid=valid)
    it = Iteration(batch, as_seen, shown, context, weights=weights)
    assert all(float(first.abs().max()) < 1e-9 for _, first, _ in derivatives(it))
    found = pull(it).curvature.double().sum(0)  # both cameras take the same step
    random = torch.Generator().manual_seed(2)
    for direction in [*torch.eye(6), *torch.randn(6, 6, generator=random)]:
        step = 0.1 * direction.double()
        second = (loss(step) + loss(-step) - 2 * loss(0 * step)) / 0.1**2
        direction = direction.double()
        assert float(direction @ found @ direction) == pytest.approx(second, rel=0.05), direction
    right, down = 0.2, -0.1
    rgb, coverage = pictures(torch.tensor([-right, -down]).double().expand(2, height, width, 2))
    it.observation = as_seen._replace(rgb=rgb.float(), mask=torch.where(valid, coverage.float(), 1))
    shifts = pull(it).shifts[:, 0] * views.intrinsics[index, :2]
    np.testing.assert_allclose(shifts, [[right, down]] * 2, atol=0.02)


def test_shifts_are_found_of_pictures_and_of_their_quarters():
    """Of a picture all of which is shifted, and of one of which a quarter is. A bright pixel beside it is no part."""
    height, width, inside = 40, 56, torch.zeros(40, 56, dtype=torch.bool)
    inside[6:34, 10:46] = True
    y, x = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")

    def picture(right, down):
        return 2 + torch.sin(0.3 * (x - right) + 0.1 * (y - down)) + torch.cos(0.4 * (y - down) - 0.2 * (x - right))

    shown, slope = picture(0, 0), slopes(picture(0, 0)[..., None])[..., 0, :]
    second = torch.einsum("hwa,hwb->hwab", slope, slope)
    moved, part = picture(0.3, -0.2), (x > 27.5) & (y > 19.5)
    all_of_it = remaining_shifts((shown - moved)[..., None] * slope, second, inside)
    np.testing.assert_allclose(all_of_it, np.tile([[0.3, -0.2]], (5, 1)), atol=0.02)
    one = remaining_shifts(((shown - moved) * part)[..., None] * slope, second, inside)
    np.testing.assert_allclose(one[1:], np.outer([0, 0, 0, 1], [0.3, -0.2]), atol=0.02)
    assert one[0].abs().max() < 0.1
    # A quarter without structure, or with some in one direction alone, tells nothing. Nor does a pixel that is NaN.
    flat = slope.clone()
    flat[..., 1] *= ~((x < 27.5) & (y < 19.5))
    second = torch.einsum("hwa,hwb->hwab", flat, flat)
    found = remaining_shifts((shown - moved)[..., None] * flat, second * ~part[..., None, None], inside)
    assert found.isnan().all(1).tolist() == [False, True, False, False, True]
    second[8, 12] = torch.nan
    assert remaining_shifts((shown - moved)[..., None] * flat, second, inside).isnan().all()


def test_shifts_that_are_unknown_are_not_stored(small_capture, monkeypatch):
    """The last that was known stays. Two photographs of a pair have one camera."""
    fit, index = posed(small_capture, batch=3)
    (solver,) = fit.optimisation.solvers
    given = torch.arange(1.0, 31).reshape(3, 5, 2)
    given[1, 2:] = torch.nan
    given[2, :2] = 0
    solver.camera[index[2]] = solver.camera[index[1]]
    monkeypatch.setattr(pose_solver, "pull", lambda it: Pull(torch.eye(6).repeat(3, 1, 1), given))
    solver.look(iteration_of(fit))
    assert torch.equal(solver.measured[index[0]], given[0])
    assert torch.equal(solver.measured[index[1]], torch.cat([given[1, :2], given[2, 2:]]))
    assert len(solver.seen[0]) == 2


def test_the_same_shift_of_all_pictures_is_no_evidence(small_capture):
    fit, _ = posed(small_capture)
    (solver,) = fit.optimisation.solvers
    random = torch.Generator().manual_seed(1)
    shifts = torch.randn(solver.measured.shape, generator=random)
    shifts[:, 0] = shifts[:, 1:].mean(1)
    solver.measured[:] = shifts + torch.tensor([0.0, 100.0])
    assert solver.shared < 0.5
    solver.measured[:] += 5 * torch.randn(len(shifts), 1, 2, generator=random)
    assert solver.shared > 0.8


def centers(calibration, index):
    """Where the object's centre is in photographs (n, 2) [focal lengths]."""
    with torch.no_grad():
        cameras = calibration().cameras[index]
    found = torch.einsum("nji,nj->ni", cameras[:, :, :3], calibration.rig.center - cameras[:, :, 3])
    return found[:, :2] / found[:, 2:]


def distorted(pictures, coverage, random):
    """Pictures (n, H, W, C) of which each quarter of the object is shifted by itself, by about a pixel."""
    n, height, width, _ = pictures.shape
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    part = torch.stack([quarters(one > 0.5) for one in coverage])
    shift = torch.randn(n, 4, 2, generator=random)[torch.arange(n)[:, None, None], part]
    grid = (torch.stack([x, y], -1) + shift) * 2 / torch.tensor([width, height]) - 1
    return F.grid_sample(pictures.movedim(-1, 1), grid, align_corners=False).movedim(1, -1)


def test_a_wrong_surface_does_not_move_cameras(small_capture):
    """It moves parts of pictures, a wrong camera all of them."""
    fit, index = posed(small_capture, batch=10)
    calibration, random = fit.model.calibration, torch.Generator().manual_seed(1)
    given = centers(calibration, index)
    with torch.no_grad():
        calibration.turn += 2 * torch.randn(calibration.turn.shape, generator=random)
        shifted, true = iteration_of(fit).prediction, centers(calibration, index)
        calibration.turn *= 0
        shown = iteration_of(fit)
    pictures = torch.cat([shown.prediction.rgb, shown.prediction.coverage[..., None]], -1)
    pictures = distorted(pictures, shown.prediction.coverage, random)
    for rgb, mask, at in (shifted.rgb, shifted.coverage, true), (pictures[..., :3], pictures[..., 3], given):
        seen = shown.observation._replace(rgb=rgb, mask=mask)
        fit.sampler.observe = lambda *_, seen=seen: seen
        for _ in range(8):
            fit.step()
        # Were all of it taken for the cameras' error, distorted pictures would move them by 0.6 px.
        assert 60 * (centers(calibration, index) - at).norm(dim=1).mean() < 0.05
    assert 60 * (given - true).norm(dim=1).mean() > 1


def test_terms_whose_curvature_is_not_known_are_refused(small_capture):
    config = mi_ring.Config(refine=("cameras",), domain="sphere")
    with pytest.raises(mi_ring.InputError, match="terms: rgb, mask: must be the default ones for --refine cameras"):
        mi_ring.Fit(mi_ring.load_capture(small_capture), config, terms={"rgb": lambda it: it.prediction.rgb.mean()})


@pytest.mark.parametrize(("domain", "start"), [("hull", 0.2), ("sphere", 0.4)])
def test_cameras_begin_when_there_is_a_shape(small_capture, domain, start):
    fit, _ = posed(small_capture, domain=domain)
    move = fit.model.calibration.move
    for progress, moved in (start - 0.01, False), (start + 0.05, True):
        with torch.no_grad():
            move += 1
        before = move.detach().clone()
        fit.course.iteration = round(progress * fit.schedule.shaping)
        fit.step()
        assert (not torch.equal(move, before)) == moved


def test_powers_go_where_photographs_were_lit(small_capture, monkeypatch):
    """Of those that were seen, by one another, and of no others. Without a joint solution, which sees all."""
    monkeypatch.setattr(schedule, "JOINTLY_SOLVED", ())
    fit, index = posed(small_capture, refine=("power",))
    calibration, random = fit.model.calibration, torch.Generator().manual_seed(3)
    with torch.no_grad():
        calibration.power += 1.5 * torch.randn(calibration.power.shape, generator=random)
    others = np.setdiff1d(np.arange(len(fit.capture)), index)

    def off():
        return (calibration.power[index] - calibration.power[index].mean(0)).detach().abs().max()

    wrong, before = off(), calibration.power[others].clone()
    for _ in range(25):
        fit.step()
    assert wrong > 1 and off() < 0.1  # of 10 %
    assert torch.equal(calibration.power[others], before)


def test_powers_of_a_dark_colour_are_not_those_of_its_highlights(small_capture):
    """Blue is a tenth as bright as red; highlights, where the prediction is wrong, are bright in it alone."""
    fit, _ = posed(small_capture, refine=("power",))
    powers = ExposureSolver(fit.model.calibration, "power")
    predicted = torch.tensor([0.4, 0.2, 0.03]).expand(3, 8, 10, 3).clone()
    factors = torch.tensor([[1.2, 1.0, 0.9], [0.8, 1.1, 1.0], [1.0, 1.0, 1.3]])
    observed = predicted * factors[:, None, None]
    predicted[:, :2, :5] += 0.5
    observed[:, :2, :5] += torch.tensor([0.9, 0.2, 0.5])[:, None, None, None]
    observed[2, :, :, 1] = 1e-4  # nothing to be told of
    inside = torch.ones(3, 8, 10)
    batch = SimpleNamespace(progress=0.5, photographs=np.array([4, 7, 2]), all_photographs=np.array([4, 7, 2]),
                            share=ALONE.share(3), stage=Stage(2, 28, 0, 9))  # fmt: skip
    seen = Observation(observed, torch.zeros(3, 8, 10, 3, dtype=torch.bool), inside, torch.ones(3).bool(), None)
    it = Iteration(batch, seen, SimpleNamespace(rgb=predicted, coverage=inside), fit.context())
    powers.look(it)
    found = powers.measured[[4, 7, 2], 0]
    expected = factors.log() - factors.log().mean(0)
    expected[:, 1] = torch.tensor([-0.5, 0.5, 0]) * np.log(1.1)
    assert powers.seen == [4, 7, 2]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    before = fit.model.calibration.power.detach().clone()
    powers.step()
    after = fit.model.calibration.power.detach()
    changed = (after != before).nonzero().tolist()
    assert after.isfinite().all() and [2, 1] not in changed and {k for k, _ in changed} <= {4, 7, 2}


def test_exposures_of_photographs_of_other_sizes_are_compared(small_capture):
    """An iteration shows one size alone. Here are three: one of them is that of a single photograph."""
    fit, _ = posed(small_capture, refine=("power",))
    calibration = fit.model.calibration
    calibration.rig.sizes = [(10, 8)] * 7 + [(8, 10)] * 4 + [(9, 9)]
    powers = ExposureSolver(calibration, "power")
    random = torch.Generator().manual_seed(2)
    factors = torch.rand(12, 3, generator=random) + torch.tensor([0.8] * 7 + [1.3] * 4 + [0.6])[:, None]
    batches, inside = [[0, 3, 5], [7, 8, 10], [11], [1, 2, 4, 6], [8, 9]], torch.ones(4, 8, 10)
    for number in range(150):
        index = np.array(batches[number % 5])
        predicted = calibration.value("power").detach()[index].exp()[:, None, None].expand(-1, 8, 10, 3) * 0.3
        observed = (factors[index] * 0.2)[:, None, None].expand_as(predicted)
        batch = SimpleNamespace(progress=0.5, photographs=index, all_photographs=index, share=ALONE.share(len(index)),
                                stage=Stage(2, 28, 0, 9))  # fmt: skip
        unclipped = torch.zeros_like(predicted, dtype=torch.bool)
        seen = Observation(observed, unclipped, inside[: len(index)], torch.ones(len(index)).bool(), None)
        rendered = SimpleNamespace(rgb=predicted, coverage=inside[: len(index)])
        powers.look(Iteration(batch, seen, rendered, fit.context()))
        powers.step()
    found = calibration.value("power").detach()
    torch.testing.assert_close(found - found.mean(0), factors.log() - factors.log().mean(0), atol=0.02, rtol=0)


def test_only_what_quarters_of_photographs_have_in_common_is_exposure():
    """Their mean has the variance of the exposures and a quarter of that of the errors: by simulation."""
    random = np.random.default_rng(3)
    exposures, errors = 0.1 * random.normal(size=(4000, 1, 3)), random.normal(size=(4000, 4, 3))
    errors *= [0.0, 0.1, 10.0]  # of each colour
    parts = exposures + errors
    measured = torch.from_numpy(np.concatenate([parts.mean(1, keepdims=True), parts], 1)).float()
    measured[::7, 2, 0] = 0  # where a quarter is unknown
    expected = [1, 0.01 / (0.01 + 0.01 / 4), 0]
    np.testing.assert_allclose(shared_part(measured), expected, atol=0.03)
    assert shared_part(measured[:5]).tolist() == [1, 1, 1]


def test_exposures_that_quarters_do_not_share_are_given_up(small_capture):
    """Also those that were found before there were enough photographs to see it."""
    fit, _ = posed(small_capture, refine=("power",))
    solver, tensor = ExposureSolver(fit.model.calibration, "power"), fit.model.calibration.power
    random = torch.Generator().manual_seed(1)
    solver.measured[:] = torch.randn(solver.measured.shape, generator=random)
    signs = torch.tensor([1.0, 1, -1, -1, 0])[:, None]  # the quarters contradict each other
    solver.measured[:] = solver.measured[:, :1] * signs[[4, 0, 1, 2, 3]] + 0.01
    solver.measured[:, 0] = 0.1
    solver.measured[1, 0, 2] = 0  # unknown
    with torch.no_grad():
        tensor.fill_(1.0)
    solver.seen = [0, 1]
    for _ in range(60):
        solver.step()
    assert tensor[0].abs().max() < 0.01 and tensor[1, 2] == 1 and tensor[2, 0] == 1


def test_quarters_are_those_of_the_object():
    inside = torch.zeros(10, 12, dtype=torch.bool)
    inside[2:6, 5:11] = True
    found = quarters(inside)
    assert found[2, 5] == 0 and found[2, 10] == 1 and found[5, 5] == 2 and found[5, 10] == 3
    assert [(found[inside] == k).sum().item() for k in range(4)] == [6, 6, 6, 6]
