"""The `room` emitter: the light of the room in which photographs were taken (Mitsuba plugin)."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.plugins.flash import InvisibleEmitter
from mi_ring.plugins.photograph import SHUTTER, Photograph
from mi_ring.plugins.properties import number_list
from mi_ring.rendering.lobe_light import sample_lobe
from mi_ring.rendering.photograph_lights import DISTANT
from mi_ring.rendering.spherical_harmonics import MAX_ORDER, to_world_axes
from mi_ring.scene.lobes import LARGEST_SHARPNESS, LEAST_SHARPNESS, MOST_LOBES, solid_angle


class Room(InvisibleEmitter):
    """Light from infinitely far away: spherical harmonics up to order 4 of the direction, and lobes.

    A lobe is a small light, such as a window, a lamp or the sun. Its radiance in the direction w is
    c exp(κ (w·d − 1)), with a direction d, a sharpness κ and a colour c. κ = 4551 / a² makes it fall to one half at a°
    from d, for a below about 40°.

    The light is fixed in the world, or it is fixed to the camera. The second is the light of the room if the object
    turns on a turntable in front of a camera that stands still.

    ============= ======= ============================================================================= =====
    Parameter     Type    Description                                                                   Flags
    ============= ======= ============================================================================= =====
    ``harmonics`` string  radiance R, G, B of each real harmonic, in the order of ``dr.sh_eval``          P, ∂
                          (l, m = 0, 0; 1, −1; 1, 0; … 2, 2; …): 3, 12, 27, 48 or 75 numbers. Exposed
                          as an array
    ``lobes``     string  7 numbers of each lobe, up to 32: x, y, z of d, κ (0.1 to 100,000), R, G, B     P, ∂
                          of c, at least 0. Exposed as an array. Default: no lobes
    ``frame``     string  axes of harmonics and lobes: ``world``, or ``camera`` for those of the
                          rendered `photograph`; then black for other sensors. Default: ``world``
    ============= ======= ============================================================================= =====

    The emitter lights every photograph, but cameras do not see it: the background stays black. A fit with ``--refine
    ambient`` estimates it. The radiance may be a little below 0 in some directions, because the harmonics are few.

    Mitsuba's own integrators sample directions of lobes in proportion to their light, and uniform directions for the
    harmonics. What it does not do: sampling by BSDFs, so glossy surfaces are noisy.

    .. tab-set-code::

        .. code-block:: xml

            <emitter type="room">
                <string name="harmonics" value="0.1 0.1 0.1 0 0 0 0.05 0.04 0.03 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/>
            </emitter>

        .. code-block:: python

            {"type": "room", "harmonics": "0.1 0.1 0.1  0 0 0  0.05 0.04 0.03" + 6 * "  0 0 0"}
    """

    of_rooms = True  #: for `mi_ring.scene.lights.is_room`

    def __init__(self, props):
        super().__init__(props)
        self.frame = props.get("frame", "world")
        if self.frame not in ("world", "camera"):
            raise ValueError(f'room "{props.id()}": frame is "{self.frame}", must be "world" or "camera"')
        counts = [3 * (order + 1) ** 2 for order in range(MAX_ORDER + 1)]
        self.harmonics = mi.Float(number_list(props, "harmonics", counts))
        lobes = number_list(props, "lobes", range(0, 7 * MOST_LOBES + 1, 7)) if "lobes" in props else []
        for k, (*toward, sharpness, red, green, blue) in enumerate(np.reshape(lobes, (-1, 7)).tolist()):
            wrong = None
            if not any(toward):
                wrong = f"direction is {toward}, must not be 0"
            elif not LEAST_SHARPNESS <= sharpness <= LARGEST_SHARPNESS:
                wrong = f"sharpness is {sharpness:g}, must be {LEAST_SHARPNESS:g} to {LARGEST_SHARPNESS:g}"
            elif not min(red, green, blue) >= 0:
                wrong = f"colour is {[red, green, blue]}, must not be negative"
            if wrong:
                raise ValueError(f'room "{props.id()}": lobes: of lobe {k} the {wrong}')
        self.lobes = mi.Float(lobes)

    @property
    def count(self) -> int:
        """Number of lobes."""
        return dr.width(self.lobes) // 7

    def lobe(self, k):
        """Return (unit direction, sharpness, radiance at the centre) of lobe `k`, an integer or UInt32."""
        x, y, z, sharpness, *colour = (dr.gather(mi.Float, self.lobes, 7 * k + n) for n in range(7))
        return dr.normalize(mi.Vector3f(x, y, z)), sharpness, mi.Color3f(colour)

    def shares(self) -> np.ndarray:
        """Return the probabilities (1 + L,) with which a direction is drawn uniformly, or of each of L lobes."""
        lobes = np.array(dr.detach(self.lobes), float).reshape(-1, 7)
        even = np.linalg.norm(np.array(dr.detach(self.harmonics), float)) * math.sqrt(4 * math.pi / 3)
        light = np.array([even, *(lobes[:, 4:].mean(1) * solid_angle(lobes[:, 3]))])
        return (
            (light + 1e-3 * light.mean()) / (1.001 * light.sum())
            if light.any()
            else np.full(len(light), 1 / len(light))
        )

    def radiance(self, direction):
        """Compute the radiance (Color3f) from unit directions in the axes of this room."""
        radiance = mi.Color3f(0)
        for j, value in enumerate(dr.sh_eval(direction, math.isqrt(dr.width(self.harmonics) // 3) - 1)):
            radiance += value * dr.gather(mi.Color3f, self.harmonics, j)
        for k in range(self.count):
            toward, sharpness, colour = self.lobe(k)
            radiance += colour * dr.exp(sharpness * (dr.dot(direction, toward) - 1))
        return radiance

    def sample_own(self, sample):
        """Draw a direction in the axes of this room. Returns (unit vector, density [1/sr]), without gradients."""
        shares = self.shares()
        ends = np.cumsum(shares)
        direction = mi.warp.square_to_uniform_sphere(mi.Point2f(sample.x / float(ends[0]), sample.y))
        for k in range(self.count):
            toward, sharpness, _ = (dr.detach(part) for part in self.lobe(k))
            inside = dr.clip((sample.x - float(ends[k])) / float(shares[k + 1]), 0, dr.one_minus_epsilon(mi.Float))
            drawn = sample_lobe(toward, sharpness, mi.Point2f(inside, sample.y))
            direction = dr.select(sample.x >= float(ends[k]), drawn, direction)
        density = mi.Float(float(shares[0]) * dr.inv_four_pi)
        for k in range(self.count):
            toward, sharpness, _ = (dr.detach(part) for part in self.lobe(k))
            whole = -dr.two_pi * (dr.exp(-2 * sharpness) - 1) / sharpness
            density += float(shares[k + 1]) * dr.exp(sharpness * (dr.dot(direction, toward) - 1)) / whole
        return direction, density

    def sample_direction(self, it, sample, active=True):
        ds = dr.zeros(mi.DirectionSample3f)
        direction, density = self.sample_own(mi.Point2f(sample))
        ds.d, ds.dist = direction, mi.Float(DISTANT)
        ds.pdf, ds.delta = density, mi.Bool(True)
        if self.frame == "camera":
            if Photograph.current is None:
                return ds, mi.Spectrum(0)
            active &= it.time == SHUTTER
            ds.d = to_world_axes(direction, Photograph.current.to_world.matrix)
        ds.p = it.p + DISTANT * ds.d
        return ds, dr.select(active, mi.Spectrum(self.radiance(direction) / density), 0)

    def traverse(self, callback):
        callback.put("harmonics", self.harmonics, mi.ParamFlags.Differentiable)
        callback.put("lobes", self.lobes, mi.ParamFlags.Differentiable)

    def to_string(self):
        return f"Room[frame={self.frame}, lobes={self.count}]"


mi.register_emitter("room", Room)
