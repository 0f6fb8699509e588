"""Measures how long iterations take on this machine, and plans a fit for a given time."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.schedule import Schedule, Stage
from mi_ring.system.machine import release_memory

FEWEST = 40  #: iterations: fewer give no useful result
AROUND = 40  #: time of the pictures before a fit and of its results, in iterations of the last stage

Settings = TypeVar("Settings", bound=Config)
Planner = Callable[[Config], Schedule]  #: the schedule of settings, see `Fit.plan`
Costs = dict[tuple[int, int], float]  #: seconds of an iteration by level and width of its stage


def measure(fit: Fit, stages: Iterable[Stage], interrupted: Callable[[], int] = int) -> Costs:
    """Measure how long an iteration takes at each mesh level and photograph width of the `stages` of a fit.

    A copy of `fit` makes two iterations at each, and the second one is timed; `fit` does not change. Returns a dict
    from (level, width) to seconds. If `interrupted()` returns a signal number other than 0, the result is {}.
    """
    print("Measuring how long iterations take, to say how long is left", flush=True)
    trial = Fit(fit.problem.given, fit.problem.config, terms=fit.loss.terms, state=fit.state())
    trial.ring.domain = fit.ring.domain  # it caches its samplings for the fit, too
    state, costs = trial.sampler.state(), {}
    for stage in {(stage.level, stage.width): stage for stage in stages if not stage.detail}.values():
        release_memory()  # reading photographs has left some, and so does each stage
        # A stage that shapes the surface: one with a fixed surface takes less time.
        last = trial.schedule.iterations
        trial.schedule = replace(trial.schedule, stages=(stage._replace(first=0, last=last, settles=False),))
        trial.optimisation.prepare(trial.schedule, trial.schedule.iterations - 2)
        for _ in range(2):
            if interrupted():
                return {}
            trial.sampler.restore(state | {"waiting": {}})  # the same photographs: in a fit they are cached, too
            trial.course.iteration = max(0, last - 2)  # the last iteration of a fit does more
            started = time.perf_counter()
            trial.step()
            costs[stage.level, stage.width] = time.perf_counter() - started
    release_memory()
    return costs


def replan(fit: Fit, config: Config) -> None:
    """Give new settings, `config`, to a fit that has made no iteration yet. `fit` is changed in place.

    Only these settings may differ from the old ones: stages, iterations, mesh level and regulariser.
    """
    fit.problem = fit.optimisation.problem = replace(fit.problem, config=config)
    fit.ring.subdivisions, fit.schedule = config.subdivisions, fit.plan(config)


def all_stages(fit: Fit, configs: Sequence[Config]) -> list[Stage]:
    """List the stages that `fit` would have with each of the settings `configs`, all in one list."""
    return [stage for config in configs for stage in fit.plan(config).stages]


def fitting_into(seconds: float, configs: Sequence[Settings], plan: Planner, costs: Costs) -> Settings:
    """Choose from `configs` the settings whose fit takes about `seconds`.

    Returns them with another number of iterations. With this number the fit fills the time. `plan`: a function from
    settings to the schedule of their fit. `costs`: a dict from (mesh level, photograph width) to measured seconds per
    iteration.
    """
    config = min(configs, key=lambda config: abs(math.log(seconds_of(config, plan, costs) / seconds)))
    around = seconds_around(config, plan, costs)
    share = (seconds - around) / (seconds_of(config, plan, costs) - around)
    return replace(config, iterations=max(FEWEST, int(config.iterations * share)))


def fewest_seconds(configs: Sequence[Config], plan: Planner, costs: Costs) -> float:
    """Estimate the time [s] of the shortest useful fit among the settings `configs`. Such a fit has 40 iterations.

    `plan`: a function from settings to the schedule of their fit. `costs`: a dict from (mesh level, photograph width)
    to measured seconds per iteration.
    """
    return min(seconds_of(replace(config, iterations=FEWEST), plan, costs) for config in configs)


def seconds_of(config: Config, plan: Planner, costs: Costs) -> float:
    """Estimate the total time [s] of a fit: pictures before the first iteration, iterations, and results.

    `plan`: a function from settings to the schedule of their fit. `costs`: a dict from (mesh level, photograph width)
    to measured seconds per iteration.
    """
    stages = plan(config).stages
    iterations = sum((stage.last - stage.first) * seconds_per_iteration(stage, stages, costs) for stage in stages)
    return iterations + seconds_around(config, plan, costs)


def seconds_per_iteration(stage: Stage, stages: Sequence[Stage], costs: Costs) -> float:
    """Return the time [s] of an iteration of a stage, one of `stages`. `costs`: of the others; details are estimated.

    An iteration for details takes as long as one of the stage before at a mesh level finer by 1, and half as long for
    each level less: it has fewer photographs. What `costs` do not tell counts as 1.
    """
    before = next(other for other in reversed(stages) if not other.detail) if stage.detail else stage
    finer = 2.0 ** (stage.level - before.level - 1) if stage.detail else 1.0
    return finer * costs.get((before.level, before.width), 1.0)


def seconds_around(config: Config, plan: Planner, costs: Costs) -> float:
    """Estimate the time [s] of a fit without its iterations: for pictures before the first one, and for the results.

    `plan`: a function from settings to the schedule of their fit. `costs`: a dict from (mesh level, photograph width)
    to measured seconds per iteration.
    """
    stages = plan(config).stages
    return AROUND * seconds_per_iteration(stages[-1], stages, costs)
