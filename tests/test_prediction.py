"""Gradients of `prediction.render` against central finite differences with the same seed."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from helpers.bumpy_ball import CENTER, COUNT, HEIGHT, OFF_CAMERA, WIDTH, Setting, tensor

from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import photographs, prediction
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.surface import Surface
from mi_ring.scene import assembly
from mi_ring.system import machine

#: Motions (V, 3) of the vertices at domain points s [units per step].
MOTIONS = {
    "translation": lambda s: np.broadcast_to(np.array([0.5, 0.8, 0.33]), s.shape),
    "scaling": lambda s: s,
    "bump": lambda s: s * np.exp(-8 * ((s - [0.75, 0.6, 0.28]) ** 2).sum(1, keepdims=True)),
}
SETTINGS = {
    "light off the camera": {"lights": OFF_CAMERA, "shadows": False},
    "light off the camera, wall behind": {"lights": OFF_CAMERA, "shadows": False, "wall": True},
    "shadows on the wall and on itself": {"lights": OFF_CAMERA, "shadows": True, "wall": True},
    "flash at the camera, wall behind": {"lights": [None, None], "shadows": True, "wall": True},
    "in a room, as if nothing were in the way of its light": {"lights": OFF_CAMERA, "shadows": False, "room": True},
}


def mean_and_error(values):
    return np.mean(values, 0), np.std(values, 0, ddof=1) / np.sqrt(len(values))


@pytest.mark.parametrize("name", SETTINGS)
def test_gradients_of_vertices_equal_finite_differences(name):
    """Of shading and outline together, for radiance and for coverage: within 1 %, beyond three standard errors.

    The step of 0.005 units is about 0.05 px: smaller ones are noisier, larger ones feel the weights of the next pixels.
    """
    setting, step = Setting(**SETTINGS[name]), 0.005
    motions = [tensor(motion(setting.s)) for motion in MOTIONS.values()]
    gradients, differences = [], []  # (seed, loss, motion)
    for seed in range(24):
        gradients.append([])
        for which in range(2):
            vertices = setting.vertices.clone().requires_grad_()
            setting.losses(vertices, setting.material, 64, 100 + 7 * seed)[which].backward()
            gradients[-1].append([(vertices.grad * motion).sum().item() for motion in motions])
    for seed in range(4):
        sides = [
            [setting.losses(setting.vertices + d * motion, setting.material, 512, seed) for motion in motions]
            for d in (step, -step)
        ]
        differences.append((np.array(sides[0]) - np.array(sides[1])).T / (2 * step))
    (a, a_error), (b, b_error) = mean_and_error(gradients), mean_and_error(differences)
    error = np.hypot(a_error, b_error)
    report = f"gradients\n{a}\nfinite differences\n{b}\nstandard errors\n{error}"
    print(report)
    assert (error < 0.035 * np.abs(b)).all(), f"too noisy to tell: {report}"
    assert (np.abs(a - b) < 0.01 * np.abs(b) + 3 * error).all(), report


def test_long_edges_seen_from_a_slant():
    """Coverage of an icosahedron that stretches toward the camera, so that its edges are foreshortened."""
    setting, step = Setting(**SETTINGS["light off the camera"]), 0.015
    ico = trimesh.creation.icosphere(subdivisions=0)
    vertices = tensor(CENTER + ico.vertices * [0.5, 0.5, 1.9])
    setting.surface.set_faces(ico.faces)
    full = partial(torch.full, device=machine.device())
    setting.material = {"diffuse": full((12, 3), 0.4), "specular": full((12,), 0.1), "roughness": full((12,), 0.4)}
    motion = tensor(ico.vertices[:, 2:] * [0.3, 0.4, 1])  # most for the vertices nearest to the camera and farthest
    gradients, differences = [], []
    for seed in range(100):
        moved = vertices.clone().requires_grad_()
        setting.losses(moved, setting.material, 1, seed)[1].backward()
        gradients.append((moved.grad * motion).sum().item())
    for seed in range(4):
        high, low = (setting.losses(vertices + d * motion, setting.material, 512, seed)[1] for d in (step, -step))
        differences.append((high - low).item() / (2 * step))
    (a, a_error), (b, b_error) = mean_and_error(gradients), mean_and_error(differences)
    error = np.hypot(a_error, b_error)
    print(f"gradient {a:.4g}, finite difference {b:.4g} ± {error:.2g}")
    assert error < 0.02 * abs(b)
    assert abs(a - b) < max(0.02 * abs(b), 4 * error), f"gradient {a:.4g}, finite difference {b:.4g} ± {error:.2g}"


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("which", ["diffuse", "specular", "roughness"])
def test_gradients_of_the_material_equal_finite_differences(name, which):
    """The same rays hit the same points on both sides, so that only float32 sums and the step's square differ."""
    setting = Setting(**SETTINGS[name])
    motion = tensor(np.random.default_rng(4).uniform(0.3, 1, setting.material[which].shape))
    material = {key: m.clone().requires_grad_() for key, m in setting.material.items()}
    loss, _ = setting.losses(setting.vertices, material, 16, 5)
    loss.backward()
    sides = []
    for d in (0.01, -0.01):
        moved = setting.material | {which: setting.material[which] + d * motion}
        sides.append(setting.losses(setting.vertices, moved, 16, 5)[0])
    difference = ((sides[0] - sides[1]) / 0.02).item()
    assert (material[which].grad * motion).sum().item() == pytest.approx(difference, rel=5e-3)
    assert abs(difference) > 1  # of a loss of some hundreds


