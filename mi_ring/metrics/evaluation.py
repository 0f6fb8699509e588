"""Compares a fit with the ground truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.capture.loading import load_capture
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import genus
from mi_ring.metrics.embedding import inside_out
from mi_ring.metrics.image_errors import SPP, compare_photographs
from mi_ring.metrics.surfaces import THRESHOLDS, alignment, compare_shapes, compare_surfaces, load_true_mesh
from mi_ring.objects.ring_file import load_fit
from mi_ring.scene.plain_mesh import scene_of
from mi_ring.scene.self_intersections import crossing_triangles
from mi_ring.system.files import read_json

COMPARED = 1024  #: width at which photographs are compared, if they are larger [px]
LINES = {  # text of each line of the table, by the prefix of the names of its numbers
    "normal": "normals, error °", "depth": "depth, error % of the diagonal", "iou": "silhouettes, IoU",
    "flipped": "seen from the back, share", "unseen": "shown by no photograph, share",
    "aligned": "truth moved by °, % of the diagonal, factor",
    "chamfer": "Chamfer distance, % of the diagonal",
    **{f"f_score_{t}": f"F-score at {t}% of the diagonal" for t in THRESHOLDS}, "genus": "genus",
    "self_intersections": "triangles that cross others", "inside_out": "triangles turned inside out",
    "psnr": "PSNR, dB", "ssim": "SSIM",
}  # fmt: skip


def evaluate(
    run: str | Path, mesh: str | Path, novel: str | Path | None = None, spp: int = SPP, seen: bool = False,
    align: str | None = None,
) -> dict:  # fmt: skip
    """Compare a fit with the truth. Renders photographs. Returns a dict from names to numbers. Writes no file.

    `run`: results folder of the fit. `mesh`: file of the true surface. `novel`: scene file of photographs that the fit
    has not used. `spp`: samples per pixel of predicted photographs. `seen`: True measures distances between surfaces
    only where a photograph shows them. `align`: "rigid" or "similarity" first align the truth and `novel` with the fit;
    the numbers `aligned_…` describe this motion. None: no alignment.

    Numbers that end in `_input` are about fitted photographs, those in `_held_out` about held-out photographs, those in
    `_novel` about `novel`. Those in `_room_input` and `_room_held_out` are about photographs without a light of their
    own, if others have one. Two entries are no numbers: `views` and `novel_views` are lists of dicts, one dict for each
    photograph. A number that is not defined, such as the genus of an open mesh, is missing.
    """
    if spp < 1:
        raise InputError(f"--spp: is {spp}, must be at least 1")
    if align not in (None, "rigid", "similarity"):
        raise InputError(f"--align: is {align}, must be rigid or similarity")
    run, mesh = Path(run), Path(mesh)
    ring, capture = load_fit(run), load_capture(run / "scene.xml", width=COMPARED, crop=False)
    unseen = novel and load_capture(novel, width=COMPARED, crop=False)
    truth_mesh, truth = load_true_mesh(mesh)
    guess_mesh, guess = load_true_mesh(run / "mesh.ply")
    diagonal, motion = truth_mesh.scale, {}
    if align:
        matrix = alignment(truth_mesh, guess_mesh, align == "similarity")
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation, before = matrix[:3, :3] / scale, truth_mesh.bounds.mean(0)
        angle = Rotation.from_matrix(rotation).magnitude()
        shift = np.linalg.norm(matrix[:3, :3] @ before + matrix[:3, 3] - before)
        motion = {"aligned_turn": float(np.degrees(angle)), "aligned_shift": float(100 * shift / diagonal),
                 "aligned_scale": scale}  # fmt: skip
        truth_mesh.apply_transform(matrix)
        truth, diagonal = scene_of(truth_mesh.vertices, truth_mesh.faces), diagonal * scale
        unseen = unseen and unseen.moved(scale, rotation, matrix[:3, 3])
    numbers, views = compare_surfaces(capture, guess, truth, diagonal)
    numbers |= motion | compare_shapes(guess_mesh, truth_mesh, capture.views if seen else None, diagonal)
    for key, surface in (("genus", guess_mesh), ("genus_true", truth_mesh)):
        if surface.is_watertight:
            numbers[key] = genus(surface)
    numbers["self_intersections"] = int(crossing_triangles(guess_mesh.vertices, guess_mesh.faces).sum())
    numbers["inside_out"] = int(inside_out(ring, *ring.domain.sample(ring.subdivisions)).sum())
    record = read_json(run / "calibration.json")
    names = record["held_out"]["photographs"] if isinstance(record, dict) and "held_out" in record else []
    held_out = np.isin(capture.names, names)
    dark = ~capture.photographs.lit & capture.photographs.mixed
    kinds = {"input": ~held_out & ~dark, "held_out": held_out & ~dark, "room_input": ~held_out & dark,
             "room_held_out": held_out & dark}  # fmt: skip
    for kind, chosen in kinds.items():
        if index := np.flatnonzero(chosen).tolist():
            predicted, photographs = compare_photographs(capture, ring, spp, index)
            numbers |= {f"{key}_{kind}": value for key, value in predicted.items()}
            for k, photograph in zip(index, photographs):
                views[k] |= photograph
    lists = {"views": views}
    if unseen:
        predicted, lists["novel_views"] = compare_photographs(unseen, ring, spp)
        numbers |= {f"{key}_novel": value for key, value in predicted.items()}
    return numbers | lists


def evaluation_table(numbers: dict[str, float]) -> str:
    """Format the numbers that describe a whole fit as a text table. `numbers`: a dict from names to numbers."""
    lines = []
    for start, words in LINES.items():
        found = {key.removeprefix(start).strip("_"): value for key, value in numbers.items() if key.startswith(start)}
        if found:
            lines.append(f"{words:36}" + "".join(f"{value:>10}  {what:6}" for what, value in found.items()).rstrip())
    if any(key.startswith("aligned") for key in numbers):
        lines.append("All numbers, except those of the input photographs, are after this alignment.")
    return "\n".join(lines)


def rounded(value: Any) -> Any:
    """Return a JSON value in which all floats are rounded to four decimals."""
    return json.loads(json.dumps(value), parse_float=lambda digits: round(float(digits), 4))
