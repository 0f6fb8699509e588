"""Matches the features of photographs with matrix products. COLMAP's library verifies the matches.

They are kept in COLMAP's database, in which an image is the reduced grey file of a photograph.
"""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from mi_ring.errors import InputError
from mi_ring.nets.chunks import in_parallel
from mi_ring.photogrammetry.folder import Picture
from mi_ring.photogrammetry.image_features import Features, batches, grey_file, read_features
from mi_ring.system.files import write_file
from mi_ring.system.machine import interruptible
from mi_ring.system.optional import LazyPackage
from mi_ring.system.progress import Progress

pycolmap = LazyPackage("pycolmap", "structure from motion")
LENGTH = 512.0  #: of a descriptor
#: Largest angle between the descriptors of a match [radians], also as a share of the angle to the second nearest one:
#: RATIO to find the geometry of two photographs, LOOSE for matches that agree with it.
ANGLE, RATIO, LOOSE = 0.7, 0.8, 0.95
TRIALS = 1.5  #: of RANSAC, as a multiple of the number that finds the geometry with a probability of 99.9 %
FAR = 4.0  #: the largest distance of a match that agrees [px]
LINE = 16  #: floats in a line of the processor's cache
BLOCK = 512  #: rows of a matrix of products that is computed at a time, so that it stays in the processor's cache
ALL_PAIRS = 60  #: all pairs of up to this number of photographs are matched
SIMILAR, NEIGHBOURS = 30, 12  #: with more: each photograph with the most similar ones, and those next to it by name
WORDS = 4096  #: descriptors to which the others are compared to see which photographs are similar
BATCH = 60  #: pairs that are matched at a time
MIN_MATCHES = 50  #: of a pair of photographs that overlap
#: A pair is static if the features' motion varies by less than STATIC [widths]. MAX_STATIC: largest share of them.
STATIC, MAX_STATIC = 0.01, 0.9


class Nearest(NamedTuple):
    """For each of n descriptors the nearest of m others, by scalar products: the larger, the nearer."""

    place: torch.Tensor  #: (n,) index of the nearest one; m if there is none
    first: torch.Tensor  #: (n,) its product
    second: torch.Tensor  #: (n,) the product of the second nearest one
    rest: torch.Tensor  #: (m,) for each of the m, the largest product with those of the n that are nearest to another


def nearest(descriptors: torch.Tensor, others: torch.Tensor) -> Nearest:
    """Find for each of n descriptors the nearest of m others.

    `descriptors` (n, 128), `others` (m, 128), uint8. The products are float32.
    """
    count = len(others)
    # Zeros for the second nearest one if there is only one. Rows of whole cache lines halve the time.
    others = torch.cat([others.float(), torch.zeros(LINE - count % LINE, others.shape[1])])
    buffer, found = torch.empty(BLOCK, len(others)), []  # new memory for each block would take longer than its product
    rest = torch.zeros(len(others))
    for block in descriptors.split(BLOCK):
        products = torch.mm(block.float(), others.T, out=buffer[: len(block)])
        first, index = products.max(1)
        products.scatter_(1, index[:, None], 0)
        found.append((index.clamp(max=count), first, products.amax(1)))
        rest = torch.maximum(rest, products.amax(0)) if len(block) else rest
    place, first, second = map(torch.cat, zip(*found))
    return Nearest(place, first, second, rest[:count])


def angles(products: torch.Tensor) -> torch.Tensor:
    """Return the angles (k,) [radians] between descriptors, whose scalar products (k,) are given."""
    return torch.acos((products.double() / LENGTH**2).clamp(max=1))


