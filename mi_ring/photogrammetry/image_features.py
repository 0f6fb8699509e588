"""Finds image features of photographs with COLMAP's library.

They are kept in COLMAP's database, in which an image is the reduced grey file of a photograph.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import torch
from PIL import Image

from mi_ring.images import encoded_picture
from mi_ring.photogrammetry.folder import DECODED, Picture, focal_35mm
from mi_ring.system.files import write_file
from mi_ring.system.machine import cores, in_threads, interruptible
from mi_ring.system.optional import LazyPackage
from mi_ring.system.progress import Progress

pycolmap = LazyPackage("pycolmap", "structure from motion")
#: Longer side of the images in which features are searched [px], maximum number of features, and their least contrast.
#: A smooth object has few strong features: weak ones are kept, and geometric verification removes the wrong ones.
LONGEST, FEATURES, PEAK = 1600, 4096, 0.003


def find_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Find the image features of photographs. Shows a progress bar.

    Writes reduced grey images to `folder`/grey, and features to the COLMAP database `folder`/database.db. Images that
    have features there already are skipped.
    """
    list(progress(extract_features(pictures, folder), "features", len(pictures)))


def extract_features(pictures: Sequence[Picture], folder: Path) -> Iterator[Picture]:
    """Find the image features of photographs. Yields each photograph when its features are in the database.

    Writes reduced grey images to `folder`/grey, and features to the COLMAP database `folder`/database.db. Images that
    have features there already are yielded, too, without work.
    """
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=cores())
    options.sift.max_num_features, options.sift.peak_threshold = FEATURES, PEAK
    database, grey = folder / "database.db", folder / "grey"

    def write_grey(picture: Picture) -> tuple[int, int]:
        reduced = Image.fromarray(picture.grey(LONGEST))
        picture.close()
        write_file(grey / grey_file(picture), encoded_picture(reduced))
        return reduced.size

    for size in dict.fromkeys(picture.size for picture in pictures):  # one camera each
        own = [picture for picture in pictures if picture.size == size]
        cameras = camera_ids(database)
        yield from (picture for picture in own if grey_file(picture) in cameras)
        missing = [picture for picture in own if grey_file(picture) not in cameras]
        for batch in batches(missing, 4 * cores()):
            sizes = list(in_threads(write_grey, batch, most=DECODED))
            reader, cameras = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL"), camera_ids(database)
            if known := [cameras[file] for file in map(grey_file, own) if file in cameras]:
                reader.existing_camera_id = known[0]
            elif equivalent := focal_35mm(own):
                width, height = sizes[0]
                reader.camera_params = f"{equivalent / 36 * max(width, height)},{width / 2},{height / 2},0"
            files, mode = [grey_file(picture) for picture in batch], pycolmap.CameraMode.SINGLE
            interruptible(pycolmap.extract_features, database, grey, files, mode, reader, options)
            yield from batch


def batches(things: Sequence[Any], count: int) -> Iterator[Sequence[Any]]:
    """Split a sequence into parts of `count` items each. The last part may be shorter."""
    return (things[k : k + count] for k in range(0, len(things), count))


def grey_file(picture: Picture) -> str:
    """Return the file name of a photograph's reduced grey image. It has no spaces, which COLMAP does not allow."""
    return f"{quote(picture.name, safe='')}.png"


def camera_ids(database: Path) -> dict[str, int]:
    """Return the camera ids of the images in a COLMAP database, by file name; empty if there is no such file."""
    if not database.is_file():
        return {}
    with pycolmap.Database.open(database) as opened:
        return {image.name: image.camera_id for image in opened.read_all_images()}


class Features(NamedTuple):
    """Features of an image in COLMAP's database: the `FEATURES` largest."""

    image: int  #: its number there
    camera: Any  #: pycolmap's camera
    numbers: np.ndarray  #: (n,) numbers of the features there
    points: np.ndarray  #: (n, 2) where they are [px]
    descriptors: torch.Tensor  #: (n, 128) uint8


def read_features(database: Path) -> dict[str, Features]:
    """Read the features of all images in a COLMAP database. Returns them by file name.

    COLMAP's own limit is a weak one: it keeps a whole level of its pyramid too many, and several orientations of a
    place.
    """
    found = {}
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        for image in opened.read_all_images():
            places = opened.read_keypoints(image.image_id).reshape(-1, 6).astype(float)  # x, y, and a matrix (2, 2)
            areas = np.abs(places[:, 2] * places[:, 5] - places[:, 3] * places[:, 4])
            numbers = np.sort(np.argsort(areas, kind="stable")[-FEATURES:])
            descriptors = torch.tensor(opened.read_descriptors(image.image_id).data).reshape(-1, 128)
            camera = cameras[image.camera_id]
            found[image.name] = Features(image.image_id, camera, numbers, places[numbers, :2], descriptors[numbers])
    return found
