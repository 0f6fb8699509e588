"""Lobe selection: least squares find out whether the photographs show a second lobe of highlights."""

import math
import xml.etree.ElementTree as ElementTree
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor, nn

from mi_ring.capture.capture import Capture
from mi_ring.capture.reflectance import add_coat
from mi_ring.fitting.model import Model
from mi_ring.fitting.optimisation import Optimisation
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.geometry.hull import evenly_spaced
from mi_ring.nets.brdf_net import COAT, BRDFNet
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.rendering import prediction
from mi_ring.rendering.surface import Surface

WIDTHS = 0.05, 0.1, 0.2, 0.35, 0.6  #: roughnesses that a second lobe may have
NEAR = 0.05  #: pixels near a highlight: where a lobe of the roughness 0.35 is above this share of its peak
#: Factors of the first lobe's roughness. Its own width may be wrong, above all early in a fit.
FACTORS = 0.5, 0.7, 1.0, 1.4, 2.0
FLOOR = 0.1  #: radiance that is added before errors are made relative, in units of the mean of the object
MOST, WIDTH, SPP = 12, 128, 4  #: photographs that are compared, their largest width [px], and samples per pixel
ANGULAR, BINS = (0.1, 0.6), 14  #: roughnesses whose ratio tells the angle of the half vector, and bins of it
FEWEST = 4, 50  #: photographs with a highlight, and pixels of it
RIDGE = 1e-6  #: relative to the diagonal of the normal equations
#: A second lobe is added if it explains more than this share of the light near highlights. It was 0.014 to 0.11 for
#: varnish and metallic paint, at most 0.004 for plastics with one lobe.
ENOUGH = 0.008
FIRST, SECOND = 1, 1 + len(FACTORS)  #: the columns of lobes begin here; before them is matte light


class Evidence(NamedTuple):
    """What photographs say about a second lobe."""

    gain: float = 0.0  #: share of the light near highlights that a second lobe explains, but no single lobe does
    coat: float = 0.0  #: strength
    roughness: float = 0.5  #: width


def select_coat(
    problem: Problem, model: Model, renderer: Renderer, optimisation: Optimisation, capture: Capture
) -> dict[str, float]:
    """Add a second lobe to the material of a fit, in place, if the photographs show one.

    `capture`: the capture with the masks that are used now. Returns the evidence as a dict, which is empty if the
    material has no place for another lobe, and if photographs have no lights of their own: the room's light from all
    sides hardly shows the shape of a highlight.
    """
    ring = model.ring
    if problem.config.parameters or problem.capture.photographs.dark or not takes_coat(ring):
        return {}
    found = problem.processes.on_first(lambda: evidence(problem, model, renderer, capture))
    if found.gain > ENOUGH:
        optimisation.follow(begin_coat(ring, found))
        renderer.surface = Surface(problem.scene, problem.capture.shape, ring)
    return found._asdict()


def described(evidence: dict[str, float]) -> str:
    """Describe the evidence for a second lobe in words, for the user."""
    found = Evidence(**evidence)
    decision = "is added" if found.gain > ENOUGH else "is not needed"
    return (f"Highlights: a second lobe {decision}; it explains {found.gain:.1%} of the light near them that no single "
            f"lobe does, and must explain {ENOUGH:.1%} (--lobes)")  # fmt: skip


def takes_coat(ring: FittedObject) -> bool:
    """Return True if the material of an object is that of `cooktorrance`, without a coat, by a `BRDFNet`."""
    names = {p.name for p in ring.brdf_net.bsdf_parameters}
    element = ElementTree.fromstring(ring.bsdf)
    given = [element.find(f"*[@name='{p.name}']") for p in COAT]
    own = type(ring.brdf_net) is BRDFNet and element.get("type") == "cooktorrance"
    return own and {"diffuse", "specular", "roughness"} <= names and given == [None, None]


