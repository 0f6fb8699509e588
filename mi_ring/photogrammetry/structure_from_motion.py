"""Structure from motion by COLMAP: cameras and points. A `model` is a `pycolmap.Reconstruction`."""

import contextlib
import hashlib
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mi_ring.errors import InputError
from mi_ring.geometry.camera import moved_pose
from mi_ring.images import read_image
from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.bundle_adjustment import adjust, model_cameras, registered
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.image_features import find_features, grey_file
from mi_ring.photogrammetry.marker_sheet import Detections
from mi_ring.photogrammetry.matching import MIN_MATCHES, match_again, match_features, read_matches
from mi_ring.system.machine import interruptible
from mi_ring.system.optional import LazyPackage
from mi_ring.system.progress import Progress

pycolmap = LazyPackage("pycolmap", "structure from motion")
SMALL = 1000  #: photographs with a shorter longer side [px] may have too few features
TEXTURED = 300  #: least number of features of a photograph with enough texture
EPIPOLAR = 2.5e-3  #: a pair of cameras explains a match up to this Sampson distance [width of the image]
PAIR_MATCHES, PAIR_EXPLAINED = 15, 0.7  #: least number of matches, and share explained, of a pair that connects parts
MIN_PART = 3  #: a disconnected part with fewer photographs is kept
MAX_NAMES = 30  #: of photographs in a message
MIN_POINTS = 30  #: least number of sparse points that a photograph must show
BLURRED = 0.25  #: a photograph with less detail is blurred [detail of those with a camera]


@dataclass
class SparseModel:
    """The cameras of photographs, and a sparse point cloud of the scene, in any unit of length."""

    cameras: dict[str, tuple[Lens, np.ndarray]]  #: lens and camera-to-world pose (4, 4), OpenCV's axes
    points: np.ndarray  #: (N, 3)
    error: float | None  #: mean reprojection error [px of the photographs]; None if unknown
    failed: dict[str, str]  #: photographs without a camera, and why
    source: str = ""  #: where the cameras are from; empty: structure from motion

    def digest(self) -> str:
        """Return a hash of the cameras as text, which changes if a camera changes."""
        cameras = [f"{name} {lens.model} {lens.params} {pose.round(6).tolist()}"
                   for name, (lens, pose) in sorted(self.cameras.items())]  # fmt: skip
        return hashlib.blake2b("\n".join(cameras).encode(), digest_size=8).hexdigest()

    def distance(self, point: np.ndarray) -> float:
        """Return the median distance from the cameras to a point (3,)."""
        return float(np.median([np.linalg.norm(pose[:3, 3] - point) for _, pose in self.cameras.values()]))

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "SparseModel":
        """Return a copy with cameras and points in another frame: a point x becomes scale · rotation · x + shift.

        `rotation` (3, 3), `shift` (3,).
        """
        cameras = {n: (lens, moved_pose(pose, scale, rotation, shift)) for n, (lens, pose) in self.cameras.items()}
        return replace(self, cameras=cameras, points=scale * self.points @ rotation.T + shift)


def structure_from_motion(
    pictures: Sequence[Picture], detections: Detections, folder: Path, progress: Progress
) -> SparseModel:
    """Find the cameras of photographs by COLMAP from image features. All photographs of one size share a lens.

    `detections`: corners of the printed sheet by the photograph's name, which improve the result; empty: none. The
    result is saved in `folder`. If it is there already, it is only read. Raises InputError if fewer than half of the
    photographs get a camera.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    sparse = folder / "sparse"
    require_sound(folder / "database.db")  # also for the reasons of failures
    if sparse.is_dir():
        return to_sparse_model(read_model(sparse), pictures, folder)
    (folder / "grey").mkdir(parents=True, exist_ok=True)
    find_features(pictures, folder, progress)
    match_features(pictures, folder, progress)
    model = reconstruct(folder, len(pictures), progress)
    placed = placed_files(model)
    if (missing := {grey_file(picture) for picture in pictures} - placed) and match_again(missing, folder, progress):
        other = reconstruct(folder, len(pictures), progress)
        if len(placed_files(other)) > len(placed):
            model, placed = other, placed_files(other)
    count = len(placed)
    if count < max(3, len(pictures) / 2):
        names = [picture.name for picture in pictures if grey_file(picture) in placed]
        which = f" ({', '.join(names[:MAX_NAMES])}{', …' * (count > MAX_NAMES)})" if names else ""
        raise InputError(f"{pictures[0].path.parent}: FOLDER: only {count} of {len(pictures)} photographs could be put "
                         f"together{which}: {advice(pictures, folder, count)}")  # fmt: skip
    model = adjust(model, pictures, detections, progress)
    partial = folder / "sparse.partial"
    partial.mkdir(exist_ok=True)
    model.write(partial)
    partial.rename(sparse)
    return to_sparse_model(model, pictures, folder)


def require_sound(database: Path) -> None:
    """Raise InputError if the file of COLMAP's database is damaged or cannot be read. It may be missing or empty."""
    if not database.exists():
        return
    complaint = "is damaged"
    try:
        with contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as opened:
            if opened.execute("PRAGMA quick_check").fetchone() == ("ok",):
                return
    except sqlite3.OperationalError as error:  # locked, or no permission
        complaint = f"cannot be read ({error})"
    except sqlite3.DatabaseError:
        pass
    raise InputError(f"{database}: {complaint}; remove it or all of {database.parent}, and repeat the command")


