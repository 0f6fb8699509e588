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
    if not on_rings(np.stack([shot.camera.to_world for shot in capture.shots])):
        return False
    moves = background_moves(capture)
    return None if moves is None else not moves


def on_rings(poses: np.ndarray) -> bool:
    """Test whether cameras may be one camera that stood still while the object turned about an axis.

    Then they are on rings about this axis, and each ring is one camera that is turned about it. Every ring has a camera
    of its own, which may have been moved before the next turn. `poses` (P, 4, 4) or (P, 3, 4): camera to world.
    """
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    axis = axis_of(turns)
    if axis is None:
        return False
    left = np.arange(len(poses))
    axes = turns.swapaxes(1, 2) @ axis  # in the axes of each camera
    beside = 0
    while len(left):
        ring = left[axes[left] @ axes[left[0]] > np.cos(np.radians(ALIKE))]
        left = np.setdiff1d(left, ring)
        beside += 0 if len(ring) >= FEWEST and is_ring(turns[ring], places[ring], axis) else len(ring)
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


def is_ring(turns: np.ndarray, places: np.ndarray, axis: np.ndarray) -> bool:
    """Test whether n cameras are one camera that is turned about an axis.

    `turns` (n, 3, 3), `places` (n, 3): camera to world. `axis` (3,): its direction.
    """
    # A point c of the axis is at the same place k in the axes of all cameras: c - R k = place.
    design = np.concatenate([np.concatenate([np.eye(3), -turn], 1) for turn in turns])
    solution = np.linalg.lstsq(design, places.ravel(), rcond=None)[0]
    wrong = np.linalg.norm((design @ solution).reshape(-1, 3) - places, axis=1)
    beside = places - solution[:3]
    away = np.linalg.norm(beside - (beside @ axis)[:, None] * axis, axis=1)
    return bool((wrong <= NEAR * away.mean()).all())
