"""The Python API: what `mi_ring` itself offers, and nothing else of the package."""

import json
import math
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from torch import nn

import mi_ring

QUICK = {"levels": (2, 3), "widths": (28, 56), "shares": (0.6, 0.4), "batch": 4, "subdivisions": 3, "domain": "sphere"}


@mi_ring.register_network("siren of the tests")
class Siren(mi_ring.Flow):
    """A velocity field of sines."""

    steps = 3

    def __init__(self, width: int = 32):
        super().__init__()
        self.first, self.last = nn.Linear(3, width), nn.Linear(width, 3)
        nn.init.normal_(self.last.weight, std=1e-3)

    def arguments(self):
        return {"width": self.first.out_features}

    def velocity(self, x):
        return self.last(torch.sin(2 * self.first(x)))


@mi_ring.register_network("grey of the tests")
class Grey(mi_ring.MaterialNet):
    """The same reflectance everywhere."""

    def __init__(self):
        super().__init__()
        self.values = nn.Parameter(torch.zeros(5))

    def evaluate(self, s):
        return self.values.expand(*s.shape[:-1], 5)


def config(**changes):
    return mi_ring.Config.preset("fast", **QUICK | {"iterations": 4} | changes)


@pytest.fixture(scope="module")
def capture(small_capture):
    return mi_ring.load_capture(small_capture)


def losses(capture, **options):
    torch.set_num_threads(1)
    try:
        return [it.loss for it in mi_ring.Fit(capture, config(), **options)]
    finally:
        torch.set_num_threads(2)


def test_all_names_are_there():
    assert all(getattr(mi_ring, name) is not None for name in mi_ring.__all__)
    assert set(mi_ring.__all__) <= set(dir(mi_ring))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = mi_ring.nonsense


def test_an_iteration_has_what_was_predicted_and_observed(capture):
    fit = mi_ring.Fit(capture, config())
    for count, it in enumerate(fit, 1):
        vertices, (height, width) = (162, (20, 28)) if it.stage.level == 2 else (642, (40, 56))
        assert it.number == count == fit.iteration and it.progress == (count - 1) / 4
        seen, shown = it.observation, it.prediction
        assert shown.vertices.shape == (vertices, 3) and it.batch.faces.shape == (2 * vertices - 4, 3)
        assert shown.rgb.shape == seen.rgb.shape == (4, height, width, 3)
        assert shown.coverage.shape == seen.mask.shape == (4, height, width)
        assert {name: value.shape for name, value in shown.material.items()} == {
            "diffuse": (vertices, 3), "specular": (vertices,), "roughness": (vertices,),
            "diffuse_roughness": (vertices,)
        }  # fmt: skip
        assert not (shown.rgb.requires_grad or shown.coverage.requires_grad or shown.vertices.requires_grad)
        assert not any(value.requires_grad for value in shown.material.values())
        assert it.loss == pytest.approx(sum(it.weights[name] * value for name, value in it.terms.items()), rel=1e-5)
    assert count == 4 and list(fit) == []
    size = np.linalg.norm(it.prediction.vertices.numpy() - fit.ring.center.numpy(), axis=1)
    assert size.min() > 10 and size.max() < 60  # scene units, about the object


def test_presets_change_and_weights_that_are_not_given_stay():
    fast = mi_ring.Config.preset("fast", weights={"mask": 10.0})
    off = dict.fromkeys(("normal_variation", "material_rank"), 0.0)
    weights = {"rgb": 1.0, "mask": 10.0, "velocity": 0.01, "calibration": 1e-3, "settling": 0.03} | off
    assert fast.iterations == 140 and fast.weights == weights
    assert mi_ring.Config(weights={"mask": 10.0}).weights == fast.weights
    paper = mi_ring.Config.preset("paper", weights={"velocity": 0.5}, seed=3)
    assert paper.weights == weights | {"mask": 0.0, "velocity": 0.5}
    assert paper.optimizer == "adam" and paper.seed == 3
    assert mi_ring.Config.preset("default") == mi_ring.Config()
    with pytest.raises(mi_ring.InputError, match="preset: is quick, must be one of fast, default, fine, paper"):
        mi_ring.Config.preset("quick")


