"""The strength of the regulariser. It falls during a fit, but not while the surface folds or explains too little."""

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
    """Controls the regulariser's strength by the unexplained light and the self-intersections of recent iterations."""

    def __init__(self) -> None:
        self.crossing: float = 0.0  #: share of self-intersecting triangles at the last count
        self.weakened: float = 0.0  #: how far the regulariser has weakened: equals progress, unless something is wrong
        self.held: bool = False  #: Did the surface intersect itself late?
        self.unexplained: float = 1.0  #: running mean of `Iteration.unexplained`

    def note(self, it: Iteration) -> None:
        """Update the strength after the iteration `it`.

        If the photographs disagree with the model, a weak regulariser lets the surface fold. So the strength rises
        while the surface intersects itself. Later it falls again. After early self-intersections, which growing limbs
        cause, it falls faster than usual until it is back on schedule. After late ones it stays behind its schedule.
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
        """Return a factor of the regulariser's weight. It falls from 1 to `decay` during a fit.

        The factor stays 1 while the model leaves much light unexplained, for example with wrong lights: a weak
        regulariser would let the surface fold. The factor may exceed 1 while the surface intersects itself.
        """
        return max(decay**self.weakened, min(1.0, (self.unexplained / UNEXPLAINED) ** 4))

    def state(self) -> dict[str, Any]:
        """Return all values of this object, for a checkpoint."""
        return dict(vars(self))

    def restore(self, state: dict[str, Any]) -> None:
        """Continue with the values in `state`, which the method `state` has returned."""
        vars(self).update(state)
