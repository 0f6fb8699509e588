"""Tells from cameras and backgrounds whether an object turned on a turntable in front of a camera that stood still."""

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.capture.background import background_moves
from mi_ring.capture.capture import Capture

ALIKE = 0.5  #: largest angle between directions that are the same [degrees]
NEAR = 0.01  #: largest distance between places that are the same [distance from the axis]
PAIRS = 400  #: of cameras, whose rotations show the axis
TURNED = 5.0, 175.0  #: least and largest rotation of such a pair [degrees]
FEWEST = 4  #: cameras of a ring
MOST_BESIDE = 0.1  #: largest share of cameras that are on no ring


def object_turned(capture: Capture) -> bool | None:
    """Tell whether the object turned while the camera stood still. None: neither cameras nor backgrounds tell it."""
    rings = on_rings(np.stack([shot.camera.to_world for shot in capture.shots]))
    if not rings:
        return rings
    moves = background_moves(capture)
    return None if moves is None else not moves


def on_rings(poses: np.ndarray) -> bool | None:
    """Tell whether cameras may be one camera that stood still while the object turned about an axis.

    Then they are on rings about this axis, and each ring is one camera that is turned about it. Every ring has a camera
    of its own, which may have been moved before the next turn. `poses` (P, 4, 4) or (P, 3, 4): camera to world.

    Returns None if all cameras look the same way from one place, which tells nothing.
    """
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    axis = axis_of(turns)
    if axis is None:
        return None if np.ptp(places, axis=0).max() == 0 else False
    left = np.arange(len(poses))
    axes = turns.swapaxes(1, 2) @ axis  # in the axes of each camera
    beside = 0
    while len(left):
        ring = left[axes[left] @ axes[left[0]] > np.cos(np.radians(ALIKE))]
        left = np.setdiff1d(left, ring)
        beside += beside_ring(turns[ring], places[ring], axis) if len(ring) >= FEWEST else len(ring)
    return beside <= MOST_BESIDE * len(poses)


def axis_of(turns: np.ndarray) -> np.ndarray | None:
    """Find the axis (3,) that most rotations from one camera to another have. None: no two cameras are turned enough.

    `turns` (P, 3, 3): camera to world.
    """
    random = np.random.default_rng(0)
    first, second = np.triu_indices(len(turns), 1)
    chosen = random.permutation(len(first))[:PAIRS]
    between = Rotation.from_matrix(turns[second[chosen]] @ turns[first[chosen]].swapaxes(1, 2)).as_rotvec()
    angles = np.linalg.norm(between, axis=1)
    large = (angles > np.radians(TURNED[0])) & (angles < np.radians(TURNED[1]))
    if not large.any():
        return None
    axes = between[large] / angles[large, None]
    agree = np.abs(axes @ axes.T) > np.cos(np.radians(ALIKE))
    most = axes[agree[agree.sum(1).argmax()]]
    return np.linalg.svd(most)[2][0]


def beside_ring(turns: np.ndarray, places: np.ndarray, axis: np.ndarray) -> int:
    """Count how many of n cameras are not where one camera is that is turned about an axis.

    `turns` (n, 3, 3), `places` (n, 3): camera to world. `axis` (3,): its direction.
    """
    # A point c of the axis is at the same place k in the axes of all cameras: c - R k = place.
    design = np.stack([np.concatenate([np.eye(3), -turn], 1) for turn in turns])
    wrong = np.zeros(len(turns))
    for _ in range(2):  # the second time without the worst
        good = wrong <= np.quantile(wrong, 1 - MOST_BESIDE)
        solution = np.linalg.lstsq(design[good].reshape(-1, 6), places[good].ravel(), rcond=None)[0]
        wrong = np.linalg.norm(design @ solution - places, axis=1)
    beside = places - solution[:3]
    away = np.linalg.norm(beside - (beside @ axis)[:, None] * axis, axis=1)
    return int((wrong > NEAR * away.mean()).sum())