def test_own_terms_have_weights_schedules_and_entries_in_the_log(capture, tmp_path):
    seen = []

    def size(it):
        seen.append(it.number)
        return (it.prediction.vertices - it.context.model.ring.center).square().sum(1).mean()

    terms = {
        "rgb": mi_ring.default_terms["rgb"],
        "size": mi_ring.Term(size, weight=2.0, schedule=lambda it: 1 - it.progress),
        "silent": lambda it: None,
        "off": mi_ring.Term(lambda it: 1 / 0, weight=0.0),
    }
    fit = mi_ring.Fit(capture, config(), terms=terms)
    for it in fit:
        assert set(it.terms) == {"rgb", "size"} and it.weights == {"rgb": 1.0, "size": 2 * (1 - it.progress)}
        assert it.loss == pytest.approx(it.terms["rgb"] + it.weights["size"] * it.terms["size"], rel=1e-5)
    assert seen == [1, 2, 3, 4]
    again = mi_ring.Fit(capture, config(weights={"size": 0.5}), terms=terms)
    assert next(iter(again)).weights["size"] == 0.5
    with pytest.raises(mi_ring.InputError, match="weights: sise: there is no such term; there are rgb, size"):
        mi_ring.Fit(capture, config(weights={"sise": 1.0}), terms=terms)


def test_a_capture_can_be_fitted_again_and_is_left_as_it_was(capture):
    before = {key: np.array(value) for key, value in mi.traverse(capture.scene).__iter__() if "vertex" in key}
    bsdf = capture.shape.bsdf()
    first, second = losses(capture), losses(capture)
    assert first == pytest.approx(second, rel=1e-4)  # parallel sums differ in their order
    assert capture.shape.bsdf() is bsdf
    now = {key: np.array(value) for key, value in mi.traverse(capture.scene).__iter__() if "vertex" in key}
    assert before.keys() == now.keys() and all(np.array_equal(before[key], now[key]) for key in before)


def test_previews_at_any_time_change_nothing(capture):
    """Of another level than the fit is at, larger and smaller, between iterations and from callbacks."""
    plain, pictures = losses(capture), []

    def look(it):
        pictures.append(fit.preview(k=it.number, width=28, level=4))
        pictures.append(fit.preview(level=1))

    fit = mi_ring.Fit(capture, config(), callbacks=[look])
    fit.preview()
    torch.set_num_threads(1)
    try:
        assert [it.loss for it in fit] == pytest.approx(plain, rel=1e-4)
    finally:
        torch.set_num_threads(2)
    assert pictures[0].shape == (20, 28, 3) and pictures[1].shape == (40, 56, 3)
    assert all(np.isfinite(picture).all() and picture.max() > 0 for picture in pictures)


def test_a_preview_from_within_a_term_is_an_error_and_no_crash(capture):
    terms = {"bad": lambda it: fit.preview() is None or it.prediction.rgb.mean()}
    fit = mi_ring.Fit(capture, config(), terms=terms)
    with pytest.raises(RuntimeError, match="written again"):
        next(iter(fit))
    assert fit.preview().max() > 0


def test_networks_of_ones_own_are_fitted_saved_and_used(capture, tmp_path):
    from mi_ring import export, render

    fit = mi_ring.Fit(capture, config(weights={"velocity": 0.1}), networks=(Siren(width=24), Grey()))
    assert float(fit.ring.brdf_net.scale) == pytest.approx(fit.model.albedo / np.pi)  # as bright as the photographs
    first, *_, last = fit
    assert "velocity" in last.terms and all(np.isfinite(it.loss) for it in (first, last))
    fit.save(tmp_path / "mine")
    ring = mi_ring.load_fit(tmp_path / "mine")
    assert type(ring.shape_net) is Siren and type(ring.brdf_net) is Grey and ring.shape_net.first.out_features == 24
    s, _ = ring.domain.sample(3)
    with torch.no_grad():
        torch.testing.assert_close(ring.surface(s), fit.ring.surface(s))
        torch.testing.assert_close(ring.brdf_net(s), fit.ring.brdf_net(s))
        surface = ring.surface(s).numpy()

    shape = mi.load_dict({"type": "shapenet", "weights": str(tmp_path / "mine" / "ring.pt"), "subdivisions": 3})
    np.testing.assert_allclose(np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3), surface, atol=1e-4)
    render.main([str(tmp_path / "mine"), str(capture.path), str(tmp_path / "pictures"), "--spp", "4"])
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 12
    export.main([str(tmp_path / "mine"), str(tmp_path / "mine.glb"), "--resolution", "64", "--subdivisions", "2"])
    assert trimesh.load(tmp_path / "mine.glb", force="mesh").faces.shape == (320, 3)
    log = json.loads((tmp_path / "mine" / "config.json").read_text())
    assert log["weights"]["velocity"] == 0.1


