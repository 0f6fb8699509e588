"""An experiment: a list of runs, and how a table and a figure show their results. Each run fits a dataset."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mi_ring.collection.jobs import RECORDS
from mi_ring.errors import InputError
from mi_ring.experiments.datasets import Dataset
from mi_ring.fitting.config import Config

NOT_RUN = "not run"  #: `Outcome.failed` of a run that --only leaves out

Row = dict[str, Any]  #: of a table: labels and numbers, by name

#: Changes of the preset `fast` by --quick. A fit then takes little longer than its start and its report.
QUICK = {"iterations": 60, "levels": (3, 4), "widths": (64, 128), "shares": (0.7, 0.3), "subdivisions": 4}


@dataclass(frozen=True)
class ExperimentOptions:
    """The options of `mi-ring paper` that apply to every experiment."""

    data: tuple[Path, ...] = ()
    materials: tuple[str, ...] = ()
    preset: str = "default"
    seeds: tuple[int, ...] = (0,)
    quick: bool = False
    threads: int = 0
    variant: str = "llvm_ad_rgb"
    out: Path = Path("out/paper")  #: folder of all experiments

    @property
    def size(self) -> str:
        """Size of the captures that experiments make: "quick", "fast" or "full"."""
        return "quick" if self.quick else "fast" if self.preset == "fast" else "full"

    @property
    def captures(self) -> Path:
        """Folder for the captures that experiments make."""
        return self.out / "captures" / self.size

    @property
    def spp(self) -> int:
        """Samples per pixel of predicted photographs."""
        return 4 if self.quick else 16


@dataclass(frozen=True)
class Run:
    """One fit of an experiment: its dataset, its settings, and how it is measured."""

    name: str  #: of the results folder
    dataset: Dataset
    labels: Row  #: first columns of its rows in the table
    #: Fields of `Config` that differ from the preset: numbers, words and tuples of these.
    changes: Mapping[str, Any] = field(default_factory=dict)
    #: (run, results folder, options) ↦ rows of the table; None: `measures.evaluated`.
    measure: Callable[["Run", Path, ExperimentOptions], list[Row]] | None = None
    watched: bool = False  #: measure the surface during the fit, too; such a fit cannot be resumed

    def config(self, options: ExperimentOptions) -> Config:
        """Return the settings of the fit. Raises InputError if a setting is invalid."""
        return Config.preset(options.preset, **self.settings(options))

    def settings(self, options: ExperimentOptions) -> dict[str, Any]:
        """Return the settings that differ from the preset: a dict from fields of `Config` to values."""
        return {**(QUICK if options.quick else {}), **self.changes}

    def fit_options(self, options: ExperimentOptions) -> tuple[str, ...]:
        """Return the settings as command-line options of `mi-ring fit`."""
        words = ["--preset", options.preset, "--variant", options.variant]
        for name, value in self.settings(options).items():
            words += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value])]
        return tuple(words)


@dataclass
class Outcome:
    """The result of a run: its rows of the table, or the reason why there are none."""

    run: Run
    folder: Path = Path()  #: of the results
    rows: Sequence[Row] = ()
    failed: str = NOT_RUN  #: reason why there are no rows; empty if there are rows
    old: bool = False  #: whether the fit was finished before


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, and how its numbers are written."""

    heading: str
    digits: int = 2  #: after the point


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper: which fits to run, and how a table and a figure show their results."""

    about: str  #: one sentence
    list_runs: Callable[[ExperimentOptions], list[Run]]  #: without seeds, unless a run sets its own
    columns: Mapping[str, Column]  #: by the names of numbers in rows; all other entries of rows are labels
    figure: Callable[[list[Outcome]], Figure]  #: of all runs that are done or have failed
    data: str = "folders of captures with scene.xml and truth/mesh.ply, or meshes"  #: what DATA must be
    published: Sequence[Row] = ()
    mean_over: str = "seed"  #: label; the table has means over it, beside those over seeds
    one_seed: bool = False  #: whether only one seed is allowed, because its rows have no mean

    def runs(self, options: ExperimentOptions) -> list[Run]:
        """Return all runs, repeated with each seed of the options.

        Raises InputError if DATA or --materials are wrong, or if two runs would have the same name.
        """
        runs = seeded(self.list_runs(options), options.seeds)
        names = [run.name for run in runs]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise InputError(f"DATA: two runs would have the name {twice}; rename a capture, or leave out the "
                             "duplicate")  # fmt: skip
        if RECORDS in names:
            raise InputError(f"DATA: a run would have the name {RECORDS} of another folder; rename the capture")
        return runs


def seeded(runs: Sequence[Run], seeds: Sequence[int]) -> list[Run]:
    """Repeat each run with each seed. A run whose settings contain a seed is not repeated.

    The seed is added to the names of the runs, unless it is 0. It is added to their labels if there are several seeds.
    """
    result = []
    for run in runs:
        for seed in [None] if "seed" in run.changes else seeds:
            changes = run.changes if seed is None else {**run.changes, "seed": seed}
            labels = {**run.labels, "seed": seed} if seed is not None and len(seeds) > 1 else run.labels
            result.append(replace(run, name=f"{run.name}-{seed}" if seed else run.name, labels=labels, changes=changes))
    return result
