"""Renders the light of small lights of a room, which are lobes: reflected in closed form, with shadows by rays."""

from collections.abc import Collection
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.direct_light import light_visible
from mi_ring.rendering.photograph_lights import DISTANT
from mi_ring.rendering.spherical_harmonics import to_world_axes
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.lobes import Lobes

CANDIDATES = 3  #: directions of which one is tested for shadows


@dataclass(frozen=True)
class LobeLight:
    """The L lobes of a room's light as Dr.Jit buffers. Directions and sharpness may carry gradients."""

    toward: object  #: Float, 3 per lobe: unit vector toward the light, in the axes of the world or of the camera
    sharpness: object  #: Float
    flux: np.ndarray  #: (L, 3) [W/m²]
    in_camera: tuple[bool, ...]

    @classmethod
    def of(cls, lobes: Lobes | None) -> "LobeLight | None":
        """Make the buffers of lobes. None, for no lobes, stays None."""
        if lobes is None:
            return None
        buffers = (to_flat(mi.Float, value) for value in (lobes.toward, lobes.sharpness))
        return cls(*buffers, lobes.flux, tuple(lobes.in_camera.tolist()))

    def __len__(self) -> int:
        return len(self.flux)

    def lobe(self, j: int, to_world):
        """Return (direction in the world, sharpness) of lobe `j`. `to_world`: pose of the camera of each lane."""
        d = dr.gather(mi.Vector3f, self.toward, j)
        if self.in_camera[j]:
            d = to_world_axes(d, to_world)
        return d, dr.gather(mi.Float, self.sharpness, j)

    def reflected(self, scene, bsdfs: Collection, si, to_world, random, active=True) -> list:
        """Compute the radiance that surface interactions reflect to the viewer by each lobe, if its flux is 1.

        Returns a Color3f for each lobe. See `reflected_lobe`. `to_world`: pose of the camera of each lane.
        """
        result = []
        for j in range(len(self)):
            result.append(reflected_lobe(scene, bsdfs, si, *self.lobe(j, to_world), random, active))
        return result

    def bounced(self, scene, si, to_world, random, active) -> tuple:
        """Estimate the light of one random lobe that surface interactions reflect to the viewer.

        Returns (index of the lobe, radiance if its flux is 1, divided by the probability of the lobe), without
        gradients and for every BSDF.
        """
        pick, count = random(), len(self)
        j = dr.minimum(mi.UInt32(pick.x * count), count - 1)
        direction = dr.gather(mi.Vector3f, dr.detach(self.toward), j)
        in_camera = dr.gather(mi.Bool, mi.Bool(list(self.in_camera)), j)
        direction = dr.select(in_camera, to_world_axes(direction, to_world), direction)
        ds = at_distance(si, sample_lobe(direction, dr.gather(mi.Float, dr.detach(self.sharpness), j), random()))
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), active)
        lit = active & dr.any(value != 0)
        lit &= light_visible(scene, si, ds, lit)
        return j, dr.select(lit, value * count, 0)


def reflected_lobe(scene, bsdfs: Collection, si, direction, sharpness, random, active=True):
    """Compute the radiance (Color3f) that surface interactions reflect to the viewer by a lobe of unit flux.

    `bsdfs`: BSDFs with a method `reflected_lobe`, which computes the unblocked light in closed form; it carries
    gradients. This is multiplied by the visibility of one random direction of the lobe, without gradients. For other
    BSDFs, the light from this direction alone is computed. `random`: function that returns random points.
    """
    ds, visible = lobe_shadow(scene, si, direction, sharpness, random, active)
    known, value = mi.Bool(False), mi.Color3f(0)
    for bsdf in bsdfs:
        own = si.bsdf() == mi.BSDFPtr(bsdf)
        known |= own
        value += dr.select(own, bsdf.reflected_lobe(si, direction, sharpness, visible & own), 0)
    other = visible & ~known
    value += dr.select(other, si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), other), 0)
    return dr.select(visible, value, 0)


def lobe_shadow(scene, si, direction, sharpness, random, active):
    """Draw a direction of a lobe above the surface. Returns (DirectionSample3f, mask: is nothing in the way?).

    What the surface's own horizon hides is part of the closed form. Of several directions one is drawn in proportion to
    the irradiance ("Importance Resampling for Global Illumination", Talbot, Cline and Egbert 2005).
    """
    direction, sharpness, n = dr.detach(direction), dr.detach(sharpness), dr.detach(si.n)
    drawn, total = direction, mi.Float(0)
    for _ in range(CANDIDATES):
        candidate = sample_lobe(direction, sharpness, random())
        weight = dr.maximum(dr.dot(n, candidate), 0)
        total += weight
        drawn = dr.select(random().x * total < weight, candidate, drawn)
    ds = at_distance(si, drawn)
    return ds, active & light_visible(scene, si, ds, active)


def at_distance(si, direction):
    """Return a DirectionSample3f from surface interactions toward light that is infinitely far away."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.dist = direction, mi.Float(DISTANT)
    ds.p = dr.detach(si.p) + DISTANT * ds.d
    return ds


def sample_lobe(direction, sharpness, sample):
    """Draw a unit vector of a von Mises–Fisher distribution.

    `direction`: its mean direction. `sharpness`: κ. `sample`: random point (Point2f) in [0, 1)². See "Simulation of the
    von Mises Fisher distribution" (Wood 1994).
    """
    lower = dr.log(sample.x + (1 - sample.x) * dr.exp(-2 * sharpness)) / sharpness  # cos θ − 1
    lower = dr.clip(lower, -2, 0)
    sine, cosine = dr.sincos(dr.two_pi * sample.y)
    radius = dr.sqrt(-lower * (2 + lower))
    return dr.normalize(mi.Frame3f(direction).to_world(mi.Vector3f(radius * cosine, radius * sine, 1 + lower)))
