"""What is measured of the fits of experiments."""

import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mi_ring.capture.loading import load_capture
from mi_ring.experiments.experiment import Made, Row, Run
from mi_ring.experiments.recipes import Perturbed, Synthetic
from mi_ring.experiments.single_view import AXES, SingleView
from mi_ring.experiments.slices import bsdf_of, second_at, slices
from mi_ring.metrics.embedding import exactly_crossing, inside_out
from mi_ring.metrics.evaluation import evaluate_fit
from mi_ring.metrics.surfaces import compare_surfaces, hits, load_true_mesh
from mi_ring.objects.ring_file import load_fit
from mi_ring.output.results import read_log
from mi_ring.scene.plain_mesh import scene_of
from mi_ring.scene.self_intersections import crossing_triangles
from mi_ring.synthesis.materials import load_material
from mi_ring.system.optional import installed

COURSE = "course.json"  #: of a fit that was watched
POINTS = 8  #: of its course
LEVELS = 3, 4, 5, 6, 7  #: that a fit is sampled at
BLACK = 1e-3  #: BRDF [1/sr] below which errors count no more than there
SAMPLED = 3  #: level of the points whose material is looked at


def evaluated(run: Run, made: Made, align: str | None = None, seen: bool = False) -> list[Row]:
    """What `mi-ring evaluate` tells, and how long the fit took; `crossing`: crossing triangles, in % of all."""
    novel = made.truth / "scene.xml"
    numbers = evaluate_fit(
        made.folder, made.truth / "mesh.ply", novel if novel.is_file() else None, made.asked.spp, seen, align
    )
    row = {key: value for key, value in numbers.items() if not isinstance(value, list)}
    mesh, _ = load_true_mesh(made.folder / "mesh.ply")
    row["crossing"] = crossing(mesh.vertices, mesh.faces)
    row["inside_out"] = 100 * row["inside_out"] / len(mesh.faces)
    row["seconds"] = read_log(made.folder)[-1]["seconds"]
    return [row]