def begin_coat(ring: FittedObject, found: Evidence) -> list[tuple[nn.Parameter, nn.Parameter]]:
    """Let an object have a coat, in place, which begins as the evidence says, the same everywhere.

    Returns pairs (old, larger) of parameters of BRDF-Net.
    """
    element = ElementTree.fromstring(ring.bsdf)
    add_coat(element)
    ring.bsdf = ElementTree.tostring(element, "unicode")
    strength, width = COAT
    relative = max(found.coat / float(ring.brdf_net.scale), 1e-3)
    starts = relative + math.log(-math.expm1(-relative)), math.log(found.roughness / (1 - found.roughness))
    return ring.brdf_net.add_parameters([  # type: ignore[operator]
        p._replace(start=start) for p, start in zip((strength, width), starts)
    ])  # fmt: skip


def evidence(problem: Problem, model: Model, renderer: Renderer, capture: Capture) -> Evidence:
    """Measure how much better a second lobe would explain the photographs.

    The surface stays, while the first lobe may be stronger, narrower or wider. The strength of a second lobe, the same
    everywhere, follows by least squares for each of several roughnesses. Compared are means over pixels of equal angle
    to the highlight. Two halves of the photographs must agree.
    """
    lit = np.intersect1d(problem.fitted, problem.capture.photographs.mainly)
    chosen = lit[evenly_spaced(len(lit), MOST)]
    level = min(problem.config.levels[0], 4)
    surface, profiles = renderer.show(model, level), []
    for index in capture.together(chosen):
        scale = -(-capture.shots[index[0]].size[0] // WIDTH)
        profiles += group_profiles(problem, model, capture, surface, index, scale)
    return judged(torch.stack(profiles)) if len(profiles) >= FEWEST[0] else Evidence()


def group_profiles(
    problem: Problem, model: Model, capture: Capture, surface: Surface, index: np.ndarray, scale: int
) -> list[Tensor]:
    """Compare photographs of one size with the prediction. Returns the result of `profile_of` of each with a highlight.

    `index`: indices of the photographs. `scale`: they are compared this many times smaller.
    """
    calibration = model.calibration
    photographs = problem.capture.selected(index, scale)
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
    return [profile_of(observed[n][inside], whole[n][inside], columns[:, n, inside], floor)
            for n, inside in enumerate(pixels) if int(inside.sum()) >= FEWEST[1]]  # fmt: skip


def profile_of(observed: Tensor, predicted: Tensor, columns: Tensor, floor: float) -> Tensor:
    """Sum the columns, the error and 1 over pixels of about equal angle between normal and half vector.

    `observed`, `predicted` (n,): radiance. `columns` (k, n): radiance that the prediction may have more. All are
    relative to the larger radiance, plus `floor`. Returns (`BINS`, k + 2). Wrong normals move a highlight: at one side
    of it errors are positive, at the other negative. The sums contain little of that.
    """
    rows = torch.cat([columns, (observed - predicted)[None]]) / (torch.maximum(observed, predicted) + floor)
    rows = torch.cat([rows, torch.ones(1, len(observed))]).double()
    # The ratio of a narrow to a wide lobe depends on that angle alone; it is between 1 / most and most.
    narrow, wide = (columns[SECOND + WIDTHS.index(width)] for width in ANGULAR)
    most = 2 * math.log(ANGULAR[1] / ANGULAR[0])
    place = 0.5 + 0.5 * (narrow / wide.clamp(min=1e-30)).clamp(min=1e-30).log() / most
    bins = (BINS * place).long().clamp(0, BINS - 1)
    return torch.zeros(BINS, len(rows), dtype=torch.double).index_add(0, bins, rows.T)


def moments_of(profiles: Tensor) -> Tensor:
    """Compute the mean products (k + 1, k + 1) of columns and error from profiles (P, `BINS`, k + 2) of photographs."""
    sums = profiles.sum(0)
    count = sums[:, -1].clamp(min=1)
    return (sums[:, :-1] / count[:, None]).T @ sums[:, :-1] / count.sum()


def judged(profiles: Tensor) -> Evidence:
    """Judge by profiles (P, `BINS`, k + 2) of P photographs. Each half of them alone must show the second lobe."""
    gains = []
    for half in (profiles[0::2], profiles[1::2]):
        moments = moments_of(half)
        one, two = (rest(moments, *best(moments, second)) for second in (False, True))
        gains.append(math.sqrt(max(one - two, 0)))
    which, solved = best(moments_of(profiles), True)
    if which[-1] < SECOND:
        return Evidence()
    return Evidence(min(gains), float(solved[-1]), WIDTHS[which[-1] - SECOND])


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
