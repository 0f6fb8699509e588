"""The `flash` emitter: with it, Mitsuba's integrators find the light of a photograph (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi

from mi_ring.plugins.photograph import SHUTTER, Photograph
from mi_ring.rendering.photograph_lights import DISTANT, flash_falloff


def flash_light(it, sample=(0, 0), active=True):
    """Sample the light that belongs to the photograph that is being rendered, at the interactions `it`.

    `sample`: two random numbers, which a point light or a directional light does not need. Returns (Mitsuba's
    DirectionSample3f, intensity / d² of a point light or irradiance of a directional light). The second is 0 if the
    sensor that is being rendered is not a `photograph`.
    """
    if Photograph.current is None:
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)
    light, cone = Photograph.current.light, Photograph.current.cone
    ds, weight = light.sample_direction(it, mi.Point2f(sample), active)
    if mi.has_flag(light.flags(), mi.EmitterFlags.Infinite):  # a nested emitter does not know the size of the scene
        ds.dist = mi.Float(DISTANT)
        ds.p = it.p + DISTANT * ds.d
    else:
        weight = weight * flash_falloff(ds.d, Photograph.current.to_world.matrix, cone)
    return ds, dr.select(it.time == SHUTTER, weight, 0)


class InvisibleEmitter(mi.Emitter):
    """Base class of emitters that light surfaces but are invisible to rays."""

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.DeltaPosition

    def eval(self, si, active=True):
        return mi.Spectrum(0)

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(0)

    def eval_direction(self, it, ds, active=True):
        return mi.Spectrum(0)

    def bbox(self):
        return mi.ScalarBoundingBox3f()


class Flash(InvisibleEmitter):
    """Lights the scene with the own light of the `photograph` that is being rendered; with other sensors, it is black.

    The emitter nested in a `photograph` lights only this photograph. It is not an emitter of the scene, so Mitsuba's
    own integrators do not find it. `flash` is an emitter of the scene. It passes every call on to the light of the
    photograph that is being rendered. It has no parameters. Each `shapenet` shape contains a `flash`.

    You need to write it only in a scene of `photograph` sensors without a `shapenet` shape:

    .. tab-set-code::

        .. code-block:: xml

            <emitter type="flash"/>

        .. code-block:: python

            {"type": "flash"}
    """

    of_photographs = True  #: for `mi_ring.scene.lights.is_flash`

    def sample_direction(self, it, sample, active=True):
        return flash_light(it, sample, active)

    def traverse(self, callback):
        pass

    def to_string(self):
        return "Flash[]"


mi.register_emitter("flash", Flash)
