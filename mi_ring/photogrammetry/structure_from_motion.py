"""Structure from motion: cameras and points from photographs alone, by COLMAP's library."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
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
from mi_ring.photogrammetry.bundle_adjustment import adjusted, cameras_of, reduction
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.marker_sheet import Sighting
from mi_ring.photogrammetry.matching import MATCHED, file_of, find_features, match_features, matches_of
from mi_ring.system.machine import interruptible
from mi_ring.system.optional import need
from mi_ring.system.progress import Progress

SMALL = 1000  #: pixels along photographs, below which they may have too few features
TEXTURED = 300  #: features of a photograph, from which they are worth something
EPIPOLAR = 2.5e-3  #: of a picture's width, by which a match may be off from what two cameras say
FEWEST_MATCHES, FIRM = 15, 0.7  #: of two photographs, and the share that cameras explain, that hold each other
PART = 3  #: photographs at least
NAMED = 30  #: photographs in a message, at most
FEWEST_POINTS = 30  #: that a photograph must show of those in space
BLURRED = 0.25  #: of the detail of those with a camera: a photograph that has less is blurred, or shows something plain


@dataclass
class Motion:
    """Cameras of photographs by name, and points [units of its own]."""

    cameras: dict[str, tuple[Lens, np.ndarray]]  #: lens and camera-to-world pose (4, 4), OpenCV's axes
    points: np.ndarray  #: (N, 3)
    error: float | None  #: mean reprojection error [px of the photographs], if it is known
    failed: dict[str, str]  #: photographs without a camera, and why
    source: str = ""  #: where the cameras are from, if not from structure from motion

    def digest(self) -> str:
        """What tells these cameras from others."""
        found = [f"{name} {lens.model} {lens.params} {pose.round(6).tolist()}"
                 for name, (lens, pose) in sorted(self.cameras.items())]  # fmt: skip
        return hashlib.blake2b("\n".join(found).encode(), digest_size=8).hexdigest()

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "Motion":
        """In another frame: x ↦ scale · rotation (3, 3) x + shift (3,)."""
        cameras = {
            name: (lens, moved_pose(pose, scale, rotation, shift)) for name, (lens, pose) in self.cameras.items()
        }
        return replace(self, cameras=cameras, points=scale * self.points @ rotation.T + shift)


def structure_from_motion(
    pictures: Sequence[Picture], sightings: Mapping[str, Sighting], folder: Path, progress: Progress
) -> Motion:
    """Cameras of photographs, one lens for all of a size. What is done is kept in `folder`, to go on from there.

    `sightings`: of the printed sheet, by the photograph's name.

    Raises InputError, which says why, if fewer than half of the photographs belong together.
    """
    pycolmap = need("pycolmap", "cameras from photographs")
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    sparse = folder / "sparse"
    if sparse.is_dir():
        return motion_of(pycolmap.Reconstruction(sparse), pictures, folder)
    (folder / "grey").mkdir(parents=True, exist_ok=True)
    find_features(pictures, folder, progress)
    match_features(pictures, folder, progress)
    model = put_together(folder, len(pictures), progress)
    found = model.num_reg_images() if model else 0
    if found < max(3, len(pictures) / 2):
        placed = {model.images[k].name for k in model.reg_image_ids()} if model else set()
        names = [picture.name for picture in pictures if file_of(picture) in placed]
        which = f" ({', '.join(names[:NAMED])}{', …' * (found > NAMED)})" if names else ""
        raise InputError(f"{pictures[0].path.parent}: FOLDER: only {found} of {len(pictures)} photographs could be put "
                         f"together{which}: {why_not(pictures, folder, found)}")  # fmt: skip
    model = adjusted(model, pictures, sightings, progress)
    growing = folder / "sparse.partial"
    growing.mkdir(exist_ok=True)
    model.write(growing)
    growing.rename(sparse)
    return motion_of(model, pictures, folder)


def put_together(folder: Path, count: int, progress: Progress) -> Any:
    """The `pycolmap.Reconstruction` that explains most of the matches; None if there is none.

    All cameras together ("Global Structure-from-Motion Revisited", Pan et al. 2024), and one after another. The former
    heeds all matches from the start, where the latter puts photographs from another side in by the first few points
    that fit; these may be nearly in one plane, and what is mirrored then stays so. The latter is better at
    photographs whose matches are mostly wrong, by a pattern that repeats or shadows that move. Of both, parts that do
    not hang together with the rest are left out.
    """
    models = [map_globally(folder, progress), map_incrementally(folder, count, progress)]
    best, most = None, 0
    for model in filter(None, models):
        pairs = agreements(model, folder / "database.db")
        leave_out(model, loose(model.reg_image_ids(), pairs))
        held = set(model.reg_image_ids())
        explained = sum(pair.explained for pair in pairs if {pair.one, pair.other} <= held)
        if explained > most:
            best, most = model, explained
    if best:
        leave_out(best, [k for k in best.reg_image_ids() if best.images[k].num_points3D < FEWEST_POINTS])
    return best


def leave_out(model: Any, images: Iterable[int]) -> None:
    """Take the cameras of these images from a model."""
    for k in list(images):
        model.deregister_frame(model.images[k].frame_id)


def map_globally(folder: Path, progress: Progress) -> Any:
    """The largest `pycolmap.Reconstruction` by rotations and places of all cameras together; None if there is none."""
    pycolmap = need("pycolmap", "structure from motion")
    options = pycolmap.GlobalPipelineOptions(random_seed=0)
    mapper = options.mapper
    for part in (mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = 0
    (folder / "models").mkdir(exist_ok=True)
    models: dict = {}
    for _ in progress(range(1), "all cameras"):
        models = interruptible(
            pycolmap.global_mapping, folder / "database.db", folder / "grey", folder / "models", options
        )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def map_incrementally(folder: Path, count: int, progress: Progress) -> Any:
    """The largest `pycolmap.Reconstruction`, one photograph after another; None if there is none."""
    pycolmap = need("pycolmap", "structure from motion")
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, extract_colors=False)
    options.mapper.random_seed = options.triangulation.random_seed = 0
    bar = iter(progress(range(count), "cameras", count))
    for _ in range(2):  # the pair that it begins with
        next(bar, None)
    (folder / "models").mkdir(exist_ok=True)
    models = interruptible(
        pycolmap.incremental_mapping, folder / "database.db", folder / "grey", folder / "models", options,
        next_image_callback=lambda: next(bar, None),
    )  # fmt: skip
    for _ in bar:
        pass
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


class Agreement(NamedTuple):
    """How many matches of two images there are, and how many are where the cameras of a model say that they are."""

    one: int
    other: int
    matches: int
    explained: int


def agreements(model: Any, database: Path) -> list[Agreement]:
    """Of every two images of a model that match."""
    placed = {model.images[k].name: k for k in model.reg_image_ids()}
    found = []
    for one, other, first, second in matches_of(database):
        if one.name in placed and other.name in placed and len(first):
            a, b = placed[one.name], placed[other.name]
            off = epipolar(model, model.images[a], model.images[b], first, second)
            near = off < EPIPOLAR * model.cameras[model.images[a].camera_id].width
            found.append(Agreement(a, b, len(first), int(near.sum())))
    return found


def loose(images: Sequence[int], pairs: Sequence[Agreement]) -> list[int]:
    """Which images are of parts that do not hang together with the largest by pairs that explain most of their matches.

    Where many of the matches do not fit that join two parts, these stand anywhere to each other, though each fits in
    itself. One or two images alone are no part: votes bear with them.
    """
    place = {k: number for number, k in enumerate(images)}
    firm = [p for p in pairs if p.matches >= FEWEST_MATCHES and p.explained > FIRM * p.matches]
    ends = [place[p.one] for p in firm], [place[p.other] for p in firm]
    joined = coo_array((np.ones(len(firm)), ends), (len(images), len(images)))
    part = connected_components(joined, directed=False)[1]
    sizes = np.bincount(part)
    return [k for k in images if part[place[k]] != sizes.argmax() and sizes[part[place[k]]] >= PART]


def epipolar(model: Any, a: Any, b: Any, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n,) how far matches of two images, (n, 2) [px] each, are from what their places say: Sampson's distance [px]."""
    lens = model.cameras[a.camera_id], model.cameras[b.camera_id]
    x, y = (np.c_[camera.cam_from_img(place), np.ones(len(place))] for camera, place in zip(lens, (first, second)))
    relative = (b.cam_from_world() * a.cam_from_world().inverse()).matrix()
    essential = np.cross(relative[:, 3], relative[:, :3], axisb=0).T
    lines, back = x @ essential.T, y @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    return np.abs((y * lines).sum(1)) / np.maximum(slope, 1e-12) * lens[0].mean_focal_length()


