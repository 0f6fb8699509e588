"""What photographs have in common: features of each and matches between them, by COLMAP's library."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image

from mi_ring.errors import InputError
from mi_ring.photogrammetry.folder import Picture, focal_35mm
from mi_ring.system.machine import interruptible
from mi_ring.system.optional import need
from mi_ring.system.progress import Progress

#: Features are looked for in pictures of so many pixels at most, and so many of them. An evenly lit, smooth object has
#: few strong ones: weak ones are let in, and what they are worth is told by geometry.
LONGEST, FEATURES, PEAK = 1600, 4096, 0.003
ALL_PAIRS = 150  #: photographs up to which each is compared with each: with fewer pairs some are put in mirrored
NEIGHBOURS, KEYS = 12, 40  #: beyond: with so many before and after, and so many of them with each other
PAIRS_AT_ONCE = 60
MATCHED = 50  #: matches of two photographs, from which they are worth something
STILL, MOST = 0.01, 0.9  #: two photographs are alike if features move so little, in widths; and pairs that must not be


def find_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Reduced pictures in grey, and their features in the database."""
    pycolmap = need("pycolmap", "features")
    options = pycolmap.FeatureExtractionOptions(use_gpu=False)
    options.sift.max_num_features, options.sift.peak_threshold = FEATURES, PEAK
    database, grey = folder / "database.db", folder / "grey"
    cameras = {image.name: image.camera_id for image in images_of(database)}
    lenses: dict[tuple[int, int], int] = {}
    equivalent = {size: focal_35mm([p for p in pictures if p.size == size]) for size in {p.size for p in pictures}}
    for picture in progress(pictures, "features"):
        file = file_of(picture)
        if file not in cameras:
            reduced = Image.fromarray(picture.grey(LONGEST))
            picture.close()
            reduced.save(grey / file)
            reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
            if picture.size in lenses:
                reader.existing_camera_id = lenses[picture.size]
            elif known := equivalent[picture.size]:
                focal = known / 36 * max(reduced.size)
                reader.camera_params = f"{focal},{reduced.width / 2},{reduced.height / 2},0"
            mode = pycolmap.CameraMode.SINGLE
            interruptible(pycolmap.extract_features, database, grey, [file], mode, reader, options)
            cameras = {image.name: image.camera_id for image in images_of(database)}
        lenses.setdefault(picture.size, cameras[file])


def file_of(picture: Picture) -> str:
    """The reduced picture's file name, without spaces, at which COLMAP's lists of pairs end a name."""
    return f"{quote(picture.name, safe='')}.png"


def images_of(database: Path) -> list[Any]:
    """The images of COLMAP's database; none if there is no database."""
    if not database.is_file():
        return []
    pycolmap = need("pycolmap", "features")
    with pycolmap.Database.open(database) as opened:
        return opened.read_all_images()


def pairs_to_match(count: int) -> list[tuple[int, int]]:
    """Which of so many photographs are compared, by their place in the order of their names."""
    pairs = itertools.combinations(range(count), 2)
    if count <= ALL_PAIRS:
        return list(pairs)
    keys = set(range(0, count, -(-count // KEYS)))
    return [(a, b) for a, b in pairs if b - a <= NEIGHBOURS or (a in keys and b in keys)]


def match_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Compare photographs with each other; pairs that the database has already are left as they are.

    Raises InputError after the first of them if they show everything from one place.
    """
    pycolmap = need("pycolmap", "features")
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=True)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0  # else it depends on which thread has a pair
    pairs = pairs_to_match(len(pictures))
    batches = [pairs[k : k + PAIRS_AT_ONCE] for k in range(0, len(pairs), PAIRS_AT_ONCE)]
    chosen = folder / "pairs.txt"
    for batch in progress(batches, "matching"):
        named = [(file_of(pictures[a]), file_of(pictures[b])) for a, b in batch]
        chosen.write_text("".join(f"{a} {b}\n" for a, b in named), "utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=chosen)
        interruptible(pycolmap.match_image_pairs, folder / "database.db", matching, pairing, verification)
        if batch is batches[0] and (share := alike(folder / "database.db", named)) >= MOST:
            raise InputError(f"{pictures[0].path.parent}: photographs: {share:.0%} of the first {len(batch)} pairs are "
                             "from one place; walk around the object, 10 degrees at a time")  # fmt: skip


def alike(database: Path, pairs: Sequence[tuple[str, str]]) -> float:
    """The share of these pairs of files that match and where features move together, as from one place."""
    pycolmap = need("pycolmap", "features")
    with pycolmap.Database.open(database) as opened:
        width = {camera.camera_id: camera.width for camera in opened.read_all_cameras()}
    asked, still = set(map(frozenset, pairs)), 0
    for a, b, first, second in matches_of(database):
        if frozenset((a.name, b.name)) in asked and len(first) >= MATCHED:
            moved = first - second
            away = np.linalg.norm(moved - np.median(moved, 0), axis=1)  # nobody holds a camera quite still
            still += float(np.median(away)) < STILL * width[a.camera_id]
    return still / len(pairs)


def matches_of(database: Path) -> Iterator[tuple[Any, Any, np.ndarray, np.ndarray]]:
    """Of every two images of COLMAP's database that match: both, and where the matches are in each, (n, 2) [px]."""
    pycolmap = need("pycolmap", "features")
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        places = {k: opened.read_keypoints(k)[:, :2] for k in images}
        for number, geometry in zip(*opened.read_two_view_geometries()):
            a, b = pycolmap.pair_id_to_image_pair(number)
            first, second = geometry.inlier_matches.T
            yield images[a], images[b], places[a][first], places[b][second]
