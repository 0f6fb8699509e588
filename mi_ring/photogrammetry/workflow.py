"""The way from photographs to a capture, stage by stage; what each has found is kept, to go on from there."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.images import read_image, write_image
from mi_ring.importers.photogrammetry import exif_exposure
from mi_ring.photogrammetry import masks
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.motion import Motion, Progress
from mi_ring.photogrammetry.scene import OBJECT, UNSURE, Shot
from mi_ring.photogrammetry.table import FLAT, Plane, find_plane, not_table
from mi_ring.photogrammetry.views import View, reduced, reduced_all
from mi_ring.rendering.lights import Light
from mi_ring.system.files import write_file

SURE = 0.8  #: agreement of a mask with what all say together that is needed at least
COARSE, FINE = 600, 1200  #: pixels at most along the pictures that masks are found in, and that outlines are
DIM = 3.0  #: albedo that lights of unknown intensity are made to imply: more than all, which tells that they are




def require_same_photographs(pictures: Sequence[Picture], folder: Path) -> None:
    """Raise InputError if what a folder holds was found in other photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    known, listed = folder / "photographs.json", {p.path.name: p.path.stat().st_size for p in pictures}
    if known.exists() and json.loads(known.read_text("utf-8")) != listed:
        raise InputError(f"{folder}: is of other photographs than {pictures[0].path.parent} holds now; remove it, or "
                         "give another DIR")  # fmt: skip
    write_file(known, json.dumps(listed))


def upright(motion: Motion, center: np.ndarray) -> Motion:
    """Moved so that the object's `center` (3,) is the origin and the photographs' mean up is z; 1 is how far it is."""
    poses = np.stack([pose for _, pose in motion.cameras.values()])
    scale = 1 / float(np.median(np.linalg.norm(poses[:, :3, 3] - center, axis=1)))
    up = -poses[:, :3, 1].mean(0)
    rotation = rotation_to_z(up / np.linalg.norm(up)) if np.linalg.norm(up) > 0.1 else np.eye(3)
    return motion.moved(scale, rotation, -scale * rotation @ center)


def rotation_to_z(direction: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) of a unit vector to z."""
    return Rotation.align_vectors([[0, 0, 1.0]], [direction])[0].as_matrix()


def found_masks(
    pictures: Sequence[Picture], motion: Motion, folder: Path, progress: Progress
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Masks (H, W) uint8 by name, but for those that are not sure, and the object's centre (3,).

    Masks that `folder` has already are taken as they are; anybody may have painted in them.
    """
    folder.mkdir(exist_ok=True)
    kept = folder / "object.json"
    if kept.exists():
        known = json.loads(kept.read_text("utf-8"))
        kept_names = [name for name, good in known["sure"].items() if good]
        return {name: read_image(folder / f"{name}.png")[..., 0] for name in kept_names}, np.array(known["center"])
    views = reduced_all(pictures, motion.cameras, COARSE)
    space = masks.Space.seen_by(views)
    plane = find_plane(motion.points, np.stack([v.camera.position for v in views]), space.center, space.axis[-1])
    found, guesses = find_object(views, space, plane, progress)
    if found is None:
        raise InputError(f"{pictures[0].path.parent}: masks: no object was found, neither one that stands on a table "
                         "nor one that the flash lights more than what is around it")  # fmt: skip
    result: dict[str, np.ndarray] = {}
    sure: dict[str, bool] = {}
    by_name = {picture.name: picture for picture in pictures}
    for view, mask, guess, agreed in progress(list(zip(views, found.masks, guesses, found.agreement)), "outlines"):
        large = reduced(by_name[view.name], *motion.cameras[view.name], FINE)
        fine = masks.sharpen(large, mask)
        maybe = cv2.resize(masks.unsure(mask, guess), fine.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        shades = np.where(fine > 0, OBJECT, np.where(maybe, UNSURE, 0)).astype(np.uint8)
        write_image(shades[..., None], folder / f"{view.name}.png")
        sure[view.name] = agreed >= SURE
        if sure[view.name]:
            result[view.name] = shades
    center = found.body.points.mean(0)
    write_file(kept, json.dumps({"center": center.tolist(), "sure": sure}))
    return result, center


def find_object(
    views: Sequence[View], space: masks.Space, plane: Plane | None, progress: Progress
) -> tuple[masks.Found | None, list[np.ndarray]]:
    """Masks by what differs from the table, if there is one, else by brightness; and the guesses they grew from."""
    ways = []
    if plane:
        above = plane.height(space.grid) > 2 * FLAT * np.linalg.norm(views[0].camera.position - space.center)
        ways.append((lambda: not_table(views, plane, space.center, space.axis[-1]), above))
    ways.append((lambda: [masks.bright(view) for view in views], np.ones(len(space.grid), bool)))
    for guess, allowed in ways:
        space.allowed, guesses = allowed, guess()
        found = masks.settle(space, guesses, progress)
        if found and found.quality >= SURE:
            return found, guesses
    return None, []


def shots(
    pictures: Sequence[Picture], motion: Motion, masks_: dict[str, np.ndarray], flash: np.ndarray
) -> list[Shot]:
    """The photographs of the scene, in its frame; `flash` (3,) is where it is in the camera's axes [scene units]."""
    exposures = [exif_exposure(picture.path) for picture in pictures]
    known = [exposure for exposure in exposures if exposure]
    result = []
    for picture, exposure in zip(pictures, exposures):
        if picture.name not in motion.cameras:
            continue
        lens, pose = motion.cameras[picture.name]
        relative = exposure / np.median(known) if exposure and len(known) == len(pictures) else 1.0
        light = Light("point", pose[:3, :3] @ flash + pose[:3, 3], np.full(3, relative / DIM))
        result.append(Shot(picture, lens, pose, masks_.get(picture.name), light))
    return result
