"""Captures in an environment that the scene does not describe."""

import numpy as np

from mi_ring.images import write_image

TINY = {
    "levels": (3,), "widths": (32,), "shares": (1.0,), "iterations": 30, "subdivisions": 3, "domain": "sphere",
    "indirect": False,  # of a convex object there is none
}  # fmt: skip
TOWARD = np.array([0.48, 0.6, -0.64])  #: the brightest direction of `lobe`, a unit vector


def lobe(path):
    """An environment, brightest in one direction: 1 + 2 max(0, cos)."""
    rows = 32
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    polar, azimuth = np.pi * v, 2 * np.pi * u
    away = np.stack([np.sin(polar) * np.sin(azimuth), np.cos(polar), -np.sin(polar) * np.cos(azimuth)], -1)
    write_image((1 + 2 * np.maximum(away @ TOWARD, 0))[..., None].repeat(3, -1).astype(np.float32), path)
    return path