def read_model(folder: Path) -> Any:
    """Read a COLMAP model from a folder. Raises InputError if it is damaged."""
    with contextlib.suppress(Exception):  # of any kind for a damaged file
        model = pycolmap.Reconstruction(folder)
        if model.num_reg_images():
            return model
    raise InputError(f"{folder}: is damaged; remove it and give the same command again")


def placed_files(model: Any) -> set[str]:
    """Return the file names of the images that have a pose in a COLMAP model; empty if `model` is None."""
    return {model.images[k].name for k in model.reg_image_ids()} if model else set()


def reconstruct(folder: Path, count: int, progress: Progress) -> Any:
    """Reconstruct the cameras in two ways. Returns the better COLMAP model, or None if both fail.

    The better model is the one whose cameras explain more matches. Global mapping ("Global Structure-from-Motion
    Revisited", Pan et al. 2024) uses all matches from the start. Incremental mapping tolerates more wrong matches
    (repeated patterns, moving shadows), but it may mirror a camera that sees few points in one plane. In both models,
    images lose their poses if no reliable matches connect them to the others.

    `folder`: has the database of matches, and the grey images. `count`: number of photographs, for the progress bar.
    """
    paths = database, _, output = folder / "database.db", folder / "grey", folder / "models"
    output.mkdir(exist_ok=True)
    best, most = None, 0
    for models in (map_globally(paths, progress), map_incrementally(paths, count, progress)):
        if models:
            model = max(models.values(), key=lambda model: len(model.reg_image_ids()))
            pairs = check_pairs(model, database)
            deregister(model, disconnected_images(model.reg_image_ids(), pairs))
            kept = set(model.reg_image_ids())
            explained = sum(pair.explained for pair in pairs if {pair.first, pair.second} <= kept)
            if explained > most:
                best, most = model, explained
    if best:
        deregister(best, [k for k in best.reg_image_ids() if best.images[k].num_points3D < MIN_POINTS])
    return best


def deregister(model: Any, images: Iterable[int]) -> None:
    """Remove the poses of images from a COLMAP model, which is changed. `images`: their ids."""
    for k in list(images):
        model.deregister_frame(model.images[k].frame_id)


def map_globally(paths: Sequence[Path], progress: Progress) -> dict[int, Any]:
    """Run COLMAP's global mapping. Returns the models by number; there may be none.

    `paths`: the database, the folder of images, and a folder for output.
    """
    options = pycolmap.GlobalPipelineOptions(random_seed=0)
    mapper = options.mapper
    for part in (mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = 0
    (models,) = (interruptible(pycolmap.global_mapping, *paths, options) for _ in progress(range(1), "all cameras"))
    return models


def map_incrementally(paths: Sequence[Path], count: int, progress: Progress) -> dict[int, Any]:
    """Run COLMAP's incremental mapping. Returns the models by number; there may be none.

    `paths`: the database, the folder of images, and a folder for output. `count`: number of photographs, for the
    progress bar.
    """
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, extract_colors=False)
    options.mapper.random_seed = options.triangulation.random_seed = 0
    bar = iter(progress(range(count), "cameras", count))
    for _ in range(2):  # the first pair
        next(bar, None)
    models = interruptible(pycolmap.incremental_mapping, *paths, options,
                           next_image_callback=lambda: next(bar, None))  # fmt: skip
    list(bar)  # to its end
    return models


class ImagePair(NamedTuple):
    """Two images of a COLMAP model (their ids), their number of matches, and how many of these agree with the poses."""

    first: int
    second: int
    matches: int
    explained: int


def check_pairs(model: Any, database: Path) -> list[ImagePair]:
    """Count the matches of each pair of images that have poses, and those of them that agree with the poses.

    `database`: COLMAP's file with the matches. Pairs without matches are left out.
    """
    images = {model.images[k].name: model.images[k] for k in model.reg_image_ids()}
    pairs = []
    for one, other, first, second in read_matches(database):
        if one.name in images and other.name in images and len(first):
            a, b = images[one.name], images[other.name]
            near = sampson_distance(model, a, b, first, second) < EPIPOLAR * model.cameras[a.camera_id].width
            pairs.append(ImagePair(a.image_id, b.image_id, len(first), int(near.sum())))
    return pairs