def motion_of(model: Any, pictures: Sequence[Picture], folder: Path) -> Motion:
    """In terms of the photographs as they were taken."""
    cameras = cameras_of(model, pictures)
    failed = reasons([p for p in pictures if p.name not in cameras], [p for p in pictures if p.name in cameras], folder)
    by_file = {file_of(picture): picture for picture in pictures}
    placed = [model.images[k] for k in model.reg_image_ids()]
    scales = [reduction(model, image, by_file[image.name].size) for image in placed]
    error = float(model.compute_mean_reprojection_error() * np.mean(scales))
    return Motion(cameras, points_of(model), error, failed)


def points_of(model: Any) -> np.ndarray:
    """The points (N, 3) of a `pycolmap.Reconstruction`."""
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def model_points(folder: Path) -> np.ndarray:
    """The points (N, 3) of a model in COLMAP's format."""
    return points_of(need("pycolmap", f"{folder}").Reconstruction(folder))


def reasons(failed: Sequence[Picture], others: Sequence[Picture], folder: Path) -> dict[str, str]:
    """Why each of some photographs has got no camera, by its name; the others have."""
    if not failed:
        return {}
    detail = {p.name: detail_of(folder / "grey" / file_of(p)) for p in (*failed, *others)}
    usual = float(np.median([detail[p.name] for p in others]))
    return {p.name: reason_of(p, folder, detail[p.name] < BLURRED * usual) for p in failed}


