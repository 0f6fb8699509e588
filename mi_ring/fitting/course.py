"""The course of a fit: what has happened so far."""

from dataclasses import dataclass, field
from typing import Any

from mi_ring.fitting.mask_refinement import Masks


@dataclass
class Course:
    """How far a fit is, and what it has found on the way besides its model."""

    iteration: int = 0  #: iterations that are done
    seconds: float = 0.0  #: time of these iterations, and of coarse fits before them
    log: list[dict[str, Any]] = field(default_factory=list)  #: entries of every fifth iteration and of the last
    masks: Masks = field(default_factory=dict)  #: masks that were found anew
    validation: dict[str, Any] = field(default_factory=dict)  #: on held-out photographs, when the fit is done
