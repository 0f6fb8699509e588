"""The course of a fit: its progress, its log and its measurements so far."""

import math
from dataclasses import dataclass, field
from typing import Any

from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.mask_refinement import Masks
from mi_ring.fitting.regulariser_strength import RegulariserStrength

LOG_EVERY = 5  #: iterations between entries of the log


@dataclass
class Course:
    """The course of a fit: the number of iterations that are done, the log, and the measurements so far."""

    iteration: int = 0  #: number of iterations that are done
    seconds: float = 0.0  #: time of these iterations, and of coarse fits before them
    log: list[dict[str, Any]] = field(default_factory=list)  #: entries of every fifth iteration and of the last
    masks: Masks = field(default_factory=dict)  #: masks that were found anew
    coat: dict[str, float] = field(default_factory=dict)  #: what photographs say about a second lobe of highlights
    validation: dict[str, Any] = field(default_factory=dict)  #: on held-out photographs, when the fit is done

    @classmethod
    def of(cls, fields: dict[str, Any], iterations: int) -> "Course":
        """Make the course of a fit that continues, from the `fields` in a checkpoint. `iterations`: the planned number.

        Raises TypeError, KeyError or ValueError if the fields are wrong.
        """
        course = cls(**fields)
        if not (0 <= course.iteration <= iterations and 0 <= course.seconds < math.inf):
            raise ValueError(f"iteration {course.iteration} after {course.seconds} s")
        for entry in course.log:
            _ = entry["iteration"], entry["seconds"]
        return course

    def record(self, it: Iteration, learning_rate: float, regulariser: RegulariserStrength, last: bool) -> None:
        """Append an entry about the iteration `it` to the log, if its number is a multiple of 5 or it is the `last`.

        The entry contains the loss, its unweighted terms and their weights. `learning_rate`: the rate of Adam for the
        networks. `regulariser`: has the share of self-intersecting triangles, which is logged, too.
        """
        if it.number % LOG_EVERY and not last:
            return
        self.log.append({
            "iteration": it.number, "seconds": round(self.seconds, 3), "loss": it.loss, **it.terms,
            "weights": it.weights, "learning_rate": learning_rate,
            "stage": it.context.schedule.stages.index(it.stage) + 1, "vertices": len(it.batch.points),
            "crossing": regulariser.crossing, "unexplained": regulariser.unexplained,
            **({"second_lobe": self.coat["gain"]} if self.coat else {}),
        })  # fmt: skip
