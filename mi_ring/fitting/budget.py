"""Time: what an iteration of each stage takes on this machine, and which fit a given time allows."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.schedule import Stage
from mi_ring.system.machine import release_memory

FEWEST = 40  #: iterations: with fewer nothing is to be expected
AROUND = 40  #: iterations of the last stage that take as long as pictures before a fit and its results after it

Settings = TypeVar("Settings", bound=Config)
Planner = Callable[[Config], list[Stage]]
Costs = dict[tuple[int, int], float]  #: seconds of an iteration by level and width of its stage


def measure(fit: Fit, stages: Iterable[Stage], interrupted: Callable[[], int] = int) -> Costs:
    """What an iteration takes at each level and width of the stages: the second of two, for the first has to warm up.

    They are those of another fit, which goes on from the state of this one and is dropped. Nothing of it, once it was
    `interrupted`.
    """
    print("Measuring what iterations take on this machine", flush=True)
    trial = Fit(fit.given, fit.config, terms=fit.terms, state=fit.state())
    trial.ring.domain = fit.ring.domain  # with the samplings, which the fit needs in any case
    random, costs = trial.random.get_state(), {}
    for stage in {(stage.level, stage.width): stage for stage in stages}.values():
        # As one that shapes the surface: those in which it stands still, of the same sizes, take less.
        trial.stages = [stage._replace(first=0, last=trial.iterations, settles=False)]
        for _ in range(2):
            if interrupted():
                return {}
            trial.random.set_state(random)
            trial.rounds.waiting = {}  # the same photographs, which are remembered, as later in a fit
            trial.iteration = max(0, trial.iterations - 2)  # the last one does more
            started = time.perf_counter()
            trial.step()
            costs[stage.level, stage.width] = time.perf_counter() - started
    release_memory()
    return fit.processes.told(costs)


def all_stages(fit: Fit, configs: Sequence[Config]) -> list[Stage]:
    """The stages of fits with these settings, from where this one starts."""
    return [stage for config in configs for stage in fit.stages_by(config)]


def fitting_into(seconds: float, configs: Sequence[Settings], stages_by: Planner, costs: Costs) -> Settings:
    """Of some settings those whose own fit takes the most like so many seconds, with as many iterations as they allow.

    `stages_by`: the stages that settings make, as `Fit.stages_by` has them.
    """
    config = min(configs, key=lambda config: abs(math.log(seconds_of(config, stages_by, costs) / seconds)))
    around = seconds_around(config, stages_by, costs)
    share = (seconds - around) / (seconds_of(config, stages_by, costs) - around)
    return dataclasses.replace(config, iterations=max(FEWEST, int(config.iterations * share)))


def fewest_seconds(configs: Sequence[Config], stages_by: Planner, costs: Costs) -> float:
    """What the shortest of fits with these settings takes."""
    return min(seconds_of(dataclasses.replace(config, iterations=FEWEST), stages_by, costs) for config in configs)


def seconds_of(config: Config, stages_by: Planner, costs: Costs) -> float:
    """What a fit takes, with pictures before it and results after it."""
    iterations = sum((s.last - s.first) * costs[s.level, s.width] for s in stages_by(config))
    return iterations + seconds_around(config, stages_by, costs)


def seconds_around(config: Config, stages_by: Planner, costs: Costs) -> float:
    """What pictures before a fit and its results after it take, which are as large as photographs of the last stage."""
    last = stages_by(config)[-1]
    return AROUND * costs[last.level, last.width]


def replan(fit: Fit, config: Config) -> None:
    """Have a fit that has not begun take settings that differ in stages, iterations, level or regulariser alone."""
    fit.config, fit.ring.subdivisions = config, config.subdivisions
    fit.stages = fit.stages_by(config)
    fit.iterations = fit.stages[-1].last