def detail_of(file: Path) -> float:
    """How much a photograph varies from pixel to pixel, but for noise."""
    grey = read_image(file)[:, :, 0]
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_32F).var())


def reason_of(picture: Picture, folder: Path, plain: bool) -> str:
    """Why a photograph has got no camera; `plain`: it has far less detail than others."""
    pycolmap = need("pycolmap", "features")
    with pycolmap.Database.open(folder / "database.db") as opened:
        image = opened.read_image_with_name(file_of(picture))
        features = opened.num_keypoints_for_image(image.image_id)
    if features < TEXTURED:
        return f"{features} features only: out of focus, blurred or too dark"
    if plain:
        return "far less detail than in the others: blurred, out of focus, or it shows something else"
    return "nothing in it fits the others: it shows something else, or there are too few photographs in between"


def why_not(pictures: Sequence[Picture], folder: Path, found: int) -> str:
    """Why no more photographs than `found` could be put together, and what to do."""
    pycolmap = need("pycolmap", "features")
    with pycolmap.Database.open(folder / "database.db") as opened:
        features = np.median([opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()])
        matched = sum(len(geometry.inlier_matches) >= MATCHED for geometry in opened.read_two_view_geometries()[1])
        count = opened.num_images()
    if features < TEXTURED:
        return (f"they have {features:.0f} features each; they are out of focus or too dark, or the object has no "
                "texture: lay a sheet of `mi-ring board` under it")  # fmt: skip
    largest = max(max(picture.size) for picture in pictures)
    if largest < SMALL:
        return (f"they have {largest} pixels along at most, which is too few for features; give them as the camera "
                f"wrote them, {SMALL} or more")  # fmt: skip
    if found >= count / 4:
        return ("the others hang on matches of which many do not fit; take more photographs, also between these and "
                "the others, 10 degrees at a time")  # fmt: skip
    if matched >= 2 * count:
        return "they fit each other but show everything from one place; walk around the object, 10 degrees at a time"
    return "they show different things, or too little of the same; photograph one object, 10 degrees at a time"
