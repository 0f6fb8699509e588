"""Features and matches of photographs: what the products find, which pairs are matched, what a second run keeps."""

import itertools

import cv2
import numpy as np
import pytest
import torch

from mi_ring.errors import InputError
from mi_ring.photogrammetry import image_features, matching
from mi_ring.photogrammetry.folder import Picture, find_pictures


def silent(things, *_):
    return things


def normalised(random, *shape):
    """Descriptors (n, 128) as SIFT writes them."""
    return as_sift(random.uniform(0, 1, (*shape, 128)) ** 4)


def as_sift(values):
    """Values (n, 128) as bytes of norm 512."""
    return np.rint(512 * values / np.linalg.norm(values, axis=-1, keepdims=True)).clip(0, 255).astype(np.uint8)


def by_brute_force(first, second):
    """Matches by the definition, one descriptor at a time."""

    def best(own, others):
        angles = [np.arccos(min(1.0, int(own.astype(int) @ other.astype(int)) / 512**2)) for other in others]
        order = np.argsort(angles)
        rival = angles[order[1]] if len(angles) > 1 else np.pi / 2
        return order[0] if angles[order[0]] <= 0.7 and angles[order[0]] < 0.8 * rival else None

    there = [best(own, second) if len(second) else None for own in first]
    back = [best(own, first) if len(first) else None for own in second]
    return [(k, match) for k, match in enumerate(there) if match is not None and back[match] == k]


@pytest.mark.parametrize("sizes", [(0, 0), (0, 5), (5, 0), (1, 1), (1, 40), (40, 1), (130, 97)], ids=str)
def test_matches_are_those_of_brute_force(sizes, monkeypatch):
    """In blocks that the features do not fill; with twins, whose match is ambiguous, and with pairs at the limits."""
    monkeypatch.setattr(matching, "BLOCK", 32)
    random = np.random.default_rng(4)
    first, second = (normalised(random, n) for n in sizes)
    shared = min(sizes) // 2 + min(sizes) % 2
    noise = random.normal(0, np.linspace(0, 30, max(shared, 1))[:shared, None], (shared, 128))
    second[-shared or len(second) :] = np.rint(first[:shared] + noise).clip(0, 255)
    if sizes == (130, 97):
        first[100], second[3], first[101:104] = first[1], second[-3], first[4]  # ties in either photograph
        first[5] = second[-10] = 0  # no direction at all
    expected = by_brute_force(first, second)
    assert len(expected) >= shared / 3 and (len(expected) < shared or shared < 2)
    found, ratios = matching.match_descriptors(torch.tensor(first), torch.tensor(second))
    assert found.dtype == np.uint32 and ratios.max(initial=0) < matching.LOOSE
    assert found[ratios < 0.8].tolist() == [list(map(int, pair)) for pair in expected]


def test_all_pairs_of_few_photographs_are_matched():
    few = [torch.zeros(k % 3, 128, dtype=torch.uint8) for k in range(matching.ALL_PAIRS)]
    assert matching.pairs_to_match(few) == list(itertools.combinations(range(len(few)), 2))
    assert len(matching.pairs_to_match([*few, *few])) < 120 * 119 / 2  # photographs may have no features


