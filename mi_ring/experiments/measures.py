"""Measures of finished fits: functions that return rows of an experiment's table."""

import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from mi_ring.capture.capture import Capture
from mi_ring.capture.loading import load_capture
from mi_ring.experiments.brdf_slices import brdf_slices, bsdf_of, is_second_material
from mi_ring.experiments.datasets import PerturbedCameras, Synthetic
from mi_ring.experiments.experiment import ExperimentOptions, Row, Run
from mi_ring.experiments.single_view import TO_MITSUBA, SingleView
from mi_ring.metrics.embedding import exactly_crossing, inside_out
from mi_ring.metrics.evaluation import evaluate
from mi_ring.metrics.surfaces import compare_surfaces, hits, load_true_mesh
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.objects.ring_file import load_fit
from mi_ring.output.results import read_log
from mi_ring.scene.plain_mesh import scene_of
from mi_ring.scene.self_intersections import crossing_triangles
from mi_ring.synthesis.materials import load_material
from mi_ring.system.optional import installed

COURSE = "course.json"  #: of a watched fit: the rows of `course`
POINTS = 8  #: number of these rows
LEVELS = 3, 4, 5, 6, 7  #: subdivisions at which `by_level` samples a fit
BLACK = 1e-3  #: least BRDF [1/sr] that errors are relative to
SLICE_LEVEL = 3  #: subdivisions: at these vertices materials are compared


def evaluated(
    run: Run, folder: Path, options: ExperimentOptions, align: str | None = None, seen: bool = False
) -> list[Row]:
    """Compare a fit with the truth.

    Returns a list of one row: the numbers of `mi-ring evaluate`, and the fit's time [s]. `folder`: the results folder.
    Crossing and inverted triangles are in % of all triangles. `align`: "rigid" or "similarity" first aligns the truth
    with the fit; None: no alignment. `seen`: True compares only parts of the surfaces that a photograph shows.
    """
    truth, novel = run.dataset.truth / "mesh.ply", run.dataset.truth / "scene.xml"
    numbers = evaluate(folder, truth, novel if novel.is_file() else None, options.spp, seen, align)
    row = {key: value for key, value in numbers.items() if not isinstance(value, list)}
    mesh, _ = load_true_mesh(folder / "mesh.ply")
    row["crossing"] = crossing(mesh.vertices, mesh.faces)
    row["inside_out"] = 100 * row["inside_out"] / len(mesh.faces)
    row["seconds"] = read_log(folder)[-1]["seconds"]
    return [row]


