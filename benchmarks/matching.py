"""Compare our matcher with COLMAP's on the same features: matches, time, and the cameras that come of them.

COLMAP's matcher gets all features that COLMAP finds, ours the largest --features of them.

    python benchmarks/matching.py PHOTOS OUT [--truth DIR] [--matchers NAME…] [--first N] [--timed N]
        [--longest 1600] [--features 4096]

Prints a Markdown table with a row for each matcher, with machine and date:

    guided        COLMAP's library with guided matching, all pairs
    library       the same without guided matching
    products      ours, all pairs
    chosen        ours, the pairs that `mi-ring photos` chooses

Matches are those per pair that are verified, of pairs with any. Seconds are processor seconds of all threads per pair;
"wall" is what passed, also per pair. --truth: a folder with cameras in any format that `mi-ring convert` reads; errors
are means and worst after a similarity, rotations in degrees, positions in shares of the distance. --first N takes the
first N photographs. --timed N matches only N pairs at random and finds no cameras. OUT keeps the features.
"""

import argparse
import datetime
import itertools
import os
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from accuracy import processor, table
from trimesh.registration import procrustes

from mi_ring.geometry.camera import nearest_point
from mi_ring.importers.formats import detect
from mi_ring.importers.frames import frames_of
from mi_ring.photogrammetry import image_features, matching
from mi_ring.photogrammetry.bundle_adjustment import adjust
from mi_ring.photogrammetry.folder import Picture, find_pictures
from mi_ring.photogrammetry.structure_from_motion import reconstruct, to_sparse_model
from mi_ring.system.progress import progress

Pairs = Sequence[tuple[str, str]]
MATCHERS = "guided", "library", "products", "chosen"


def match(name: str, pairs: Pairs, folder: Path) -> None:
    """Match pairs of files with one of the `MATCHERS`."""
    if name in ("products", "chosen"):
        features = image_features.read_features(folder / "database.db")
        list(progress(matching.match_pairs(pairs, features, folder), name, len(pairs)))
        return
    for batch in progress(list(image_features.batches(pairs, matching.BATCH)), name):
        matching.match_by_library(batch, folder, name == "guided")


def clocked(call: Callable[[], object]) -> tuple[float, float]:
    """Processor seconds of all threads, and seconds that passed, during a call."""
    before, start = os.times(), time.monotonic()
    call()
    after = os.times()
    return after.user + after.system - before.user - before.system, time.monotonic() - start


def errors(found: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> list[str]:
    """Rotation errors [degrees] and position errors [share of the distance] of poses (4, 4): mean and worst of each."""
    a, b = (np.array([poses[name] for name in sorted(found.keys() & true.keys())]) for poses in (found, true))
    _, moved, _ = procrustes(a[:, :3, 3], b[:, :3, 3], reflection=False)
    turns = b[:, :3, :3] @ a[:, :3, :3].swapaxes(1, 2)
    u, _, v = np.linalg.svd(turns.sum(0))
    cosines = (np.trace((u @ v).T @ turns, axis1=1, axis2=2) - 1) / 2
    middle = nearest_point(b[:, :3, 3], b[:, :3, 2], "cameras")
    off = np.linalg.norm(moved - b[:, :3, 3], axis=1) / np.linalg.norm(b[:, :3, 3] - middle, axis=1)
    turned = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return [f"{turned.mean():.3f}", f"{turned.max():.3f}", f"{off.mean():.3%}", f"{off.max():.3%}"]


def cameras(pictures: Sequence[Picture], folder: Path, true: dict[str, np.ndarray]) -> list[str]:
    """How many photographs are placed, the mean reprojection error [px], and the errors of the cameras."""
    model = reconstruct(folder, len(pictures), progress)
    if model is None:
        return ["0"]
    sparse = to_sparse_model(adjust(model, pictures, {}, progress), pictures, folder)
    poses = {name: pose for name, (_, pose) in sparse.cameras.items()}
    if len(poses) < 3:
        return [f"{len(poses)}"]
    return [f"{len(poses)}", f"{sparse.error:.3f}", *(errors(poses, true) if true else [])]


def main() -> None:
    """The benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--matchers", nargs="+", choices=MATCHERS, default=MATCHERS)
    parser.add_argument("--first", type=int)
    parser.add_argument("--timed", type=int)
    parser.add_argument("--longest", type=int, default=image_features.LONGEST)
    parser.add_argument("--features", type=int, default=image_features.FEATURES)
    options = parser.parse_args()
    image_features.LONGEST, image_features.FEATURES = options.longest, options.features
    matching.pycolmap.logging.minloglevel = matching.pycolmap.logging.FATAL
    pictures = find_pictures(options.photos)[: options.first]
    features = options.out / f"features_{options.longest}_{options.features}"
    (features / "grey").mkdir(parents=True, exist_ok=True)
    spent, passed = clocked(lambda: image_features.find_features(pictures, features, progress))
    true = {f.image.stem: f.pose for f in frames_of(detect(options.truth))} if options.truth else {}
    files = [image_features.grey_file(picture) for picture in pictures]
    known = image_features.read_features(features / "database.db")
    descriptors = [known[file].descriptors for file in files]
    rows = []
    for name in options.matchers:
        folder = options.out / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        shutil.copy(features / "database.db", folder)
        (folder / "grey").symlink_to(features.absolute() / "grey")
        numbers = list(itertools.combinations(range(len(files)), 2))
        if name == "chosen":
            numbers = matching.pairs_to_match(descriptors)
        if options.timed:
            numbers = np.random.default_rng(0).permutation(numbers)[: options.timed].tolist()
        pairs = [(files[a], files[b]) for a, b in numbers]
        took = clocked(lambda name=name, pairs=pairs, folder=folder: match(name, pairs, folder))
        counts = [len(first) for _, _, first, _ in matching.read_matches(folder / "database.db") if len(first)]
        row = [name, len(pairs), len(counts), f"{np.mean(counts):.0f}", *(f"{t / len(pairs):.3f}" for t in took)]
        mapped = []
        seconds = 0.0
        if not options.timed:
            seconds, _ = clocked(lambda f=folder, m=mapped: m.extend(cameras(pictures, f, true)))
        rows.append([*map(str, row), *mapped, f"{seconds:.0f}"])
        print(*rows[-1], flush=True)
    heads = ["matcher", "pairs", "verified", "matches", "s / pair", "wall", "placed", "error [px]"]
    heads += ["rotation [°]", "worst", "position", "worst"] if true else []
    heads = heads[:6] if options.timed else heads
    print("\n" + table([*heads, "s for cameras"], rows))
    count = np.median([len(own) for own in descriptors])
    print(f"\n{len(pictures)} photographs, {count:.0f} features each (median), {spent / len(pictures):.2f} processor "
          f"seconds each, {passed / len(pictures):.2f} passed; {processor()}, {datetime.date.today()}")  # fmt: skip


if __name__ == "__main__":
    main()
