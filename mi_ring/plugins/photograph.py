"""The `photograph` sensor: a calibrated photograph and the light it was taken under (Mitsuba plugin)."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.geometry.camera import Camera, distortion_range
from mi_ring.plugins.properties import LARGEST, beside_scene, number, number_list
from mi_ring.rendering.pinhole import camera_ray

SHUTTER = -1.0  #: time of a photograph's rays, by which the flash knows them from those of other sensors (0 and later)
FARTHEST = 50  #: sizes of the film from which a principal point may be


class Photograph(mi.Sensor):
    """A calibrated photograph: pinhole camera, image, optional mask, and the light it was taken under.

    ================ ============ ====================================================================== =====
    Parameter        Type         Description                                                            Flags
    ================ ============ ====================================================================== =====
    ``filename``     string       image file, relative to the XML; read by the fit, never by an
                                  integrator
    ``mask``         string       mask file of the same size: 0 background, 255 object. If it is
                                  ``filename`` itself: its alpha channel. Default: none
    ``valid``        string       mask file of the same size: 0 where the photograph shows nothing, for
                                  instance beyond the border of a lens whose distortion was undone.
                                  Default: none, all of it shows something
    ``ambient``      string       image file of the same view without the photograph's own light, and
                                  as long exposed: is subtracted, so that this light alone is left.
                                  Default: none
    ``fx``, ``fy``   float        focal lengths [px]
    ``cx``, ``cy``   float        principal point [px]; the image spans [0, W] × [0, H], so that the
                                  centre of the first pixel is (0.5, 0.5). Default: the middle of the
                                  film
    ``distortion``   float        first radial one of the lens: what a pinhole would have at r focal     P, ∂
                                  lengths from the principal point is at r (1 + ``distortion`` r²), as
                                  COLMAP's SIMPLE_RADIAL and OpenCV's k1 have it. Default: 0
    ``to_world``     transform    camera-to-world, Mitsuba's axes: x left, y up, z forward; no scale.    P, ∂
                                  Default: the identity
    ``encoding``     string       ``srgb`` or ``linear``; linear data of 8 bits is refused. Default:
                                  ``srgb`` for 8-bit files, ``linear`` for 16-bit PNG/TIFF and EXR
    ``saturation``   float        pixels at or above it (encoded value, 1 = full scale) are clipped:
                                  they only say "at least this bright". Default: 1
    ``gamma``        float        exponent of the camera's curve: a pixel, decoded as ``encoding`` says,
                                  is radiance to this power. Default: 1
    ``contrast``     float        of the camera's curve: the encoding v of what ``gamma`` has made of
                                  radiance is recorded as vᶜ / (vᶜ + (1 − v)ᶜ). Default: 1, as it is
    ``vignetting``   float        how much darker the lens is toward the borders of the picture: like
                                  the cosine of the angle from the optical axis to this power.
                                  Default: 0, none
    ``gain``         string       how much of the radiance is recorded, by exposure and white balance: a
                                  factor, or one each for R, G, B. Default: 1
    ``falloff``      float        how much less a point light, taken to be a flash that looks where the  P, ∂
                                  camera looks, shines to the sides: like the cosine of the angle from
                                  that direction to this power. Default: 0, alike in all directions
    ``calibrated``   boolean      are camera and light exact? Then a fit leaves them alone unless told
                                  otherwise. Default: false
    (nested)         film         its size is the image's; exposed as ``film``                           P
    (nested)         emitter      ``point`` or ``directional``: the light of this photograph alone;      P, ∂
                                  exposed as ``light``. Default: a point light of intensity 1 at the
                                  camera centre
    ================ ============ ====================================================================== =====

    ================ ============ ====================================================================== =====
    Exposed          Type         Description                                                            Flags
    ================ ============ ====================================================================== =====
    ``focal``        point (2)    ``fx``, ``fy`` [px]                                                    P, ∂
    ``centre``       point (2)    ``cx``, ``cy`` [px]                                                    P, ∂
    ================ ============ ====================================================================== =====

    Every integrator sees the nested light while it renders this sensor, through the `flash` emitter that a `shapenet`
    shape carries. What it does not do: depth of field, other lens distortion, motion blur; light tracing integrators
    (``ptracer``) and the ``batch`` sensor cannot see the nested light.

    .. tab-set-code::

        .. code-block:: xml

            <sensor type="photograph" id="000">
              <string name="filename" value="images/000.png"/>
              <float name="fx" value="443.4"/> <float name="fy" value="443.4"/>
              <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
              <film type="hdrfilm">
                <integer name="width" value="512"/> <integer name="height" value="512"/>
              </film>
              <emitter type="point">
                <point name="position" x="0" y="0" z="5"/> <rgb name="intensity" value="25"/>
              </emitter>
            </sensor>

        .. code-block:: python

            {
                "type": "photograph", "filename": "images/000.png", "fx": 443.4, "fy": 443.4,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 512, "height": 512},
                "light": {"type": "point", "position": [0, 0, 5], "intensity": {"type": "rgb", "value": 25}},
            }
    """

    current = None  #: the photograph being rendered; `Flash` lights the scene with its light

    def __init__(self, props):
        super().__init__(props)
        for name in ("filename", "fx", "fy"):
            if name not in props:
                raise ValueError(f'photograph "{props.id()}": {name} is missing')
        self.filename = beside_scene(props["filename"])
        self.mask = beside_scene(props["mask"]) if "mask" in props else None
        self.valid = beside_scene(props["valid"]) if "valid" in props else None
        self.ambient = beside_scene(props["ambient"]) if "ambient" in props else None
        self.encoding = props.get("encoding", "auto")
        if self.encoding not in ("auto", "srgb", "linear"):
            raise ValueError(f'photograph "{props.id()}": encoding is "{self.encoding}", must be "srgb" or "linear"')
        self.saturation = number(props, "saturation", 1.0, positive=True)
        self.gamma = number(props, "gamma", 1.0, positive=True)
        self.contrast = number(props, "contrast", 1.0, positive=True)
        self.vignetting = number(props, "vignetting", 0.0)
        gain = number_list(props, "gain", (1, 3)) if "gain" in props else [1.0]
        if min(gain) < 1 / LARGEST:
            raise ValueError(f'photograph "{props.id()}": gain is "{props["gain"]}", must be above 0')
        self.gain = np.broadcast_to(gain, 3)
        self.falloff = mi.Float(number(props, "falloff", 0.0))
        self.calibrated = props.get("calibrated", False)

        width, height = (int(s) for s in self.film().size())
        self.focal = mi.Point2f(*(number(props, name, positive=True) for name in ("fx", "fy")))
        self.centre = mi.Point2f(number(props, "cx", width / 2), number(props, "cy", height / 2))
        if (far := np.abs(np.ravel(self.centre) / [width, height])).max() > FARTHEST:
            name = ("cx", "cy")[int(far.argmax())]
            raise ValueError(f'photograph "{props.id()}": {name} is {number(props, name):g}, which is more than '
                             f"{FARTHEST} times its film away; is it in pixels?")  # fmt: skip
        self.distortion = mi.Float(number(props, "distortion", 0.0))
        least, most = distortion_range(np.ravel(self.focal), np.ravel(self.centre), np.array([width, height]))
        if not least <= self.bend <= most:
            raise ValueError(f'photograph "{props.id()}": distortion is {self.bend:.6g}, must be within {least:.6g} '
                             f"and {most:.6g}: below, its corners would show what is elsewhere, too")  # fmt: skip
        matrix = np.array(props["to_world"].matrix) if "to_world" in props else np.eye(4)
        rotation = matrix[:3, :3]
        rigid = np.isfinite(matrix).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
        if not rigid or np.linalg.det(rotation) < 0:
            raise ValueError(
                f'photograph "{props.id()}": to_world must be a rotation and a translation, without scale or mirror'
            )
        self.to_world = mi.AffineTransform4f(mi.Matrix4f(matrix))

        lights = [value for _, value in props.objects() if isinstance(value, mi.Emitter)]
        if len(lights) > 1:
            raise ValueError(f'photograph "{props.id()}": {len(lights)} nested emitters, must be at most one')
        position = [float(v) for v in matrix[:3, 3]]
        self.light = lights[0] if lights else mi.load_dict({"type": "point", "position": position, "intensity": 1.0})
        if self.light.class_name() != "PointLight" and "falloff" in props:
            raise ValueError(
                f'photograph "{props.id()}": falloff is for point lights, not for {self.light.class_name()}'
            )
        dr.make_opaque(self.focal, self.centre, self.to_world, self.falloff, self.distortion)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]"""
        width, height = self.film().size()
        return int(width), int(height)

    @property
    def cone(self) -> float:
        """``falloff`` as a number."""
        return float(np.ravel(self.falloff)[0])

    @property
    def bend(self) -> float:
        """``distortion`` as a number."""
        return float(np.ravel(self.distortion)[0])

    @property
    def files(self) -> set[Path]:
        """All that it names, resolved."""
        return {file.resolve() for file in (self.filename, self.mask, self.valid, self.ambient) if file}

    @property
    def camera(self) -> Camera:
        """The camera as numpy arrays."""
        matrix = np.array(self.to_world.matrix).reshape(4, 4)
        return Camera(matrix, np.array(self.focal).ravel(), np.array(self.centre).ravel(), self.size, self.bend)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        Photograph.current = self
        film = self.film()
        pixel = sample2 * mi.ScalarVector2f(film.crop_size()) + mi.ScalarVector2f(film.crop_offset())
        lens = self.focal, self.centre, self.distortion
        origin, direction = camera_ray(self.to_world.matrix, *lens, pixel)
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        return mi.Ray3f(origin, direction, SHUTTER, wavelengths), weight

    def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def traverse(self, callback):
        super().traverse(callback)
        callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable)
        callback.put("focal", self.focal, mi.ParamFlags.Differentiable)
        callback.put("centre", self.centre, mi.ParamFlags.Differentiable)
        callback.put("distortion", self.distortion, mi.ParamFlags.Differentiable)
        callback.put("falloff", self.falloff, mi.ParamFlags.Differentiable)
        callback.put("light", self.light, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        super().parameters_changed(keys)
        # Dr.Jit gives literals, which are shared, the size of a call that reads them.
        dr.make_opaque(self.falloff, self.distortion)

    def to_string(self):
        return f"Photograph[filename={self.filename}, size={self.size}]"


mi.register_sensor("photograph", Photograph)
