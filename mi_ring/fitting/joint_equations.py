"""Joint least squares of all unknowns of calibration. Surface and material are unknown, too.

Photographs are compared with their predictions from the current model. The normal equations follow from these
errors, and from the derivatives with respect to each unknown. Each patch of the surface has unknowns of its own, which
are eliminated ("Bundle Adjustment: A Modern Synthesis", Triggs et al. 2000, section 6.1). The covariance is the inverse
of the matrix (the same, section 8.1).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import torch

from mi_ring.fitting.comparison import ROOM, Group, compare
from mi_ring.fitting.local_unknowns import Patches
from mi_ring.fitting.model import Model
from mi_ring.fitting.normal_equations import Equations, Layout
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.renderer import Renderer
from mi_ring.geometry.hull import evenly_spaced

COMPARED_WIDTH = 96  #: largest width of the compared pictures [px]
LEVEL = 5  #: of the mesh in them, at most
UNTOLD = 0.7  #: share of a prior's standard deviation


@dataclass(frozen=True)
class JointEquations:
    """Normal equations `matrix` x = `vector` of all parameters of a calibration, in the units of their priors.

    Their solution is the change from the current parameters that explains the photographs best, whatever the surface
    and the material are. The priors of the parameters are not part of them.
    """

    layout: Layout
    matrix: np.ndarray  #: (N, N), the Fisher information
    vector: np.ndarray  #: (N,)

    @classmethod
    @torch.no_grad()
    def of(
        cls, problem: Problem, model: Model, renderer: Renderer, level: int, most: int | None = None,
        width: int = COMPARED_WIDTH,
    ) -> "JointEquations":  # fmt: skip
        """Render fitted photographs from the current model, and compare them with the photographs.

        `most`: of those with a light of their own, and of those without, at most so many are rendered, evenly spaced;
        None: all. `level` of the mesh: at most `LEVEL` is rendered. `width`: largest width of the pictures [px].
        Colours and silhouettes eliminate the surface separately, so its prior counts twice.
        """
        calibration, ring = model.calibration, model.ring
        assert calibration is not None
        layout = Layout(calibration)
        surface = renderer.show(model, min(level, LEVEL))
        s = ring.domain.sample(min(level, LEVEL))[0]
        patches = Patches(surface, s, float(ring.radius), ring.brdf_net.bsdf_parameters)
        colours, silhouettes = (Equations(layout.count, patches.count, n) for n in (patches.components, 1))
        lit = problem.capture.photographs.lit[problem.fitted]
        kinds = [problem.fitted[lit == kind] for kind in (True, False)]
        kinds = [kind[evenly_spaced(len(kind), most or len(kind))] for kind in kinds if len(kind)]
        for index in (some for kind in kinds for some in problem.capture.together(kind)):
            scale = -(-problem.capture.shots[index[0]].size[0] // width)
            group = Group(problem, calibration, surface, patches, ring.indirect, index, scale)
            compare(group, layout, colours, silhouettes)
        calibration.relight(surface)  # as it was
        (matrix, vector), (more, shift) = (part.without_patches() for part in (colours, silhouettes))
        return cls(layout, matrix + more, vector + shift)

    @cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (N, N) of all parameters with their priors. Logarithms of powers and gains have mean 0."""
        centring = self.layout.centring()
        return centring @ np.linalg.inv(np.eye(self.layout.count) + self.matrix) @ centring.T

    def deviations(self, exposure: float) -> dict[str, np.ndarray]:
        """Return the standard deviation of each refined unknown of the calibration.

        They are a dict from names of unknowns to arrays in the shape and the unit of the unknown. The room's light is
        "ambient": (3,), the deviations of the first harmonic's R, G, B [radiance]. `exposure`: that of the problem. The
        deviations include the `doubt` of unknowns.
        """
        layout, rig, spread = self.layout, self.layout.calibration.rig, np.sqrt(np.diag(self.covariance))
        result = {}
        for name, width in layout.calibration.widths.items():
            shape, doubt = getattr(layout.calibration, name).shape, layout.calibration.unknowns[name].doubt_for(rig)
            told = np.hypot(width * spread[layout.places(name)].reshape(shape), doubt)
            result[name] = np.minimum(told, width)  # what is not told is known as well as before
            if name == "light" and not (layout.calibration.exposure_of_flash or rig.free[2]):
                result[name][:, 2] = width  # nothing finds how far the flash is ahead
        if layout.room:
            result["ambient"] = ROOM * exposure * spread[layout.places("ambient")][:3]
        return result

    def untold(self) -> list[str]:
        """List the options of `--refine` of which photographs tell hardly more than the priors.

        Of each component of the option's unknowns at least `UNTOLD` of the prior's standard deviation is left. Unknowns
        of single photographs and the room are left out.
        """
        spread, least = np.sqrt(np.diag(self.covariance)), dict[str, float]()
        for name, unknown in self.layout.calibration.unknowns.items():
            if not unknown.single:
                least[unknown.option] = min(least.get(unknown.option, 1.0), *spread[self.layout.places(name)])
        return [option for option, left in least.items() if left >= UNTOLD]

    def correlations(self) -> list[tuple[str, str, float]]:
        """List all pairs of options of `--refine`, and how much their unknowns look alike in the photographs, 0 to 1.

        It is the largest canonical correlation ("Relations between two sets of variates", Hotelling 1936). Of the room
        the first harmonic counts. Poses are left out: they always look like another surface.
        """
        layout, covariance = self.layout, self.covariance
        at: dict[str, list[int]] = {}
        for name, unknown in layout.calibration.unknowns.items():
            at.setdefault(unknown.option, []).extend(layout.places(name))
        at["ambient"] = [*layout.places("ambient")[:3]]
        result = []
        for one, other in combinations([name for name in at if name != "cameras" and len(at[name])], 2):
            own, others, both = (covariance[np.ix_(at[j], at[k])] for j, k in
                                 ((one, one), (other, other), (one, other)))  # fmt: skip
            explained = np.linalg.pinv(own, hermitian=True) @ both @ np.linalg.pinv(others, hermitian=True) @ both.T
            correlation = float(np.linalg.eigvals(explained).real.max().clip(0, 1)) ** 0.5
            result.append((one, other, correlation))
        return result
