"""Microfacet distributions, and tables of how they reflect light that is given by spherical harmonics."""

import functools

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import MIN_COSINE

MIN_ROUGHNESS = 0.02  #: a highlight of less is too narrow for float32
DISTRIBUTIONS = {"ggx": "GGX", "beckmann": "Beckmann"}  #: names in Mitsuba
#: of `gloss_table`: nodes along each axis, and samples of each node along each axis
GLOSS_NODES, GLOSS_SAMPLES = 32, 32


def microfacets(distribution, r):
    """Make Mitsuba's microfacet distribution for roughness `r`. Its `eval` is D / π, its `G` is G.

    `distribution`: ``ggx`` or ``beckmann``.
    """
    return mi.MicrofacetDistribution(getattr(mi.MicrofacetType, DISTRIBUTIONS[distribution]), r, True)


@functools.lru_cache(maxsize=8)
def gloss_table(variant, distribution, order):
    """Tabulate the specular lobe for a specular reflectance of 1. Returns a Dr.Jit texture over (roughness, n·o).

    The roughness goes from 0.02 to 1, n·o from 0 to 1. n is the normal, o the direction to the viewer. Channels 0 and 1
    describe the mean direction of the lobe. Channel 0 is its component along the surface, opposite to o, divided by the
    component of o along the surface. Channel 1 is its component along n. Channel 2 + l is the integral of the lobe
    times the Legendre polynomial of degree l about the mean direction, for l from 0 to `order`. The integrals are means
    over a grid of visible normals.

    `variant`: Mitsuba's current variant, which only serves as a key of the cache. `distribution`: ``ggx`` or
    ``beckmann``.
    """
    with dr.suspend_grad():
        count = GLOSS_SAMPLES**2
        lane = dr.arange(mi.UInt32, GLOSS_NODES**2 * count)
        node, sample = lane // count, lane % count
        r = MIN_ROUGHNESS + mi.Float(node % GLOSS_NODES) / (GLOSS_NODES - 1) * (1 - MIN_ROUGHNESS)
        cosine = dr.clip(mi.Float(node // GLOSS_NODES) / (GLOSS_NODES - 1), MIN_COSINE, 1 - 1e-4)
        o = mi.Vector3f(dr.sqrt(1 - cosine**2), 0, cosine)
        facets = microfacets(distribution, r)
        h, _ = facets.sample(
            o,
            mi.Point2f((sample % GLOSS_SAMPLES + 0.5) / GLOSS_SAMPLES, (sample // GLOSS_SAMPLES + 0.5) / GLOSS_SAMPLES),
        )
        i = mi.reflect(o, h)
        weight = dr.select(i.z > 0, 4 * facets.G(i, o, mi.Normal3f(0, 0, 1)) / facets.smith_g1(o, h), 0)
        mean = [dr.block_sum(weight * part, count) for part in (i.x, i.z)]
        length = dr.rsqrt(mean[0] ** 2 + mean[1] ** 2)
        x, z = mean[0] * length, mean[1] * length
        toward = mi.Vector3f(dr.gather(mi.Float, x, node), 0, dr.gather(mi.Float, z, node))
        away = dr.gather(mi.Float, o.x, dr.arange(mi.UInt32, GLOSS_NODES**2) * count)
        polynomials = legendre(dr.dot(i, toward), order)
        channels = [-x / away, z, *(dr.block_sum(weight * p, count) / count for p in polynomials)]
        table = dr.zeros(mi.Float, GLOSS_NODES**2 * len(channels))
        for k, channel in enumerate(channels):
            dr.scatter(table, channel, dr.arange(mi.UInt32, GLOSS_NODES**2) * len(channels) + k)
        return mi.Texture2f(
            mi.TensorXf(table, (GLOSS_NODES, GLOSS_NODES, len(channels))), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )


def legendre(x, order):
    """Evaluate the Legendre polynomials at `x`. Returns a list of `order` + 1 values, for the degrees 0 to `order`."""
    found = [mi.Float(1), x]
    for n in range(1, order):
        found.append(((2 * n + 1) * x * found[n] - n * found[n - 1]) / (n + 1))
    return found[: order + 1]


def widened_roughness(r, sharpness, cosine, distribution):
    """Compute the roughness at which a directional light makes the same highlight as a lobe of light.

    `r`: roughness of the surface. `sharpness`: κ of the lobe. `cosine`: between viewer and half vector. A lobe is close
    to a Gaussian of variance 1 / κ along each axis. So its half vectors vary by s² = 1 / (4 κ o·h), which is the
    geometric mean of both axes. Beckmann's distribution is a Gaussian of slopes of variance r² / 2: r² grows by
    2 s². For GGX the roughness is chosen so that the peak of the convolution has the right height. It contains the
    exponential integral, here by the rational function in "Handbook of Mathematical Functions" (Abramowitz and Stegun
    1964, 5.1.54).
    """
    twice = 1 / (2 * sharpness * dr.maximum(cosine, MIN_COSINE))
    if distribution == "beckmann":
        return dr.sqrt(r * r + twice)
    a = r * r / twice
    return dr.sqrt(twice * (a * a + 3.330657 * a + 1.681534) / (a + 1.430913))
