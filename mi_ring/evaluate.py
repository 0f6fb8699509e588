"""Compare a fit with the truth: `python -m mi_ring.evaluate RUN --mesh TRUTH.ply`."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from skimage.metrics import structural_similarity
from tyro.conf import Positional, arg

from mi_ring import bridge, capture, command
from mi_ring.capture import linear_to_srgb, to_bytes
from mi_ring.domain import read_mesh
from mi_ring.errors import InputError
from mi_ring.hull import genus
from mi_ring.integrator import Photographs
from mi_ring.mesh import mesh_of
from mi_ring.photograph import camera_ray
from mi_ring.render import RenderConfig
from mi_ring.results import replace, require_place
from mi_ring.ring import Ring

POINTS = 100_000  #: on each of two surfaces whose distance is measured
THRESHOLDS = 0.1, 0.5  #: of the F-score [% of the diagonal]
STEP = 1e-6  #: past a triangle that was met, for a mesh of size 1: more than what float32 rounds off
WINDOW = 11  #: of SSIM [px]

LINES = {  # of the table
    "normal": "normals, error °", "depth": "depth, error % of the diagonal", "iou": "silhouettes, IoU",
    "flipped": "seen from the back, share", "chamfer": "Chamfer distance, % of the diagonal",
    **{f"f_score_{t}": f"F-score at {t} % of the diagonal" for t in THRESHOLDS}, "genus": "genus",
    "self_intersections": "triangles that cross others", "psnr": "PSNR, dB", "ssim": "SSIM",
}  # fmt: skip


@dataclass(frozen=True)
class EvaluateConfig:
    """Compare a finished fit with the truth: a table on standard error, one line of JSON on standard output.

    In it: errors of normals [deg] and depths [% of the diagonal of the true bounding box] where both surfaces are seen;
    overlap of silhouettes; share of what is seen whose faces point away from the camera; Chamfer distance [% of the
    diagonal] and F-score of whole surfaces, unseen parts included; genus; triangles that cross another; PSNR [dB] and
    SSIM of the photographs that mi_ring.render predicts. A file has the same for every photograph.
    """

    run: Positional[Annotated[Path, arg(metavar="RUN")]]
    """Results folder of a fit."""
    mesh: Path
    """True surface in the units and frame of the scene: PLY, OBJ or GLB."""
    novel: Path | None = None
    """Scene of photographs that the fit has not seen."""
    spp: int = RenderConfig.spp
    """Samples per pixel of the predicted photographs."""
    out: Path | None = None
    """JSON file to write. Default: evaluation.json in the results folder."""


def load_mesh(path: Path) -> tuple[trimesh.Trimesh, mi.Scene]:
    """A mesh file and the scene that holds it alone, with smooth normals. Raises InputError if it cannot be read."""
    mesh = read_mesh(path, "mesh")
    if not len(mesh.faces):
        raise InputError(f"{path}: mesh: has no triangles; give a surface")
    return mesh, scene_of(mesh.vertices, mesh.faces)


def scene_of(vertices, faces) -> mi.Scene:
    """A scene that holds this mesh alone, with smooth normals."""
    return mi.load_dict({"type": "scene", "mesh": mesh_of(vertices, faces)})


def hits(scene: mi.Scene, photograph: Photographs) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where pixel centres see the surface (P,), at what distance (P,) [scene units], with what normal (P, 3).

    And where they see the back of a face (P,). One photograph.
    """
    # As `center_rays`, but not divided by the focal length: so Dr.Jit rounds where cameras are constants in the code.
    # Rays that differ in the last bit show in the fourth digit of the means, by pixels that just graze the surface.
    to_world, focal, centre = photograph.camera(mi.UInt32(0))
    width, height = photograph.size
    pixel = dr.arange(mi.UInt32, width * height)
    where = (mi.Point2f(pixel % width, pixel // width) + 0.5 - centre) * mi.Point2f(1 / np.array(focal))
    rays = mi.Ray3f(*camera_ray(to_world, mi.Point2f(1), mi.Point2f(0), where))
    si = scene.ray_intersect(rays)
    back = si.is_valid() & (dr.dot(si.n, rays.d) > 0)
    return np.array(si.is_valid()), np.array(si.t), np.array(si.sh_frame.n).T, np.array(back)


def compare_surfaces(
    scene: capture.Capture, guess: mi.Scene, truth: mi.Scene, diagonal: float
) -> tuple[dict[str, float], list[dict]]:
    """Angles between shading normals [deg], depths [% of `diagonal`] and silhouettes, at every pixel of every view.

    Normals and depths count where both surfaces are seen; `iou` is the mean over views; `flipped` is the share of what
    is seen of `guess` whose faces point away from the camera. Returns those of all views, and of each.
    """
    angles, depths, views, backs, pixels = [], [], [], 0, 0
    for k, name in enumerate(scene.names):
        photograph = scene.photograph(k)
        (seen, t, n, back), (true_seen, true_t, true_n, _) = hits(guess, photograph), hits(truth, photograph)
        both = seen & true_seen
        angles.append(np.degrees(np.arccos(np.clip((n[both] * true_n[both]).sum(1), -1, 1))))
        depths.append(np.abs(t[both] - true_t[both]) / np.float64(diagonal) * 100)
        iou = float(both.sum() / max(1, (seen | true_seen).sum()))
        views.append({"name": name} | errors(angles[-1], depths[-1]) | {"iou": iou})
        backs, pixels = backs + back.sum(), pixels + seen.sum()
    everything = errors(np.concatenate(angles), np.concatenate(depths))
    if not everything:
        raise InputError(f"{scene.path}: no pixel sees both the fit and the true mesh; are they in the same frame?")
    iou = float(np.mean([view["iou"] for view in views]))
    return everything | {"iou": iou, "flipped": float(backs / pixels)}, views


def errors(angle: np.ndarray, depth: np.ndarray) -> dict[str, float]:
    """Means and medians of errors (P,), none if there are no pixels."""
    return {
        "normal_mean": float(angle.mean()), "normal_median": float(np.median(angle)),
        "depth_mean": float(depth.mean()), "depth_median": float(np.median(depth)),
    } if len(angle) else {}  # fmt: skip


def compare_photographs(scene: capture.Capture, ring: Ring, spp: int) -> tuple[dict[str, float], list[dict]]:
    """`psnr` [dB] and `ssim` of predictions as 8-bit sRGB against the files, sRGB in [0, 1].

    Of all photographs, from the mean of their squared errors and as the mean of their SSIM, and of each. What is
    predicted is what `mi_ring.render` writes by default. Where it is exact there is no PSNR.
    """
    surface = bridge.Surface(scene.scene, scene.shape, ring)
    surface.show(ring, *ring.domain.sample(ring.subdivisions))
    squares, views = [], []
    for k, name in enumerate(scene.names):
        rgb, _ = bridge.draw(surface, scene.photograph(k), spp=spp, shadows=scene.shadows, indirect=ring.indirect)
        predicted = to_bytes(linear_to_srgb(rgb[0].numpy())) / 255
        observed = linear_to_srgb(scene.observe([k])[0][0].numpy())
        squares.append(np.mean((predicted - observed) ** 2))
        views.append({"name": name} | decibels(squares[-1]) | ssim(predicted, observed))
    similar = [view["ssim"] for view in views if "ssim" in view]
    return decibels(np.mean(squares)) | ({"ssim": float(np.mean(similar))} if similar else {}), views


def decibels(square: float) -> dict[str, float]:
    """PSNR of a mean squared error."""
    return {"psnr": float(-10 * np.log10(square))} if square else {}


def ssim(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Structural similarity of images (H, W, 3) in [0, 1], mean over channels, none if they are less than its window.

    Wang et al., Image Quality Assessment, IEEE TIP 2004: Gaussian window of 11 × 11 pixels, σ = 1.5 px.
    """
    if min(a.shape[:2]) < WINDOW:
        return {}
    wang = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return {"ssim": float(structural_similarity(a, b, data_range=1, channel_axis=-1, **wang))}


def compare_shapes(guess: trimesh.Trimesh, truth: trimesh.Trimesh) -> dict[str, float]:
    """Chamfer distance [% of the diagonal of the true bounding box] and F-scores of two whole surfaces.

    100,000 points of each, drawn evenly by area with a fixed seed, and their exact distances from the other surface:
    not from points of it, so that equal surfaces have distance 0. `chamfer` is the mean of the two mean distances, from
    the fit to the truth and back; `f_score_t` is the harmonic mean of precision, the share of the fit's points within t
    % of the diagonal of the truth, and recall, the share of the truth's within t of the fit (Knapitsch et al., Tanks
    and Temples, ACM TOG 2017). Parts that no camera sees count, too.
    """
    diagonal, middle = np.linalg.norm(truth.extents), truth.bounds.mean(0)
    there, back = (100 / diagonal * distances(a, b, middle) for a, b in ((guess, truth), (truth, guess)))
    numbers = {"chamfer": float(there.mean() + back.mean()) / 2}
    for threshold in THRESHOLDS:
        precision, recall = ((d <= threshold).mean() for d in (there, back))
        numbers[f"f_score_{threshold}"] = float(2 * precision * recall / max(precision + recall, 1e-12))
    return numbers


def distances(start: trimesh.Trimesh, end: trimesh.Trimesh, middle: np.ndarray) -> np.ndarray:
    """Of points of one surface from another (POINTS,). What counts is how both lie around `middle`."""
    from gpytoolbox import squared_distance  # here, for it takes a second

    points, _ = trimesh.sample.sample_surface(start, POINTS, seed=0)
    mesh = np.asarray(end.vertices - middle), np.asarray(end.faces, np.int32)
    return np.sqrt(squared_distance(points - middle, *mesh, use_cpp=True)[0])


def self_intersections(mesh: trimesh.Trimesh) -> int:
    """Number of triangles that cross another, of a mesh without seams.

    Two triangles cross where an edge of one pierces the other: all edges are traced as rays. Those that share a vertex
    with the edge are not pierced by it; triangles that overlap in one plane do not count.
    """
    vertices = np.asarray(mesh.vertices - mesh.bounds.mean(0)) / mesh.extents.max()  # for float32
    scene, crossing = scene_of(vertices, mesh.faces), np.zeros(len(mesh.faces), bool)
    # Each edge once, and the triangles that have it.
    edges, edge_of = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)
    pierces = np.zeros(len(edges), bool)
    origin, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along, reached = along / np.maximum(length, 1e-30)[:, None], np.zeros(len(edges))
    lanes = np.flatnonzero(length > 0)
    while len(lanes):
        start = origin[lanes] + along[lanes] * reached[lanes, None]
        ray = mi.Ray3f(mi.Point3f(*start.T.astype(np.float32)), mi.Vector3f(*along[lanes].T.astype(np.float32)))
        ray.maxt = mi.Float((length - reached)[lanes].astype(np.float32))
        hit = scene.ray_intersect_preliminary(ray)
        valid, t, triangle = (np.array(a) for a in (hit.is_valid(), hit.t, hit.prim_index))
        lanes, t, triangle = lanes[valid], t[valid], triangle[valid]
        apart = (mesh.faces[triangle][:, :, None] != edges[lanes][:, None]).all((1, 2))
        crossing[triangle[apart]] = pierces[lanes[apart]] = True
        reached[lanes] += t + STEP
        lanes = lanes[reached[lanes] < length[lanes]]
    return int((crossing | pierces[edge_of].reshape(-1, 3).any(1)).sum())


def evaluate(run: Path, mesh: Path, novel: Path | None = None, spp: int = RenderConfig.spp) -> dict:
    """The paper's columns and more for the results folder `run`; of each photograph under `views`, `novel_views`.

    What is not defined is left out: the genus of a surface that is not closed, for instance.
    """
    ring = Ring.load(run)
    scene = capture.load(run / "scene.xml")
    unseen = novel and capture.load(novel)
    truth_mesh, truth = load_mesh(mesh)
    guess_mesh, guess = load_mesh(run / "mesh.ply")
    numbers, views = compare_surfaces(scene, guess, truth, float(np.linalg.norm(truth_mesh.extents)))
    numbers |= compare_shapes(guess_mesh, truth_mesh)
    for key, surface in (("genus", guess_mesh), ("genus_true", truth_mesh)):
        if surface.is_watertight:
            numbers[key] = genus(surface)
    numbers["self_intersections"] = self_intersections(guess_mesh)
    predicted, photographs = compare_photographs(scene, ring, spp)
    numbers |= {f"{key}_input": value for key, value in predicted.items()}
    lists = {"views": [view | photograph for view, photograph in zip(views, photographs)]}
    if unseen:
        predicted, lists["novel_views"] = compare_photographs(unseen, ring, spp)
        numbers |= {f"{key}_novel": value for key, value in predicted.items()}
    return numbers | lists


def table(numbers: dict[str, float]) -> str:
    """The numbers of all photographs as text, those that belong together in one line."""
    lines = []
    for start, words in LINES.items():
        found = {key.removeprefix(start).strip("_"): value for key, value in numbers.items() if key.startswith(start)}
        if found:
            lines.append(f"{words:36}" + "".join(f"{value:>10}  {what:6}" for what, value in found.items()).rstrip())
    return "\n".join(lines)


def rounded(value):
    """Four digits after the point, all that mean anything, of all numbers in lists and dictionaries."""
    if isinstance(value, dict):
        return {key: rounded(v) for key, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return round(value, 4) if isinstance(value, float) else value


def main(arguments: Sequence[str]) -> None:
    """The command."""
    config = command.parse(EvaluateConfig, arguments, "mi_ring.evaluate")
    if config.spp < 1:
        raise InputError(f"--spp: is {config.spp}, must be at least 1")
    for name in ("scene.xml", "mesh.ply", "ring.pt"):
        if not (config.run / name).is_file():
            raise InputError(f"{config.run}: has no {name}; give the results folder of a finished fit")
    out = config.out or config.run / "evaluation.json"
    if out.suffix.lower() != ".json":
        raise InputError(f"{out}: --out: must end in .json")
    require_place(out, "--out")
    numbers = rounded(evaluate(config.run, config.mesh, config.novel, config.spp))
    replace(out, json.dumps(numbers, indent=2))
    totals = {key: value for key, value in numbers.items() if not isinstance(value, list)}
    print(table(totals), f"Every photograph: {out}", sep="\n", file=sys.stderr)
    print(json.dumps(totals))


if __name__ == "__main__":
    command.run("mi_ring.evaluate", main)
