"""Reproduce a table or figure of the paper, beside the published numbers: `python -m mi_ring.paper NAME`."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mi_ring.errors import InputError, require_range
from mi_ring.experiments.catalogue import EXPERIMENTS
from mi_ring.experiments.engine import run_experiment
from mi_ring.experiments.experiment import ExperimentOptions
from mi_ring.fit_config import MOST_THREADS
from mi_ring.fitting.setting_types import as_typed
from mi_ring.system import command
from mi_ring.system.files import locked
from mi_ring.system.machine import set_variant

Name: Any = Literal[tuple(EXPERIMENTS)]


@dataclass(frozen=True)
class PaperConfig:
    """Reproduce a table or figure of the paper: fits, a table of our results and the published ones, and a figure.

    Each run is a fit. Its results are in OUT/NAME/runs/, or in OUT/NAME-PRESET/runs/ for another preset than default.
    table.csv, table.md and figure.png are written after each run. To continue after an interruption, give the same
    command again. If a run fails, the others continue, and the exit status is 1.
    """

    name: Positional[Annotated[Name, arg(metavar="NAME")]]
    """The experiment to repeat.
    table1: accuracy. table2: DiLiGenT-MV. table3: wrong camera poses, refined.
    specularity: materials from dull to glossy. stripes: two materials on one object. swap: materials exchanged.
    views: 5 to 50 photographs. genus: from a sphere and from the visual hull.
    ablation: the flow against plain ResNets. encoding: positional encodings. steps: Euler steps, the paper's T.
    resolution: one fit at several mesh levels. timing: errors in the course of a fit.
    single: DiLiGenT's photographs from one side."""
    data: Positional[Annotated[tuple[Path, ...], arg(metavar="DATA")]] = ()
    """Captures (folders with scene.xml and truth/mesh.ply) or meshes. specularity and stripes take one mesh.
    table2 takes the folder of DiLiGenT-MV, single takes .npz files.
    Without DATA, the other experiments use the capture pot2 of the source repository. If it is not there, they use the
    pot of mi-ring example."""
    materials: tuple[str, ...] = ()
    """Materials of the meshes, for example "principled roughness=0.3"; mi-ring synthesize --help lists all forms.
    The first mesh gets the first material, the second mesh the second material, and so on. If there are more meshes
    than materials, the list of materials is repeated.
    specularity gives its one mesh each of the materials in turn. stripes needs two materials."""
    out: Path = Path("out/paper")
    """Folder for the results of all experiments and for the captures that they make.
    Each experiment has a folder of its name and preset."""
    preset: Literal["fast", "default", "fine", "paper"] | None = None
    """Preset of the fits, as in mi-ring fit: finer presets take longer.
    Without this option: default. With --quick it is fast, and no other preset is allowed."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds, for example 0 1 2. Each run is made once with each seed. The table contains the means.
    With more seeds the means vary less by chance, and the experiment takes longer."""
    only: tuple[str, ...] = ()
    """Names of the runs to make now. You can make the other runs later or on other machines.
    To see all names, give a wrong name. Without this option: all runs."""
    quick: bool = False
    """Make a small version in minutes: few runs, few iterations, small photographs.
    Its results are in OUT/NAME-quick."""
    variant: Literal["llvm_ad_rgb", "cuda_ad_rgb"] = "llvm_ad_rgb"
    """Where Mitsuba computes. llvm_ad_rgb: on the processor. cuda_ad_rgb: on an Nvidia GPU, which must be there."""
    threads: int = 0
    """Number of processor threads. 0: one per core. Give for example 2 to leave the other cores to other programs."""


def main(arguments: Sequence[str]) -> int:
    """Run the command with these arguments of the command line.

    Returns its exit status: 1 if a run has failed, otherwise 0.
    """
    config = command.parse(PaperConfig, arguments, "mi_ring.paper")
    experiment = EXPERIMENTS[config.name]
    require_range(config, "threads", 0, MOST_THREADS)
    if not config.seeds or len({*config.seeds}) < len(config.seeds):
        raise InputError(f"--seeds: is {as_typed(config.seeds)}, must be different numbers")
    if experiment.one_seed and len(config.seeds) > 1:
        raise InputError(f"--seeds: {config.name} takes only one seed")
    if missing := next((path for path in config.data if not path.exists()), None):
        raise InputError(f"{missing}: DATA: no such file or folder; {config.name} takes {experiment.data}")
    if config.quick and config.preset not in (None, "fast"):
        raise InputError(f"--preset: is {config.preset}, but --quick needs fast; leave one of the two out")
    if not all(material.strip() for material in config.materials):
        raise InputError("--materials: one is empty; give a BSDF of Mitsuba, a .binary file, or FILE.npz:MATERIAL")
    preset = config.preset or ("fast" if config.quick else "default")
    options = ExperimentOptions(config.data, config.materials, preset, config.seeds, config.quick, config.threads,
                                set_variant(config.variant), config.out)  # fmt: skip
    kind = "quick" if config.quick else preset
    out = config.out / (config.name if kind == "default" else f"{config.name}-{kind}")
    words = ["mi-ring paper", config.name, *(path.name or str(path.resolve().name) for path in config.data)]
    if config.materials:
        words += ["--materials", *(shlex.quote(Path(material).name) for material in config.materials)]
    words.append("--quick" if config.quick else f"--preset {preset}")
    if options.variant != PaperConfig.variant:
        words.append(f"--variant {options.variant}")
    if config.seeds != (0,):
        words.append(f"--seeds {as_typed(config.seeds)}")
    with command.resumable(), locked(out):
        failed = run_experiment(experiment, options, out, config.only, " ".join(words))
    runs = f"; {failed} run{'s' * (failed > 1)} failed" * bool(failed)
    print(f"{out}/table.md{' and figure.png' * (out / 'figure.png').is_file()}{runs}")
    return int(failed > 0)


if __name__ == "__main__":
    command.run("mi_ring.paper", main)
