"""Coarse to fine: the stages of a fit."""

from typing import NamedTuple

from mi_ring.fitting.config import Config

HEAD_START = 2 / 3  #: share of the first stage's iterations that a start near the object makes unnecessary
EXCHANGE = 0.4  #: iterations of the second stage that it gets for each; by the presets they take about as long


class Stage(NamedTuple):
    """One stage of coarse to fine."""

    level: int  #: of the icosphere
    width: int  #: of the photographs, at most [px]
    first: int  #: iteration
    last: int  #: iteration after the last


def stages_of(config: Config, near: bool = False) -> list[Stage]:
    """Those stages that get at least one iteration, in order, from a start that is `near` the object or far."""
    shares = list(config.shares)
    if near and len(shares) > 1:
        shares[1] += EXCHANGE * HEAD_START * shares[0]
        shares[0] -= HEAD_START * shares[0]
    total, done, first, stages = sum(config.shares), 0.0, 0, []
    for level, width, share in zip(config.levels, config.widths, shares):
        done += share
        last = round(config.iterations * done / total)
        stages.append(Stage(level, width, first, last))
        first = last
    return [stage for stage in stages if stage.last > stage.first]
