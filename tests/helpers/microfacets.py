"""Equation 1 of the paper by hand, and directions at which BSDFs are tried."""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import erf

CONTEXT = mi.BSDFContext()


def direction(angle, azimuth):
    """Unit vector at `angle` from z, both in degrees."""
    angle, azimuth = np.radians([angle, azimuth])
    return np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])


# Walter et al. 2007; tan2 is the squared tangent of the angle to n.


def ggx_density(cos, tan2, r):  # equation 33
    return r**2 / (np.pi * cos**4 * (r**2 + tan2) ** 2)


def beckmann_density(cos, tan2, r):  # equation 25
    return np.exp(-tan2 / r**2) / (np.pi * r**2 * cos**4)


def ggx_masking(tan2, r):  # equation 34
    return 2 / (1 + np.sqrt(1 + r**2 * tan2))


def beckmann_masking(tan2, r):  # equation 26
    a = 1 / (r * np.sqrt(np.maximum(tan2, 1e-30)))
    return 2 / (1 + erf(a) + np.exp(-(a**2)) / (a * np.sqrt(np.pi)))


def beckmann_masking_fit(tan2, r):  # equation 27, which Mitsuba uses: within 0.35 % of equation 26
    a = 1 / (r * np.sqrt(np.maximum(tan2, 1e-30)))
    return np.where(a < 1.6, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2), 1)


TWINS = {
    "ggx": (ggx_density, ggx_masking),
    "beckmann": (beckmann_density, beckmann_masking_fit),
    "beckmann, exact": (beckmann_density, beckmann_masking),
}


def twin(i, o, diffuse, specular, r, distribution="ggx"):
    """Equation 1 times n·i, slow and obvious: (N, 3) for directions (N, 3) in the frame of n = z."""
    density, masking = TWINS[distribution]
    n = np.array([0.0, 0.0, 1.0])
    h = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)

    def tan2(a):
        return (a[:, 0] ** 2 + a[:, 1] ** 2) / (a @ n) ** 2

    d, g = np.pi * density(h @ n, tan2(h), r), masking(tan2(i), r) * masking(tan2(o), r)
    specular = specular * d * g / (np.pi * (i @ n) * (o @ n))
    return (np.array(diffuse) + specular[:, None]) * (i @ n)[:, None]


def directions(count, seed, lowest=0.05):
    """Unit vectors (N, 3) of the upper hemisphere with float32 components, none so grazing that digits are lost."""
    random = np.random.default_rng(seed)
    z, phi = random.uniform(lowest, 1, count), random.uniform(0, 2 * np.pi, count)
    i = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1)
    return i.astype(np.float32).astype(float)


def vectors(a):
    return mi.Vector3f(*a.T.astype(np.float32))


def interaction(o):
    """A surface interaction seen from `o` (N, 3) on the plane with normal z."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(o))
    si.wi = vectors(o)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    return si


def evaluate(bsdf, i, o):
    """BSDF · n·i as (N, 3)."""
    return np.array(bsdf.eval(CONTEXT, interaction(o), vectors(i))).T


def draw(bsdf, o, count, seed=1):
    """`count` samples of the BSDF seen from `o` (3,): (BSDFSample3f, weight)."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    return bsdf.sample(CONTEXT, interaction(np.repeat(o[None], count, 0)), sampler.next_1d(), sampler.next_2d())
