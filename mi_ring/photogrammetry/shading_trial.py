"""Finds the object by its shading alone: a short fit without masks that starts from a sphere."""

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.photogrammetry.reduced_photographs import Views
from mi_ring.rendering import prediction
from mi_ring.scene.lights import Light
from mi_ring.system.progress import Progress

ITERATIONS = 100
MIN_POINTS = 30  #: near the object
MIN_RADIUS, MAX_RADIUS = 0.15, 0.8  #: of the sphere, relative to the half size of the voxel grid
#: If the flash's intensity is unknown, it is set so that this is the mean albedo. Above 1, so that fits notice.
ASSUMED_ALBEDO = 3.0
SETTINGS = Config.preset("fast", iterations=ITERATIONS, levels=(4,), widths=(128,), shares=(1,), subdivisions=4,
                         masks="given", domain="sphere", weights={"mask": 0.0})  # fmt: skip


def initial_sphere(points: np.ndarray, center: np.ndarray, half_size: float) -> tuple[np.ndarray, float] | None:
    """Find a sphere around most of the points near `center`. Returns (centre (3,), radius).

    `points` (N, 3): sparse points. Those closer to `center` (3,) than `half_size` are near. Returns None if too few are
    near.
    """
    near = points[np.linalg.norm(points - center, axis=1) < half_size]
    if len(near) < MIN_POINTS:
        return None
    middle = np.median(near, axis=0)
    radius = float(np.quantile(np.linalg.norm(near - middle, axis=1), 0.8))
    return middle, float(np.clip(radius, MIN_RADIUS * half_size, MAX_RADIUS * half_size))


def shading_silhouettes(views: Views, center: np.ndarray, radius: float, progress: Progress) -> list[np.ndarray]:
    """Find the object by a short fit that starts from a sphere. Returns its mask (H, W) uint8 in each view, 1 inside.

    `center` (3,), `radius`: the sphere. Raises InputError if the fit diverges.
    """
    distance = float(np.median([np.linalg.norm(view.camera.position - center) for view in views]))
    level = float(np.median([view.linear[view.valid].mean() for view in views]))
    intensity = np.full(3, np.pi * level / ASSUMED_ALBEDO * distance**2)
    lights = [Light("point", view.camera.position, intensity) for view in views]
    capture = Capture.from_arrays(
        [view.rgb for view in views], valid=[view.valid for view in views], cameras=[view.camera for view in views],
        lights=lights, center=center, radius=radius, name="a trial fit",
    )  # fmt: skip
    fit = Fit(capture, SETTINGS)
    for _ in progress(fit, "a trial fit", fit.iterations):
        pass
    surface, seen = fit.renderer.show(fit.model, SETTINGS.subdivisions), fit.calibrated()
    drawn = (prediction.draw(surface, seen.photograph(k), spp=4, shadows=False)[1] for k in range(len(views)))
    return [(coverage[0].numpy() > 0.5).astype(np.uint8) for coverage in drawn]
