"""How strong the regulariser is: it weakens as a fit goes on, but not while something is wrong."""

import math

from mi_ring.fitting.iteration import Iteration
from mi_ring.scene.self_intersections import crossing_triangles

CROSSING = 1e-3  #: share of the triangles that may cross others; beyond, the regulariser does not weaken
CROSSING_EVERY = 20  #: iterations between counts of them
STRONGEST = -0.3  #: the least `calm`
RETREAT, CATCH_UP = 2.0, 3.0  #: how fast the regulariser strengthens then, and weakens afterwards; 1 is as planned
RECENT = 0.1  #: weight of an iteration in the mean of what is unexplained
LATE = 0.6  #: progress after which a surface that crosses itself says that the regulariser is too weak
UNEXPLAINED = 0.2  #: share of the object's light from which the regulariser does not weaken; exact captures end at .07


class Restraint:
    """What says how far the regulariser may weaken."""

    def __init__(self) -> None:
        self.crossing: float = 0.0  #: share of the triangles that cross others, when they were counted last
        self.calm: float = 0.0  #: how far the regulariser has weakened: like progress, but for holding back
        self.held: bool = False  #: whether the surface crossed itself late
        self.unexplained: float = 1.0  #: share of the object's light that is not as predicted, of the last iterations

    def note(self, it: Iteration, iterations: int) -> None:
        """Let the regulariser weaken after iteration `it` of so many; strengthen it while the surface crosses itself.

        Where photographs disagree with the model a weak one lets the surface fold. Limbs that grow cross in passing,
        early: afterwards the regulariser catches up with its plan. Where they cross late it does not.
        """
        step = 1 / iterations
        if it.number % CROSSING_EVERY == 0:
            self.crossing = float(crossing_triangles(it.vertices.cpu().numpy(), it.faces).mean())
            self.held |= self.crossing > CROSSING and it.progress > LATE
        if self.crossing > CROSSING:
            self.calm = max(STRONGEST, self.calm - RETREAT * step)
        else:
            self.calm = min(it.number * step, self.calm + (1.0 if self.held else CATCH_UP) * step)
        unexplained = it.unexplained()
        if math.isfinite(unexplained):
            self.unexplained += RECENT * (unexplained - self.unexplained)

    def strength(self, decay: float) -> float:
        """Of the regulariser, which is to end at `decay`; full while much of the light is unexplained.

        What no surface explains (lights that are elsewhere, a room that is not dark) a weak one would explain by
        terraces and folds.
        """
        return max(decay**self.calm, min(1.0, (self.unexplained / UNEXPLAINED) ** 4))
