"""Strength of the regulariser: it weakens during a fit, but not while something is wrong with the surface."""

import math
from typing import Any

from mi_ring.fitting.iteration import Iteration
from mi_ring.scene.self_intersections import crossing_triangles

CROSSING = 1e-3  #: share of self-intersecting triangles above which the regulariser gets stronger
CROSSING_EVERY = 20  #: iterations between counts of them
STRONGEST = -0.3  #: smallest value of `weakened`
RETREAT, CATCH_UP = 2.0, 3.0  #: how fast `weakened` falls then and rises later, relative to progress
RECENT = 0.1  #: weight of an iteration in the running mean of `unexplained`
LATE = 0.6  #: progress after which self-intersections mean that the regulariser is too weak
UNEXPLAINED = 0.2  #: share of unexplained light at which the regulariser has full strength; exact captures end at 0.07


class RegulariserStrength:
    """Schedules the regulariser's weight by the unexplained light and the self-intersections of recent iterations."""

    def __init__(self) -> None:
        self.crossing: float = 0.0  #: share of self-intersecting triangles at the last count
        self.weakened: float = 0.0  #: how far the regulariser has weakened: equals progress, unless something is wrong
        self.held: bool = False  #: Did the surface intersect itself late?
        self.unexplained: float = 1.0  #: running mean of `Iteration.unexplained`

    def note(self, it: Iteration) -> None:
        """Update the strength after the iteration `it`.

        Where photographs disagree with the model, a weak regulariser lets the surface fold. So the strength grows while
        the surface intersects itself. After early intersections, which growing limbs cause, it catches up with its
        schedule. After late ones it does not.
        """
        step = 1 / it.context.schedule.shaping
        if it.number % CROSSING_EVERY == 0:
            vertices = it.prediction.vertices.detach().cpu().numpy()
            self.crossing = float(crossing_triangles(vertices, it.batch.faces).mean())
            self.held |= self.crossing > CROSSING and it.progress > LATE
        if self.crossing > CROSSING:
            self.weakened = max(STRONGEST, self.weakened - RETREAT * step)
        else:
            self.weakened = min(it.number * step, self.weakened + (1.0 if self.held else CATCH_UP) * step)
        unexplained = it.unexplained()
        if math.isfinite(unexplained):
            self.unexplained += RECENT * (unexplained - self.unexplained)

    def strength(self, decay: float) -> float:
        """Factor for the regulariser's weight: it falls from 1 at the start to `decay` at the end of the fit.

        It stays 1 while the model leaves much light unexplained: with wrong lights, or in a room that is not dark, a
        weak regulariser would let the surface fold. It exceeds 1 while the surface intersects itself.
        """
        return max(decay**self.weakened, min(1.0, (self.unexplained / UNEXPLAINED) ** 4))

    def state(self) -> dict[str, Any]:
        """Collect what a checkpoint needs."""
        return dict(vars(self))

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state()`."""
        vars(self).update(state)
