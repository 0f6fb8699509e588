"""The schedule of a fit: stages from coarse to fine, learning rates and blur. It is known before the fit begins."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from mi_ring.fitting.config import Config

HEAD_START = 2 / 3  #: share of the first stage's iterations that a start near the object makes unnecessary
EXCHANGE = 0.4  #: iterations of the second stage that replace one of the first: they take as long, with the presets
FEWEST = 10  #: iterations for details: fewer do not show whether photographs agree
SETTLING = 0.15  #: iterations of the settling stage, as a share of all iterations before it
RAMP = 0.05  #: progress in which a learning rate rises from 0 to full, after its start
MASKS_REFINED = 0.5, 0.75  #: progress at which masks are found anew, if they are refined
#: Progress at which small lights of an unknown room are sought: when harmonics have their full order, and later.
LIGHTS_SOUGHT = 0.36, 0.5, 0.65, 0.8
JOINTLY_SOLVED = 0.3, 0.6  #: progress at which a room beside other light, flash and exposures are found together
FLASH_SOUGHT = 0.6  #: the one of them before which highlights tell the flash's place: earlier the surface is too coarse
COAT_DECIDED = 0.5  #: progress at which a fit decides about a second lobe of highlights
#: Iterations before light is sought or a coat decided: in shorter fits surface and material are too wrong.
EARLIEST = 20
INITIAL_BLUR = 0.06  #: standard deviation of the silhouettes' blur at the start, as a share of the width
SHARP = 0.8  #: progress at which the blur of silhouettes has shrunk to one pixel


class Stage(NamedTuple):
    """A stage of a fit. Mesh level and photograph width are constant in a stage; stages go from coarse to fine."""

    level: int  #: of the icosphere
    width: int  #: largest width of the photographs [px]
    first: int  #: first iteration, from 0
    last: int  #: iteration after the last
    settles: bool = False  #: Is the surface fixed, while light and material settle?
    detail: bool = False  #: Are networks and calibration fixed, while details are found?


class Rate(NamedTuple):
    """The learning rate of a group of parameters, as a function of progress; see `learning_rate`."""

    initial: float
    decay: float  #: the factor that the rate has reached at the end; it falls exponentially
    start: float = -1.0  #: progress at which the rate begins to rise from 0; -1: it starts at full


class Stepper(NamedTuple):
    """An optimiser and the learning rate of each of its parameter groups."""

    optimizer: torch.optim.Optimizer
    rates: Sequence[Rate]
    evaluates: bool = False  #: Does its `step` take a function that evaluates the loss again, as L-BFGS does?


@dataclass(frozen=True)
class Schedule:
    """The stages of a fit, and functions for the quantities that change with its progress."""

    stages: tuple[Stage, ...]

    @classmethod
    def of(cls, config: Config, near: bool = False, settling: bool = False, detail: Sequence[int] = ()) -> "Schedule":
        """Plan the stages of a fit with these settings. Stages without iterations are left out.

        `near`: the fit starts near the object's surface; its first stage is shorter. `settling`: add a stage in which
        the surface is fixed. `detail`: levels of the coarse and the fine mesh for details, which come last.
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
            first += more
        more = round(config.detail_share * config.iterations)
        shown = config.detail != "none" and more >= FEWEST
        for level, count in zip(detail, (more - more // 3, more // 3)) if shown else ():
            mesh = max(level, config.levels[-1])  # on a coarser mesh details would learn the difference of the meshes
            stages.append(Stage(mesh, max(config.widths), first, first + count, detail=True))
            first += count
        return cls(tuple(stage for stage in stages if stage.last > stage.first))

    @property
    def iterations(self) -> int:
        """Number of all iterations."""
        return self.stages[-1].last

    @property
    def shaping(self) -> int:
        """Number of iterations that shape the surface: all before the settling stage and the details."""
        return next((stage.first for stage in self.stages if stage.settles or stage.detail), self.iterations)

    @property
    def trained_level(self) -> int:
        """Level of the finest mesh with which the networks are trained."""
        return max(stage.level for stage in self.stages if not stage.detail)

    @property
    def final_level(self) -> int:
        """Level of the icosphere in the last stage."""
        return self.stages[-1].level

    def reaches(self, marks: Sequence[float], iteration: int) -> bool:
        """Test whether `iteration`, counted from 0, is the first one at one of these marks of progress."""
        return iteration in [int(mark * self.shaping) for mark in marks]

    def masks_due(self, iteration: int) -> bool:
        """Test whether masks are refined before `iteration`, counted from 0, if the fit refines masks."""
        return self.reaches(MASKS_REFINED, iteration)

    def lights_due(self, iteration: int) -> bool:
        """Test whether small lights are sought before `iteration`, counted from 0, if the fit seeks any."""
        return iteration >= EARLIEST and self.reaches(LIGHTS_SOUGHT, iteration)

    def joint_due(self, iteration: int) -> bool:
        """Test whether lights and exposures are found together before `iteration`, if any of them is refined."""
        return iteration >= EARLIEST and self.reaches(JOINTLY_SOLVED, iteration)

    def flash_due(self, iteration: int) -> bool:
        """Test whether highlights are to tell the place of the flash before `iteration`, if it is refined."""
        return self.joint_due(iteration) and self.reaches([FLASH_SOUGHT], iteration)

    def coat_due(self, iteration: int) -> bool:
        """Test whether the fit decides before `iteration`, counted from 0, whether the material has a coat."""
        return iteration == int(COAT_DECIDED * self.shaping) >= EARLIEST

    def stage(self, iteration: int) -> Stage:
        """Return the stage of `iteration`, counted from 0."""
        return next(stage for stage in self.stages if iteration < stage.last)

    def progress(self, iteration: int) -> float:
        """Return the progress of the fit before `iteration`, counted from 0.

        It is the share of the iterations that shape the surface that are done. In the settling stage it is 1.
        """
        return min(1.0, iteration / self.shaping)

    def detail_progress(self, iteration: int) -> float:
        """Return the share of the iterations for details that are done before `iteration`, in [0, 1]."""
        first = next((stage.first for stage in self.stages if stage.detail), self.iterations)
        return max(0, iteration - first) / max(1, self.iterations - first)

    def outline_blur(self, progress: float, width: float) -> float:
        """Return the standard deviation [px] of the blur of silhouettes in photographs `width` [px] wide.

        It shrinks with `progress`, 0 to 1, and is at least one pixel.
        """
        return max(1.0, INITIAL_BLUR * (1 - progress / SHARP) * width)


def learning_rate(rate: Rate, progress: float) -> float:
    """Return the learning rate at this `progress` of a fit, 0 to 1."""
    return rate.initial * rate.decay**progress * min(1.0, max(0.0, (progress - rate.start) / RAMP))
