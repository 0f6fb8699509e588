"""The `room` emitter: the light of the room in which photographs were taken (Mitsuba plugin)."""

import math

import drjit as dr
import mitsuba as mi

from mi_ring.plugins.photograph import SHUTTER, Photograph
from mi_ring.plugins.properties import number_list
from mi_ring.rendering.photograph_lights import FAR
from mi_ring.rendering.spherical_harmonics import ORDER, in_camera


class Room(mi.Emitter):
    """Light from infinitely far away that varies slowly with direction, as spherical harmonics of order 4 at most.

    Fixed in the world; or in the camera, as is the room around a turntable.

    ============= ======= ============================================================================= =====
    Parameter     Type    Description                                                                   Flags
    ============= ======= ============================================================================= =====
    ``harmonics`` string  R, G, B of the radiance in each real harmonic, in the order of ``dr.sh_eval``   P, ∂
                          (l, m = 0, 0; 1, −1; 1, 0; … 2, 2; …): 3, 12, 27, 48 or 75 numbers. Exposed
                          as an array
    ``frame``     string  in which axes: ``world``, or ``camera``, those of the `photograph` being
                          rendered (black while another kind of sensor is). Default: ``world``
    ============= ======= ============================================================================= =====

    It lights every photograph, and is not seen itself: the background stays black. `mi_ring.fit` finds it
    (``--refine ambient``). A sum of few harmonics may be a little less than zero in some directions, and is left so.

    What it does not do: stock integrators sample its directions uniformly, which is noisy on glossy surfaces.

    .. tab-set-code::

        .. code-block:: xml

            <emitter type="room">
                <string name="harmonics" value="0.1 0.1 0.1 0 0 0 0.05 0.04 0.03 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/>
            </emitter>

        .. code-block:: python

            {"type": "room", "harmonics": "0.1 0.1 0.1  0 0 0  0.05 0.04 0.03" + 6 * "  0 0 0"}
    """

    of_rooms = True  #: to `mi_ring.rendering`, whatever the variant that this class belongs to

    def __init__(self, props):
        super().__init__(props)
        self.frame = props.get("frame", "world")
        if self.frame not in ("world", "camera"):
            raise ValueError(f'room "{props.id()}": frame is "{self.frame}", must be "world" or "camera"')
        self.harmonics = mi.Float(number_list(props, "harmonics", [3 * (order + 1) ** 2 for order in range(ORDER + 1)]))
        self.m_flags = mi.EmitterFlags.DeltaPosition  # lest a camera sees it

    def sample_direction(self, it, sample, active=True):
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = mi.warp.square_to_uniform_sphere(mi.Point2f(sample))
        ds.dist, ds.p = mi.Float(FAR), it.p + FAR * ds.d
        ds.pdf, ds.delta = mi.Float(dr.inv_four_pi), mi.Bool(True)
        direction = ds.d
        if self.frame == "camera":
            if Photograph.current is None:
                return ds, mi.Spectrum(0)
            active &= it.time == SHUTTER
            direction = in_camera(ds.d, Photograph.current.to_world.matrix)
        radiance = mi.Color3f(0)
        for j, value in enumerate(dr.sh_eval(direction, math.isqrt(dr.width(self.harmonics) // 3) - 1)):
            radiance += value * dr.gather(mi.Color3f, self.harmonics, j)
        return ds, dr.select(active, mi.Spectrum(radiance) * dr.four_pi, 0)

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(0)

    def bbox(self):
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback):
        callback.put("harmonics", self.harmonics, mi.ParamFlags.Differentiable)

    def to_string(self):
        return f"Room[frame={self.frame}]"


mi.register_emitter("room", Room)
