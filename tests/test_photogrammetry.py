"""From photographs to a capture, piece by piece: pictures, masks, the table, crops."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers.ellipsoid_pictures import AXES, CENTER, LENS, hit_ellipsoid, in_a_dim_room, poses, rays_of, view
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ring.capture.grabcut import dilate_by_share, disk, overlap
from mi_ring.errors import InputError
from mi_ring.importers.camera_models import Lens
from mi_ring.importers.undistortion import Window
from mi_ring.importers.writer import Writer
from mi_ring.photogrammetry import automatic_masks, bundle_adjustment, shading_trial, structure_from_motion, table_plane
from mi_ring.photogrammetry.capture_files import (
    OBJECT,
    UNKNOWN,
    PosedPicture,
    crop_mask,
    crop_windows,
    mask_bounds,
    write_posed_picture,
)
from mi_ring.photogrammetry.folder import Picture, find_pictures
from mi_ring.photogrammetry.marker_sheet import SheetDetection
from mi_ring.photogrammetry.object_masks import SegmentationInput, locate_object
from mi_ring.photogrammetry.reduced_photographs import (
    paste_mask,
    reduce_photograph,
    window_around,
)
from mi_ring.photogrammetry.structure_from_motion import SparseModel
from mi_ring.scene.lights import Light
from mi_ring.scene.xml_elements import load_element


def test_masks_of_a_dim_room_with_lamps():
    random = np.random.default_rng(3)
    views, true = [], []
    for k, pose in enumerate(poses(24)):
        rgb, mask = in_a_dim_room(pose, random)
        views.append(view(str(k), pose, rgb))
        true.append(mask)
    guesses = [automatic_masks.bright_mask(v) for v in views]
    assert min(overlap(g, t) for g, t in zip(guesses, true)) < 0.95  # the lamps
    found = automatic_masks.refine_masks(
        automatic_masks.VoxelGrid.seen_by(views), guesses, automatic_masks.empty_masks(views), lambda things, *_: things
    )
    assert min(overlap(m, t) for m, t in zip(found.masks, true)) > 0.96
    assert np.quantile(found.agreement, 0.2) > 0.9
    np.testing.assert_allclose(found.object.points.mean(0), CENTER, atol=0.15)


def test_a_trial_fit_covers_the_object_without_any_mask(monkeypatch):
    few = replace(shading_trial.SETTINGS, iterations=30, levels=(3,), widths=(80,), subdivisions=3)
    monkeypatch.setattr(shading_trial, "SETTINGS", few)
    random = np.random.default_rng(5)
    views, true = [], []
    for k, pose in enumerate(poses(20)):
        rgb, mask = in_a_dim_room(pose, random)
        views.append(view(str(k), pose, rgb))
        true.append(mask)
    directions = random.normal(size=(200, 3))
    points = CENTER + AXES * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    grid = automatic_masks.VoxelGrid.seen_by(views)
    assert shading_trial.initial_sphere(points[:20], grid.center, grid.half_size) is None
    center, radius = shading_trial.initial_sphere(points, grid.center, grid.half_size)
    np.testing.assert_allclose(center, CENTER, atol=0.5)
    assert AXES.min() < radius < AXES.max()
    covered = shading_trial.shading_silhouettes(views, center, radius, lambda things, *_: things)
    assert np.median([overlap(c, t) for c, t in zip(covered, true)]) > 0.9


def test_nothing_in_common_is_no_object():
    random = np.random.default_rng(0)
    views = [view(str(k), pose, np.full((120, 160, 3), 20)) for k, pose in enumerate(poses(12))]
    guesses = [np.zeros((120, 160), np.uint8) for _ in views]
    for guess in guesses:
        x, y = random.integers(0, 150, 2)
        guess[y : y + 8, x : x + 8] = 1
    assert (
        automatic_masks.refine_masks(
            automatic_masks.VoxelGrid.seen_by(views),
            guesses,
            automatic_masks.empty_masks(views),
            lambda things, *_: things,
        )
        is None
    )


def test_a_rod_that_touches_is_unsure_and_a_lamp_apart_is_not():
    mask, guess = np.zeros((2, 40, 60), np.uint8)
    mask[10:20, 20:40] = guess[10:20, 20:40] = 1
    guess[20:40, 28:32] = guess[2:6, 2:6] = 1
    expected = np.zeros((40, 60), np.uint8)
    expected[20:40, 28:32] = 1
    np.testing.assert_array_equal(automatic_masks.touching_pixels(mask, guess), expected)


def on_a_table(pose, random, gain, bare=False):
    """The ellipsoid over a table of many colours, lit by a flash with a cone, a little room light; and its mask.

    A bare table is without it.
    """
    camera = LENS.camera(pose)
    t, cosine = hit_ellipsoid(camera)
    rays = rays_of(camera)
    height = CENTER[2] - AXES[2]
    away = (height - camera.position[2]) / rays[:, 2]
    place = camera.position + away[:, None] * rays
    pattern = 0.45 + 0.3 * np.sin(1.7 * place[:, :1] + [0, 1, 2]) * np.cos(2.3 * place[:, 1:2] + [2, 0, 1])
    cone = (rays @ camera.forward) ** 3
    object_ = np.isfinite(t) & (not bare)
    distance, facing = np.where(object_, t, away), np.where(object_, cosine, -rays[:, 2])
    albedo = np.where(object_[:, None], [0.5, 0.42, 0.36], pattern)
    radiance = gain * albedo * (cone * np.clip(facing, 0, 1) * (18 / distance) ** 2 + 0.03)[:, None]
    encoded = 255 * np.clip(radiance, 0, 1) ** (1 / 2.2)
    encoded[away < 0] = 0
    mask = object_.reshape(LENS.size[::-1])
    return (encoded + random.normal(0, 2, encoded.shape)).clip(0, 255), mask


def test_what_stands_on_a_table_differs_from_it():
    random = np.random.default_rng(1)
    views, true = [], []
    for k, pose in enumerate(poses(20, lowest=30)):
        rgb, mask = on_a_table(pose, random, random.uniform(0.8, 1.2))
        views.append(view(str(k), pose, rgb))
        true.append(mask)
    plane = table_plane.Plane(np.array([0, 0, 1.0]), CENTER[2] - AXES[2])
    grid = automatic_masks.VoxelGrid.seen_by(views)
    guesses = table_plane.TableAppearance(
        views, table_plane.TexelGrid(plane, grid.center, grid.half_size), lambda things, *_: things
    ).foreign_masks()
    assert np.median([overlap(g, t) for g, t in zip(guesses, true)]) > 0.75
    sure = table_plane.TableAppearance(
        views, table_plane.TexelGrid(plane, CENTER, 5.0), lambda things, *_: things
    ).pattern_masks()
    assert max((s & t).sum() for s, t in zip(sure, true)) < 0.01 * np.mean([t.sum() for t in true])
    assert np.mean([s.sum() for s in sure]) > 0.1 * sure[0].size


def test_the_bare_table_is_known_but_for_an_object_that_looks_like_it():
    random = np.random.default_rng(2)
    views, true = [], []
    for k, pose in enumerate(poses(20, lowest=30)):
        rgb, mask = on_a_table(pose, random, random.uniform(0.8, 1.2))
        rgb = rgb.reshape(120, 160, 3)
        rgb[:, 20:45] *= np.where(mask[:, 20:45, None], 1, 0.5)  # a shadow
        views.append(view(str(k), pose, rgb))
        true.append(mask)
    plane = table_plane.Plane(np.array([0, 0, 1.0]), CENTER[2] - AXES[2])
    covered = [mask.astype(np.uint8) for mask in true]
    hidden = [dilate_by_share(mask, 0.1) for mask in covered]
    grounds = table_plane.TexelGrid(plane, CENTER, 3.0), table_plane.TexelGrid(plane, CENTER, 8.0)

    def known(pictures):
        tables = [
            table_plane.TableAppearance(pictures, ground, lambda things, *_: things, hidden) for ground in grounds
        ]
        return tables, table_plane.bare_table(pictures, covered, tables, lambda things, *_: things)

    tables, found = known(views)
    assert np.mean([f[t].mean() for f, t in zip(found, true)]) < 0.05
    beside = [~t & np.isfinite(tables[1].expected(v)).all(-1) for v, t in zip(views, true)]
    assert np.mean([f[b].mean() for f, b in zip(found, beside)]) > 0.8
    assert np.mean([f[:, 22:43][b[:, 22:43]].mean() for f, b in zip(found, beside)]) > 0.7
    painted = []  # the object has the table's own colours where it hides the table
    for v, mask in zip(views, true):
        expected = tables[1].expected(v)
        paint = mask & np.isfinite(expected).all(-1)
        rgb = v.rgb.copy()
        rgb[paint] = 255 * np.exp(expected[paint]) ** (1 / 2.2)
        painted.append(v._replace(rgb=rgb))
    assert known(painted)[1] is None


@pytest.mark.parametrize("bare", [False, True])
def test_a_table_that_the_flash_lights_is_no_object(bare):
    random = np.random.default_rng(1)
    views = [view(str(k), pose, on_a_table(pose, random, 1.0, bare)[0]) for k, pose in enumerate(poses(20, lowest=30))]
    plane = table_plane.Plane(np.array([0, 0, 1.0]), CENTER[2] - AXES[2])
    body = locate_object(
        automatic_masks.VoxelGrid.seen_by(views),
        np.zeros((0, 3)),
        SegmentationInput(plane),
        lambda things, *_: things,
    )
    if bare:
        assert body is None
    else:
        np.testing.assert_allclose(body.points.mean(0), CENTER, atol=0.5)


def test_a_few_voxels_are_no_object():
    views = [view(str(k), pose, np.full((120, 160, 3), 20)) for k, pose in enumerate(poses(12))]
    grid = automatic_masks.VoxelGrid.seen_by(views)
    for radius, enough in ((1.2, False), (3.0, True)):
        near = np.linalg.norm(grid.points - grid.points[len(grid.points) // 2], axis=1)
        grid.allowed = near < radius * (grid.axis[1] - grid.axis[0])
        assert (
            grid.vote([np.ones((120, 160), np.uint8) for _ in views], automatic_masks.MIN_AGREEMENT) is not None
        ) == enough


def test_a_mask_that_misses_far_more_than_others_has_no_vote():
    views = [view(str(k), pose, np.full((120, 160, 3), 20)) for k, pose in enumerate(poses(12))]
    true = [np.isfinite(hit_ellipsoid(v.camera)[0]).reshape(120, 160).astype(np.uint8) for v in views]
    grid = automatic_masks.VoxelGrid.seen_by(views)
    body = grid.vote(true, 0.96)
    np.testing.assert_allclose(body.points.mean(0), CENTER, atol=0.1)
    wrong = [
        mask * (np.arange(160) < 80) if k == 5 else mask for k, mask in enumerate(true)
    ]  # a lamp in the other half
    covered = [body.silhouette(v) for v in views]
    voters = automatic_masks.are_complete(views, wrong, covered)
    assert voters == [k != 5 for k in range(12)]
    assert automatic_masks.are_complete(views, true, covered) == [True] * 12
    assert grid.vote(wrong, 0.96).voxels.sum() < 0.8 * body.voxels.sum()
    assert grid.vote(wrong, 0.96, voters).voxels.sum() == pytest.approx(body.voxels.sum(), rel=0.05)
    for v, mask in zip(views, true):
        reach = cv2.dilate(body.silhouette(v), disk(body.voxel_pixels(v)))
        assert (reach >= mask)[body.silhouette(v) > 0].all() and reach.sum() < 1.5 * mask.sum()


def test_the_pattern_of_the_table_is_known_again_in_a_shadow():
    random = np.random.default_rng(4)
    known = np.log(random.uniform(0.05, 0.9, (20, 24))).repeat(6, 0).repeat(6, 1)
    seen = known + random.normal(0, 0.1, known.shape)
    seen[:, 40:110] -= 2.5  # shadow
    seen[60:90, 60:100] = np.log(0.3) + random.normal(0, 0.1, (30, 40))  # something of one colour on it
    known[105:] = np.nan
    sure = table_plane.match_pattern(seen, known)
    assert sure[10:45, 55:95].mean() > 0.9
    assert sure[60:90, 60:100].mean() < 0.05
    assert not sure[100:].any()


def test_masks_that_others_contradict_are_left_open():
    coverage = np.zeros((40, 60), np.uint8)
    coverage[10:30, 20:40] = 1
    mask = coverage.copy()
    mask[15:25, 38:50], mask[18:22, 25:30] = 1, 0  # a shadow, and a hole
    found = automatic_masks.disputed_pixels(mask, coverage, 2.0)
    assert found[16:24, 43:50].all() and found[18:22, 25:30].all()
    assert found.sum() < 10 * 12 + 4 * 5 + 10


@pytest.mark.parametrize("seed", range(8))
def test_a_window_about_the_object_and_back(seed):
    """A disk, in a window about it, as mask of all of the picture, and cut out in full size: it stays where it is."""
    random = np.random.default_rng(seed)
    size = 1603, 1201  # no multiples of the scales
    lens = Lens("PINHOLE", size, (1700.0, 1760.0, 770.0, 640.0))
    center, radius = random.uniform(300, 900, 2), random.uniform(150, 250)
    away = np.linalg.norm(np.stack(np.meshgrid(np.arange(1603) + 0.5, np.arange(1201) + 0.5), -1) - center, axis=-1)
    whole = cv2.resize((away < radius).astype(np.uint8)[:1200, :1600], (160, 120), interpolation=cv2.INTER_NEAREST)
    window = window_around(lens, whole, 100)
    scale = window.scale
    assert scale in (3, 4, 5) and window.width * scale < 4 * radius
    row = window.top + scale * (np.arange(window.height) + 0.5)
    column = window.left + scale * (np.arange(window.width) + 0.5)
    inside = np.hypot(column - center[0], row[:, None] - center[1]) < radius
    back = paste_mask(inside * np.uint8(OBJECT), lens, window)
    assert back.shape == (1201 // scale, 1603 // scale)
    cut = crop_mask(back, size, (100, 40, 1400, 1150)) > 127
    rows, columns = np.nonzero(cut)
    np.testing.assert_allclose([columns.mean() + 100.5, rows.mean() + 40.5], center, atol=0.4)
    assert cut.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    extent = mask_bounds(back, lens.size)
    np.testing.assert_allclose(extent, [center - radius, center + radius], atol=scale)


def test_the_plane_under_an_object():
    random = np.random.default_rng(2)
    turn = Rotation.from_euler("xyz", [30, -50, 20], degrees=True).as_matrix()
    sheet = np.c_[random.uniform(-5, 5, (400, 2)), random.normal(0, 0.01, 400)]
    object_ = np.abs(random.normal(size=(250, 3))) * [1, 1, 2]
    cameras = np.array([[8, 0, 9], [-3, 8, 7], [0, -9, 6.0]])
    points = np.concatenate([sheet, object_]) @ turn.T + CENTER
    plane = table_plane.find_plane(points, cameras @ turn.T + CENTER, CENTER, 4.0)
    np.testing.assert_allclose(plane.normal, turn[:, 2], atol=0.01)
    assert abs(plane.height(CENTER)) < 0.02
    assert table_plane.find_plane(random.normal(size=(300, 3)), cameras, np.zeros(3), 4.0) is None
    axes = plane.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)


def camera_and_image(number, pose, focal):
    colmap = pytest.importorskip("pycolmap")
    camera = colmap.Camera(model="SIMPLE_RADIAL", width=160, height=120, params=[focal, 80, 60, 0.0], camera_id=number)
    there = np.linalg.inv(pose)
    rigid = colmap.Rigid3d(colmap.Rotation3d(there[:3, :3]), there[:3, 3])
    return camera, SimpleNamespace(camera_id=number, cam_from_world=lambda: rigid)


def test_how_far_matches_are_from_what_two_cameras_say():
    """Nothing where they are projections of points; sideways by d from the line of the other: d, as is told of both."""
    (first, one), (second, two) = (camera_and_image(k, pose, 170.0) for k, pose in enumerate(list(poses(7))[:2]))
    model = SimpleNamespace(cameras={0: first, 1: second})
    points = CENTER + np.random.default_rng(1).normal(0, 2, (30, 3))
    seen = []
    for camera, image in ((first, one), (second, two)):
        local = points @ image.cam_from_world().matrix()[:, :3].T + image.cam_from_world().matrix()[:, 3]
        seen.append(camera.img_from_cam(local))
    np.testing.assert_allclose(structure_from_motion.sampson_distance(model, one, two, *seen), 0, atol=1e-9)
    centre = one.cam_from_world().inverse().matrix()[:, 3]
    local = two.cam_from_world().matrix()[:, :3] @ centre + two.cam_from_world().matrix()[:, 3]
    toward = seen[1] - (170 * local[:2] / local[2] + [80, 60])  # lines of the second picture meet in the first's camera
    aside = toward[:, ::-1] * [1, -1] / np.linalg.norm(toward, axis=1, keepdims=True)
    off = structure_from_motion.sampson_distance(model, one, two, seen[0], seen[1] + 1e-3 * aside)
    # Sampson's distance shares the error out among both pictures, whose lines are about equally steep.
    np.testing.assert_allclose(off, 1e-3 / np.sqrt(2), rtol=0.35)


def test_of_two_ways_of_putting_photographs_together_the_one_that_explains_more_is_taken(tmp_path, monkeypatch):
    def model(name, points):
        images = {k: SimpleNamespace(num_points3D=n, frame_id=k) for k, n in enumerate(points)}
        left = list(images)
        return SimpleNamespace(name=name, images=images, reg_image_ids=lambda: list(left), deregister_frame=left.remove)

    for counts, best, kept in (((50, 40), "together", [0, 1]), ((40, 50), "after", [0, 1, 2])):
        together, after = model("together", [90, 80, 12]), model("after", [90, 80, 70])
        monkeypatch.setattr(structure_from_motion, "map_globally", lambda *_, model=together: {0: model})
        monkeypatch.setattr(structure_from_motion, "map_incrementally", lambda *_, model=after: {0: model})
        found = {name: [structure_from_motion.ImagePair(0, 1, n, n), structure_from_motion.ImagePair(2, 1, 50, 45)]
                 for name, n in zip(("together", "after"), counts)}  # fmt: skip
        monkeypatch.setattr(structure_from_motion, "check_pairs", lambda model, _, found=found: found[model.name])
        taken = structure_from_motion.reconstruct(tmp_path, 3, None)
        assert taken.name == best and taken.reg_image_ids() == kept
    # What hangs on matches that do not fit is left out, and what it explains within itself does not count.
    together, after = model("together", [90] * 7), model("after", [90] * 7)
    monkeypatch.setattr(structure_from_motion, "map_globally", lambda *_: {0: together})
    monkeypatch.setattr(structure_from_motion, "map_incrementally", lambda *_: {0: after})
    whole = [structure_from_motion.ImagePair(k, k + 1, 100, 80) for k in range(6)]
    torn = [*(structure_from_motion.ImagePair(k, k + 1, 100, 90) for k in range(3)),
            structure_from_motion.ImagePair(3, 4, 100, 60),
            *(structure_from_motion.ImagePair(k, k + 1, 900, 890) for k in (4, 5)),
            structure_from_motion.ImagePair(0, 6, 14, 14)]  # fmt: skip
    # Of single ones nothing can be said.
    assert structure_from_motion.disconnected_images([9, 8, 0, 1, 2, 3, 4, 5, 6], torn) == [4, 5, 6]
    monkeypatch.setattr(structure_from_motion, "check_pairs", lambda model, _: whole if model is together else torn)
    assert structure_from_motion.reconstruct(tmp_path, 7, None) is together and after.reg_image_ids() == [0, 1, 2, 3]
    monkeypatch.setattr(structure_from_motion, "map_globally", lambda *_: {})
    monkeypatch.setattr(structure_from_motion, "map_incrementally", lambda *_: {})
    assert structure_from_motion.reconstruct(tmp_path, 3, None) is None


def test_a_motion_in_another_frame_shows_points_at_the_same_pixels():
    random = np.random.default_rng(4)
    points = CENTER + random.normal(size=(9, 3))
    cameras = {str(k): (LENS, pose) for k, pose in enumerate(poses(3))}
    motion = SparseModel(cameras, points, 0.3, {})
    turn = Rotation.from_euler("xyz", [10, 80, -40], degrees=True).as_matrix()
    moved = motion.moved(2.5, turn, np.array([1.0, -2, 3]))
    for name in cameras:
        local = (np.linalg.inv(m.cameras[name][1]) @ np.c_[m.points, np.ones(9)].T for m in (motion, moved))
        before, after = (LENS.colmap.img_from_cam(points[:3].T) for points in local)
        np.testing.assert_allclose(before, after, atol=1e-9)


def picture(path, pixels):
    Image.fromarray(pixels).save(path)
    return Picture(path)


def test_pictures_of_a_folder(tmp_path):
    random = np.random.default_rng(0)
    with pytest.raises(InputError, match="FOLDER: no such folder"):
        find_pictures(tmp_path / "none")
    for k in range(8):
        picture(tmp_path / f"{k}.JPG", random.integers(0, 255, (6, 9, 3), np.uint8))
    (tmp_path / "notes.txt").write_text("no photograph")
    (tmp_path / "3.dng").write_bytes(b"the raw one of the same shot")
    found = find_pictures(tmp_path)
    assert [p.path.name for p in found] == ["0.JPG", "1.JPG", "2.JPG", "3.dng", *(f"{k}.JPG" for k in range(4, 8))]
    assert found[0].size == (9, 6) and found[0].pixels.shape == (6, 9, 3)
    with pytest.raises(InputError, match=r"3.dng: cannot be read as photograph"):
        _ = found[3].pixels
    for k in range(4):
        (tmp_path / f"{k}.JPG").unlink()
    with pytest.raises(InputError, match=r"has 5 photographs .* at least 8 are needed"):
        find_pictures(tmp_path)


def test_grey_pictures_are_means_of_whole_blocks(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (13, 31, 3), np.uint8)
    grey = picture(tmp_path / "a.png", pixels).grey(10)
    assert grey.shape == (3, 7)
    weights = np.array([0.299, 0.587, 0.114])
    expected = (pixels[:12, :28] @ weights).reshape(3, 4, 7, 4).mean((1, 3))
    np.testing.assert_allclose(grey, expected, atol=1.5)


def shot(tmp_path, name, lens, pose, mask):
    pixels = np.random.default_rng(0).integers(60, 200, (lens.size[1], lens.size[0], 3), np.uint8)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 3)
    light = Light("point", pose[:3, 3], np.full(3, 2.0))
    return PosedPicture(picture(tmp_path / f"{name}.png", pixels), lens, pose, mask, light)


def test_crops_are_of_one_size_hold_the_object_and_see_the_same(tmp_path):
    """Of a lens with distortion: what a point of the object looks like is what the photograph has there."""
    lens = Lens("SIMPLE_RADIAL", (160, 120), (150.0, 77.0, 64.0, -0.15))
    shots = []
    for k, pose in enumerate(poses(4, away=24.0)):
        mask = np.zeros((60, 80), np.uint8)
        t, _ = hit_ellipsoid(Lens("PINHOLE", (80, 60), (75, 75, 38.5, 32)).camera(pose))
        mask.ravel()[np.isfinite(t)] = OBJECT
        mask[:6, :8] = UNKNOWN
        shots.append(shot(tmp_path, str(k), lens, pose, mask))
    cut = crop_windows([one.mask for one in shots], [one.lens.size for one in shots])
    assert len({(w.width, w.height) for w in cut}) == 1
    assert cut[0].width * cut[0].height < 0.6 * 160 * 120
    writer = Writer(tmp_path / "capture/scene.xml")
    try:
        for one, window in zip(shots, cut):
            element = write_posed_picture(writer, one, window)
            sensor = load_element(element)
            np.testing.assert_allclose(sensor.camera.position, one.pose[:3, 3], rtol=1e-5)
            rows, columns = np.nonzero(one.mask == OBJECT)
            extent = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]]) * 2
            assert (extent[0] >= [window.left, window.top]).all()
            assert (extent[1] <= [window.left + window.width, window.top + window.height]).all()
            local = np.array([0.05, -0.04, 1.0])  # a ray, in the camera's axes
            distorted = lens.colmap.img_from_cam(local[None])[0]
            camera = sensor.camera
            straight = camera.focal * local[:2] + camera.centre
            taken = np.array(Image.open(writer.staging / f"images/{one.picture.name}.png")).astype(float)
            there, here = (
                cv2.remap(pixels.astype(np.float32), *np.float32(place - 0.5)[:, None], cv2.INTER_LINEAR)
                for pixels, place in ((one.picture.pixels, distorted), (taken, straight))
            )
            np.testing.assert_allclose(here, there, atol=2.5)
            white = np.array(Image.open(writer.staging / f"masks/{one.picture.name}.png"))
            assert set(np.unique(white)) == {0, 255}
    finally:
        writer.close()


def test_a_reduced_photograph_has_a_camera_that_sees_the_same(tmp_path):
    lens = Lens("SIMPLE_RADIAL", (160, 120), (150.0, 77.0, 64.0, -0.15))
    pixels = np.zeros((120, 160, 3), np.uint8)
    local = np.array([0.2, -0.15, 1.0])
    column, row = lens.colmap.img_from_cam(local[None])[0]
    cv2.circle(pixels, (round((column - 0.5) * 16), round((row - 0.5) * 16)), 64, (255, 255, 255), -1, cv2.LINE_AA, 4)
    for window, shape in ((Window.whole(lens, 80), (60, 80, 3)), (Window(61, 17, 45, 38, 2), (38, 45, 3))):
        small = reduce_photograph(picture(tmp_path / "a.png", pixels), lens, np.eye(4), window)
        assert small.rgb.shape == shape
        weight = small.rgb.sum(-1).astype(float)
        y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
        found = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
        np.testing.assert_allclose(found, small.camera.focal * local[:2] + small.camera.centre, atol=0.1)


def quiet(things, *_):
    return things


def model_of(points, noise, focal=800.0, shift=(0, 0), count=14):
    """A `pycolmap.Reconstruction` of photographs 0.png …, whose principal point was `shift` off, and their lens."""
    pycolmap = pytest.importorskip("pycolmap")
    random, away = np.random.default_rng(0), focal / 125
    lenses = [pycolmap.Camera(model="SIMPLE_RADIAL", width=1000, height=700, params=[focal, cx, cy, 0.02], camera_id=1)
              for cx, cy in ((500, 350), np.array([500, 350]) + shift)]  # fmt: skip
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lenses[0])
    for k in range(count):
        turn = [random.normal(0, 20), 360 * k / count, random.uniform(-35, 35)]
        pose = np.c_[Rotation.from_euler("zyx", turn, degrees=True).as_matrix(), [0, 0, away]]
        seen = seen_by(lenses[1], pose, points) + random.normal(0, noise, (len(points), 2))
        features = pycolmap.Point2DList([pycolmap.Point2D(place) for place in seen])
        image = pycolmap.Image(name=f"{k}.png", camera_id=1, image_id=k + 1, points2D=features)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for n, point in enumerate(points):
        track = pycolmap.Track()
        for k in range(count):
            track.add_element(k + 1, n)
        model.add_point3D(point, track)
    return model, lenses[1]


def seen_by(lens, pose, points):
    """Pixels (n, 2) of points (n, 3) for a camera-from-world pose (3, 4)."""
    return lens.img_from_cam(points @ pose[:, :3].T + pose[:, 3])


@pytest.mark.parametrize(("focal", "told"), [(500.0, True), (8000.0, False)])
def test_principal_points_are_found_where_the_lens_tells_them(focal, told):
    model, _ = model_of(np.random.default_rng(1).normal(0, 1, (300, 3)), 0.3, focal, (7, -4))
    structure_from_motion.deregister(model, [3])
    pictures = [SimpleNamespace(name=str(k), path=Path(f"{k}.jpg"), size=(1000, 700)) for k in range(14)]
    (lens,) = bundle_adjustment.adjust(model, pictures, {}, quiet).cameras.values()
    np.testing.assert_allclose(lens.params[1:3], [507, 346] if told else [500, 350], atol=1.5 if told else 0.0)


@pytest.fixture(scope="module")
def by_features():
    return adjusted_by_corners(None)


def adjusted_by_corners(shift):
    """How far off points of the object are seen after bundle adjustment [px], by poor features; and the model.

    Photographs are twice as wide as what features were looked for in. The sheet is moved by `shift` in every second.
    """
    random = np.random.default_rng(2)
    points = random.normal(0, 1, (60, 3))
    pictures = [SimpleNamespace(name=str(k), path=Path(f"{k}.jpg"), size=(2000, 1400)) for k in range(14)]
    grid = np.stack([*np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 5)), np.zeros((5, 6))], -1).reshape(-1, 3)
    model, lens = model_of(points, 0.8 if not shift else 0.3)
    poses = {k: model.images[k + 1].cam_from_world().matrix() for k in range(14)}
    sightings = {}
    for k, pose in poses.items():
        seen = seen_by(lens, pose, grid + np.array([k % 2 * (shift or 0), 0, 0])) + random.normal(0, 0.05, (30, 2))
        sightings[str(k)] = SheetDetection(np.arange(30), 40 * grid, 2 * seen)
    model = bundle_adjustment.adjust(model, pictures, {} if shift is None else sightings, quiet)
    (found,) = model.cameras.values()
    shown = [seen_by(found, model.images[k + 1].cam_from_world().matrix(), points) for k in poses]
    return np.abs(shown - np.array([seen_by(lens, pose, points) for pose in poses.values()])).mean(), model


def test_corners_of_the_sheet_hold_cameras_whose_features_are_poor(by_features):
    off, model = adjusted_by_corners(0.0)
    assert off < 0.5 * by_features[0]
    assert model.num_points3D() <= 60  # not the corners
    before = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(before)


def test_a_sheet_that_was_moved_under_the_object_bends_no_camera():
    assert adjusted_by_corners(0.05)[0] < 0.3


def test_a_blurred_photograph_has_less_detail_though_it_has_the_same_noise(tmp_path):
    random = np.random.default_rng(0)
    sharp = cv2.resize(random.integers(0, 255, (60, 80), np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)
    for name, picture in (("sharp", sharp), ("blurred", cv2.blur(sharp, (31, 3)))):
        noisy = picture + random.normal(0, 3, sharp.shape)
        cv2.imwrite(str(tmp_path / f"{name}.png"), noisy.clip(0, 255).astype(np.uint8))
    sharp, blurred = (structure_from_motion.sharpness(tmp_path / f"{name}.png") for name in ("sharp", "blurred"))
    assert blurred < structure_from_motion.BLURRED * sharp


@pytest.mark.parametrize("damage", ["header alone", "not a database", "folder"])
def test_a_damaged_database_is_an_error_that_says_what_to_do(tmp_path, damage):
    database = tmp_path / "work" / "database.db"
    database.parent.mkdir()
    structure_from_motion.require_sound(database)  # there is none yet
    database.write_bytes(b"")
    structure_from_motion.require_sound(database)
    if damage == "folder":
        database.unlink()
        database.mkdir()
    else:
        head = b"SQLite format 3\0" if damage == "header alone" else b"none of COLMAP's"
        database.write_bytes(head + bytes(range(256)) * 40)
    with pytest.raises(
        InputError, match=r"work/database.db: (is damaged|cannot be read .*); remove it or all of .*work"
    ):
        structure_from_motion.require_sound(database)


def test_a_database_of_colmap_is_sound_unless_a_part_is_lost(tmp_path):
    pycolmap, database = pytest.importorskip("pycolmap"), tmp_path / "database.db"
    with pycolmap.Database.open(database) as opened:
        for k in range(2000):
            opened.write_camera(pycolmap.Camera.create_from_model_name(k + 1, "SIMPLE_RADIAL", 900, 800, 600), True)
    structure_from_motion.require_sound(database)
    content = database.read_bytes()
    database.write_bytes(content[: len(content) // 8192 * 4096])
    with pytest.raises(InputError, match="database.db: is damaged"):
        structure_from_motion.require_sound(database)


def test_a_damaged_model_is_an_error_that_says_what_to_do(tmp_path):
    pytest.importorskip("pycolmap")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match="is damaged; remove it and give the same command again"):
        structure_from_motion.read_model(tmp_path)
