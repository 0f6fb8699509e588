"""The sampler: it draws the points, photographs and random seeds of an iteration, as one `Batch`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mi_ring.capture.capture import Capture, Observation
from mi_ring.fitting.problem import Problem
from mi_ring.fitting.processes import Share
from mi_ring.fitting.schedule import Schedule, Stage
from mi_ring.geometry.domain import Domain

SEEDED = "renderer", "indirect", "regulariser"  #: get a seed in each batch
RAYS = 2**20  #: of an iteration in which details are found
PURPOSES = "photographs", "rotations", *SEEDED  #: of random generators


@dataclass(frozen=True)
class Batch:
    """The random choices of one iteration: V points of the domain, photographs and random seeds.

    All processes of a fit together render N photographs. This process renders n of them.
    """

    number: int  #: of the iteration, from 1
    progress: float  #: share of the shaping iterations that are done, in [0, 1]; 1: the surface is fixed
    detail_progress: float  #: share of the iterations for details that are done, in [0, 1]
    stage: Stage
    points: Tensor  #: (V, 3) domain points
    faces: np.ndarray  #: (F, 3)
    photographs: np.ndarray  #: (n,) indices
    all_photographs: np.ndarray  #: (N,) indices
    size: tuple[int, int]  #: of these photographs' files (width, height) [px]
    scale: int  #: photographs are compared this many times smaller
    seeds: dict[str, int]  #: of the renderer, of its indirect light, and of the regulariser
    share: Share  #: this process's part of the N photographs; brings results of all processes together


class Sampler:
    """Draws batches. Photographs come in random order.

    None comes twice before all photographs of its size have come once. Photographs, rotations and seeds each have a
    random generator. So the number of draws of one does not change the others.
    """

    def __init__(self, problem: Problem) -> None:
        first = torch.Generator().manual_seed(problem.config.seed)
        seeds = torch.randint(2**62, (len(PURPOSES),), generator=first).tolist()
        self.random = {name: torch.Generator().manual_seed(seed) for name, seed in zip(PURPOSES, seeds)}
        capture = problem.capture
        self.sizes = [capture.shots[k].size for k in problem.fitted]
        self.alike = {size: np.intersect1d(index, problem.fitted) for size, index in capture.sizes.items()}
        #: by size (width, height): photographs that are still to come in this round
        self.waiting: dict[tuple[int, int], list[int]] = {}

    def draw(self, problem: Problem, schedule: Schedule, domain: Domain, iteration: int) -> Batch:
        """Draw the batch for an `iteration`, counted from 0.

        `domain`: the start surface, from which points are drawn.
        """
        stage = schedule.stage(iteration)
        resample = problem.config.resample and not stage.detail
        points, faces = domain.sample(stage.level, self.random["rotations"] if resample else None)
        most = RAYS // stage.width**2 if stage.detail else None
        everyone, size = self.draw_photographs(problem.config.batch, most)
        seeds = {name: int(torch.randint(2**31, (), generator=self.random[name])) for name in SEEDED}
        share = problem.processes.share(len(everyone))
        return Batch(iteration + 1, schedule.progress(iteration), schedule.detail_progress(iteration), stage,
                     points.to(problem.device), faces, everyone[share.part], everyone, size,
                     -(-size[0] // stage.width), seeds, share)  # fmt: skip

    def draw_photographs(self, count: int, most: int | None = None) -> tuple[np.ndarray, tuple[int, int]]:
        """Draw `count` photographs of one size, or all photographs of this size if there are fewer.

        `most`: draw at most so many, and at most a quarter of this size: so details see others in each iteration.
        Returns (their indices, their size (width, height) [px]).
        """
        random = self.random["photographs"]
        size = self.sizes[int(torch.randint(len(self.sizes), (), generator=random))]
        alike, waiting = self.alike[size], self.waiting.get(size, [])
        count = min(count, len(alike))
        if most is not None:
            count = max(1, min(count, most, len(alike) // 4))
        if len(waiting) < count:  # the remaining ones come first, and last in the next round
            order = alike[torch.randperm(len(alike), generator=random).numpy()].tolist()
            waiting = waiting + [k for k in order if k not in waiting] + waiting
        self.waiting[size] = waiting[count:]
        return np.array(waiting[:count]), size

    def observe(self, problem: Problem, capture: Capture, batch: Batch) -> Observation:
        """Read this process's photographs of a batch from `capture`, at the scale of the batch.

        At the first iteration of a stage, photographs that were cached in the stage before are removed: most stages
        have another scale. Raises InputError in all processes if one process cannot read its files.
        """
        if 1 < batch.number == batch.stage.first + 1:
            capture.clear_caches()  # what the stage before has used
        seen = problem.processes.agreed(lambda: capture.observe(batch.photographs, batch.scale))
        return seen.to(problem.device)

    def state(self) -> dict[str, Any]:
        """Return the states of the random generators, and the photographs still to come, for a checkpoint."""
        return {"random": {name: random.get_state() for name, random in self.random.items()}, "waiting": self.waiting}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from `state`, which the method `state` has returned.

        Raises ValueError if it contains photographs that are not fitted.
        """
        if not {k for some in state["waiting"].values() for k in some} <= {k for a in self.alike.values() for k in a}:
            raise ValueError("photographs that are not fitted")
        for name, random in self.random.items():
            random.set_state(state["random"][name])
        self.waiting = state["waiting"]
