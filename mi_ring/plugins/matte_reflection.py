"""Diffuse reflection of rough matte surfaces, as a lobe for light that is given by spherical harmonics."""

import math

import drjit as dr

from mi_ring.rendering.direct_light import MIN_COSINE

#: The rough diffuse term is divided by 1 + DARKER σ. Its mean albedo is (1 + MEAN σ) / (1 + DARKER σ) of Lambert's.
DARKER, MEAN = 1 / 2 - 2 / (3 * math.pi), 2 / 3 - 28 / (15 * math.pi)


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