def test_networks_that_are_not_registered_here_are_told_by_name(capture, tmp_path):
    fit = mi_ring.Fit(capture, config(iterations=1), networks=(Siren(), Grey()))
    torch.save(fit.state()["ring"], tmp_path / "ring.pt")
    code = "import sys, mi_ring; mi_ring.load_fit(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "ring.pt"], capture_output=True, text=True)
    complaint = done.stderr.strip().splitlines()[-1]
    assert "siren of the tests" in complaint and "import the module that registers it" in complaint

    class Unknown(Siren):
        pass

    with pytest.raises(ValueError, match="Unknown: is not registered, so it cannot be saved; put @mi_ring.reg"):
        mi_ring.Fit(capture, config(), networks=(Unknown(), Grey())).state()
    with pytest.raises(ValueError, match="is registered already"):
        mi_ring.register_network("siren of the tests")(Unknown)


def test_networks_of_other_shapes_are_refused_before_any_work(capture):
    class Flat(Siren):
        def velocity(self, x):
            return super().velocity(x)[..., :2]

    class Six(Grey):
        def evaluate(self, s):
            return s.repeat(1, 2)

    class Still(nn.Module):
        def forward(self, s, time=1.0):
            return s

    for networks, words in (
        ((Siren(), Six()), "Six: has 6 outputs, diffuse, specular, roughness need 5"),
        ((Still(), Grey()), "Still: has no velocity, which the term of that name needs"),
    ):
        with pytest.raises(mi_ring.InputError, match=words):
            mi_ring.Fit(capture, config(), networks=networks)
    assert mi_ring.Fit(capture, config(weights={"velocity": 0.0}), networks=(Still(), Grey())).preview().max() > 0


def test_jacobians_of_the_networks():
    """By the documented slow path, against finite differences; the fast path gives the same rows, one at a time."""
    torch.manual_seed(2)
    ring = mi_ring.FittedObject([0.3, -1.0, 2.0], 1.7, steps=3).double()
    ring.shape_net.output.weight.data.mul_(50)
    s = torch.nn.functional.normalize(torch.randn(4, 3, dtype=torch.float64), dim=1)
    with mi_ring.plain_autograd():
        jacobian = torch.func.vmap(torch.func.jacrev(lambda x: ring.surface(x[None])[0]))(s)
        hessian = torch.func.hessian(lambda x: ring.surface(x[None])[0].sum())(s[0])
    for axis in range(3):
        step = 1e-7 * torch.eye(3, dtype=torch.float64)[axis]  # across no kink of a leaky ReLU
        with torch.no_grad():
            difference = (ring.surface(s + step) - ring.surface(s - step)) / 2e-7
        torch.testing.assert_close(jacobian[:, :, axis], difference, rtol=1e-6, atol=1e-6)
        x = s.clone().requires_grad_()
        ring.surface(x)[:, axis].sum().backward()
        torch.testing.assert_close(jacobian[:, axis], x.grad)
    torch.testing.assert_close(hessian, hessian.T)
    assert hessian.abs().max() > 1e-3
    x = s.clone().requires_grad_()
    y = ring.surface(x).sum()
    y.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="plain_autograd"):
        y.backward()


def test_a_fit_goes_on_from_its_state(capture):
    whole = mi_ring.Fit(capture, config())
    first = iter(whole)
    next(first), next(first)
    state = whole.state()
    rest = [it.loss for it in first]
    again = mi_ring.Fit(capture, config(), state=state)
    assert again.iteration == 2 and [it.loss for it in again] == pytest.approx(rest, rel=1e-4)
    for settings, found in ((config(optimizer="adam"), state), *((config(), no) for no in ({"ring": 1}, {}, "a.pt"))):
        with pytest.raises(mi_ring.InputError, match="state: is of a fit with other settings, networks or photographs"):
            mi_ring.Fit(capture, settings, state=found)
    with pytest.raises(mi_ring.InputError, match="state: is of a fit with other settings, networks or photographs"):
        mi_ring.Fit(capture.part(range(5)), config(), state=state)


def test_what_was_frozen_stays_so(capture):
    """Parameters of networks of one's own that are not to be trained."""
    shape_net, brdf_net = Siren(), Grey()
    frozen = next(shape_net.parameters()).requires_grad_(False)
    before = [p.detach().clone() for p in shape_net.parameters()]
    fit = mi_ring.Fit(capture, config(), networks=(shape_net, brdf_net))
    list(fit)
    assert fit.problem.given is capture and not frozen.requires_grad
    moved = [not torch.equal(p, q) for p, q in zip(shape_net.parameters(), before)]
    assert not moved[0] and any(moved[1:])