def test_of_a_ring_of_many_photographs_all_neighbours_are_matched():
    """In any order of names: each sees a part of the ring, other things, and nothing twice the same."""
    random, count, reach = np.random.default_rng(1), 100, 10
    landmarks, views = normalised(random, 2000), []
    place = random.permutation(count)
    for angle in place:
        seen = np.arange(angle * 20, (angle + reach) * 20) % len(landmarks)  # the next one shows 90 % of the same
        seen = random.choice(seen, 150, replace=False)
        noisy = np.rint(landmarks[seen] + random.normal(0, 8, (len(seen), 128))).clip(0, 255).astype(np.uint8)
        views.append(torch.tensor(np.concatenate([noisy, normalised(random, 50)])))
    pairs = matching.pairs_to_match(views)
    apart = np.abs(place[:, None] - place)
    apart = np.minimum(apart, count - apart)
    near = {(a, b) for a, b in itertools.combinations(range(count), 2) if apart[a, b] <= reach // 2}
    assert near <= set(pairs) and len(pairs) < 3000 and pairs == sorted(set(pairs))
    assert {(k, k + 1) for k in range(count - 1)} <= set(pairs)
    assert pairs == matching.pairs_to_match(views)  # so that an interrupted run goes on with the same


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Photographs of a plane with blots, each turned and moved, one of another size, one without any feature."""
    pytest.importorskip("pycolmap").logging.minloglevel = 2
    monkeypatch.setattr(image_features, "FEATURES", 500)
    random = np.random.default_rng(0)
    layers = [cv2.GaussianBlur(random.normal(size=(500, 500)), (0, 0), sigma) * sigma for sigma in (1.5, 4, 10)]
    page = np.where(sum(layers) > 0, 200, 30).astype(np.uint8)
    for k in range(8):
        size = np.array([160, 120] if k < 6 else [120, 160])
        turn = cv2.getRotationMatrix2D((250, 250), 9 * k, 0.6 + 0.02 * k)
        turn[:, 2] += size / 2 - 250
        image = cv2.warpAffine(page, turn, tuple(size)) if k != 3 else np.full(size[::-1], 9, np.uint8)
        cv2.imwrite(f"{tmp_path}/a photograph {k}.png", image)
    (tmp_path / "work/grey").mkdir(parents=True)
    return tmp_path


def content(database):
    """Cameras by files, and the verified matches of each pair of files."""
    with matching.pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pairs = {frozenset((names[a], names[b])): (a, b) for a, b in itertools.combinations(names, 2)}
        verified = {pair: opened.read_two_view_geometry(*ids).inlier_matches.tolist() for pair, ids in pairs.items()
                    if opened.exists_two_view_geometry(*ids)}  # fmt: skip
    return image_features.camera_ids(database), verified


def test_photographs_that_show_the_same_match(folder, monkeypatch):
    pictures, shown = find_pictures(folder), []
    monkeypatch.setattr(matching, "BATCH", 10)

    def progress(things, what, total):
        shown.append((what, total))
        return things

    image_features.find_features(pictures, folder / "work", progress)
    matching.match_features(pictures, folder / "work", progress)
    assert shown == [("features", 8), ("matching", 28)]
    cameras, verified = content(folder / "work/database.db")
    assert len(verified) == 28
    blank = image_features.grey_file(pictures[3])
    assert all((not found) == (blank in pair) for pair, found in verified.items())
    assert min(len(found) for pair, found in verified.items() if blank not in pair) > 40
    files = [image_features.grey_file(picture) for picture in pictures]
    assert len({cameras[file] for file in files[:6]}) == len({cameras[file] for file in files[6:]}) == 1
    assert cameras[files[0]] != cameras[files[6]]


def test_what_an_earlier_run_has_found_is_kept(folder, monkeypatch):
    """Features of one batch, and pairs that COLMAP's own matcher has matched."""
    pictures, work = find_pictures(folder), folder / "work"
    database, pycolmap = work / "database.db", matching.pycolmap
    image_features.find_features(pictures[:5], work, silent)
    files = [image_features.grey_file(picture) for picture in pictures]
    (work / "pairs.txt").write_text(f"{files[0]} {files[1]}\n{files[1]} {files[2]}\n")
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=True)
    pycolmap.match_image_pairs(database, options, pycolmap.ImportedPairingOptions(match_list_path=work / "pairs.txt"))
    before = content(database)
    decoded = []
    grey = Picture.grey
    monkeypatch.setattr(Picture, "grey", lambda self, longest: decoded.append(self.name) or grey(self, longest))
    image_features.find_features(pictures, work, silent)
    assert sorted(decoded) == [picture.name for picture in pictures[5:]]
    matching.match_features(pictures, work, silent)
    cameras, verified = content(database)
    assert before[0].items() <= cameras.items() and cameras[files[5]] == cameras[files[0]]
    assert len(before[1]) == 2 and before[1].items() <= verified.items() and len(verified) == 28
    monkeypatch.setattr(matching, "match_pair", None)  # nothing is left to do
    matching.match_features(pictures, work, silent)
    assert content(database) == (cameras, verified)


def test_pairs_that_were_not_chosen_are_matched_for_a_photograph_without_a_camera(folder, monkeypatch):
    """Of one photograph alone, and then by guided matching, which finds no fewer."""
    pictures, work = find_pictures(folder), folder / "work"
    files = [image_features.grey_file(picture) for picture in pictures]
    monkeypatch.setattr(matching, "pairs_to_match", lambda descriptors: [(0, 1), (1, 2), (4, 5)])
    image_features.find_features(pictures, work, silent)
    matching.match_features(pictures, work, silent)
    _, before = content(work / "database.db")
    assert matching.match_again({files[7]}, work, silent)
    _, after = content(work / "database.db")
    new = {frozenset((file, files[7])) for file in files[:7]}
    assert len(before) == 3 and set(after) == set(before) | new
    assert all(after[pair] == found for pair, found in before.items())
    assert all(len(after[pair]) > 40 for pair in new if files[3] not in pair)


def two_views(random, plane):
    """Points of a scene, or of a plane, in two photographs (n, 2), by the same camera."""
    camera = matching.pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 900, 800, 600)
    points = random.uniform([-1, -0.7, 4], [1, 0.7, 6], (400, 3))
    points[:, 2] = 5 + 0.3 * points[:, 0] if plane else points[:, 2]
    turn = cv2.Rodrigues(np.array([0.04, -0.17, 0.06]))[0]
    matrix = np.array([[900, 0, 400], [0, 900, 300], [0, 0, 1.0]])
    views = [points @ matrix.T, (points @ turn.T + [0.9, 0.2, 0.3]) @ matrix.T]
    return camera, [view[:, :2] / view[:, 2:] for view in views]


