"""Compare `photometric` with Mitsuba's path tracer: `python -m mi_ring.validate SCENE.xml` or `… RUN`."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ring.errors import InputError, require_range
from mi_ring.metrics.path_tracing import BATCHES, open_lit_scene, render_both
from mi_ring.metrics.renderer_agreement import all_as_one, compare_renderers, comparison_table, verdict
from mi_ring.output.validation_sheet import strip, validation_sheet
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.shot import Shot
from mi_ring.system import command
from mi_ring.system.files import write_file, writing
from mi_ring.system.progress import progress


@dataclass(frozen=True)
class ValidateConfig:
    """Compare `photometric` with Mitsuba's path tracer on every photograph.

    Prints a line for each photograph and one for all. Numbers are in % of the path tracer's mean radiance:
    difference: mean difference. absolute: mean absolute difference. noise: the part of `absolute` that Monte Carlo
    noise explains. shadows: light that shadows remove. interreflection: light that interreflection adds.
    unexplained: difference of direct light.
    p direct: probability of a difference as large as this if the direct light of both renderers is the same.
    p path: this probability for all light of the path tracer. It is tiny if there is interreflection.

    The command writes a contact sheet, validate.png, and all numbers, validate.json. The exit status is 1 if the direct
    light differs by more than Monte Carlo noise. It is 2 if there is nothing to compare.
    """

    scene: Positional[Annotated[Path, arg(metavar="SCENE.xml|RUN")]]
    """Mitsuba XML file that names the photographs, or results folder of a fit."""
    out: Path | None = None
    """Folder for the results. Without this option: RUN/validate, or out/validate/NAME for a scene file.
    NAME is the name of the scene file without .xml: pot for pot.xml. It is pot for pot/scene.xml, too."""
    photographs: tuple[str, ...] = ()
    """Photographs to compare, by id or image name in the scene file, for example 003.jpg. Without this option: all."""
    width: int = 128
    """Largest width and height of the pictures [px]. Larger pictures take longer and show smaller details."""
    spp: int = 64
    """Samples per pixel, rounded up to a multiple of 16. More samples find smaller differences and take longer."""
    depth: int = 6
    """Largest length of the path tracer's light paths, Mitsuba's max_depth: 3 or more. -1: no limit.
    Longer paths find more interreflection and take longer. With 2 there would be direct light only."""
    significance: float = 0.01
    """Probability of a false alarm: the command reports a difference although both renderers agree. Between 0 and 1.
    0.01: once in a hundred runs. With a smaller number the command misses more small differences."""
    seed: int = 0
    """Random seed of all samples. Give another seed to see whether a reported difference was only chance."""

    def __post_init__(self) -> None:
        for name in ("width", "spp"):
            require_range(self, name, 1)
        if self.depth < 3 and self.depth != -1:
            raise InputError(f"--depth: is {self.depth}, must be at least 3, or -1 for no limit")
        if not 0 < self.significance < 1:
            raise InputError(f"--significance: is {self.significance}, must be between 0 and 1")
        require_range(self, "seed", 0, 2**31 - 1)


def chosen_photographs(shots: Sequence[Shot], names: Sequence[str]) -> list[int]:
    """Return the indices of the photographs with these names.

    If `names` is empty, return the indices of all photographs. A name is the id of a photograph in the scene file, or
    the name of its image file. Raises InputError for a name that no photograph has.
    """
    for name in names:
        if not any(name in (shot.name, shot.file_name) for shot in shots):
            raise InputError(f"--photographs: there is no {name}; the first is called {shots[0].name}")
    return [k for k, shot in enumerate(shots) if not names or {shot.name, shot.file_name} & set(names)]


def main(arguments: Sequence[str]) -> int:
    """Run the command with these arguments of the command line. Returns its exit status.

    It is 1 if the direct light of the two renderers differs by more than Monte Carlo noise, otherwise 0.
    """
    config = command.parse(ValidateConfig, arguments, "mi_ring.validate")
    path, out = config.scene, Path("out/validate") / command.scene_name(config.scene)
    if path.is_dir():
        path, out = path / "scene.xml", path / "validate"
        if not path.is_file():
            raise InputError(f"{config.scene}: has no scene.xml; give the folder of a finished fit or a scene file")
    out = config.out or out
    scene, sensors = open_lit_scene(path)
    shots = [sensor.shot for sensor in sensors]
    chosen = chosen_photographs(shots, config.photographs)
    with writing(f"{out}: --out"):
        out.mkdir(parents=True, exist_ok=True)

    photographs, spp = Photographs.of(shots), -(-config.spp // BATCHES)
    names = [shot.file_name for shot in shots]
    rows, strips = [], []
    for k in progress(chosen, "comparing", unit="photograph", leave=True):
        size = shots[k].size
        scale = -(-max(size) // config.width)
        if min(size) < scale:
            raise InputError(f"--width: is {config.width}, too small for {names[k]} of {size[0]} x {size[1]} pixels")
        seed = 2 * BATCHES * (config.seed * len(shots) + k) % 2**32
        pictures = render_both(scene, photographs, k, sensors[k], scale, spp, config.depth, seed)
        rows.append(compare_renderers(names[k], pictures))
        strips.append(strip(rows[-1], pictures))
    if not any(row.radiance > 0 or row.difference for row in rows):
        raise InputError(f"{path}: every photograph is black; check where the object is, cameras and lights")
    everything = all_as_one(rows)
    numbers = {
        "scene": str(path), "spp": spp * BATCHES, "width": config.width, "depth": config.depth, "seed": config.seed,
        "significance": config.significance, "all": asdict(everything), "photographs": [asdict(row) for row in rows],
    }  # fmt: skip
    write_file(out / "validate.json", json.dumps(numbers, indent=1) + "\n")
    write_file(out / "validate.png", validation_sheet(strips))
    print(comparison_table([*rows, everything]))
    print("\n".join(verdict(rows, everything, config.significance)))
    print(f"{out}/validate.png, {out}/validate.json")
    return int(everything.p_direct < config.significance)


if __name__ == "__main__":
    command.run("mi_ring.validate", main)
