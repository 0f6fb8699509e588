"""Compare a fit with the truth: `python -m mi_ring.evaluate RUN --mesh TRUTH.ply`."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mi_ring.errors import InputError
from mi_ring.metrics.evaluation import evaluate, evaluation_table, rounded
from mi_ring.metrics.image_errors import SPP
from mi_ring.output.ambiguity import ambiguity_of
from mi_ring.system import command
from mi_ring.system.files import require_place, write_file

MISPLACED = 0.3  #: below this IoU of the silhouettes the true mesh is probably in another frame


@dataclass(frozen=True)
class EvaluateConfig:
    """Compare a finished fit with the truth. Prints a table to standard error and a line of JSON to standard output.

    Normals and depths are compared at pixels that see both surfaces: errors [deg], and [% of the diagonal of the true
    bounding box]. Silhouettes are compared by intersection over union. The table also has the share of visible faces
    that point away from the camera. The surfaces are compared by Chamfer distance [% of the diagonal] and F-score; with
    --seen, only their visible parts. The fitted mesh is described by its genus, the number of triangles that cross
    another, and the number of triangles that Shape-Net turned inside out. Predicted photographs are compared by PSNR
    [dB] and SSIM: for all pixels, and for the object's pixels if there is a mask and a visible background. The JSON
    file has the numbers of every photograph.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit."""
    mesh: Path
    """PLY, OBJ or GLB file of the true surface, in the units and the frame of the scene.
    For a capture of mi-ring synthesize or mi-ring example it is truth/mesh.ply."""
    novel: Path | None = None
    """Scene file of photographs that the fit has not used. The command predicts them and measures the errors.
    Without this option: only the photographs of the fit are compared."""
    seen: bool = False
    """Compute Chamfer distance and F-score only for the parts of the surfaces that a photograph of the fit shows.
    Use this option if the photographs do not show the whole object, for example if its underside is hidden."""
    align: Literal["rigid", "similarity"] | None = None
    """Align the true surface and the photographs of --novel with the fit before the comparison.
    rigid: by rotation and translation. similarity: also by scale. Results for the fit's own photographs do not change.
    Use this option after a fit that refined cameras: it may have moved the whole object."""
    spp: int = SPP
    """Samples per pixel of the predicted photographs. More samples give less noise and take longer."""
    out: Path | None = None
    """JSON file for the numbers. Without this option: evaluation.json in the results folder."""


def main(arguments: Sequence[str]) -> None:
    """Run the command with these arguments of the command line."""
    config = command.parse(EvaluateConfig, arguments, "mi_ring.evaluate")
    for name in ("scene.xml", "mesh.ply", "ring.pt"):
        if not (config.run / name).is_file():
            raise InputError(f"{config.run}: has no {name}; give the results folder of a finished fit")
    out = config.out or config.run / "evaluation.json"
    if out.suffix.lower() != ".json":
        raise InputError(f"{out}: --out: must end in .json")
    require_place(out, "--out")
    numbers = rounded(evaluate(config.run, config.mesh, config.novel, config.spp, config.seen, config.align))
    write_file(out, json.dumps(numbers, indent=2))
    totals = {key: value for key, value in numbers.items() if not isinstance(value, list)}
    print(evaluation_table(totals), f"Every photograph: {out}", sep="\n", file=sys.stderr)
    if totals["iou"] < MISPLACED:
        print(f"{config.mesh}: hardly overlaps with the fit: is it in the frame of the scene? The true mesh of a "
              "capture of mi-ring synthesize is its truth/mesh.ply", file=sys.stderr)  # fmt: skip
    if config.novel and (ambiguity := ambiguity_of(config.run)):
        print(f"{ambiguity} Novel views in a known light may be too bright or have another colour", file=sys.stderr)
    print(json.dumps(totals))


command.make_callable(__name__, evaluate)

if __name__ == "__main__":
    command.run("mi_ring.evaluate", main)
