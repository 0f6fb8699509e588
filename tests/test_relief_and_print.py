"""What the stage for details takes for relief and what for print. The start is the true smooth ball of one colour."""

import numpy as np
import torch
import trimesh
from helpers.matte_ball import MATTE, PALE, pale_ball, photographed, plain

from mi_ring.capture.loading import load_capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.sharpened_material import SharpenedMaterial
from mi_ring.output.atlas import reflectances
from mi_ring.system.machine import threads_of

WIDTH = 96  #: of the photographs [px]; the radius of the ball is 46 px
CONFIG = Config(iterations=1, detail_share=60.0, levels=(4,), widths=(WIDTH,), shares=(1.0,), batch=6, domain="sphere",
                subdivisions=5, deterministic=True, refine=("none",), indirect=False, diffuse="lambert", lobes="1",
                learning_rate=1e-9, muon_rate=1e-9)  # fmt: skip


def waves(points):
    """Waves (V, 1) about 8 pixels long, between -1 and 1, at points of the unit sphere."""
    return np.sin(30 * points[:, :1]) * np.sin(28 * points[:, 1:2] + 1)


def embossed(points):
    """Slopes of 9 degrees, root mean square."""
    return points * (1 + 0.012 * waves(points))


def printed(points):
    return PALE * (1 + 0.3 * waves(points))


def fitted(folder, colours, surface) -> tuple[FittedObject, FittedObject]:
    """(what a fit with details finds in photographs of a ball, what it began with)."""
    start = pale_ball()
    capture = load_capture(photographed(folder, colours, 16, surface, WIDTH, aside=0.1))
    with threads_of(1):
        fit = Fit(capture, CONFIG, networks=(start.shape_net, start.brdf_net))
        scale = float(fit.ring.brdf_net.scale)  # the fit has chosen another one
        with torch.no_grad():
            last = [p for p in fit.ring.brdf_net.parameters() if p.shape == (5,)][-1]
            last[:3] = torch.from_numpy(np.log(np.expm1(MATTE / scale)))
        ring = fit.run()
        assert fit.result().ring is ring and isinstance(ring.brdf_net, SharpenedMaterial) == (colours is printed)
        return ring, pale_ball()


def normals_of(ring):
    """The normals (V, 3) of an object at the points of the sphere at level 5."""
    s, faces = ring.domain.sample(5)
    with torch.no_grad():
        return trimesh.Trimesh(ring.surface(s).numpy(), faces, process=False).vertex_normals


def true_normals(surface):
    s, faces = pale_ball().domain.sample(5)
    return trimesh.Trimesh(surface(s.numpy().astype(float)), faces, process=False).vertex_normals


def fine(values):
    """Values (V, C) at the vertices of level 5 without their waves longer than about 16 pixels."""
    s, faces = pale_ball().domain.sample(5)
    edges = trimesh.Trimesh(s.numpy(), faces, process=False).edges_unique
    means = trimesh.graph.edges_to_coo(np.vstack([edges, edges[:, ::-1]]), len(s)).tocsr().astype(float)
    means = means.multiply(1 / means.sum(1)).tocsr()
    coarse = values
    for _ in range(15):
        coarse = means @ coarse
    return values - coarse


def angles(a, b):
    """Angles (V,) between unit vectors [degrees]."""
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_an_embossed_ball_of_one_colour_keeps_it(tmp_path):
    """Its relief is found, and is not painted. Print alone, in place of relief, would vary by 3.3 %."""
    found, start = fitted(tmp_path, plain, embossed)
    colours = reflectances(found, found.domain.sample(5)[0].numpy())["diffuse"] / MATTE
    assert colours.std(0).max() < 0.028 and np.abs(colours.mean(0) - 1).max() < 0.02  # measured: 0.023, 0.006
    truth = true_normals(embossed)
    error, without = (np.sqrt(np.square(fine(normals_of(ring) - truth)).sum(1).mean()) for ring in (found, start))
    assert error < 0.6 * without  # measured: 4.4 of 8.7 degrees


def test_a_printed_ball_stays_smooth(tmp_path):
    """Its print is found, and is not embossed. Relief alone, in place of print, would turn the normals by 2.1 degrees.

    Without details they are turned by 0.01 degrees.
    """
    found, _ = fitted(tmp_path, printed, lambda points: points)
    s = found.domain.sample(5)[0].numpy()
    turned = angles(normals_of(found), s)
    assert turned.mean() < 1.1 and np.quantile(turned, 0.99) < 3.5  # measured: 0.71, 2.0
    truth = printed(s.astype(float))
    error, without = (np.sqrt(np.mean(np.square(colours / truth - 1)))
                      for colours in (np.pi * reflectances(found, s)["diffuse"], plain(s)))  # fmt: skip
    assert error < 0.3 * without  # measured: 0.029 of 0.162
