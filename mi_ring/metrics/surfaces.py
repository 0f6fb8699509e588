"""Compares two surfaces: normals, depths and silhouettes in photographs, and distances in space. Also aligns them."""

import sys
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import read_mesh
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.plain_mesh import scene_of
from mi_ring.scene.visibility import MaskedCamera, Visibility
from mi_ring.system.optional import LazyPackage

gpytoolbox = LazyPackage("gpytoolbox", "the distance of surfaces")

POINTS = 100_000  #: on each of two surfaces, to measure their distance
ALIGNED, ALIGNMENTS = 20_000, 20  #: number of points and of steps of the alignment of two surfaces
THRESHOLDS = 0.1, 0.5  #: of the F-score [% of the diagonal]


def load_true_mesh(path: Path) -> tuple[trimesh.Trimesh, mi.Scene]:
    """Read a mesh file. Returns (mesh, Mitsuba scene with only this mesh, with smooth normals).

    A mesh that is inside out is inverted, with a message on standard error. Raises InputError if the file cannot be
    read or has no triangles.
    """
    mesh = read_mesh(path, "mesh")
    if not len(mesh.faces):
        raise InputError(f"{path}: mesh: has no triangles; give a surface")
    outward = np.einsum("ij,ij->i", mesh.triangles_center - mesh.bounds.mean(0), mesh.face_normals) * mesh.area_faces
    if outward.sum() < -0.5 * np.abs(outward).sum():
        print(f"{path}: is inside out, its faces look inwards; they are turned", file=sys.stderr)
        mesh.invert()
    return mesh, scene_of(mesh.vertices, mesh.faces)