@pytest.mark.parametrize("plane", [False, True])
def test_ambiguous_features_match_where_the_geometry_says(plane):
    """All features have a rival that fails the ratio test but one in five, and half of the rest are elsewhere."""
    pytest.importorskip("pycolmap")
    random = np.random.default_rng(6)
    camera, (first, second) = two_views(random, plane)
    own = normalised(random, 400)
    other, rivals = (as_sift((own + random.normal(0, noise, own.shape)).clip(0)) for noise in (8.5, 9))
    rivals[::5] = normalised(random, 80)
    wrong = random.permutation(400)[:200]
    wrong = wrong[wrong % 5 > 0]
    second[wrong] = random.uniform([0, 0], [800, 600], (len(wrong), 2))
    elsewhere = random.uniform([0, 0], [800, 600], (400, 2))
    images = [
        image_features.Features(k, camera, before + np.arange(len(points)), points, torch.tensor(descriptors))
        for k, before, points, descriptors in (
            (1, 7, first, own), (2, 3, np.concatenate([second, elsewhere]), np.concatenate([other, rivals])),
        )
    ]  # fmt: skip
    found = matching.match_pair(*images).inlier_matches.astype(int) - [7, 3]  # numbers in the database
    _, ratios = matching.match_descriptors(*(image.descriptors for image in images))
    right = (found[:, 0] == found[:, 1]) & ~np.isin(found[:, 0], wrong)
    assert right.sum() > 1.3 * (ratios < matching.RATIO).sum()
    assert right.mean() > 0.95
    back = matching.match_pair(*images[::-1]).inlier_matches[:, ::-1].astype(int) - [7, 3]
    assert len(set(map(tuple, back.tolist())) & set(map(tuple, found.tolist()))) > 0.95 * len(found)


def test_the_largest_features_are_matched(folder, monkeypatch):
    """No more than `FEATURES`; matches are numbered as in the database, so their places agree with a homography."""
    pictures, work = find_pictures(folder), folder / "work"
    image_features.find_features(pictures, work, silent)
    monkeypatch.setattr(image_features, "FEATURES", 200)
    features = image_features.read_features(work / "database.db")
    first = features[image_features.grey_file(pictures[0])]
    with matching.pycolmap.Database.open(work / "database.db") as opened:
        every = opened.read_keypoints(first.image)
    sizes = np.abs(every[:, 2] * every[:, 5] - every[:, 3] * every[:, 4])
    assert len(every) > 300 and len(first.points) == 200 and np.array_equal(every[first.numbers, :2], first.points)
    assert sizes[first.numbers].min() >= np.delete(sizes, first.numbers).max()
    list(matching.match_pairs([tuple(map(image_features.grey_file, pictures[:2]))], features, work))
    ((_, _, one, other),) = matching.read_matches(work / "database.db")
    assert len(one) > 40
    homography, agreeing = cv2.findHomography(one, other, cv2.RANSAC, 4.0)
    assert homography is not None and agreeing.mean() > 0.9


@pytest.mark.parametrize(("matches", "share"), [(None, 0.25), (10, 1.0), (15, 1.0), (30, 0.5), (60, 0.25), (900, 0.25)])
def test_a_search_ends_when_a_geometry_of_fifteen_matches_would_be_found(matches, share):
    pytest.importorskip("pycolmap")
    options = matching.verification(matches)
    assert options.min_num_inliers == 15 and options.ransac.min_inlier_ratio == share


def test_an_interrupted_run_loses_at_most_a_batch(folder, monkeypatch):
    pictures, work = find_pictures(folder), folder / "work"
    image_features.find_features(pictures, work, silent)
    calls, match = [], matching.match_pair

    def interrupted(*features):
        calls.append(1)
        if len(calls) == 12:
            raise KeyboardInterrupt
        return match(*features)

    monkeypatch.setattr(matching, "BATCH", 4)
    monkeypatch.setattr(matching, "in_parallel", lambda *arguments: list(map(*arguments)))
    monkeypatch.setattr(matching, "match_pair", interrupted)
    with pytest.raises(KeyboardInterrupt):
        matching.match_features(pictures, work, silent)
    matching.match_features(pictures, work, silent)
    assert len(calls) == 28 + 4 and len(content(work / "database.db")[1]) == 28


def test_photographs_from_one_place_are_refused(folder):
    page = cv2.imread(f"{folder}/a photograph 0.png")
    for k in range(8):
        cv2.imwrite(f"{folder}/a photograph {k}.png", np.roll(page, k, 1))
    pictures = find_pictures(folder)
    image_features.find_features(pictures, folder / "work", silent)
    with pytest.raises(InputError, match="100% of the first 28 pairs are from one place"):
        matching.match_features(pictures, folder / "work", silent)
