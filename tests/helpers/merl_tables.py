"""Measured materials by a closed form, and networks of them."""

import numpy as np

from helpers import microfacets

SCALES = np.array([1, 1.15, 1.66]) / 1500


def closed_form(theta_h, theta_d, phi_d):
    """Smooth values (..., 3) whose period in φd is π."""
    lobe = np.exp(-((theta_h / 0.5) ** 2))
    return np.stack([0.1 + lobe, 0.2 + 0.5 * lobe * np.cos(theta_d) ** 2, 0.3 + 0.2 * np.cos(2 * phi_d)], -1)


def write(path, values):
    """Values (90, 90, 180, 3) [1/sr], NaN where none was measured, as the database has them."""
    raw = np.nan_to_num(values / SCALES, nan=-1.0)
    planes = np.zeros(3 * 90 * 90 * 180)
    h, d, p = np.meshgrid(np.arange(90), np.arange(90), np.arange(180), indexing="ij")
    index = p + d * 180 + h * 180 * 90
    for channel in range(3):
        planes[channel * 1_458_000 + index] = raw[..., channel]
    path.write_bytes(np.array([90, 90, 180], "<i4").tobytes() + planes.astype("<f8").tobytes())


def nodes():
    """Angles of the cells."""
    return np.meshgrid((np.arange(90) / 90) ** 2 * np.pi / 2, np.radians(np.arange(90)), np.radians(np.arange(180)),
                       indexing="ij")  # fmt: skip


def directions(count, seed, widest=75.0):
    """Unit vectors (count, 3) of the upper side."""
    rng = np.random.default_rng(seed)
    angle, azimuth = np.radians(rng.uniform(2, widest, count)), rng.uniform(-np.pi, np.pi, count)
    return np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], 1)


def evaluate(bsdf, wi, wo):
    """f · (n·wo) at pairs of directions (n, 3), to the viewer and to the light: (n, 3)."""
    return microfacets.evaluate(bsdf, wo, wi)


def networks(path, seed=0):
    rng = np.random.default_rng(seed)
    shapes = {"w1": (6, 21), "b1": (21,), "w2": (21, 21), "b2": (21,), "w3": (21, 3), "b3": (3,)}
    arrays = {name: rng.normal(0, 0.3, (2, *shape)).astype(np.float32) for name, shape in shapes.items()}
    np.savez(path, names=["one", "other"], **arrays)
    return {name: array[1] for name, array in arrays.items()}