def alignment(mesh: trimesh.Trimesh, onto: trimesh.Trimesh, similarity: bool) -> np.ndarray:
    """Estimate the transform (4, 4) that aligns `mesh` with the mesh `onto`, which must be near. Moves neither mesh.

    `similarity`: True allows a scale; False: the transform is rigid. The method is point-to-plane ICP (Chen and
    Medioni, 1992). Far points have small weights, because parts of `onto` may be missing.
    """
    middle, unit = onto.bounds.mean(0), onto.scale
    normalise = trimesh.transformations.scale_and_translate(1 / unit, -middle / unit)
    end = np.asarray((onto.vertices - middle) / unit), np.asarray(onto.faces, np.int32)
    start = trimesh.transform_points(trimesh.sample.sample_surface(mesh, ALIGNED, seed=0)[0], normalise)
    total = np.eye(4)
    for _ in range(ALIGNMENTS):
        points = trimesh.transform_points(start, total)
        squared, nearest, _ = gpytoolbox.squared_distance(points, *end, use_cpp=True)
        normals = onto.face_normals[nearest]
        gaps = np.einsum("ij,ij->i", end[0][end[1][nearest, 0]] - points, normals)
        weights = 1 / (np.sqrt(squared) + np.sqrt(np.median(squared)) + 1e-9)
        columns = [np.cross(points, normals), normals, np.einsum("ij,ij->i", points, normals)[:, None]]
        design = np.concatenate(columns if similarity else columns[:2], 1)
        step = np.linalg.lstsq(design * weights[:, None], gaps * weights)[0]
        move = np.eye(4)
        move[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() * (np.exp(step[6]) if similarity else 1)
        move[:3, 3] = step[3:6]
        total = move @ total
    return np.linalg.inv(normalise) @ total @ normalise


def hits(scene: mi.Scene, photograph: Photographs) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Trace a ray through the centre of each of the P pixels of a photograph.

    `photograph`: its camera, as the renderer takes it. Returns (whether the ray hits a surface (P,) bool, distance
    (P,), shading normal (P, 3), whether it hits the back of a face (P,) bool).
    """
    # As `center_rays`, but times 1 / focal, as Dr.Jit computes it for constant cameras. Rays that differ in the last
    # bit change the fourth digit of mean errors, where pixels just graze the surface.
    camera = photograph.camera(mi.UInt32(0))
    width, height = photograph.size
    pixel = dr.arange(mi.UInt32, width * height)
    where = (mi.Point2f(pixel % width, pixel // width) + 0.5 - camera.centre) * mi.Point2f(1 / np.array(camera.focal))
    rays = mi.Ray3f(*camera._replace(focal=mi.Point2f(1), centre=mi.Point2f(0)).ray(where))
    si = scene.ray_intersect(rays)
    back = si.is_valid() & (dr.dot(mi.Vector3f(si.n), rays.d) > 0)
    return np.array(si.is_valid()), np.array(si.t), np.array(si.sh_frame.n).T, np.array(back)


def compare_surfaces(
    capture: Capture, guess: mi.Scene, truth: mi.Scene, diagonal: float
) -> tuple[dict[str, float], list[dict]]:
    """Compare two surfaces, `guess` and `truth`, in all photographs.

    Returns (errors of all photographs together, list with errors of each), as dicts. They have mean and median of the
    errors of normals [deg] and of depths [% of `diagonal`], at pixels that see both surfaces, and `iou`, the
    intersection over union of the silhouettes. For all together, `flipped` is the share of the pixels of `guess` that
    see the back of a face. `diagonal`: of the true bounding box [scene units]. Raises InputError if no pixel sees both
    surfaces.
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
    """Compute mean and median of the errors of normals, `angle` (P,) [deg], and of depths, `depth` (P,).

    Returns a dict with `normal_mean`, `normal_median`, `depth_mean` and `depth_median`; {} if P is 0.
    """
    return {
        "normal_mean": float(angle.mean()), "normal_median": float(np.median(angle)),
        "depth_mean": float(depth.mean()), "depth_median": float(np.median(depth)),
    } if len(angle) else {}  # fmt: skip


def compare_shapes(
    guess: trimesh.Trimesh, truth: trimesh.Trimesh, views: Sequence[MaskedCamera] | None = None,
    diagonal: float | None = None,
) -> dict[str, float]:  # fmt: skip
    """Compare two surfaces in space. Returns a dict from names to numbers.

    The numbers use the exact distances of 100,000 random points of each surface to the other surface. `chamfer`: mean
    of the two mean distances [% of `diagonal`]. `f_score_t`: harmonic mean of precision and recall (Knapitsch et al.,
    Tanks and Temples, ACM TOG 2017). Precision is the share of the points of `guess` whose distance is at most t % of
    the diagonal; recall is the same for `truth`. `diagonal`: None: that of the bounding box of `truth`. `views`: if
    given, only points that a camera sees count; `unseen` and `unseen_true` are the shares of the others, on `guess` and
    on `truth`.
    """
    diagonal, middle = diagonal or truth.scale, truth.bounds.mean(0)
    there, back = (100 / diagonal * distances(a, b, middle, views) for a, b in ((guess, truth), (truth, guess)))
    numbers = {"chamfer": float(there.mean() + back.mean()) / 2}
    if views is not None:
        numbers |= {"unseen": 1 - len(there) / POINTS, "unseen_true": 1 - len(back) / POINTS}
    for threshold in THRESHOLDS:
        precision, recall = ((d <= threshold).mean() for d in (there, back))
        numbers[f"f_score_{threshold}"] = float(2 * precision * recall / max(precision + recall, 1e-12))
    return numbers


def distances(
    start: trimesh.Trimesh, end: trimesh.Trimesh, middle: np.ndarray, views: Sequence[MaskedCamera] | None = None
) -> np.ndarray:
    """Compute the distances (n,) of random points on `start` to the surface `end`, in their unit of length.

    `middle` (3,): a point near both surfaces, for numerical precision. `views`: cameras; only points that one of them
    sees are used; None: all. Raises InputError if no camera sees a point.
    """
    points, faces = trimesh.sample.sample_surface(start, POINTS, seed=0)
    if views is not None:
        points = points[Visibility(start.vertices, start.faces, views).of_points(points, start.face_normals[faces])]
        if not len(points):
            raise InputError("--seen: no photograph shows anything of the fit or of the true mesh; are they in the "
                             "same frame, and do the faces of both point outwards?")  # fmt: skip
    mesh = np.asarray(end.vertices - middle), np.asarray(end.faces, np.int32)  # near 0, for precision
    return np.sqrt(gpytoolbox.squared_distance(points - middle, *mesh, use_cpp=True)[0])
