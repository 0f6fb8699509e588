"""The options of a fit: its settings, what it is of, where its results go and what computes it."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from mi_ring.errors import InputError
from mi_ring.fitting.config import PRESETS, WEIGHTS, Config, as_typed
from mi_ring.output import results
from mi_ring.system import command

MOST_THREADS = 1024  #: of a fit
MOST_MINUTES = 10_000  #: a week


@dataclass(frozen=True, kw_only=True)
class Task:
    """What a fit is of, where its results go, and what computes it."""

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file with the photographs."""
    out: Path | None = None
    """Folder of the results. Default: out/<name>, the name of the scene file, or of its folder if it is scene.xml."""
    resume: bool = False
    """Go on from the folder's checkpoint.pt. Give the same settings as before."""
    preset: Literal["fast", "default", "fine", "paper"] = "default"
    """Settings that go together; each can be overridden. paper: the paper's own, seven hours on two cores."""
    minutes: float = 0
    """About how long the command may take, results included: by what iterations take on this machine --iterations are
    chosen, and --preset unless it is given. 0: as long as they take."""
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Variant of Mitsuba, and with it of torch: llvm_ad_rgb computes on the processor, cuda_ad_rgb on a GPU if there is
    one."""
    threads: int = 0
    """Processor threads of the fit; 0: all."""


@dataclass(frozen=True, kw_only=True)
class FitConfig(Config, Task):
    """Reconstruct an object: photographs in, a watertight mesh with a spatially varying material out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.threads <= MOST_THREADS:
            raise InputError(f"--threads: is {self.threads}, must be 0 to {MOST_THREADS}")
        if not 0 <= self.minutes <= MOST_MINUTES:
            raise InputError(f"--minutes: is {self.minutes:g}, must be 0 to {MOST_MINUTES}")
        if self.minutes and self.deterministic:
            raise InputError("--deterministic: does not go with --minutes, by which the machine's speed decides")
        if self.deterministic and self.variant != "llvm_ad_rgb":
            raise InputError("--deterministic: needs --variant llvm_ad_rgb; a GPU adds numbers in an order of its own")
        if not set(self.weights) <= set(WEIGHTS):
            raise InputError(f"--weights: is {as_typed(self.weights)}, must be of {', '.join(WEIGHTS)}")

    @property
    def thread_count(self) -> int:
        """Threads to compute with; 0: all."""
        return 1 if self.deterministic else self.threads

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self.out or results.default_folder(self.scene)


def parse_options(arguments: Sequence[str]) -> FitConfig:
    """The configuration: the preset's settings under those given on the command line."""
    early = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    early.add_argument("--preset", nargs="?", default="default")
    preset = early.parse_known_args(arguments)[0].preset
    default = FitConfig(scene=tyro.MISSING, **PRESETS.get(preset, {}))
    return command.parse(FitConfig, arguments, "mi_ring.fit", default, needs_llvm=False)