def test_gradients_of_the_material_are_the_same_if_nothing_else_has_one():
    setting, gradients = Setting(**SETTINGS["light off the camera"]), []
    for vertices in (setting.vertices, setting.vertices.clone().requires_grad_()):
        material = {key: m.clone().requires_grad_() for key, m in setting.material.items()}
        setting.losses(vertices, material, 4, 5)[0].backward()
        gradients.append(torch.cat([m.grad.ravel() for m in material.values()]))
    assert setting.vertices.grad is None
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6 * float(gradients[0].abs().max()))


def test_coverage_does_not_depend_on_the_material():
    setting = Setting(**SETTINGS["light off the camera"])
    material = {key: m.clone().requires_grad_() for key, m in setting.material.items()}
    setting.losses(setting.vertices, material, 4, 1)[1].backward()
    assert all((m.grad == 0).all() for m in material.values())


def test_gradients_do_not_depend_on_the_unit_of_length():
    gradients = []
    for unit in (1.0, 1000.0):
        setting = Setting(OFF_CAMERA, shadows=True, unit=unit)
        vertices = setting.vertices.clone().requires_grad_()
        sum(setting.losses(vertices, setting.material, 16, 3)).backward()
        gradients.append(vertices.grad * unit)
    # The same samples; some of them fall to the other side of an edge by rounding.
    assert (gradients[1] - gradients[0]).norm() < 0.02 * gradients[0].norm()


def test_pictures_do_not_depend_on_whether_gradients_are_wanted():
    setting = Setting(**SETTINGS["light off the camera"])
    args = setting.surface, setting.photographs
    with_gradients = prediction.render(*args, setting.vertices.clone().requires_grad_(), setting.material, 4, 9)
    plain = prediction.render(*args, setting.vertices, setting.material, 4, 9)
    drawn = prediction.draw(*args, 4, 9)
    for a, b, c in zip(with_gradients, plain, drawn):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(b.cpu(), c, rtol=0, atol=0)
    rgb, alpha = drawn
    assert rgb.shape == (COUNT, HEIGHT, WIDTH, 3) and alpha.shape == (COUNT, HEIGHT, WIDTH)
    assert 0.1 < alpha.mean() < 0.9


