"""What an experiment is: runs, each a fit of a capture by changed settings, and what is shown of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from mi_ring.collection.jobs import RECORDS
from mi_ring.errors import InputError
from mi_ring.experiments.recipes import Recipe
from mi_ring.fitting.config import Config

NOT_RUN = "not run"  #: by --only

Row = dict[str, Any]  #: of a table: what it is of, and numbers

#: What --quick changes of the preset `fast`: what a fit takes is then mostly to begin, and to write its report.
QUICK: dict[str, Any] = {
    "iterations": 60,
    "levels": (3, 4),
    "widths": (64, 128),
    "shares": (0.7, 0.3),
    "subdivisions": 4,
}


@dataclass(frozen=True)
class Asked:
    """What the user asks of an experiment."""

    data: tuple[Path, ...] = ()
    materials: tuple[str, ...] = ()
    preset: str = "default"
    seeds: tuple[int, ...] = (0,)
    quick: bool = False
    threads: int = 0
    variant: str = "llvm_ad_rgb"

    @property
    def settings(self) -> dict[str, Any]:
        """Of all fits, beside those of the preset."""
        return dict(QUICK) if self.quick else {}

    @property
    def size(self) -> str:
        """Of captures that are made: quick, fast or full."""
        return "quick" if self.quick else "fast" if self.preset == "fast" else "full"

    @property
    def spp(self) -> int:
        """Samples per pixel of predicted photographs."""
        return 4 if self.quick else 16


class Made(NamedTuple):
    """A finished fit, to be measured."""

    folder: Path  #: of its results
    scene: Path
    truth: Path  #: folder of mesh.ply
    captures: Path  #: folder of those that experiments make
    asked: Asked


@dataclass(frozen=True)
class Run:
    """A fit of an experiment."""

    name: str  #: of the folder of its results
    recipe: Recipe  #: of its capture
    labels: Row  #: what the table says of it before its numbers
    changes: Mapping[str, Any] = field(default_factory=dict)  #: settings of `Config`
    #: Rows of the table that are made of it: one, or one for each of several resolutions or times.
    measure: Callable[["Run", Made], list[Row]] | None = None
    watched: bool = False  #: is the fit looked at in its course? Then it cannot go on where it stopped

    def config(self, asked: Asked) -> Config:
        """Its settings. Raises InputError for what `Config` does not take."""
        return Config.preset(asked.preset, **{**asked.settings, **self.changes})

    def options(self, asked: Asked) -> tuple[str, ...]:
        """The same as options of `mi-ring fit`."""
        return ("--preset", asked.preset, "--variant", asked.variant, *words({**asked.settings, **self.changes}))


@dataclass
class Outcome:
    """What has become of a run."""

    run: Run
    made: Made | None = None  #: None unless it is done
    rows: Sequence[Row] = ()
    failed: str = NOT_RUN  #: why there are no rows; empty if there are
    old: bool = False  #: was its fit there already?


@dataclass(frozen=True)
class Column:
    """Of a table."""

    heading: str
    digits: int = 2  #: after the point


@dataclass(frozen=True)
class Experiment:
    """One of the paper's, or of ours in its spirit."""

    about: str  #: one sentence
    runs: Callable[[Asked], list[Run]]
    columns: Mapping[str, Column]  #: by the names of numbers; all else that rows have are labels
    figure: Callable[[list[Outcome]], Figure]  #: of all runs that are done or have failed
    data: str  #: what DATA must be
    published: Sequence[Row] = ()  #: rows beside ours
    mean_over: str = "seed"  #: label over which further rows have means, beside those over seeds


def words(settings: Mapping[str, Any]) -> list[str]:
    """Settings as options of `mi-ring fit`."""
    result: list[str] = []
    for name, value in settings.items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            result.append(option if value else f"--no-{option[2:]}")
        elif isinstance(value, Mapping):
            result += [w for key, weight in value.items() for w in (f"{option}.{key.replace('_', '-')}", str(weight))]
        else:
            result += [option, *map(str, value if isinstance(value, tuple | list) else [value])]
    return result


def require_distinct(runs: Sequence[Run]) -> None:
    """Raise InputError if two runs would have the same folder, or one that of their records."""
    names = [run.name for run in runs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"DATA: two runs would both be called {twice}; rename a capture, leave out what is given "
                         "twice, or give them one by one")  # fmt: skip
    if RECORDS in names:
        raise InputError(f"DATA: a run would be called {RECORDS}, as the folder of records is; rename the capture")
