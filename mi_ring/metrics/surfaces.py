"""How near two surfaces are: normals, depths, silhouettes, distances, crossing triangles."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import read_mesh
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.pinhole import camera_ray
from mi_ring.rendering.plain_mesh import scene_of
from mi_ring.system.optional import need

POINTS = 100_000  #: on each of two surfaces whose distance is measured
THRESHOLDS = 0.1, 0.5  #: of the F-score [% of the diagonal]
STEP = 1e-6  #: past a triangle that was met, for a mesh of size 1: more than what float32 rounds off


def load_true_mesh(path: Path) -> tuple[trimesh.Trimesh, mi.Scene]:
    """A mesh file and the scene that holds it alone, with smooth normals. Raises InputError if it cannot be read."""
    mesh = read_mesh(path, "mesh")
    if not len(mesh.faces):
        raise InputError(f"{path}: mesh: has no triangles; give a surface")
    return mesh, scene_of(mesh.vertices, mesh.faces)


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
    back = si.is_valid() & (dr.dot(mi.Vector3f(si.n), rays.d) > 0)
    return np.array(si.is_valid()), np.array(si.t), np.array(si.sh_frame.n).T, np.array(back)


def compare_surfaces(
    capture: Capture, guess: mi.Scene, truth: mi.Scene, diagonal: float
) -> tuple[dict[str, float], list[dict]]:
    """Angles between shading normals [deg], depths [% of `diagonal`] and silhouettes, at every pixel of every view.

    Normals and depths count where both surfaces are seen; `iou` is the mean over views; `flipped` is the share of what
    is seen of `guess` whose faces point away from the camera. Returns those of all views, and of each.
    """
    angles, depths, views, backs, pixels = [], [], [], 0, 0
    for k, name in enumerate(capture.names):
        photograph = capture.photograph(k)
        (seen, t, n, back), (true_seen, true_t, true_n, _) = hits(guess, photograph), hits(truth, photograph)
        both = seen & true_seen
        angles.append(np.degrees(np.arccos(np.clip((n[both] * true_n[both]).sum(1), -1, 1))))
        depths.append(np.abs(t[both] - true_t[both]) / np.float64(diagonal) * 100)
        iou = float(both.sum() / max(1, (seen | true_seen).sum()))
        views.append({"name": name} | error_means(angles[-1], depths[-1]) | {"iou": iou})
        backs, pixels = backs + back.sum(), pixels + seen.sum()
    everything = error_means(np.concatenate(angles), np.concatenate(depths))
    if not everything:
        raise InputError(f"{capture.path}: no pixel sees both the fit and the true mesh; are they in the same frame?")
    iou = float(np.mean([view["iou"] for view in views]))
    return everything | {"iou": iou, "flipped": float(backs / pixels)}, views


def error_means(angle: np.ndarray, depth: np.ndarray) -> dict[str, float]:
    """Means and medians of errors (P,), none if there are no pixels."""
    return {
        "normal_mean": float(angle.mean()), "normal_median": float(np.median(angle)),
        "depth_mean": float(depth.mean()), "depth_median": float(np.median(depth)),
    } if len(angle) else {}  # fmt: skip


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

    points, _ = trimesh.sample.sample_surface(start, POINTS, seed=0)
    mesh = np.asarray(end.vertices - middle), np.asarray(end.faces, np.int32)
    squared = need("gpytoolbox", "the distance of surfaces").squared_distance(points - middle, *mesh, use_cpp=True)[0]
    return np.sqrt(squared)


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
        ray.maxt = mi.Float((length - reached)[lanes].astype(np.float32))  # type: ignore[assignment]  # wrong stub
        hit = scene.ray_intersect_preliminary(ray)
        valid, t, triangle = (np.array(a) for a in (hit.is_valid(), hit.t, hit.prim_index))
        lanes, t, triangle = lanes[valid], t[valid], triangle[valid]
        apart = (mesh.faces[triangle][:, :, None] != edges[lanes][:, None]).all((1, 2))
        crossing[triangle[apart]] = pierces[lanes[apart]] = True
        reached[lanes] += t + STEP
        lanes = lanes[reached[lanes] < length[lanes]]
    return int((crossing | pierces[edge_of].reshape(-1, 3).any(1)).sum())