def test_gradient_of_a_picture_that_was_painted_over_is_refused():
    """The surface holds one set of vertices: what a second picture has replaced cannot be differentiated any more."""
    setting = Setting(**SETTINGS["light off the camera"])
    vertices = setting.vertices.clone().requires_grad_()
    loss, _ = setting.losses(vertices, setting.material, 4, 2)
    setting.losses(setting.vertices + 0.1, setting.material, 4, 2)
    with pytest.raises(RuntimeError, match="written again"):
        loss.backward()


def test_new_faces_come_with_new_vertices_and_attributes():
    """Another resolution of the same ball makes the same picture, up to the facets."""
    setting = Setting(**SETTINGS["light off the camera"])
    pictures = []
    for level in (3, 5):
        ico = trimesh.creation.icosphere(subdivisions=level)
        full, count = partial(torch.full, device=machine.device()), len(ico.vertices)
        setting.surface.set_faces(ico.faces)
        material = {"diffuse": full((count, 3), 0.4), "specular": full((count,), 0.1), "roughness": full((count,), 0.4)}
        args = setting.surface, setting.photographs, tensor(CENTER + 0.8 * ico.vertices), material
        pictures.append(prediction.render(*args, 64, 4, False))
    (coarse, coarse_alpha), (fine, fine_alpha) = pictures
    # An icosphere of level 3 lies inside the ball by up to 1 % of its radius, which is 8 px.
    assert (coarse_alpha - fine_alpha).abs().max() < 0.2
    assert coarse.mean().item() == pytest.approx(fine.mean().item(), rel=0.02)


def resident():
    """Memory that this process holds [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_nothing_is_compiled_and_nothing_kept_after_the_first_iterations():
    """Shapes that turn and change, so that the number of outlines differs each time."""
    setting = Setting(**SETTINGS["shadows on the wall and on itself"])
    random = np.random.default_rng(2)

    def iterate(count):
        compiled = 0
        for seed in range(count):
            vertices = (setting.vertices + tensor(random.normal(scale=0.01, size=(642, 3)))).requires_grad_()
            material = {key: m.clone().requires_grad_() for key, m in setting.material.items()}
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
                rgb, alpha = prediction.render(setting.surface, setting.photographs, vertices, material, 1, seed)
                rgb = rgb + GlobalIllumination.of(setting.surface, setting.photographs, alpha, seed).interreflection
                (rgb.sum() + alpha.sum()).backward()
                compiled += sum(not k["cache_hit"] for k in dr.kernel_history([dr.KernelType.JIT]))
        return compiled

    iterate(5)
    before = resident()
    assert iterate(30) == 0
    assert resident() - before < 8e6


def test_a_second_backward_pass_of_a_picture_is_refused():
    """Dr.Jit's graph is used up by the first: the second would return the first gradient, whatever it was asked for."""
    setting = Setting(OFF_CAMERA, shadows=True)
    vertices = setting.vertices.clone().requires_grad_()
    rgb, _ = prediction.render(setting.surface, setting.photographs, vertices, setting.material, spp=1)
    loss = rgb.sum()
    loss.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="a second time; render it again"):
        loss.backward()


def test_vertices_that_do_not_go_with_the_triangles_are_refused():
    """Mitsuba would read beyond the end of them."""
    setting = Setting(OFF_CAMERA, shadows=True)
    for vertices, material, words in (
        (setting.vertices[:-1], setting.material, r"vertices: of shape \(641, 3\), but the triangles need \(642, 3\)"),
        (setting.vertices, setting.material | {"specular": tensor(np.ones(7))}, r"attribute specular: of shape \(7,\)"),
        (setting.vertices, setting.material | {"diffuse": tensor(np.ones((642, 5)))}, "attribute diffuse"),
    ):
        with pytest.raises(ValueError, match=words):
            prediction.render(setting.surface, setting.photographs, vertices, material)


