"""Diffuse reflection of matte surfaces: of rough ones, of spherical harmonics, and of small lights."""

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.direct_light import MIN_COSINE

#: The rough diffuse term is divided by 1 + DARKER σ. Its mean albedo is (1 + MEAN σ) / (1 + DARKER σ) of Lambert's.
DARKER, MEAN = 1 / 2 - 2 / (3 * math.pi), 2 / 3 - 28 / (15 * math.pi)
COSINE_NODES, WIDTH_NODES = 257, 33  #: of `cosine_table`
COSINE_DEGREES = 512  #: degrees of the series in `cosine_table`: it has converged for lights between its nodes


def rough_lobe(cosine, sigma):
    """Compute the diffuse lobe of roughness `sigma` with π ρᵈ = 1, seen at this `cosine`, n·o. Returns three arrays.

    They are the integrals over all i of the lobe L (its albedo, from "EON", Portsmouth, Kutz and Hill 2024), and of L
    times two components of i: that along the surface on the viewer's side, divided by sin(n, o), and that along n.
    """
    mu = dr.maximum(cosine, MIN_COSINE)
    sine, angle = dr.safe_sqrt(1 - mu**2), dr.safe_acos(mu)
    albedo = sine * (angle - sine * mu) + 2 / 3 * (sine / mu * (1 - sine**3) - sine)
    aside = dr.pi / 2 * (1 - mu - (1 - mu**3) / 3 + (1 - sine**4) / (4 * mu) + 1 / 4)
    rest = dr.pi / 16 - angle / 8 + dr.sin(4 * angle) / 32
    along = 2 * sine * (sine**3 / 3 + rest / mu - dr.pi / 16)
    darker, back = 1 / (1 + DARKER * sigma), sigma / dr.pi
    return darker * (1 + back * albedo), darker * back * aside, darker * (2 / 3 + back * along)


def cosine_factors(order):
    """Compute the factors by which a diffuse surface with ρᵈ = 1 multiplies spherical harmonics of incident light.

    Returns a list of `order` + 1 numbers for the degrees 0 to `order`: the coefficients of the clamped cosine.
    """
    factors = [math.pi, 2 * math.pi / 3]
    for degree in range(2, order + 1):
        half = degree // 2
        central = math.comb(degree, half) / 2**degree
        sign = (-1) ** (half - 1)
        factors.append(0.0 if degree % 2 else 2 * math.pi * sign / ((degree + 2) * (degree - 1)) * central)
    return factors[: order + 1]


def mean_albedo(sigma):
    """Return the mean albedo over all viewing directions, relative to Lambert's, at a diffuse roughness `sigma`."""
    return (1 + MEAN * sigma) / (1 + DARKER * sigma)


def roughened(i, o, sigma):
    """Compute the factor of the diffuse reflectance by its roughness `sigma`, for light from `i`, seen from `o`."""
    beside = dr.dot(i, o) - i.z * o.z
    back = beside / dr.select(beside > 0, dr.maximum(i.z, o.z), 1)
    return (1 + sigma * back) / (1 + DARKER * sigma)


def zonal_coefficients(sharpness, order):
    """Compute the mean Legendre polynomials of a von Mises–Fisher distribution about its axis.

    `sharpness` (n,): κ of the density in proportion to exp(κ cos θ). `order`: at least 1. Returns (order + 1, n), for
    degrees 0 to `order`. They are ratios of modified spherical Bessel functions, by the recurrence downward, which is
    stable ("Handbook of Mathematical Functions", Abramowitz and Stegun 1964, 10.2.18).
    """
    k = np.maximum(np.asarray(sharpness, float), 1e-12)
    first = order + 16 + int(6 * np.sqrt(k.max()))  # the first ratio is a bound, whose error has gone after these steps
    ratio, ratios = k / (first + 1 + np.hypot(k, first + 2)), []
    for degree in range(first, 0, -1):
        ratio = 1 / ((2 * degree + 1) / k + ratio)
        ratios.append(ratio)
    return np.cumprod([np.ones_like(k), *reversed(ratios[-order:])], axis=0)


@functools.lru_cache(maxsize=4)
def cosine_table(variant):
    """Tabulate the irradiance by a lobe of unit flux. Returns a Dr.Jit texture over (width, (1 + cosine) / 2).

    The light is a von Mises–Fisher distribution of sharpness κ about a direction. The cosine is between this direction
    and the normal. The width is (1 + κ)^(−1/2), from 0, a directional light, to 1, light from all around. `variant`:
    Mitsuba's current variant, which only serves as a key of the cache.
    """
    cosine = np.linspace(-1, 1, COSINE_NODES)
    width = np.linspace(0, 1, WIDTH_NODES)[1:]
    shares = zonal_coefficients(1 / width**2 - 1, COSINE_DEGREES)
    factors = (2 * np.arange(COSINE_DEGREES + 1) + 1) / (4 * np.pi) * cosine_factors(COSINE_DEGREES)
    soft = np.polynomial.legendre.legval(cosine, factors[:, None] * shares).T  # (cosine, width)
    table = np.column_stack([np.maximum(cosine, 0), soft])
    return mi.Texture2f(mi.TensorXf(table[..., None].astype(np.float32)), use_accel=False, wrap_mode=dr.WrapMode.Clamp)


def softened_cosine(cosine, sharpness):
    """Compute the irradiance of a surface by a lobe of unit flux: the clamped cosine, convolved with the lobe.

    `cosine`: between the normal and the lobe's direction. `sharpness`: κ of the lobe. Attached to both.
    """
    at = dr.rsqrt(1 + sharpness), (1 + cosine) / 2
    nodes = WIDTH_NODES, COSINE_NODES
    where = mi.Point2f(*(x * (1 - 1 / n) + 0.5 / n for x, n in zip(at, nodes)))
    return cosine_table(mi.variant()).eval(where)[0]
