"""Lobe selection: least squares find out whether the photographs show a second lobe of highlights."""

import math
import xml.etree.ElementTree as ElementTree
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.capture.reflectance import add_coat
from mi_ring.fitting.model import Model
from mi_ring.fitting.optimisation import Optimisation
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.nets.brdf_net import COAT, BRDFNet, Parameter
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

WIDTHS = 0.05, 0.1, 0.2, 0.35, 0.6  #: roughnesses that a second lobe may have
NEAR = 0.05  #: pixels near a highlight: where a lobe of the roughness 0.35 is above this share of its peak
#: Factors of the first lobe's roughness. Its own width may be wrong, above all early in a fit.
FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0
FLOOR = 0.1  #: radiance that is added before errors are made relative, in units of the mean of the object
MOST, WIDTH, SPP = 12, 128, 4  #: photographs that are compared, their largest width [px], and samples per pixel
FEWEST = 4, 50  #: photographs with a highlight, and pixels of it
RIDGE = 1e-6  #: relative to the diagonal of the normal equations
ENOUGH = 0.01  #: a second lobe is added if it explains more than this share of the errors near highlights
FIRST, SECOND = 1, 1 + len(FACTORS)  #: the columns of lobes begin here; before them is matte light


class Evidence(NamedTuple):
    """What photographs say about a second lobe."""

    share: float = 0.0  #: share of the squared errors near highlights that it explains in other photographs
    coat: float = 0.0  #: strength
    roughness: float = 0.5  #: width


def select_lobes(
    problem: Problem, model: Model, renderer: Renderer, optimisation: Optimisation, capture: Capture
) -> dict[str, float]:
    """Add a second lobe to the material of a fit, in place, if the photographs show one.

    `capture`: the capture with the masks that are used now. Returns the evidence as a dict, which is empty if the
    material has no place for another lobe.
    """
    ring = model.ring
    if problem.config.parameters or not takes_coat(ring):
        return {}
    found = problem.processes.on_first(lambda: evidence(problem, model, renderer, capture))
    if found.share > ENOUGH:
        begin_coat(ring, found)
        optimisation.follow(ring.brdf_net.output.parameters())  # type: ignore[operator, union-attr]
        renderer.surface = Surface(problem.scene, problem.capture.shape, ring)
    return found._asdict()


def described(evidence: dict[str, float]) -> str:
    """Describe the evidence for a second lobe in words, for the user."""
    found = Evidence(**evidence)
    decision = "is added" if found.share > ENOUGH else "is not needed"
    return (f"Highlights: a second lobe {decision}; it explains {max(0.0, found.share):.1%} of what is left near them "
            f"in other photographs, and must explain {ENOUGH:.0%} (--lobes)")  # fmt: skip


def takes_coat(ring: FittedObject) -> bool:
    """Return True if the material of an object is that of `cooktorrance`, without a coat, by a `BRDFNet`."""
    names = {p.name for p in ring.brdf_net.bsdf_parameters}
    element = ElementTree.fromstring(ring.bsdf)
    given = [element.find(f"*[@name='{p.name}']") for p in COAT]
    own = type(ring.brdf_net) is BRDFNet and element.get("type") == "cooktorrance"
    return own and {"diffuse", "specular", "roughness"} <= names and given == [None, None]


def begin_coat(ring: FittedObject, found: Evidence) -> None:
    """Let an object have a coat, in place, which begins as the evidence says, the same everywhere."""
    element = ElementTree.fromstring(ring.bsdf)
    add_coat(element)
    ring.bsdf = ElementTree.tostring(element, "unicode")
    strength, width = COAT
    relative = max(found.coat / float(ring.brdf_net.scale), 1e-3)
    starts = relative + math.log(-math.expm1(-relative)), math.log(found.roughness / (1 - found.roughness))
    ring.brdf_net.add_parameters([  # type: ignore[operator]
        Parameter(p.name, p.channels, p.low, p.high, start) for p, start in zip((strength, width), starts)
    ])  # fmt: skip


