"""Coarse to fine: the stages of a fit, and one in which light and material settle."""

from typing import NamedTuple

from mi_ring.fitting.config import Config

HEAD_START = 2 / 3  #: share of the first stage's iterations that a start near the object makes unnecessary
SETTLING = 0.15  #: iterations in which light and material settle, by those before them
EXCHANGE = 0.4  #: iterations of the second stage that it gets for each; by the presets they take about as long


class Stage(NamedTuple):
    """One stage of coarse to fine."""

    level: int  #: of the icosphere
    width: int  #: of the photographs, at most [px]
    first: int  #: iteration
    last: int  #: iteration after the last
    settles: bool = False  #: Does the surface stand still, while light and material settle?


def stages_of(config: Config, near: bool = False, settling: bool = False) -> list[Stage]:
    """Those stages that get at least one iteration, in order, from a start that is `near` the object or far.

    `settling`: and one more, in which the surface stands still.
    """
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
    if settling:
        more = max(1, round(SETTLING * first))
        stages.append(Stage(config.levels[-1], config.widths[-1], first, first + more, settles=True))
    return [stage for stage in stages if stage.last > stage.first]
