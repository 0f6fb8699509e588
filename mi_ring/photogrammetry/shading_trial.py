"""What the object might be by its shading alone: a short fit without masks, from the sphere of the sparse points."""

from collections.abc import Sequence

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.photogrammetry.reduced_photographs import View
from mi_ring.rendering import prediction
from mi_ring.scene.lights import Light
from mi_ring.system.progress import Progress

ITERATIONS = 100
FEWEST = 30  #: points that tell where the object is
INNER, OUTER = 0.15, 0.8  #: least and largest radius of the sphere, in the reach of what is looked at
DIM = 3.0  #: mean albedo by lights of unknown intensity: more than all light is reflected, which tells that they are
SETTINGS = Config.preset("fast", iterations=ITERATIONS, levels=(4,), widths=(128,), shares=(1,), subdivisions=4,
                         masks="given", domain="sphere", weights={"mask": 0.0})  # fmt: skip


def sphere_of(points: np.ndarray, center: np.ndarray, reach: float) -> tuple[np.ndarray, float] | None:
    """Centre (3,) and radius of a sphere of about the size of what most points (N, 3) near `center` show.

    None if there are too few: then nothing may be there.
    """
    near = points[np.linalg.norm(points - center, axis=1) < reach]
    if len(near) < FEWEST:
        return None
    middle = np.median(near, axis=0)
    radius = float(np.quantile(np.linalg.norm(near - middle, axis=1), 0.8))
    return middle, float(np.clip(radius, INNER * reach, OUTER * reach))


def coverages(views: Sequence[View], center: np.ndarray, radius: float, progress: Progress) -> list[np.ndarray]:
    """What a surface that explains the photographs covers of each view: (H, W) uint8, 1 the object.

    The light is taken to be at the lens. The surface starts as a sphere about `center` (3,) with this `radius`.
    """
    away = float(np.median([np.linalg.norm(view.camera.position - center) for view in views]))
    level = float(np.median([view.linear[view.shown].mean() for view in views]))
    intensity = np.full(3, np.pi * level / DIM * away**2)
    lights = [Light("point", view.camera.position, intensity) for view in views]
    capture = Capture.from_arrays(
        [view.rgb for view in views], valid=[view.shown for view in views], cameras=[view.camera for view in views],
        lights=lights, center=center, radius=radius, name="a trial fit",
    )  # fmt: skip
    fit = Fit(capture, SETTINGS)
    for _ in progress(fit, "a trial fit", fit.iterations):
        pass
    surface = fit.renderer.showing(fit.model, SETTINGS.subdivisions)
    drawn = (prediction.draw(surface, capture.photograph(k), spp=4, shadows=False)[1] for k in range(len(views)))
    return [(coverage[0].numpy() > 0.5).astype(np.uint8) for coverage in drawn]
