"""Silhouettes of bodies, by formulas."""

import numpy as np
from scipy.spatial.transform import Rotation

from mi_ring.geometry.camera import Camera
from mi_ring.geometry.hull import Silhouette

CENTER = np.array([12.0, -40.0, 7.0])
W, H, FOCAL, CENTRE = 120, 90, np.array([130.0, 140.0]), np.array([57.0, 48.0])


def cameras(count, distance=20.0):
    """Camera-to-world matrices, Mitsuba's axes, of cameras about CENTER that do not quite look at it."""
    for R in Rotation.random(count, rng=np.random.default_rng(4)).as_matrix():
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R, CENTER - distance * R[:, 2] + [0.3, -0.2, 0.1]
        yield matrix


def silhouettes(hit, count=24, scale=1, distortion=0.0):
    """Masks of a body: `hit(origin, directions)` says which rays meet it. `scale`: so many times as many pixels."""
    y, x = np.mgrid[: scale * H, : scale * W] + 0.5
    pixels, lens = np.stack([x.ravel(), y.ravel()], 1), (scale * FOCAL, scale * CENTRE, (scale * W, scale * H))
    for k, matrix in enumerate(cameras(count)):
        camera = Camera(matrix, *lens, distortion)
        mask = hit(camera.position, camera.directions(pixels)).reshape(x.shape)
        yield Silhouette(np.where(mask, 255, 0).astype(np.uint8), camera, f"mask {k}")


def ball(radius, at=CENTER):
    def hit(origin, rays):
        to_center = at - origin
        return np.linalg.norm(np.cross(rays, to_center), axis=1) < radius

    return hit
