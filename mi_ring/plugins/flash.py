"""The `flash` emitter: through it other integrators see a photograph's light (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi

from mi_ring.plugins.photograph import SHUTTER, Photograph
from mi_ring.rendering.photograph_lights import FAR, cone


def flash_light(it, sample=(0, 0), active=True):
    """The light at `it` of the photograph whose rays arrive there: (DirectionSample3f, radiance · d⁻²).

    Black where the rays of another kind of sensor arrive.
    """
    if Photograph.current is None:
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)
    light, falloff = Photograph.current.light, Photograph.current.falloff
    ds, weight = light.sample_direction(it, mi.Point2f(sample), active)
    if mi.has_flag(light.flags(), mi.EmitterFlags.Infinite):  # being nested, it was never told how large the scene is
        ds.dist = mi.Float(FAR)
        ds.p = it.p + FAR * ds.d
    else:
        weight = weight * cone(ds.d, Photograph.current.to_world.matrix, falloff)
    return ds, dr.select(it.time == SHUTTER, weight, 0)


class Flash(mi.Emitter):
    """The light of whichever `photograph` is being rendered; black while another kind of sensor is.

    Nested emitters light only their own photograph, so they are no emitters of the scene and stock integrators would
    see none. `shapenet` therefore carries this one, which hands every question on to the light of the current
    photograph. It has no parameters.

    Of use in itself only in a scene of `photograph` sensors without a `shapenet` shape:

    .. tab-set-code::

        .. code-block:: xml

            <emitter type="flash"/>

        .. code-block:: python

            {"type": "flash"}
    """

    of_photographs = True  #: to `mi_ring.rendering`, whatever the variant that this class belongs to

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.DeltaPosition

    def sample_direction(self, it, sample, active=True):
        return flash_light(it, sample, active)

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(0)

    def bbox(self):
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback):
        pass

    def to_string(self):
        return "Flash[]"


mi.register_emitter("flash", Flash)
