"""Gradients through plain `mi.render` against finite differences: what moves, under which light, before what.

`benchmarks/gradients.py` holds the whole table; here every row and column of it occurs, at smaller cost.
"""

import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.image_formation import render_photographs
from mi_ring.rendering.photographs import Photographs

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from gradients import COVERAGE, HEIGHT, RADIANCE, STEPS, WIDTH, Picture, allowed, compare

mi.set_log_level(mi.LogLevel.Error)

#: How many gradients and differences tell, and the differences' spp.
NOISY, QUIET, QUIETEST = (8, 3, 192), (4, 3, 128), (2, 2, 32)
CELLS = [  # moved, light, wall, shape, unit, channels, how many
    ("translate", "lamp", True, "bumpy", 1000.0, RADIANCE, QUIET),
    ("translate", "flash", False, "sphere", 1.0, COVERAGE, QUIET),
    ("scale", "directional", True, "sphere", 1000.0, RADIANCE, NOISY),
    ("bump", "directional", True, "bumpy", 0.001, RADIANCE, NOISY),
    ("camera moves", "flash", True, "bumpy", 1000.0, RADIANCE, NOISY),
    ("camera turns", "directional", False, "sphere", 1.0, RADIANCE, QUIET),
    ("focal length", "lamp", True, "sphere", 1000.0, RADIANCE, QUIET),
    ("light moves", "lamp", True, "bumpy", 1000.0, RADIANCE, QUIETEST),
    ("light moves", "directional", True, "sphere", 1.0, RADIANCE, QUIETEST),
    ("light moves", "flash", True, "bumpy", 1.0, RADIANCE, QUIETEST),
    ("principal point", "lamp", False, "bumpy", 1.0, RADIANCE, QUIET),
    ("distortion", "flash", False, "bumpy", 1.0, COVERAGE, QUIET),
    ("falloff", "flash", False, "bumpy", 1000.0, RADIANCE, QUIETEST),
    ("room", "flash", True, "bumpy", 1.0, RADIANCE, QUIETEST),
    ("intensity", "flash", False, "sphere", 1.0, RADIANCE, QUIETEST),
]


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: f"{c[0]}, {c[1]}, {c[3]}")
def test_gradient_equals_finite_difference(cell):
    """Within 1 %, 3 % where edges of shadows take part, beyond three standard errors, which must be small."""
    *what, channels, many = cell
    a, b, error = compare(Picture(*what, level=4), channels, *many)
    assert error < 0.016 * abs(b), f"too noisy to tell: {a:.5g} and {b:.5g} ± {error:.2g}"
    limit = allowed(light=what[1], wall=what[2]) * abs(b) + 3 * error
    assert abs(a - b) < limit, f"{a:.5g}, not {b:.5g} ± {error:.2g}"


def test_every_row_of_the_table_is_here():
    assert {cell[0] for cell in CELLS} == set(STEPS)


def test_soft_filter_of_a_cropped_film():
    """The film's reconstruction filter spreads edges over several pixels."""
    picture = Picture("translate", "lamp", True, "sphere", level=4, rfilter="gaussian")
    film = mi.traverse(picture.scene.sensors()[0])
    film["film.crop_size"], film["film.crop_offset"] = [40, 52], [31, 17]
    film.update()
    picture.params.update()
    picture.weights = picture.weights[17:69, 31:71]
    assert np.array(picture.at(mi.Float(0), 0, 4)).shape == (52, 40, 4)
    a, b, error = compare(picture, RADIANCE, *NOISY)
    assert error < 0.01 * abs(b)
    assert abs(a - b) < 0.01 * abs(b) + 3 * error, f"{a:.5g}, not {b:.5g} ± {error:.2g}"


def test_forward_mode_equals_reverse_mode():
    picture = Picture("camera moves", "lamp", True, "bumpy", level=3)
    reverse = picture.gradient(3, 16, RADIANCE)
    t = mi.Float(0)
    dr.enable_grad(t)
    image = picture.at(t, 3, 16)
    dr.forward(t)
    forward = (np.array(dr.grad(image)) * picture.weights)[..., RADIANCE].sum()
    assert abs(forward) > 10
    assert forward == pytest.approx(reverse, rel=1e-3)


def test_many_photographs_in_one_launch_have_the_same_gradient():
    picture = Picture("focal length", "lamp", True, "bumpy", level=4)
    weights = [mi.Float(w.astype(np.float32).ravel()) for w in np.moveaxis(picture.weights, -1, 0)]
    many = []
    for seed in range(6):
        t = mi.Float(0)
        dr.enable_grad(t)
        picture.at(t, seed, 1)
        photographs = Photographs.attached(picture.scene.sensors()[0])
        channels = render_photographs(picture.scene, photographs, 64, seed, True, Edges.of(picture.scene))
        dr.backward(sum(dr.sum(w * c) for w, c in zip(weights[:3], channels)))
        many.append(dr.grad(t)[0])
    one = [picture.gradient(50 + seed, 64, RADIANCE) for seed in range(6)]
    error = np.hypot(np.std(many, ddof=1), np.std(one, ddof=1)) / np.sqrt(6)
    assert error < 0.03 * abs(np.mean(one))
    assert abs(np.mean(many) - np.mean(one)) < 4 * error


@pytest.mark.parametrize("name", ["diffuse", "specular", "roughness"])
def test_material_constants(name):
    """The samples of the gradient are those of the difference."""
    picture = Picture("intensity", "lamp", True, "bumpy", level=3)
    key = next(k for k, _ in picture.params if k.endswith(f"bsdf.{name}.value"))
    before = type(picture.params[key])(picture.params[key])

    def image(t, seed):
        picture.params[key] = before * (1 + t)
        picture.params.update()
        return mi.render(picture.scene, picture.params, spp=64, seed=seed, seed_grad=seed + 1)

    t = mi.Float(0)
    dr.enable_grad(t)
    dr.backward(dr.sum(image(t, 4) * mi.TensorXf(picture.weights.astype(np.float32)), axis=None))
    high, low = (np.array(image(mi.Float(d), 5), np.float64) for d in (0.02, -0.02))
    assert np.abs(high - low).max() > 1e-3
    assert dr.grad(t)[0] == pytest.approx(((high - low) * picture.weights).sum() / 0.04, rel=0.01)


def test_lights_do_not_move_coverage():
    """Though the edges of shadows come as near to an outline as they like."""
    picture = Picture("light moves", "flash", True, "bumpy", level=5)
    assert all(picture.gradient(seed, 1, COVERAGE) == 0 for seed in range(3))


def test_stock_sensors_are_refused():
    picture = Picture("intensity", "lamp", False, "sphere", level=2)
    sensor = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}})
    key = next(k for k, _ in picture.params if k.endswith("vertex_positions"))
    dr.enable_grad(picture.params[key])
    picture.params.update()
    image = mi.render(picture.scene, picture.params, sensor=sensor, spp=1)
    with pytest.raises(Exception) as caught:
        dr.backward(dr.sum(image, axis=None))
    assert "gradients need an RGB variant and a photograph sensor" in str(caught.value) + str(caught.value.__cause__)


def test_the_benchmark_of_endurance_runs():
    script = Path(__file__).parents[1] / "benchmarks" / "endurance.py"
    done = subprocess.run([sys.executable, script, "--iterations", "1"], capture_output=True, text=True)
    assert done.returncode == 0 and "\n| 1 | " in done.stdout, done.stderr
