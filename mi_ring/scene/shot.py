"""The camera, light, response and files of a photograph, as plain values without Mitsuba."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mi_ring.geometry.camera import Camera, moved_pose
from mi_ring.scene.lights import Light
from mi_ring.scene.tone_curve import STRAIGHT, ToneCurve

#: How a file encodes linear values; `auto`: files of 8 bits are sRGB, all others are linear.
Encoding: TypeAlias = Literal["auto", "srgb", "linear"]


class Files(NamedTuple):
    """The paths of the files of a photograph. A path is None if the photograph has no such file."""

    filename: Path | None = None  #: the photograph
    mask: Path | None = None  #: 0 background, 255 object; equal to `filename` if the alpha channel is the mask
    valid: Path | None = None  #: 0 where a pixel is ignored
    ambient: Path | None = None  #: the same view without the photograph's own light


NO_FILES = Files()


class Window(NamedTuple):
    """A rectangle of a photograph, and the smaller size to which its pixels are reduced."""

    corner: tuple[int, int]  #: first column and row [px of the photograph]
    extent: tuple[int, int]  #: width and height [px of the photograph]
    size: tuple[int, int]  #: width and height after the reduction [px]
    whole: tuple[int, int]  #: width and height of the photograph [px]

    @property
    def scale(self) -> np.ndarray:
        """Factors (2,) by which width and height of the rectangle are divided, 1 or more."""
        return np.divide(self.extent, self.size)

    @property
    def blocks(self) -> int:
        """Side [px] of square blocks of pixels. The first step of the reduction averages each block."""
        blocks = int(self.scale.min())
        while any(side % blocks for side in self.extent):
            blocks -= 1
        return blocks

    @property
    def share(self) -> float:
        """Area of the rectangle divided by the area of the photograph."""
        return float(np.prod(self.extent) / np.prod(self.whole))


@dataclass(frozen=True)
class Response:
    """How a camera records radiance. With the default values, the recorded value is the radiance itself.

    The recorded linear value is that of radiance · `gain` · cosine ^ `vignetting` under the `curve`. The cosine is
    between the ray of the pixel and the optical axis.
    """

    curve: ToneCurve = STRAIGHT
    vignetting: float = 0.0  #: exponent of the cosine between the ray of a pixel and the optical axis
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  #: factors of R, G, B, by exposure and white balance

    def changed(self, first: ToneCurve = STRAIGHT, vignetting: float = 0.0, gain: ArrayLike = 1.0) -> "Response":
        """Return a changed copy: with another curve `first`, more `vignetting` (added) and `gain` (multiplied)."""
        red, green, blue = np.multiply(self.gain, gain).tolist()
        return Response(self.curve.after(first), self.vignetting + vignetting, (red, green, blue))


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph of a capture without its pixels: camera, light, response and files, as plain values.

    The fields cannot be assigned. `dataclasses.replace` makes a copy with other fields.
    """

    name: str  #: the sensor's id in the scene file
    camera: Camera
    light: Light | None = None  #: its own light, which lights no other photograph; None: see `own_light`
    falloff: float = 0.0  #: exponent of the cosine between the direction from a point light and where the camera looks
    tilt: tuple[float, float] = (0.0, 0.0)  #: (a, b): a point light has a factor exp(a x + b y) to the left x, up y
    response: Response = Response()
    files: Files = NO_FILES
    encoding: Encoding = "auto"  #: of the photograph's file
    saturation: float = 1.0  #: encoded value from which a pixel is clipped (1 = full scale)
    calibrated: bool = False  #: are camera and light exact? If so, a fit does not refine them by default
    window: Window | None = None  #: the part of its files that it shows, with the camera of that part; None: all

    def through(self, window: Window) -> "Shot":
        """Return a copy that is cropped to a window and reduced to its size. The camera is that of the window.

        The shot must be a whole photograph.
        """
        camera = self.camera
        camera = camera._replace(focal=camera.focal / window.scale, size=window.size,
                                 centre=(camera.centre - window.corner) / window.scale)  # fmt: skip
        return replace(self, camera=camera, window=window)

    @property
    def whole(self) -> "Shot":
        """The shot of the whole photograph, if this shot is a cropped or reduced one; otherwise the shot itself."""
        if self.window is None:
            return self
        camera, scale = self.camera, self.window.scale
        camera = camera._replace(focal=camera.focal * scale, size=self.window.whole,
                                 centre=camera.centre * scale + self.window.corner)  # fmt: skip
        return replace(self, camera=camera, window=None)

    @property
    def frame(self) -> np.ndarray:
        """First and last corner (2, 2) of the whole photograph as (x, y), in pixels of this cropped or reduced shot."""
        if self.window is None:
            return np.array([(0, 0), self.size])
        return (np.array([(0, 0), self.window.whole]) - self.window.corner) / self.window.scale

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.camera.size

    @property
    def file_name(self) -> str:
        """Name of the photograph's file without folder; `name` if it has no file."""
        return self.files.filename.name if self.files.filename else self.name

    @property
    def own_light(self) -> Light:
        """The photograph's `light`. If `light` is None: a point light of intensity 1 at the camera."""
        return self.light or Light("point", self.camera.position, np.ones(3))

    @property
    def in_room(self) -> bool:
        """True if the light of the room is in the photograph. It is not if it was subtracted, see `Files.ambient`."""
        return self.files.ambient is None

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> "Shot":
        """Return a copy with camera and light in another frame: a point x becomes scale · rotation · x + shift.

        `rotation` (3, 3), `shift` (3,). The intensity of a point light is multiplied by the square of `scale`, so that
        irradiances stay the same.
        """
        light = self.own_light
        if light.kind == "point":  # scaled so that irradiance does not change
            light = Light("point", scale * rotation @ light.vector + shift, scale**2 * light.rgb)
        else:
            light = light._replace(vector=rotation @ light.vector)
        to_world = moved_pose(self.camera.to_world, scale, rotation, shift)
        return replace(self, camera=self.camera._replace(to_world=to_world), light=light)