def disconnected_images(images: Sequence[int], pairs: Sequence[ImagePair]) -> list[int]:
    """Return the ids of images whose poses are unreliable, because no good pair connects them to the largest group.

    A pair connects two images if their poses explain most of their matches. Images form groups by these pairs. The
    poses of other groups are random relative to the largest group. Groups of only one or two images are not returned: a
    few wrong poses do no harm to the masks. `images`: ids of all images with poses.
    """
    index = {k: number for number, k in enumerate(images)}
    firm = [p for p in pairs if p.matches >= PAIR_MATCHES and p.explained > PAIR_EXPLAINED * p.matches]
    ends = [index[p.first] for p in firm], [index[p.second] for p in firm]
    graph = coo_array((np.ones(len(firm)), ends), (len(images), len(images)))
    part = connected_components(graph, directed=False)[1]
    sizes = np.bincount(part)
    return [k for k, p in zip(images, part) if p != sizes.argmax() and sizes[p] >= MIN_PART]


def sampson_distance(model: Any, a: Any, b: Any, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Sampson distances (n,) [px] of n matches from the epipolar lines that two images' poses give.

    `a`, `b`: images of `model` with poses. `first`, `second` (n, 2): the points of the matches in `a` and in `b` [px].
    """
    cameras = model.cameras[a.camera_id], model.cameras[b.camera_id]
    rays = (camera.cam_from_img(pixels) for camera, pixels in zip(cameras, (first, second)))
    essential = pycolmap.essential_matrix_from_pose(b.cam_from_world() * a.cam_from_world().inverse())
    return np.sqrt(pycolmap.compute_squared_sampson_error(*rays, essential)) * cameras[0].mean_focal_length()


def to_sparse_model(model: Any, pictures: Sequence[Picture], folder: Path) -> SparseModel:
    """Convert a COLMAP model. Its images are reduced; the result's cameras and error are for photographs at full size.

    `folder`: has the database and the grey images, from which the reasons of failures are found.
    """
    cameras, scales = model_cameras(model, pictures), [scale for _, _, scale in registered(model, pictures)]
    error = float(model.compute_mean_reprojection_error() * np.mean(scales))
    return SparseModel(cameras, model_points(model), error, failure_reasons(pictures, cameras, folder))


def model_points(model: Any) -> np.ndarray:
    """Return the points (N, 3) of a COLMAP model."""
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def failure_reasons(pictures: Sequence[Picture], placed: Iterable[str], folder: Path) -> dict[str, str]:
    """Find out why photographs have no camera. Returns texts for the user by the photograph's name.

    `placed`: names of the photographs that have a camera. `folder`: has the database and the grey images.
    """
    failed, reasons = [picture for picture in pictures if picture.name not in placed], {}
    detail = {p.name: sharpness(folder / "grey" / grey_file(p)) for p in pictures} if failed else {}
    for name, file in ((picture.name, grey_file(picture)) for picture in failed):
        with pycolmap.Database.open(folder / "database.db") as opened:
            image = opened.read_image_with_name(file)  # None if the user has removed the database
            features = opened.num_keypoints_for_image(image.image_id) if image else TEXTURED
        reasons[name] = ("nothing in it matches the others: it shows something else, or photographs in between are "
                         "missing")  # fmt: skip
        if features < TEXTURED:
            reasons[name] = f"only {features} features: out of focus, blurred or too dark"
        elif detail[name] < BLURRED * np.median([detail[other] for other in placed]):
            reasons[name] = "far less detail than in the others: blurred, out of focus, or it shows something else"
    return reasons


def sharpness(file: Path) -> float:
    """Return how sharp an image file is: the variance of its Laplacian, after a blur against noise."""
    grey = read_image(file)[:, :, 0]
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_32F).var())


def advice(pictures: Sequence[Picture], folder: Path, count: int) -> str:
    """Return a clause for the user that says why so few photographs have a camera, and what to do.

    `count`: number of photographs that have one. `folder`: has the database of features and matches.
    """
    with pycolmap.Database.open(folder / "database.db") as opened:
        features = np.median([opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()])
        matched = sum(len(geometry.inlier_matches) >= MIN_MATCHES for geometry in opened.read_two_view_geometries()[1])
        total = opened.num_images()
    if features < TEXTURED:
        return (f"they have {features:.0f} features each; they are out of focus or too dark, or the object has no "
                "texture: put a sheet of `mi-ring board` under it")  # fmt: skip
    largest = max(max(picture.size) for picture in pictures)
    if largest < SMALL:
        return (f"their longer side has {largest} pixels, too few for features; give the camera's own files, with "
                f"{SMALL} pixels or more")  # fmt: skip
    if count >= total / 4:
        return ("many matches of the others are wrong; take more photographs, also between these and the others, 10 "
                "degrees at a time")  # fmt: skip
    if matched >= 2 * total:
        return "they fit each other but show everything from one place; walk around the object, 10 degrees at a time"
    return "they show different things, or too little of the same; photograph one object, 10 degrees at a time"