def match_descriptors(first: torch.Tensor, second: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs of descriptors that are nearest to each other. Returns (index pairs (k, 2) uint32, ratios (k,)).

    `first` (n, 128), `second` (m, 128), uint8. A ratio is the angle between the two, divided by the angle to the second
    nearest descriptor; of both directions, the larger one. Pairs are left out if their angle is above `ANGLE`, if their
    ratio is `LOOSE` or more, or if two are equally near.
    """
    there, product, other, rest = nearest(first, second)
    rows = (there < len(second)).nonzero()[:, 0]
    # Back from `second`: of those that chose a descriptor, the nearest one. The others are its rivals. If one that
    # chose another is nearer, the ratio is above 1, and the pair is left out.
    best = torch.zeros(len(second)).scatter_reduce_(0, there[rows], product[rows], "amax")
    chosen = product[rows] == best[there[rows]]
    rivals = rows[~chosen]
    rest = rest.scatter_reduce_(0, there[rivals], product[rivals], "amax")
    rows = rows[chosen]
    alone = torch.bincount(there[rows], minlength=len(second))[there[rows]] == 1
    angle = angles(product[rows])
    ratios = angle / angles(torch.maximum(other[rows], rest[there[rows]]))
    good = alone & (angle <= ANGLE) & (ratios < LOOSE)
    rows = rows[good]
    return torch.stack([rows, there[rows]], 1).numpy().astype(np.uint32), ratios[good].numpy()


def match_pair(first: Features, second: Features) -> Any:
    """Match the features of two images, and estimate their two-view geometry by COLMAP, which is returned.

    Its inliers are the matches. The geometry is found from matches with a low ratio of the angles to the nearest and
    the second nearest descriptor. Then all other matches are added that agree with the geometry. Few of these are
    wrong, even with a ratio near 1, for example for two similar features of an object.
    """
    matches, ratios = match_descriptors(first.descriptors, second.descriptors)
    likely = matches[ratios < RATIO]
    geometry = pycolmap.estimate_two_view_geometry(
        first.camera, first.points, second.camera, second.points, likely, verification(len(likely))
    )
    if len(geometry.inlier_matches):
        a, b = (own.points[column] for own, column in zip((first, second), matches.T))
        one, other = matches[distances(geometry, a, b) <= FAR].T
        geometry.inlier_matches = np.column_stack([first.numbers[one], second.numbers[other]]).astype(np.uint32)
    return geometry


def verification(matches: int | None = None) -> Any:
    """Return options for COLMAP's geometric verification, with a fixed random seed, so that results can be repeated.

    `matches`: number of matches of the pair; None: unknown. If it is known, the search assumes that COLMAP's least
    number of inliers are among them. Otherwise pairs that do not overlap would take the longest.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    if matches:
        options.ransac.dyn_num_trials_multiplier = TRIALS
        least = min(1.0, options.min_num_inliers / matches)
        options.ransac.min_inlier_ratio = max(options.ransac.min_inlier_ratio, least)
    return options


def distances(geometry: Any, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how far k matches are from agreement with a two-view geometry of COLMAP, (k,) [px].

    `first`, `second` (k, 2): the points of the matches in both images [px]. For a homography, it is the distance of the
    second point from the mapped first one. Otherwise it is the Sampson distance from the epipolar line.
    """
    kinds = pycolmap.TwoViewGeometryConfiguration
    if geometry.config in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
        mapped = np.column_stack([first, np.ones(len(first))]) @ geometry.H.T
        return np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - second, axis=1)
    return np.sqrt(pycolmap.compute_squared_sampson_error(first, second, geometry.F))


def pairs_to_match(descriptors: Sequence[torch.Tensor]) -> list[tuple[int, int]]:
    """Choose which pairs of photographs to match. Returns pairs of indices (a, b), with a < b.

    `descriptors`: (n, 128) uint8 for each photograph, sorted by the photograph's name. If there are more than
    `ALL_PAIRS` photographs, only similar ones and neighbours are paired. Similar photographs show the same visual words
    (Sivic and Zisserman, "Video Google", 2003). The words are descriptors drawn from all photographs.
    """
    pairs = list(itertools.combinations(range(len(descriptors)), 2))
    if len(descriptors) <= ALL_PAIRS:
        return pairs
    everything = torch.cat(list(descriptors))
    words = everything[torch.randperm(len(everything), generator=torch.Generator().manual_seed(0))[:WORDS]]
    counts = torch.stack(in_parallel(partial(count_words, words=words), descriptors))
    rarity = torch.log(len(counts) / (counts > 0).sum(0).clamp(min=1))
    weights = torch.nn.functional.normalize(counts.sqrt() * rarity)
    similarity = (weights @ weights.T).fill_diagonal_(-1)
    chosen = torch.zeros(len(counts), len(counts), dtype=torch.bool)
    chosen.scatter_(1, similarity.topk(SIMILAR).indices, True)
    return [(a, b) for a, b in pairs if b - a <= NEIGHBOURS or chosen[a, b] or chosen[b, a]]


def count_words(descriptors: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
    """Count how many descriptors are nearest to each of m visual words. Returns a histogram (m + 1,).

    `descriptors` (n, 128), `words` (m, 128), uint8. The last bin counts descriptors that are near no word.
    """
    return torch.bincount(nearest(descriptors, words).place, minlength=len(words) + 1)


def match_features(pictures: Sequence[Picture], folder: Path, progress: Progress) -> None:
    """Match the pairs of photographs that the COLMAP database `folder`/database.db lacks, and write the matches there.

    Features must be there already. Raises InputError if most of the first pairs are from one viewpoint.
    """
    features = read_features(folder / "database.db")
    files = [grey_file(picture) for picture in pictures]
    pairs = [(files[a], files[b]) for a, b in pairs_to_match([features[file].descriptors for file in files])]
    for number, _ in enumerate(progress(match_pairs(pairs, features, folder), "matching", len(pairs)), 1):
        if number == min(BATCH, len(pairs)):
            share = static_share(folder / "database.db", pairs[:number])
            if share >= MAX_STATIC:
                raise InputError(f"{pictures[0].path.parent}: photographs: {share:.0%} of the first {number} pairs are "
                                 "from one place; walk around the object, 10 degrees at a time")  # fmt: skip


def match_pairs(
    pairs: Sequence[tuple[str, str]], features: Mapping[str, Features], folder: Path
) -> Iterator[tuple[str, str]]:
    """Match pairs of images. Yields each pair when its matches are in the COLMAP database `folder`/database.db.

    `pairs`: file names of grey images. `features`: by file name. A pair that is in the database already is not matched
    again.
    """
    with pycolmap.Database.open(folder / "database.db") as opened:
        for batch in batches(pairs, BATCH):
            both = [(features[a], features[b]) for a, b in batch]
            if new := [(a, b) for a, b in both if not opened.exists_two_view_geometry(a.image, b.image)]:
                for (a, b), geometry in zip(new, in_parallel(match_pair, *zip(*new))):
                    opened.write_two_view_geometry(a.image, b.image, geometry)
            yield from batch


def match_again(files: Collection[str], folder: Path, progress: Progress) -> bool:
    """Match each pair that contains one of `files`, names of grey images, as well as possible.

    First, pairs that were not chosen for matching are matched. Then those with matches are matched again by guided
    matching. It searches along the epipolar lines, and finds more matches, but also more wrong ones. The COLMAP
    database `folder`/database.db is changed. Returns True if a pair has matches.
    """
    database = folder / "database.db"
    features = read_features(database)
    asked = [(a, b) for a, b in itertools.combinations(sorted(features), 2) if a in files or b in files]
    list(progress(match_pairs(asked, features, folder), "matching more", len(asked)))
    pairs = [(a.name, b.name) for a, b, first, _ in read_matches(database)
             if len(first) and (a.name in files or b.name in files)]  # fmt: skip
    for batch in progress(list(batches(pairs, BATCH)), "matching again"):
        with pycolmap.Database.open(database) as opened:
            ids = {image.name: image.image_id for image in opened.read_all_images()}
            for a, b in batch:
                opened.delete_matches(ids[a], ids[b])
                opened.delete_two_view_geometry(ids[a], ids[b])
        match_by_library(batch, folder)
    return bool(pairs)


def match_by_library(pairs: Sequence[tuple[str, str]], folder: Path, guided: bool = True) -> None:
    """Match pairs of images by COLMAP's own matcher, and write the result to the database `folder`/database.db.

    `pairs`: file names of grey images. `guided`: search once more along the epipolar lines.
    """
    listed = folder / "pairs.txt"
    write_file(listed, "".join(f"{a} {b}\n" for a, b in pairs))
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=guided)
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    interruptible(pycolmap.match_image_pairs, folder / "database.db", options, pairing, verification())


def static_share(database: Path, pairs: Sequence[tuple[str, str]]) -> float:
    """Return which share of pairs of images match and are from one viewpoint, 0 to 1.

    `database`: file of COLMAP. `pairs`: file names of grey images. Two images are from one viewpoint if all features
    move alike between them.
    """
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
    """Read all matched pairs of images in COLMAP's database.

    Yields (first image, second image, points (n, 2) [px] in the first, the same points in the second).
    """
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        keypoints = {k: opened.read_keypoints(k)[:, :2] for k in images}
        for number, geometry in zip(*opened.read_two_view_geometries()):
            a, b = pycolmap.pair_id_to_image_pair(number)
            first, second = geometry.inlier_matches.T
            yield images[a], images[b], keypoints[a][first], keypoints[b][second]
