"""Quick fits of the small capture, and fits of calibration alone."""

import numpy as np
import torch
import trimesh
from conftest import AXES, CENTER
from scipy.spatial.transform import Rotation

import mi_ring
from mi_ring.fitting.iteration import Iteration

QUICK = ["--levels", "2", "3", "--widths", "28", "56", "--shares", "0.6", "0.4", "--batch", "4", "--subdivisions", "3"]
SPHERE = [*QUICK, "--domain", "sphere"]  # whose sizes are known
#: Of fits of which only matters what is written, and when. One unknown, so that there is a calibration.
BRIEF = ["--levels", "2", "--widths", "28", "--shares", "1", "--batch", "2", "--subdivisions", "2",
         "--domain", "sphere", "--refine", "power", "--no-indirect", "--detail", "none", "--lobes", "1"]  # fmt: skip
ITERATIONS = 40  #: of the fit that the fixture `finished` makes


def distance(mesh_file):
    """Mean distance of a mesh's vertices from the true ellipsoid, as a share of its size (by its implicit function)."""
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    vertices = trimesh.load(mesh_file, process=False).vertices
    return np.abs(np.linalg.norm((vertices - CENTER) @ turn / AXES, axis=1) - 1).mean()


TABLE = """<shape type="table"><bsdf type="diffuse"/><transform name="to_world">
  <scale value="90"/><translate x="400" y="-150" z="60"/></transform></shape></scene>"""


def posed(capture, **changes):
    """A fit that finds calibration alone, at its middle, and photographs that show what it predicts; which of them."""
    settings = {"refine": ("cameras",), "levels": (4,), "widths": (56,), "shares": (1.0,), "batch": 4, "spp": 16,
                "indirect": False, "weights": {"calibration": 0.0}}  # the prior alone would find them  # fmt: skip
    config = mi_ring.Config(**settings | changes)
    fit = mi_ring.Fit(mi_ring.load_capture(capture), config)
    fit.course.iteration, chosen = fit.iterations // 2, fit.sampler.draw_photographs(config.batch)
    fit.sampler.draw_photographs = lambda *_: chosen
    with torch.no_grad():
        it = iteration_of(fit)
    seen = it.observation._replace(rgb=it.prediction.rgb, mask=it.prediction.coverage)
    fit.sampler.observe = lambda *_: seen
    own = set(fit.model.calibration.parameters())
    steppers = fit.optimisation.steppers  # without those of the networks, so that the surface stays as it is
    fit.optimisation.steppers = [s for s in steppers if own & {*s.optimizer.param_groups[0]["params"]}]
    return fit, it.batch.photographs


def iteration_of(fit):
    """What a step of a fit would draw, see and predict."""
    batch = fit.sampler.draw(fit.problem, fit.schedule, fit.ring.domain, fit.iteration)
    seen = fit.sampler.observe(fit.problem, fit.capture, batch)
    return Iteration(batch, seen, fit.renderer.predict(fit.problem, fit.model, batch), fit.context())


FILES = [
    "scene.xml",
    "ring.pt",
    "mesh.ply",
    "config.json",
    "log.jsonl",
    "inputs.png",
    "report.html",
    "checkpoint.before.pt",
    "checkpoint.pt",
    "calibration.json",
]
