"""The `photograph` sensor: a calibrated photograph and the light it was taken under (Mitsuba plugin)."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import SceneError
from mi_ring.geometry.camera import Camera
from mi_ring.plugins.properties import LARGEST, beside_scene, number, number_list
from mi_ring.rendering.pinhole import Pinhole
from mi_ring.scene.lights import LAMP_CLASSES, light_of
from mi_ring.scene.shot import Files, Response, Shot
from mi_ring.scene.tone_curve import ToneCurve

#: Time of a photograph's rays. Other sensors have times of 0 and later: by the time the flash tells them apart.
SHUTTER = -1.0
STEEPEST = 50  #: tilt of a flash: exp of much more is infinite in float32


class Photograph(mi.Sensor):
    """A calibrated photograph: pinhole camera, image, optional mask, and the light it was taken under.

    ================ ============ ====================================================================== =====
    Parameter        Type         Description                                                            Flags
    ================ ============ ====================================================================== =====
    ``filename``     string       image file, relative to the XML. A fit reads it, integrators never do
    ``mask``         string       mask file of the same size: 0 background, 255 object. If it is
                                  ``filename`` itself, its alpha channel is the mask. Default: none
    ``valid``        string       mask file of the same size: 0 where the photograph shows nothing, for
                                  instance beyond the border of a lens whose distortion was undone.
                                  Default: none, all of it shows something
    ``ambient``      string       image file of the same view and the same exposure, without the
                                  photograph's own light. A fit subtracts it. Default: none
    ``fx``, ``fy``   float        focal lengths [px]
    ``cx``, ``cy``   float        principal point [px]. The image spans [0, W] × [0, H]: the centre of
                                  the first pixel is (0.5, 0.5). Default: the middle of the film
    ``distortion``   float        first radial coefficient k of the lens: a point that a pinhole has     P, ∂
                                  r focal lengths from the principal point is r (1 + k r²) from it.
                                  The same as k of COLMAP's SIMPLE_RADIAL and k1 of OpenCV. Default: 0
    ``to_world``     transform    camera-to-world, Mitsuba's axes: x left, y up, z forward; no scale.    P, ∂
                                  Default: the identity
    ``encoding``     string       ``srgb`` or ``linear``; linear data of 8 bits is refused. Default:
                                  ``srgb`` for 8-bit files, ``linear`` for 16-bit PNG/TIFF and EXR
    ``saturation``   float        encoded value (1 = full scale) from which a pixel is clipped. A
                                  clipped pixel only says "at least this bright". Default: 1; of 8-bit
                                  files, values just below 1 to which lossy coding moves clipped pixels
                                  count, too
    ``gamma``        float        exponent of the camera's curve: a pixel, decoded by ``encoding``, is
                                  radiance to this power. Default: 1
    ``contrast``     float        exponent c of the camera's S-curve: after ``gamma``, an sRGB value v
                                  is recorded as vᶜ / (vᶜ + (eᵗ (1 − v))ᶜ). Default: 1
    ``toe``          float        t of it: above 0, the dark end of the curve is longer. Default: 0
    ``vignetting``   float        exponent of the lens' vignetting: a pixel records radiance times the
                                  cosine between its ray and the optical axis to this power.
                                  Default: 0, none
    ``gain``         string       factor of the recorded radiance, by exposure and white balance: one
                                  number, or one each for R, G, B. Default: 1
    ``falloff``      float        exponent of the flash's cone: a point light shines in a direction by   P, ∂
                                  its intensity times the cosine between this direction and where the
                                  camera looks, to this power. Default: 0, the same in all directions
    ``tilt``         string       two numbers a and b: the flash is brighter to one side. A point        P, ∂
                                  light's intensity is multiplied by exp(a x + b y); x and y are the
                                  components of the unit direction from the light, to the camera's
                                  left and up. Default: 0 0
    ``calibrated``   boolean      true: camera and light are exact, so a fit does not refine them unless
                                  its options say so. Default: false
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

    A `shapenet` shape contains a `flash` emitter. Through it, every integrator that renders this sensor uses the nested
    light.

    What it does not do: depth of field, other lens distortion, motion blur. Integrators that trace light
    (``ptracer``) and the ``batch`` sensor cannot use the nested light.

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
        what = f'photograph "{props.id()}"'
        for name in ("filename", "fx", "fy"):
            if name not in props:
                raise ValueError(f"{what}: {name} is missing")
        self.files = Files(*(beside_scene(props[name]) if name in props else None for name in Files._fields))
        self.encoding = props.get("encoding", "auto")
        if self.encoding not in ("auto", "srgb", "linear"):
            raise ValueError(f'{what}: encoding is "{self.encoding}", must be "srgb" or "linear"')
        self.saturation = number(props, "saturation", 1.0, positive=True)
        gamma, contrast = (number(props, name, 1.0, positive=True) for name in ("gamma", "contrast"))
        curve = ToneCurve(gamma, contrast, number(props, "toe", 0.0))
        vignetting = number(props, "vignetting", 0.0)
        gain = number_list(props, "gain", (1, 3)) if "gain" in props else [1.0]
        if min(gain) < 1 / LARGEST:
            raise ValueError(f'{what}: gain is "{props["gain"]}", must be above 0')
        self.response = Response(curve, vignetting, tuple(np.broadcast_to(gain, 3).tolist()))
        self.falloff = mi.Float(number(props, "falloff", 0.0))
        tilt = number_list(props, "tilt", (2,)) if "tilt" in props else (0.0, 0.0)
        if max(map(abs, tilt)) > STEEPEST:
            raise ValueError(f'{what}: tilt is "{props["tilt"]}", must be from -{STEEPEST} to {STEEPEST}')
        self.tilt = mi.Point2f(*tilt)
        self.calibrated = props.get("calibrated", False)

        width, height = (int(s) for s in self.film().size())
        self.focal = mi.Point2f(*(number(props, name, positive=True) for name in ("fx", "fy")))
        self.centre = mi.Point2f(number(props, "cx", width / 2), number(props, "cy", height / 2))
        self.distortion = mi.Float(number(props, "distortion", 0.0))
        matrix = np.array(props["to_world"].matrix) if "to_world" in props else np.eye(4)
        self.to_world = mi.AffineTransform4f(mi.Matrix4f(matrix))
        if fault := self.camera.fault():
            raise ValueError(f"{what}: {fault}")

        lights = [value for _, value in props.objects() if isinstance(value, mi.Emitter)]
        if len(lights) > 1:
            raise ValueError(f"{what}: {len(lights)} nested emitters, must be at most one")
        position = [float(v) for v in matrix[:3, 3]]
        self.light = lights[0] if lights else mi.load_dict({"type": "point", "position": position, "intensity": 1.0})
        for name in ("falloff", "tilt"):
            if self.light.class_name() != "PointLight" and name in props:
                raise ValueError(f"{what}: {name} is for point lights, not for {self.light.class_name()}")
        dr.make_opaque(self.focal, self.centre, self.to_world, self.falloff, self.tilt, self.distortion)

    @property
    def camera(self) -> Camera:
        """The camera as NumPy values, read from the current parameters of the plugin."""
        matrix, distortion = np.array(self.to_world.matrix).reshape(4, 4), float(np.ravel(self.distortion)[0])
        size = tuple(map(int, self.film().size()))
        return Camera(matrix, np.array(self.focal).ravel(), np.array(self.centre).ravel(), size, distortion)

    @property
    def shot(self) -> Shot:
        """Camera, light and file names of the photograph as NumPy values, from the current parameters of the plugin.

        No image is read. Raises SceneError if the nested light is neither a point light nor a directional light.
        """
        if (kind := self.light.class_name()) not in LAMP_CLASSES:
            raise SceneError(f'photograph "{self.id()}": nested emitter is a {kind}, must be "point" or "directional"')
        falloff, left, up = (float(np.ravel(part)[0]) for part in (self.falloff, self.tilt.x, self.tilt.y))
        return Shot(self.id(), self.camera, light_of(self.light), falloff, (left, up), self.response, self.files,
                    self.encoding, self.saturation, self.calibrated)  # fmt: skip

    @property
    def cone(self):
        """The numbers (Vector3f) of the flash's cone: its exponent, and its tilt to the left and up."""
        return mi.Vector3f(self.falloff, self.tilt.x, self.tilt.y)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        Photograph.current = self
        film = self.film()
        pixel = sample2 * mi.ScalarVector2f(film.crop_size()) + mi.ScalarVector2f(film.crop_offset())
        origin, direction = Pinhole(self.to_world.matrix, self.focal, self.centre, self.distortion).ray(pixel)
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
        callback.put("tilt", self.tilt, mi.ParamFlags.Differentiable)
        callback.put("light", self.light, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys):
        super().parameters_changed(keys)
        # Dr.Jit gives literals, which are shared, the size of a call that reads them.
        dr.make_opaque(self.falloff, self.tilt, self.distortion)

    def to_string(self):
        return f"Photograph[filename={self.files.filename}, size={self.camera.size}]"


mi.register_sensor("photograph", Photograph)
