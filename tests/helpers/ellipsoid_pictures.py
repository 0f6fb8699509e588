"""Pictures of an ellipsoid by hand-held cameras, by formulas."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.importers.camera_models import Lens
from mi_ring.photogrammetry.reduced_photographs import (
    ReducedView,
)

CENTER, AXES = np.array([40.0, -15.0, 9.0]), np.array([3.0, 2.0, 2.4])  #: of an ellipsoid
LENS = Lens("PINHOLE", (160, 120), (170.0, 176.0, 77.0, 64.0))


def pose_at(position, target, roll=0.0):
    """Camera-to-world (4, 4), OpenCV's axes, z up but for the roll [deg]."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    pose[:3, 3] = position
    return pose


def poses(count, seed=0, lowest=15, highest=65, away=18.0):
    """Hand-held all around."""
    random = np.random.default_rng(seed)
    for k in range(count):
        turn, tilt = 2 * np.pi * k / count, np.radians(random.uniform(lowest, highest))
        d = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
        position, target = CENTER + random.uniform(0.9, 1.1) * away * d, CENTER + random.uniform(-0.6, 0.6, 3)
        yield pose_at(position, target, random.uniform(-9, 9))


def rays_of(camera):
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    return camera.directions(pixels)


def hit_ellipsoid(camera):
    """Distance along the rays of all pixels (H·W,), infinite where they miss, and cosines."""
    d, o = rays_of(camera) / AXES, (camera.position - CENTER) / AXES
    a, b, c = (d * d).sum(1), d @ o, o @ o - 1
    inside = b * b - a * c
    t = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
    normal = (o + np.where(np.isfinite(t), t, 0)[:, None] * d) / AXES
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return t, -(normal * rays_of(camera)).sum(1)


def view(name, pose, rgb):
    camera = LENS.camera(pose)
    height, width = LENS.size[::-1]
    return ReducedView(name, rgb.reshape(height, width, 3).astype(np.uint8), np.ones((height, width), bool), camera)


def in_a_dim_room(pose, random):
    """The ellipsoid lit by a flash, a lamp in the background somewhere, noise; and its mask."""
    camera = LENS.camera(pose)
    t, cosine = hit_ellipsoid(camera)
    object_ = np.isfinite(t)
    shade = np.where(object_, 60 + 150 * np.clip(cosine, 0, 1), 22)[:, None] * np.array([1.0, 0.9, 0.7])
    rgb = (shade + random.normal(0, 3, shade.shape)).reshape(*LENS.size[::-1], 3)
    x, y = random.integers(10, 150), random.integers(10, 110)
    lamp = np.zeros(rgb.shape[:2], np.uint8)
    cv2.circle(lamp, (int(x), int(y)), 6, 1, -1)
    rgb[(lamp > 0) & ~object_.reshape(lamp.shape)] = 250
    return rgb.clip(0, 255), object_.reshape(lamp.shape)