def crossing(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the share of triangles (F, 3) that cross another triangle [%]. It is exact if libigl is installed."""
    count = exactly_crossing if installed("igl") else crossing_triangles
    return 100 * float(np.mean(count(vertices, faces)))


def surface_errors(
    run: Run, capture: Capture, ring: FittedObject, s: Tensor, faces: np.ndarray
) -> tuple[np.ndarray, Row]:
    """Compare an object's surface with the true mesh of a run. Returns (vertices (V, 3), row with errors).

    `capture`: the cameras. `s` (V, 3): points of the domain. `faces` (F, 3): triangles of these points. Errors of
    normals are in degrees, errors of depth in % of the diagonal of the true bounding box.
    """
    mesh, truth = load_true_mesh(run.dataset.truth / "mesh.ply")
    with torch.no_grad():
        vertices = ring.surface(s.to(ring.center.device)).cpu().numpy()
    return vertices, compare_surfaces(capture, scene_of(vertices, faces), truth, mesh.scale)[0]


def in_millimetres(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Compare a fit with the truth where photographs show the surface. Returns a list of one row.

    It has the numbers of `mi-ring evaluate`; depth and Chamfer distance are also given in mm. `folder`: the results
    folder.
    """
    percent = load_true_mesh(run.dataset.truth / "mesh.ply")[0].scale / 100
    (row,) = evaluated(run, folder, options, seen=True)
    return [row | {"depth_mm": row["depth_mean"] * percent, "chamfer_mm": row["chamfer"] * percent}]


def aligned(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Align the truth rigidly with a fit, and compare them. Returns a list of one row.

    It has the numbers of `mi-ring evaluate`, and `turned`: root mean square of the cameras' rotation errors [°].
    `folder`: the results folder.
    """
    (row,) = evaluated(run, folder, options, align="rigid")
    exact = run.dataset.source if isinstance(run.dataset, PerturbedCameras) else run.dataset
    return [row | {"turned": rotation_error(exact.scene, folder / "scene.xml")}]


def rotation_error(a: Path, b: Path) -> float:
    """Return the root mean square angle [°] between corresponding cameras of two scene files.

    A rotation that all cameras share is removed first.
    """
    first, second = ([s.camera.to_world[:3, :3] for s in load_capture(x, images=False).shots] for x in (a, b))
    between = Rotation.from_matrix([x @ y.T for x, y in zip(first, second, strict=True)])
    return float(np.degrees(np.sqrt(np.mean((between * between.mean().inv()).magnitude() ** 2))))


def by_level(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Compare meshes of one fit with the truth at levels 3 to 7. Returns one row for each level.

    `folder`: the results folder.
    """
    ring, capture = load_fit(folder), load_capture(run.dataset.scene, images=False)
    rows = []
    for level in LEVELS:
        s, faces = ring.domain.sample(level)
        vertices, numbers = surface_errors(run, capture, ring, s, faces)
        flaws = {"inside_out": 100 * float(inside_out(ring, s, faces).mean()), "crossing": crossing(vertices, faces)}
        rows.append({"level": level, "vertices": len(vertices), **numbers, **flaws})
    return rows


def course(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Return the rows that were measured during the fit and written to course.json in `folder`, the results folder."""
    return json.loads((folder / COURSE).read_text())


def single_view_normals(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Measure the errors of the normals that the one camera of a dataset sees. Returns a list of one row.

    The row has their mean and median [°], the share of pixels at which the camera misses the fitted surface [%], and
    the fit's time [s]. At these pixels the error is 90°. `folder`: the results folder.
    """
    angles, missed = normal_errors(run, folder)
    known = np.isfinite(angles)
    return [{
        "normal_mean": float(angles[known].mean()), "normal_median": float(np.median(angles[known])),
        "missed": 100 * float(missed[known].mean()), "seconds": read_log(folder)[-1]["seconds"],
    }]  # fmt: skip


def normal_errors(run: Run, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays (H, W) for the one camera of a run: errors of normals [°]; True where it misses the surface.

    The error is NaN where the true normal is unknown, and 90° where the surface is missed. `folder`: the results
    folder.
    """
    assert isinstance(run.dataset, SingleView)
    data = run.dataset.read()
    shape = data["mask"].shape
    _, surface = load_true_mesh(folder / "mesh.ply")
    seen, _, normals, _ = hits(surface, load_capture(run.dataset.scene, images=False).photograph(0))
    cosine = (normals * TO_MITSUBA * data["normal_gt"].reshape(-1, 3)).sum(1)
    angles = np.where(seen, np.degrees(np.arccos(np.clip(cosine, -1, 1))), 90.0).reshape(shape)
    known = (data["mask"] > 0) & data["normal_gt"].any(-1)
    return np.where(known, angles, np.nan), ~seen.reshape(shape)


def with_slices(run: Run, folder: Path, options: ExperimentOptions) -> list[Row]:
    """Compare a fit and its BRDF with the truth. Returns a list of one row.

    It has the numbers of `mi-ring evaluate`, and errors of BRDF values for light and camera in one direction. If the
    object has one material, slices.npz is written to `folder`, the results folder, for the figure.
    """
    (row,) = evaluated(run, folder, options)
    found, truth, other = slices_of(run, folder)
    if other is None:
        np.savez(folder / "slices.npz", found=np.median(found, 0), truth=np.median(truth, 0))
    return [row | compare_slices(found, truth, other)]


def compare_slices(found: np.ndarray, truth: np.ndarray, other: np.ndarray | None) -> Row:
    """Return a row with the errors of fitted BRDF values, `found`, at V points of the surface.

    All arrays: (V, angles, 3). `slice_error`: abs(found − truth) / max(truth, `BLACK`), mean over angles and channels,
    median over points [%]. `other`: values of the material that a point does not have, or None. `right_material`: share
    of points [%] whose `found` is nearer to `truth` than to `other`, by distances between logarithms.
    """
    error = (np.abs(found - truth) / np.maximum(truth, BLACK)).mean((1, 2))
    row = {"slice_error": 100 * float(np.median(error))}
    if other is not None:
        logs = [np.log(np.maximum(f, 1e-6)) for f in (found, truth, other)]
        near, far = (np.square(logs[0] - log).sum((1, 2)) for log in logs[1:])
        row["right_material"] = 100 * float((near < far).mean())
    return row


def slices_of(run: Run, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return BRDF values at V points of the surface, for light and camera in one direction: (fitted, true, wrong).

    Each is an array (V, angles, 3) [1/sr]. Wrong values are those of the material that a point does not have; None if
    the object has one material. `folder`: the results folder.
    """
    assert isinstance(run.dataset, Synthetic)
    config = run.dataset.config
    ring = load_fit(folder)
    s, _ = ring.domain.sample(SLICE_LEVEL)
    with torch.no_grad():
        vertices, material = ring(s)
    mesh, _ = load_true_mesh(run.dataset.truth / "mesh.ply")
    found = brdf_slices(bsdf_of({name: value.numpy() for name, value in material.items()}), len(s))
    true = [brdf_slices(load_material(str(m), "--materials", False), 1) for m in (config.material, config.second) if m]
    if len(true) == 1:
        return found, true[0], None
    second = is_second_material(config, mesh.bounds, vertices.numpy())[:, None, None]
    return found, np.where(second, true[1], true[0]), np.where(second, true[0], true[1])
