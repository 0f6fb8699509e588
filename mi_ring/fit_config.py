"""The options of `mi-ring fit`: the settings in `Config`, and the input, output and computing resources in `Task`."""

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, Suppress, arg

from mi_ring.errors import InputError, require_range
from mi_ring.fitting.config import PRESETS, WEIGHTS, Ablation, Common, Config, Tuning
from mi_ring.fitting.setting_types import as_typed
from mi_ring.output import results
from mi_ring.system import command

MOST_THREADS, MOST_MINUTES = 1024, 10_000  #: upper limits of the options; 10,000 minutes are a week
#: Groups of options that only --help-all shows, and the number of these options.
GROUPS = {"tuning": Tuning, "ablation": Ablation}
MORE = sum(len(dataclasses.fields(part)) for part in GROUPS.values()) - 1 + len(WEIGHTS)


@dataclass(frozen=True, kw_only=True)
class Task:
    """Options for the input, the output and the computing resources of a fit."""

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml")]]
    """Mitsuba XML file that names the photographs, their cameras and lights."""
    out: Path | None = None
    """Folder for the results. Without this option: out/NAME.
    NAME is the name of the scene file without .xml: pot.xml gives out/pot. If the file is called scene.xml, NAME is
    the name of its folder: pot/scene.xml gives out/pot."""
    resume: bool = False
    """Continue an interrupted fit from the checkpoint in its results folder. Give the same options as before."""
    preset: Literal["fast", "default", "fine", "paper"] = "default"
    """A set of values for the other options. Options that you give override it. Times are for two processor cores.
    fast: a preview in two minutes. default: good results in ten minutes. fine: more detail in half an hour.
    paper: the paper's own settings, seven hours."""
    minutes: float = 0
    """Time that the whole command may take, approximately [min], for example 10. 0: no limit.
    The command measures the speed of this machine and then chooses --iterations. If you give no --preset, the command
    chooses the preset, too."""
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Where Mitsuba computes. llvm_ad_rgb: on the processor. cuda_ad_rgb: on an Nvidia GPU, which must be there."""
    threads: int = 0
    """Number of processor threads. 0: one per core. Give for example 2 to leave the other cores to other programs."""


@dataclass(frozen=True, kw_only=True)
class FitConfig(Config, Task):
    """Reconstruct an object from photographs as a watertight mesh with a spatially varying material."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_range(self, "threads", 0, MOST_THREADS)
        require_range(self, "minutes", 0, MOST_MINUTES)
        if self.minutes and self.deterministic:
            raise InputError("--deterministic: does not go with --minutes, which depends on the speed of the machine")
        if self.deterministic and self.variant != "llvm_ad_rgb":
            raise InputError("--deterministic: needs --variant llvm_ad_rgb; on a GPU the order of sums varies")
        if not set(self.weights) <= set(WEIGHTS):
            raise InputError(f"--weights: is {as_typed(self.weights)}, must be of {', '.join(WEIGHTS)}")

    @property
    def thread_count(self) -> int:
        """Number of threads to compute with; 0: one per core. It is 1 for a deterministic fit."""
        return 1 if self.deterministic else self.threads

    @property
    def folder(self) -> Path:
        """The results folder: --out, or the default folder for the scene file."""
        return self.out or results.default_folder(self.scene)


def parse_options(arguments: Sequence[str]) -> FitConfig:
    """Read the options of the command line. Options that are not given have the values of the preset.

    Raises InputError for wrong options. With --help or --help-all it prints the help and raises SystemExit: --help
    shows the options that users set, --help-all shows all options.
    """
    early = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    early.add_argument("--preset", nargs="?", default="default")
    preset = early.parse_known_args(arguments)[0].preset
    preset_values = vars(FitConfig(scene=tyro.MISSING, **PRESETS.get(preset, {})))
    brief = "--help-all" not in arguments and bool({"-h", "--help"} & {*arguments})
    kind, parts = command_line(brief)
    default = built(kind, preset_values | {name: built(part, preset_values) for name, part in parts.items()})
    try:
        parsed = command.parse(kind, arguments, "mi_ring.fit", default, FitConfig.__doc__, needs_llvm=False)
    except SystemExit:
        if brief:
            print(f"{MORE} more options, for tuning and ablation: --help-all shows them")
        raise
    values = dict(vars(parsed))
    for name in parts:
        values |= vars(values.pop(name))
    return FitConfig(**values)


def command_line(brief: bool) -> tuple[Any, dict[str, Any]]:
    """Make the dataclass that tyro parses. It has one nested dataclass for each group of options.

    Returns (dataclass, dict from group names to nested dataclasses). Nested options keep their names: --levels, not
    --tuning.levels. `brief`: True if tyro neither shows nor parses the nested options.
    """
    parts, nested, hidden = {}, {}, Suppress
    for name, group in GROUPS.items():
        bare = {f.name: Annotated[f.type, arg(prefix_name=False)] for f in dataclasses.fields(group)}
        parts[name] = part = dataclass_of(group.__name__, bare, group)
        nested[name] = hidden[part] if brief else Annotated[part, arg(help=group.__doc__)]  # type: ignore[valid-type]
    return dataclass_of("Options", nested, Common, Task), parts


def dataclass_of(name: str, fields: dict[str, Any], *bases: type) -> Any:
    """Make a frozen dataclass called `name`. `fields`: a dict from names of fields to types.

    `bases`: its base classes.
    """
    return dataclasses.make_dataclass(name, fields.items(), bases=bases, frozen=True, kw_only=True)


def built(kind: Any, values: dict[str, Any]) -> Any:
    """Make an instance of the dataclass `kind`.

    `values`: a dict with a value for each field; other names in it are ignored.
    """
    return kind(**{f.name: values[f.name] for f in dataclasses.fields(kind)})
