"""Time: what an iteration of each stage takes on this machine, and which fit a given time allows."""

import dataclasses
import math
import time
from collections.abc import Iterable, Sequence
from typing import TypeVar

from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.schedule import Stage, stages_of
from mi_ring.geometry.domain import Sphere

FEWEST = 40  #: iterations: with fewer nothing is to be expected

Settings = TypeVar("Settings", bound=Config)
Costs = dict[tuple[int, int], float]  #: seconds of an iteration by level and width of its stage


def measure(fit: Fit, stages: Iterable[Stage]) -> Costs:
    """What an iteration of each stage takes: the second of two, for the first has to warm up.

    They are those of another fit, which goes on from the state of this one and is dropped.
    """
    refine = tuple(name for name in fit.config.refine if name != "masks")  # which a few iterations find anew
    config = dataclasses.replace(fit.config, holdout=0, refine=refine or ("none",))
    trial = Fit(fit.capture, config, terms=fit.terms, state=fit.state())
    costs: Costs = {}
    for stage in stages:
        trial.stages = [stage._replace(first=0, last=trial.iterations)]
        for _ in range(2):
            trial.iteration = trial.iterations - 1
            started = time.perf_counter()
            trial.step()
            costs[stage.level, stage.width] = time.perf_counter() - started
    return costs


def all_stages(fit: Fit, configs: Sequence[Config]) -> list[Stage]:
    """The stages of fits with these settings, from where this one starts, each level and width once."""
    near = not isinstance(fit.ring.domain, Sphere)
    stages = [stage for config in configs for stage in stages_of(config, near)]
    return list({(stage.level, stage.width): stage for stage in stages}.values())


def fitting_into(seconds: float, configs: Sequence[Settings], near: bool, costs: Costs) -> Settings:
    """Of some settings those whose own fit takes the most like so many seconds, with as many iterations as they allow.

    `near`: is the start near the object?
    """
    own = [seconds_of(config, near, costs) for config in configs]
    nearest = min(range(len(configs)), key=lambda k: abs(math.log(own[k] / seconds)))
    config = configs[nearest]
    return dataclasses.replace(config, iterations=max(FEWEST, int(config.iterations * seconds / own[nearest])))


def seconds_of(config: Config, near: bool, costs: Costs) -> float:
    """What the iterations of a fit take."""
    return sum((s.last - s.first) * costs[s.level, s.width] for s in stages_of(config, near))