def test_pictures_in_chunks_are_those_in_one(monkeypatch):
    """Bit for bit, however the pixels of several photographs are shared out."""
    setting = Setting(OFF_CAMERA, shadows=True)
    setting.surface.write(setting.vertices, setting.material)
    one = [*prediction.draw(setting.surface, setting.photographs, spp=6, seed=3)]
    one.append(prediction.maps(setting.surface, setting.photographs))
    launched, genuine = [], prediction.render_photographs
    monkeypatch.setattr(
        prediction, "render_photographs", lambda *a, **k: launched.append(k["pixels"]) or genuine(*a, **k)
    )
    monkeypatch.setattr(photographs, "LANES", 6 * 400 + 5)
    rgb, coverage = prediction.draw(setting.surface, setting.photographs, spp=6, seed=3)
    assert launched == [(0, 400), (400, 800), (800, 1200), (1200, 1600), (1600, 2 * WIDTH * HEIGHT)]
    assert torch.equal(rgb, one[0]) and torch.equal(coverage, one[1]) and rgb.max() > 0
    monkeypatch.setattr(photographs, "LANES", 400)
    again = prediction.maps(setting.surface, setting.photographs)
    assert all(np.array_equal(again[name], values) for name, values in one[2].items())


def test_a_surface_of_a_ring_leaves_the_scene_as_it_was():
    """It has a scene of its own, with all that is in the other, sensors included."""
    setting = Setting(OFF_CAMERA, shadows=True, wall=True)
    shape = setting.surface.shape
    before, bsdf = np.array(shape.vertex_positions_buffer()), shape.bsdf()
    ring = FittedObject([0.3, -0.2, 0.15], 0.8, scale=0.2)
    surface = Surface(setting.scene, shape, ring)
    surface.show(ring, *ring.domain.sample(2))
    assert np.array_equal(np.array(shape.vertex_positions_buffer()), before) and shape.bsdf() is bsdf
    assert [s.id() for s in surface.scene.shapes()] == [s.id() for s in setting.scene.shapes()]
    assert len(surface.scene.sensors()) == len(setting.scene.sensors()) == 2
    ours, theirs = (np.array(mi.render(scene, sensor=1, integrator=mi.load_dict({"type": "direct"}), spp=4))
                    for scene in (surface.scene, setting.scene))  # fmt: skip
    assert np.abs(ours - theirs).max() > 0.1 and ours.max() > 0.1  # another ball, lit by the same light


@pytest.mark.parametrize("light", ["directional", "constant"])
def test_distant_emitters_of_a_surface_are_beyond_all_of_it(light):
    """Also of one that is far from the origin and large, in its first picture: what is in the way casts shadows."""
    emitter = mi.load_dict({"type": light} | ({"direction": [0.48, 0.6, -0.64]} if light == "directional" else {}))
    shape = mi.load_dict({"type": "shapenet", "subdivisions": 0, "flash": False, "bsdf": {"type": "cooktorrance"}})
    center, radius = np.array([400.0, -150.0, 90.0]), 700.0  # the origin is within
    ring = FittedObject(center, radius)
    surface = Surface(assembly.assembled([shape], [emitter]), shape, ring)
    surface.show(ring, *ring.domain.sample(2))
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p = mi.Point3f(0.5 / surface.unit)
    ds, _ = surface.scene.emitters()[0].sample_direction(si, mi.Point2f(0.3, 0.8))
    assert surface.unit * ds.dist[0] > 2 * radius


def test_the_backward_pass_may_be_taken_by_another_thread():
    """As torch does on a GPU: always by the same one, for which Dr.Jit counts scopes of its own."""
    setting, gradients, other = Setting(OFF_CAMERA, shadows=True), [], ThreadPoolExecutor(1)
    for run in (lambda backward: backward(), *[lambda backward: other.submit(backward).result()] * 2):
        vertices = setting.vertices.clone().requires_grad_()
        run(setting.losses(vertices, setting.material, 4, 3)[0].backward)
        gradients.append(vertices.grad)
    for gradient in gradients[1:]:
        torch.testing.assert_close(gradient, gradients[0], rtol=1e-4, atol=1e-3)