def crossing(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Triangles (F, 3) that cross others [%], counted exactly where libigl is installed."""
    count = exactly_crossing if installed("igl") else crossing_triangles
    return 100 * float(np.mean(count(vertices, faces)))


def in_millimetres(run: Run, made: Made) -> list[Row]:
    """As `evaluated`, of what is seen; depth and Chamfer distance in scene units, too, which are millimetres."""
    mesh, _ = load_true_mesh(made.truth / "mesh.ply")
    diagonal = float(np.linalg.norm(mesh.extents))
    (row,) = evaluated(run, made, seen=True)
    return [
        row | {f"{key}_mm": row[of] * diagonal / 100 for key, of in (("depth", "depth_mean"), ("chamfer", "chamfer"))}
    ]


def aligned(run: Run, made: Made) -> list[Row]:
    """As `evaluated` after rigid alignment, and the root mean square of what is left of cameras' turns [°]."""
    (row,) = evaluated(run, made, align="rigid")
    exact = run.recipe.source if isinstance(run.recipe, Perturbed) else run.recipe
    return [row | {"turned": turns(exact.place(made.captures), made.folder / "scene.xml")}]


def turns(a: Path, b: Path) -> float:
    """Root mean square of the angles [°] between the cameras of two scenes, after the turn that all have in common."""
    first, second = ([s.camera.to_world[:3, :3] for s in load_capture(x, images=False).shots] for x in (a, b))
    between = Rotation.from_matrix([x @ y.T for x, y in zip(first, second, strict=True)])
    return float(np.degrees(np.sqrt(np.mean((between * between.mean().inv()).magnitude() ** 2))))


def by_level(run: Run, made: Made) -> list[Row]:
    """Of one fit as sampled at several levels."""
    ring, capture = load_fit(made.folder), load_capture(made.scene, images=False)
    mesh, truth = load_true_mesh(made.truth / "mesh.ply")
    rows = []
    for level in LEVELS:
        s, faces = ring.domain.sample(level)
        with torch.no_grad():
            vertices = ring.surface(s).numpy()
        numbers, _ = compare_surfaces(capture, scene_of(vertices, faces), truth, float(np.linalg.norm(mesh.extents)))
        turned = 100 * float(inside_out(ring, s, faces).mean())
        flaws = {"inside_out": turned, "crossing": crossing(vertices, faces)}
        rows.append({"level": level, "vertices": len(vertices), **numbers, **flaws})
    return rows


def course(run: Run, made: Made) -> list[Row]:
    """Of a fit that was watched: errors in the course of time."""
    return json.loads((made.folder / COURSE).read_text())


def normals_from_one_side(run: Run, made: Made) -> list[Row]:
    """Errors of the normals that the only camera of DiLiGenT's photographs sees; 90° where it misses the surface."""
    angles, missed = errors_from_one_side(run, made)
    known = np.isfinite(angles)
    return [{
        "normal_mean": float(angles[known].mean()), "normal_median": float(np.median(angles[known])),
        "missed": 100 * float(missed[known].mean()), "seconds": read_log(made.folder)[-1]["seconds"],
    }]  # fmt: skip


def errors_from_one_side(run: Run, made: Made) -> tuple[np.ndarray, np.ndarray]:
    """The same of each pixel (H, W) [deg], NaN where no normal was measured, and whether the surface is missed there.

    Along the cat's outline none was measured.
    """
    assert isinstance(run.recipe, SingleView)
    data = run.recipe.read()
    shape = data["mask"].shape
    _, surface = load_true_mesh(made.folder / "mesh.ply")
    seen, _, normals, _ = hits(surface, load_capture(made.scene, images=False).photograph(0))
    cosine = (normals * AXES * data["normal_gt"].reshape(-1, 3)).sum(1)
    angles = np.where(seen, np.degrees(np.arccos(np.clip(cosine, -1, 1))), 90.0).reshape(shape)
    known = (data["mask"] > 0) & data["normal_gt"].any(-1)
    return np.where(known, angles, np.nan), ~seen.reshape(shape)


def with_slices(run: Run, made: Made) -> list[Row]:
    """As `evaluated`, and how near the material is: `slice_error`, `right_material` as `compare_slices` has them.

    The slices themselves of one material are written beside the fit, for the figure: slices.npz.
    """
    (row,) = evaluated(run, made)
    found, truth, other = slices_of(run, made)
    if other is None:
        np.savez(made.folder / "slices.npz", found=np.median(found, 0), truth=np.median(truth, 0))
    return [row | compare_slices(found, truth, other)]


def compare_slices(found: np.ndarray, truth: np.ndarray, other: np.ndarray | None) -> Row:
    """Of slices (V, angles, 3) at as many points of the surface.

    `slice_error`: absolute value of found − true, by the true one or `BLACK` if that is more, mean over angles and
    channels, median over the points [%].
    `right_material`: share of points [%] whose slice, as logarithms, is nearer to the true one than to that of the
    `other` material.
    """
    error = (np.abs(found - truth) / np.maximum(truth, BLACK)).mean((1, 2))
    row = {"slice_error": 100 * float(np.median(error))}
    if other is not None:
        logs = [np.log(np.maximum(f, 1e-6)) for f in (found, truth, other)]
        near, far = (np.square(logs[0] - log).sum((1, 2)) for log in logs[1:])
        row["right_material"] = 100 * float((near < far).mean())
    return row


def slices_of(run: Run, made: Made) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """BRDFs (V, angles, 3) [1/sr] by θh, light and camera at one place, at points of the surface.

    That of the fit, the true one, and that of the other material where there are two.
    """
    assert isinstance(run.recipe, Synthetic)
    config = run.recipe.complete(made.captures)
    ring = load_fit(made.folder)
    s, _ = ring.domain.sample(SAMPLED)
    with torch.no_grad():
        vertices, material = ring(s)
    mesh, _ = load_true_mesh(made.truth / "mesh.ply")
    found = slices(bsdf_of({name: value.numpy() for name, value in material.items()}), len(s))
    true = [slices(load_material(str(m), "--materials", False), 1) for m in (config.material, config.second) if m]
    if len(true) == 1:
        return found, true[0], None
    second = second_at(config, mesh.bounds, vertices.numpy())[:, None, None]
    return found, np.where(second, true[1], true[0]), np.where(second, true[0], true[1])