def evidence(problem: Problem, model: Model, renderer: Renderer, capture: Capture) -> Evidence:
    """Measure how much better a second lobe would explain the photographs.

    The surface stays, while the first lobe may be stronger, narrower or wider. The strength of a second lobe, the same
    everywhere, follows by least squares for each of several roughnesses. Half of the photographs decide, the other half
    tells which share of the errors goes; then the halves change places.
    """
    chosen = problem.fitted[np.unique(np.linspace(0, len(problem.fitted) - 1, MOST).round().astype(int))]
    level = min(problem.config.levels[0], 4)
    surface, moments = renderer.show(model, level), []
    for index in capture.together(chosen):
        scale = -(-capture.shots[index[0]].size[0] // WIDTH)
        moments += group_moments(problem, model, capture, surface, index, scale)
    return judged(torch.stack(moments)) if len(moments) >= FEWEST[0] else Evidence()


def group_moments(
    problem: Problem, model: Model, capture: Capture, surface: Surface, index: np.ndarray, scale: int
) -> list[Tensor]:
    """Compare photographs of one size with the prediction. Returns the result of `moments_of` of each with a highlight.

    `index`: indices of the photographs. `scale`: they are compared this many times smaller.
    """
    calibration = model.calibration
    photographs = problem.capture.photographs.select(index, capture.shots[index[0]].size, scale)
    seen = capture.observe(index, scale)
    observed = seen.rgb
    if calibration:
        photographs = calibration.refined_photographs(photographs, calibration(scale))
        observed = calibration.linear(observed, index, scale)
    names = "diffuse", "specular", "roughness"
    own = {name: mi.Float(surface.params[f"{surface.prefix}vertex_{name}"]) for name in names}
    black = {name: 0 * own[name] for name in names}

    def picture(changed: dict[str, Any], indirect: bool = False) -> tuple[Tensor, Tensor]:
        """Draw the surface with other parameters. Returns (radiance, coverage)."""
        surface.write_arrays({f"vertex_{name}": value for name, value in (own | changed).items()})
        shadows = problem.config.shadows and problem.capture.shadows
        return prediction.draw(surface, photographs, SPP, shadows=shadows, indirect=indirect)

    try:
        whole, coverage = picture({}, model.ring.indirect)
        matte, _ = picture({"specular": black["specular"]})
        without = {"diffuse": black["diffuse"]}
        gloss = [picture({**without, "roughness": factor * own["roughness"]})[0] for factor in FACTORS]
        one = {**without, "specular": black["specular"] + 1}
        lobes = [picture({**one, "roughness": black["roughness"] + width})[0] for width in WIDTHS]
    finally:
        surface.write_arrays({f"vertex_{name}": value for name, value in own.items()})
    # Grey, because lobes are: a coloured highlight would look like an error.
    columns = torch.stack([matte, *gloss, *lobes]).mean(-1)
    observed, whole, wide = observed.cpu().mean(-1), whole.mean(-1), columns[SECOND + WIDTHS.index(0.35)]
    pixels = seen.surely(coverage) & ~seen.clipped.any(-1) & (wide > NEAR * wide.amax((1, 2), keepdim=True))
    floor = FLOOR * problem.exposure
    return [moments_of(observed[n][inside], whole[n][inside], columns[:, n, inside], floor)
            for n, inside in enumerate(pixels) if int(inside.sum()) >= FEWEST[1]]  # fmt: skip


def moments_of(observed: Tensor, predicted: Tensor, columns: Tensor, floor: float) -> Tensor:
    """Sum products of the columns and the error, which is the last. Returns (k + 1, k + 1), a mean over n pixels.

    `observed`, `predicted` (n,): radiance. `columns` (k, n): radiance that the prediction may have more. All are
    relative to the larger radiance, plus `floor`.
    """
    rows = torch.cat([columns, (observed - predicted)[None]]) / (torch.maximum(observed, predicted) + floor)
    return rows.double() @ rows.T.double() / len(observed)


def judged(moments: Tensor) -> Evidence:
    """Judge by sums (P, k + 1, k + 1) over pixels of P photographs, results of `moments_of`, in two halves."""
    halves = moments[0::2].sum(0), moments[1::2].sum(0)
    left = [0.0, 0.0]  # by one lobe, and by two
    for fitted, test in (halves, halves[::-1]):
        for n, second in enumerate((False, True)):
            which, solved = best(fitted, second)
            left[n] += rest(test, which, solved)
    which, solved = best(moments.sum(0), True)
    if which[-1] < SECOND:
        return Evidence()
    return Evidence(1 - left[1] / max(left[0], 1e-30), float(solved[-1]), WIDTHS[which[-1] - SECOND])


def best(moments: Tensor, second: bool) -> tuple[list[int], Tensor]:
    """Find the columns that leave the least squared error, and their factors. `moments` (k + 1, k + 1).

    They are matte light, a first lobe between two neighbouring widths and, if it is positive and `second`, another.
    """
    found = []
    for k in range(FIRST, SECOND - 1):
        for more in [[], *([n] for n in range(SECOND, SECOND + len(WIDTHS)) if second)]:
            which = [0, k, k + 1, *more]
            solved = solution(moments, which)
            if not more or solved[-1] > 0:
                found.append((rest(moments, which, solved), which, solved))
    return min(found, key=lambda one: one[0])[1:]


def solution(moments: Tensor, which: list[int]) -> Tensor:
    """Solve normal equations for some columns. `moments` (k + 1, k + 1): with the error last."""
    matrix = moments[which][:, which]
    return torch.linalg.solve(matrix + (RIDGE * matrix.diagonal() + 1e-12).diag(), moments[which, -1])


def rest(moments: Tensor, which: list[int], solved: Tensor) -> float:
    """Compute the squared error that columns times `solved` leave."""
    matrix = moments[which][:, which]
    return float(moments[-1, -1] - 2 * solved @ moments[which, -1] + solved @ matrix @ solved)
