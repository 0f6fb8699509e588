"""The `room` emitter: the light of the room in which photographs were taken (Mitsuba plugin)."""

import math

import drjit as dr
import mitsuba as mi

from mi_ring.plugins.flash import InvisibleEmitter
from mi_ring.plugins.photograph import SHUTTER, Photograph
from mi_ring.plugins.properties import number_list
from mi_ring.rendering.photograph_lights import DISTANT
from mi_ring.rendering.spherical_harmonics import MAX_ORDER, to_camera_axes


class Room(InvisibleEmitter):
    """Light from infinitely far away, as spherical harmonics up to order 4 of the direction.

    The light is fixed in the world, or it is fixed to the camera. The second is the light of the room if the object
    turns on a turntable in front of a camera that stands still.

    ============= ======= ============================================================================= =====
    Parameter     Type    Description                                                                   Flags
    ============= ======= ============================================================================= =====
    ``harmonics`` string  radiance R, G, B of each real harmonic, in the order of ``dr.sh_eval``          P, ∂
                          (l, m = 0, 0; 1, −1; 1, 0; … 2, 2; …): 3, 12, 27, 48 or 75 numbers. Exposed
                          as an array
    ``frame``     string  axes of the harmonics: ``world``, or ``camera`` for those of the rendered
                          `photograph`; then black for other kinds of sensors. Default: ``world``
    ============= ======= ============================================================================= =====

    The emitter lights every photograph, but cameras do not see it: the background stays black. A fit with ``--refine
    ambient`` estimates it. The radiance may be a little below 0 in some directions, because the harmonics are few.

    What it does not do: importance sampling. Mitsuba's own integrators sample its directions uniformly, so glossy
    surfaces are noisy.

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

    def sample_direction(self, it, sample, active=True):
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = mi.warp.square_to_uniform_sphere(mi.Point2f(sample))
        ds.dist, ds.p = mi.Float(DISTANT), it.p + DISTANT * ds.d
        ds.pdf, ds.delta = mi.Float(dr.inv_four_pi), mi.Bool(True)
        direction = ds.d
        if self.frame == "camera":
            if Photograph.current is None:
                return ds, mi.Spectrum(0)
            active &= it.time == SHUTTER
            direction = to_camera_axes(ds.d, Photograph.current.to_world.matrix)
        radiance = mi.Color3f(0)
        for j, value in enumerate(dr.sh_eval(direction, math.isqrt(dr.width(self.harmonics) // 3) - 1)):
            radiance += value * dr.gather(mi.Color3f, self.harmonics, j)
        return ds, dr.select(active, mi.Spectrum(radiance) * dr.four_pi, 0)

    def traverse(self, callback):
        callback.put("harmonics", self.harmonics, mi.ParamFlags.Differentiable)

    def to_string(self):
        return f"Room[frame={self.frame}]"


mi.register_emitter("room", Room)
