"""Calibrates the flash, the room's light and the camera's response from the brightness of the sheet's white paper."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from mi_ring.geometry.hull import evenly_spaced
from mi_ring.photogrammetry.marker_sheet import PaperSamples
from mi_ring.rendering.photograph_lights import MIN_FLASH_COSINE

PAPER_ALBEDO = 0.8
#: Standard deviations of the priors: the flash's position across and along the optical axis [median distance from
#: camera to paper], its cone's exponent, the room's light relative to the flash, the object's reflectance, and the log
#: exponent of the camera's response.
OFFSET, DEPTH, CONE, ROOM, REFLECTED, RESPONSE = 0.1, 0.02, 1.0, 0.1, 1.0, 0.2
EXIF, NO_EXIF = 0.3, 1.0  #: the same for the log intensity of one photograph, with and without an exposure in EXIF
ERROR = 0.1  #: standard deviation of a sample's log brightness; errors within a photograph are correlated
ROBUST = 0.02  #: scale of the robust loss [log brightness]: samples in shadows and highlights are outliers
MIN_RADIANCE = 1e-4  #: lower radiance is replaced by this
FEW = 3  #: with so few samples of a photograph, its median is not used
MAX_PHOTOGRAPHS = 60  #: maximum number that are fitted together
#: Smaller effects are set to zero: room's light relative to the flash, cone's exponent, log exponent of the response.
NO_ROOM, NO_CONE, NO_RESPONSE = 0.003, 0.05, 0.06
OTHER_MATERIAL = 0.1  #: the margin is not paper if its log intensity differs from that of the squares by more


class ObjectSphere(NamedTuple):
    """A sphere that stands for the object: it reflects light onto the paper, and it blocks the light of the room."""

    center: np.ndarray  #: (3,)
    radius: float

    def reflected(self, points: np.ndarray, lights: np.ndarray) -> np.ndarray:
        """Return the irradiance (n,) of the paper by light that the sphere reflects, for a white sphere.

        `points` (n, 3): points of the paper. `lights` (n, 3): for each point, the position of the flash, of intensity
        1.
        """
        up, to_light = self.center - points, lights - self.center
        distance = np.linalg.norm(to_light, axis=1)
        phase = np.arccos(np.clip(-(up * to_light).sum(1) / (np.linalg.norm(up, axis=1) * distance), -1, 1))
        lit = (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi  # of a distant Lambertian sphere (Lambert 1760)
        return 2 / 3 * lit * self.form_factor(points) / distance**2

    def form_factor(self, points: np.ndarray) -> np.ndarray:
        """Return the form factors (n,) of the sphere: which share of uniform room light it blocks at each point.

        `points` (n, 3): points of the sheet.
        """
        up = self.center - points
        distance = np.linalg.norm(up, axis=1)
        return ((self.radius / distance) ** 2 * np.maximum(up[:, 2], 0) / distance).clip(max=1)


class FlashCalibration(NamedTuple):
    """The estimated flash, room light and camera response, in the sheet's frame [mm]. Camera axes are OpenCV's."""

    offset: np.ndarray  #: (3,) position of the flash relative to the lens, in the axes of `turn_with_cameras` [mm]
    falloff: float  #: exponent of the cone: intensity is proportional to cosine ^ falloff, from the optical axis
    room: np.ndarray  #: (3,) irradiance of the sheet by the room's light, for a flash of intensity 1 [1/mm²]
    gamma: float  #: exponent of the response: linear values in the file are radiance ^ gamma
    power: np.ndarray  #: (3,) the flash's intensity at the median exposure
    intensities: dict[str, np.ndarray]  #: (3,) by the photograph's name; includes its exposure and white balance

    @property
    def ambient(self) -> np.ndarray:
        """Radiance (3,) of the room, as if it were uniform, at the median exposure."""
        return self.room / np.pi * self.power


def irradiance(to_light: np.ndarray, normal: np.ndarray, forward: np.ndarray, falloff: float) -> np.ndarray:
    """Return the irradiance (n,) of n surface points by a flash of intensity 1.

    It is 0 where the flash is behind the surface. `to_light` (n, 3): vectors from the points to the flash. `normal`
    (3,): unit surface normal. `forward` (3,) or (n, 3): unit axis of the flash. `falloff`: exponent of the cone;
    intensity is proportional to the cosine of the angle to the axis ^ `falloff`.
    """
    distance = np.linalg.norm(to_light, axis=1)
    cosine = np.maximum(-(to_light * forward).sum(1) / distance, MIN_FLASH_COSINE)
    return cosine**falloff * np.maximum(to_light @ normal, 0) / distance**3


class Observations(NamedTuple):
    """n samples of white paper, each with the pose of its camera."""

    points: np.ndarray  #: (n, 3)
    colours: np.ndarray  #: (n, 3) logarithms
    in_margin: np.ndarray  #: (n,) bool, see `PaperSamples`
    poses: np.ndarray  #: (n, 4, 4) of the cameras
    axes: np.ndarray  #: (n, 3, 3) from the axes of the flash's offset to the world's


class FlashParameters(NamedTuple):
    """The unknowns of a flash calibration that all photographs share."""

    offset: np.ndarray
    falloff: float
    room: np.ndarray
    reflectance: np.ndarray  #: (3,) of the object
    gamma: float
    power: np.ndarray  #: logarithms

    def intensities(self, seen: Observations, sphere: ObjectSphere | None) -> np.ndarray:
        """Return the log intensity (n, 3) of the flash that explains each of n paper samples by these parameters.

        `seen`: the samples. `sphere`: stands for the object; None: no object.
        """
        to_light, room = seen.poses[:, :3, 3] + seen.axes @ self.offset - seen.points, self.room
        light = irradiance(to_light, np.array([0.0, 0, 1]), seen.poses[:, :3, 2], self.falloff)[:, None]
        if sphere:
            light = light + self.reflectance * sphere.reflected(seen.points, to_light + seen.points)[:, None]
            room = room * (1 - sphere.form_factor(seen.points))[:, None]
        return seen.colours / self.gamma - np.log(np.maximum(light + room, 1e-12) * PAPER_ALBEDO / np.pi)


def calibrate_flash(
    papers: Mapping[str, PaperSamples], poses: Mapping[str, np.ndarray], axes: Mapping[str, np.ndarray],
    exposures: Mapping[str, float], offset: np.ndarray, sphere: ObjectSphere | None = None, curved: bool = True,
) -> FlashCalibration | None:  # fmt: skip
    """Calibrate the flash from the brightness of white paper. Returns None if no photograph shows the paper.

    The dictionaries have names of photographs as keys. `papers`: samples of the paper. `poses`: camera-to-world (4, 4),
    in the sheet's frame [mm]. `axes`: rotations (3, 3) from the axes of `offset` to the pixel axes of the photograph.
    `exposures`: relative exposures, NaN if unknown. `offset` (3,): approximate position of the flash relative to the
    lens [mm]. `sphere`: a sphere in place of the object, which shades the sheet; None: no object. `curved`: True: also
    estimate the camera's response; False: it is linear.

    The method is robust least squares of log brightness, with priors. It estimates the position and falloff of the
    flash and the camera's response, which all photographs share, and the intensity of each photograph. The sheet is
    white in the squares of its pattern and in the margin around it. Samples in the margin are used only if they are as
    bright as those in the squares. If the response is nearly linear, it is set to linear.
    """
    names = [n for n in papers if n in poses and not papers[n].in_margin.all() and poses[n][2, 3] > 0]
    if not names:
        return None
    whole = []
    for name in names:
        paper, pose = papers[name], poses[name]
        colours = np.log(np.maximum(paper.colours, MIN_RADIANCE))
        camera = [np.repeat(matrix[None], len(colours), 0) for matrix in (pose, pose[:3, :3] @ axes[name])]
        whole.append(Observations(paper.points, colours, paper.in_margin, *camera))
    squares = [Observations(*(part[~seen.in_margin] for part in seen)) for seen in whole]
    known = np.array([exposures[name] for name in names])
    prior = np.log(np.where(np.isfinite(known), known, 1.0)), np.where(np.isfinite(known), EXIF, NO_EXIF)
    seen, parameters = squares, fit_parameters(squares, prior, offset, sphere, curved)
    intensities = fit_intensities(squares, prior, parameters, sphere)
    margin = np.concatenate([(parameters.intensities(own, sphere) - intensity)[own.in_margin]
                             for own, intensity in zip(whole, intensities)])  # fmt: skip
    if len(margin) and np.abs(np.median(margin, 0)).max() < OTHER_MATERIAL:
        seen, parameters = whole, fit_parameters(whole, prior, offset, sphere, curved)
    if curved and abs(np.log(parameters.gamma)) < NO_RESPONSE:
        parameters = fit_parameters(seen, prior, offset, sphere, curved=False)
    intensities = np.exp(fit_intensities(seen, prior, parameters, sphere))
    distance = np.median([np.linalg.norm(poses[name][:3, 3]) for name in names])
    room = parameters.room if (parameters.room * distance**2).max() > NO_ROOM else 0 * parameters.room
    falloff = parameters.falloff if parameters.falloff > NO_CONE else 0.0
    return FlashCalibration(parameters.offset, falloff, room, parameters.gamma, np.exp(parameters.power),
                            dict(zip(names, intensities)))  # fmt: skip


def fit_parameters(
    observations: Sequence[Observations], prior: tuple[np.ndarray, np.ndarray], offset: np.ndarray,
    sphere: ObjectSphere | None, curved: bool,
) -> FlashParameters:  # fmt: skip
    """Estimate the unknowns that all photographs share. At most `MAX_PHOTOGRAPHS` photographs are used.

    `observations`: one per photograph. `prior`: (log exposures, their standard deviations), each (count,) for the
    photographs. `offset` (3,): approximate position of the flash relative to the lens [mm]. `sphere`: stands for the
    object; None: no object. `curved`: also estimate the camera's response; False: it is linear.
    """
    some = evenly_spaced(len(observations), MAX_PHOTOGRAPHS)
    exposures, deviations = (part[some, None] for part in prior)
    seen = Observations(*(np.concatenate(parts) for parts in zip(*(observations[k] for k in some))))
    index = np.repeat(np.arange(len(some)), [len(observations[k].points) for k in some])
    unit = float(np.median(np.linalg.norm(seen.poses[:, :3, 3] - seen.points, axis=1)))
    units = np.array([OFFSET * unit, OFFSET * unit, DEPTH * unit, CONE, *[ROOM / unit**2] * 3, *[REFLECTED] * 3,
                      RESPONSE])  # fmt: skip
    power = slice(len(units), len(units) + 3)  # of x; the photographs' own follow

    def unpack(x: np.ndarray) -> FlashParameters:
        values = x[: len(units)] * units
        gamma = float(np.exp(values[10])) if curved else 1.0
        return FlashParameters(offset + values[:3], float(values[3]), values[4:7], values[7:10], gamma, x[power])

    def residuals(x: np.ndarray) -> np.ndarray:
        parameters, own = unpack(x), x[power.stop :]
        intensities = exposures + parameters.power + deviations * own.reshape(-1, 3)
        error = parameters.gamma * (parameters.intensities(seen, sphere) - intensities[index]) / ERROR
        return np.concatenate([error.ravel(), own, x[: len(units)]])

    def loss(z: np.ndarray) -> np.ndarray:
        """Loss of squared residuals `z`, and two derivatives: `soft_l1` for brightness, squares for priors."""
        brightness = np.arange(len(z)) < seen.colours.size
        root = np.sqrt(1 + z)
        return np.where(brightness, [2 * (root - 1), 1 / root, -0.5 / root**3], [z, 1 + 0 * z, 0 * z])

    start = np.zeros(power.stop + 3 * len(some))
    start[3:10] = 0.3  # away from the bounds
    start[power] = np.median(unpack(start).intensities(seen, sphere) - exposures[index], 0)
    lowest = np.full(len(start), -np.inf)
    lowest[3:10] = 0  # cone, room and object add light
    return unpack(least_squares(residuals, start, bounds=(lowest, np.inf), loss=loss, f_scale=ROBUST / ERROR).x)


def fit_intensities(
    observations: Sequence[Observations], prior: tuple[np.ndarray, np.ndarray], parameters: FlashParameters,
    sphere: ObjectSphere | None,
) -> np.ndarray:  # fmt: skip
    """Estimate the log intensity of the flash in each photograph, robustly. Returns (count, 3).

    `observations`: one per photograph. `prior`: (log exposures, their standard deviations), each (count,).
    `parameters`: what all photographs share. `sphere`: stands for the object; None: no object.
    """
    result = []
    for seen, exposure, deviation in zip(observations, *prior):
        single, expected = parameters.intensities(seen, sphere), exposure + parameters.power
        found = np.median(single, 0) if len(single) > FEW else expected
        for _ in range(20):  # reweighted least squares, with the loss of `fit_parameters`
            weight = (1 + ((single - found) / ROBUST) ** 2) ** -0.5 / ERROR**2
            found = ((weight * single).sum(0) + expected / deviation**2) / (weight.sum(0) + 1 / deviation**2)
        result.append(found)
    return np.array(result)
