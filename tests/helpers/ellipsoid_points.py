"""The points of the small capture's ellipsoid that pixels show, by rays and normals in closed form."""

import numpy as np
from conftest import AXES, CENTER
from scipy.spatial.transform import Rotation


def ellipsoid_points(shot):
    """What the n pixels of a photograph show of the ellipsoid, row by row.

    Returns (whether it shows it (n,), vectors to the light (n, 3), and unit vectors (n, 3): normals, directions to the
    light and to the viewer).
    """
    turn = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
    width, height = shot.size
    v, u = np.mgrid[:height, :width] + 0.5
    rays = shot.camera.directions(np.stack([u.ravel(), v.ravel()], 1))
    start, along = (shot.camera.position - CENTER) @ turn / AXES, rays @ turn / AXES
    a, b, c = (along**2).sum(1), along @ start, start @ start - 1
    inside = b**2 > a * c
    away = (-b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    on_sphere = start + away[:, None] * along
    normals = on_sphere / AXES @ turn.T
    toward = shot.light.vector - (CENTER + (on_sphere * AXES) @ turn.T)
    n, i, o = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (normals, toward, -rays))
    return inside, toward, n, i, o
