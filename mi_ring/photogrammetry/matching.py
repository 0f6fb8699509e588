"""Features of the photographs and matches between them, by COLMAP's library."""

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
from mi_ring.system.optional import LazyPackage
from mi_ring.system.progress import Progress

pycolmap = LazyPackage("pycolmap", "structure from motion")
#: Longer side of the images in which features are searched [px], maximum number of features, and their least contrast.
#: A smooth object has few strong features: weak ones are kept, and geometric verification removes the wrong ones.
LONGEST, FEATURES, PEAK = 1600, 4096, 0.003
ALL_PAIRS = 150  #: all pairs of up to this number of photographs are matched: fewer pairs may mirror cameras
NEIGHBOURS, KEYS = 12, 40  #: with more photographs: neighbours on each side, and key photographs with each other
BATCH = 60  #: pairs per call
MIN_MATCHES = 50  #: of a pair of photographs that overlap
#: A pair is static if the features' motion varies by less than STATIC [widths]. MAX_STATIC: largest share of them.
STATIC, MAX_STATIC = 0.01, 0.9


def find_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Write reduced grey images to `folder`, and their features to the database. Existing files are kept."""
    options = pycolmap.FeatureExtractionOptions(use_gpu=False)
    options.sift.max_num_features, options.sift.peak_threshold = FEATURES, PEAK
    database, grey = folder / "database.db", folder / "grey"
    cameras = camera_ids(database)
    shared: dict[tuple[int, int], int] = {}  # cameras by the size of the photographs
    focal_lengths = {size: focal_35mm([p for p in pictures if p.size == size]) for size in {p.size for p in pictures}}
    for picture in progress(pictures, "features"):
        file = grey_file(picture)
        if file not in cameras:
            reduced = Image.fromarray(picture.grey(LONGEST))
            picture.close()
            reduced.save(grey / file)
            reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
            if picture.size in shared:
                reader.existing_camera_id = shared[picture.size]
            elif equivalent := focal_lengths[picture.size]:
                focal = equivalent / 36 * max(reduced.size)
                reader.camera_params = f"{focal},{reduced.width / 2},{reduced.height / 2},0"
            mode = pycolmap.CameraMode.SINGLE
            interruptible(pycolmap.extract_features, database, grey, [file], mode, reader, options)
            cameras = camera_ids(database)
        shared.setdefault(picture.size, cameras[file])


def grey_file(picture: Picture) -> str:
    """The file name of a photograph's grey image. It has no spaces, which separate names in COLMAP's lists of pairs."""
    return f"{quote(picture.name, safe='')}.png"


def camera_ids(database: Path) -> dict[str, int]:
    """The cameras of the images in COLMAP's database, by file; empty if there is no database."""
    if not database.is_file():
        return {}
    with pycolmap.Database.open(database) as opened:
        return {image.name: image.camera_id for image in opened.read_all_images()}


def pairs_to_match(count: int) -> list[tuple[int, int]]:
    """Choose the pairs of `count` photographs, sorted by name, that are matched."""
    pairs = itertools.combinations(range(count), 2)
    if count <= ALL_PAIRS:
        return list(pairs)
    keys = set(range(0, count, -(-count // KEYS)))
    return [(a, b) for a, b in pairs if b - a <= NEIGHBOURS or (a in keys and b in keys)]


def match_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Match the pairs that the database lacks. Raises InputError if the first batch is from one viewpoint."""
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=True)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0  # otherwise it depends on the thread
    pairs = pairs_to_match(len(pictures))
    batches = [pairs[k : k + BATCH] for k in range(0, len(pairs), BATCH)]
    database, listed = folder / "database.db", folder / "pairs.txt"
    for batch in progress(batches, "matching"):
        named = [(grey_file(pictures[a]), grey_file(pictures[b])) for a, b in batch]
        listed.write_text("".join(f"{a} {b}\n" for a, b in named), "utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        interruptible(pycolmap.match_image_pairs, database, matching, pairing, verification)
        if batch is batches[0] and (share := static_share(database, named)) >= MAX_STATIC:
            raise InputError(f"{pictures[0].path.parent}: photographs: {share:.0%} of the first {len(batch)} pairs are "
                             "from one place; walk around the object, 10 degrees at a time")  # fmt: skip


def static_share(database: Path, pairs: Sequence[tuple[str, str]]) -> float:
    """The share of pairs of grey files that match and are from one viewpoint, so that all features move alike."""
    with pycolmap.Database.open(database) as opened:
        width = {camera.camera_id: camera.width for camera in opened.read_all_cameras()}
    asked, static = set(map(frozenset, pairs)), 0
    for a, b, first, second in read_matches(database):
        if frozenset((a.name, b.name)) in asked and len(first) >= MIN_MATCHES:
            motion = first - second
            spread = np.linalg.norm(motion - np.median(motion, 0), axis=1)  # a hand moves the whole picture a little
            static += float(np.median(spread)) < STATIC * width[a.camera_id]
    return static / len(pairs)


def read_matches(database: Path) -> Iterator[tuple[Any, Any, np.ndarray, np.ndarray]]:
    """Read COLMAP's database: the two images of each matched pair, and verified matches (n, 2) [px] in each of them."""
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        keypoints = {k: opened.read_keypoints(k)[:, :2] for k in images}
        for number, geometry in zip(*opened.read_two_view_geometries()):
            a, b = pycolmap.pair_id_to_image_pair(number)
            first, second = geometry.inlier_matches.T
            yield images[a], images[b], keypoints[a][first], keypoints[b][second]