def test_a_fit_that_looks_at_no_photograph_is_refused(capture):
    for weights in ({"rgb": 0.0, "mask": 0.0}, {"rgb": 0.0, "mask": 0.0, "velocity": 0.0, "normal_variation": 1.0}):
        with pytest.raises(mi_ring.InputError, match="no term compares the surface with the photographs"):
            mi_ring.Fit(capture, config(weights=weights))


def test_what_is_no_part_of_a_fit_is_refused_by_name(capture):
    own = mi_ring.default_terms["rgb"]
    for arguments, words in (
        ({"capture": "small.xml"}, "capture: is str, must be a mi_ring.Capture"),
        ({"config": "fast"}, "config: is str, must be a mi_ring.Config"),
        ({"terms": [own]}, "terms: is list, must be a dict"),
        ({"terms": {"rgb": own, "mine": 3}}, "terms: mine: must be a function, or a Term"),
        ({"terms": {"rgb": own, "mine": own._replace(weight=math.nan)}}, "terms: mine: must be"),
        ({"terms": {"rgb": own, "mine": own._replace(schedule=0.5)}}, "terms: mine: must be"),
        ({"networks": (mi_ring.ShapeNet(3),)}, "networks: must be two instances"),
        ({"networks": mi_ring.ShapeNet(3)}, "networks: must be two instances"),
        ({"networks": (mi_ring.ShapeNet, mi_ring.BRDFNet)}, "networks: must be two instances"),
        ({"config": {}}, "config: is dict, must be a mi_ring.Config"),
        ({"lighting": "environment"}, r"lighting: is 'environment'; give Fit what mi_ring.choose_lighting\("),
        ({"lighting": mi_ring.Lighting("auto")}, r"lighting: is Lighting\(kind='auto', .*choose_lighting\("),
        ({"lighting": mi_ring.Lighting("lamps")}, r"lighting: is Lighting\(kind='lamps', .*choose_lighting\("),
    ):
        with pytest.raises(mi_ring.InputError, match=words):
            mi_ring.Fit(**{"capture": capture, "config": config()} | arguments)


def test_terms_that_would_change_nothing_or_everything_are_told_by_name(capture):
    with pytest.raises(mi_ring.InputError, match="terms: still: have no gradients"):
        mi_ring.Fit(capture, config(), terms={"still": lambda it: it.prediction.rgb.detach().mean()}).step()
    terms = {**mi_ring.default_terms, "mine": lambda it: it.prediction.rgb.mean() * math.nan}
    fit = mi_ring.Fit(capture, config(iterations=30, levels=(1,), widths=(28,), shares=(1.0,)), terms=terms)
    with pytest.raises(mi_ring.InputError, match="diverged at iteration [0-9]+ by the term mine; try"):
        fit.run()


def test_cameras_lights_and_levels_that_are_none_are_refused(finished):
    ring = mi_ring.load_fit(finished)
    shot = mi_ring.load_capture(finished / "scene.xml", images=False).shots[0]
    camera, light = shot.camera, shot.own_light
    for changes, words in (
        ({"camera": camera.to_world}, "camera: is ndarray; must be a mi_ring.Camera"),
        ({"camera": camera._replace(size=(56.5, 40))}, r"camera: size is \(56.5, 40\); must be whole numbers"),
        ({"camera": camera._replace(size=(0, 40))}, "camera: size is"),
        ({"camera": camera._replace(focal=np.array([math.nan, 60]))}, "camera: focal: must be finite"),
        ({"light": mi_ring.Light("spot", light.vector, light.rgb)}, 'light: is of kind "spot"'),
        ({"light": light._replace(rgb=-light.rgb)}, "light: .* strong, must be positive"),
        ({"spp": 0}, "spp: is 0, must be a whole number from 1 to 10,000"),
        ({"level": 1.5}, "level: is 1.5, must be a whole number from 0 to 10"),
    ):
        with pytest.raises(mi_ring.InputError, match=words):
            ring.render(**{"camera": camera, "light": light, "spp": 1, "level": 1} | changes)
    assert ring.render(camera, light, spp=np.int64(1), level=np.int32(1)).shape == (*camera.size[::-1], 3)
    with pytest.raises(mi_ring.InputError, match="ring: is str; must be a fitted object"):
        mi_ring.export(str(finished), "a.ply")
    with pytest.raises(mi_ring.InputError, match="--subdivisions: is 1.5, must be 0 to 10"):
        mi_ring.export(ring, "a.ply", subdivisions=1.5)
