"""The rig: what a capture says about its cameras and lights, as tensors, and estimates that differ from it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.camera_response import CameraResponse
from mi_ring.calibration.light_tensors import LightTensors
from mi_ring.capture.capture import Capture
from mi_ring.geometry.camera import distortion_range
from mi_ring.geometry.rotations import quarter_turns
from mi_ring.scene.assembly import lamp_lights

RIGID = 0.02  #: how much a flash may move in the cameras' axes and still be one flash [rig's distance]
INSIDE = 0.999  #: share of the range in which a lens distortion can be inverted


class Views(NamedTuple):
    """Cameras and lights of all P photographs, in the order in which the renderer takes them."""

    cameras: Tensor  #: (P, 3, 4) camera-to-world
    intrinsics: Tensor  #: (P, 4) fx, fy, cx, cy [px]
    places: Tensor  #: (P, 3) of lights: positions [scene units], of distant ones unit directions toward them
    strengths: Tensor  #: (P, 3) intensities, of distant lights irradiances
    falloff: Tensor  #: (P,) exponents of flashes' cones
    distortion: Tensor  #: (P,) first radial distortions of the lenses


@dataclass(frozen=True)
class Estimate:
    """What an `Unknown` changes: cameras and lights, starting from those of the capture."""

    cameras: Tensor  #: as of `Views`
    intrinsics: Tensor
    falloff: Tensor
    distortion: Tensor
    offset: Tensor  #: (light places, 3) or (): of the lights [rig's distance], of distant ones [rad]
    log_power: Tensor  #: (P, 3) or (): logarithm of a factor of the lights' strengths
    lamp_offset: Tensor  #: (L, 3) or (): as `offset`, of the scene's own lamps
    log_lamp_power: Tensor  #: (L, 3) or (): as `log_power`, of these lamps
    response: CameraResponse


class Rig:
    """Cameras and lights of a capture, fixed during a fit.

    Photographs share a `lens` if focal lengths and distortion are equal, and a light's `place` if that is equal. A
    flash that moves with the camera has one place for all photographs, in the cameras' axes.
    """

    def __init__(
        self, capture: Capture, center: np.ndarray, exposure: float, fitted: np.ndarray | None = None,
        power: float = 1.0, guessed: bool = False, ahead: bool = True, lamps: bool = False,
    ) -> None:  # fmt: skip
        """`center` (3,): of the object. `exposure`: the object's mean radiance.

        `fitted`: indices of the photographs that are fitted; default: all. `power`: initial factor of all lights.
        `guessed`: nobody measured the lights' places. `ahead`: a flash may also move along the camera's axis. `lamps`:
        the scene's own lamps are unknown.
        """
        self.path, self.exposure, self.power, self.guessed = capture.path, exposure, power, guessed
        cameras, lights = [shot.camera for shot in capture.shots], capture.photographs.lights
        to_world = np.stack([camera.to_world[:3] for camera in cameras])
        intrinsics = np.array([[*camera.focal, *camera.centre] for camera in cameras])
        cones = np.array([shot.falloff for shot in capture.shots])
        distortion = np.array([camera.distortion for camera in cameras])
        arrays = to_world, intrinsics, lights.positions(), power * lights.rgb(), cones, distortion
        self.views = Views(*(torch.from_numpy(array).float() for array in arrays))
        self.sizes = [shot.size for shot in capture.shots]
        self.dark = capture.photographs.dark  #: Have photographs no lights of their own?
        self.fitted = torch.arange(len(cameras)) if fitted is None else torch.from_numpy(fitted)
        self.lamps = LightTensors.of(lamp_lights(capture.scene) if lamps else [])  #: that are unknown

        self.center = torch.from_numpy(np.asarray(center)).float()
        #: the unit of length of unknowns: median distance from the cameras to the object [scene units]
        self.distance = float(np.median(np.linalg.norm(to_world[:, :, 3] - center, axis=1)))
        self.finite = torch.from_numpy(lights.is_finite())[:, None]
        of_world = self.views.cameras[:, :, :3]
        in_camera = torch.einsum("pji,pj->pi", of_world, self.views.places - self.views.cameras[:, :, 3])
        #: (P, 3, 3) quarter turns of photographs that were taken with the camera on its side
        self.held = quarter_turns(in_camera, RIGID * self.distance)
        upright = (self.held.mT @ in_camera[..., None])[..., 0]
        self.upright = upright.mean(0)  #: (3,) place of the flash in the axes of a camera that is held upright
        spread = float((upright.amax(0) - upright.amin(0)).max())
        rigid = self.finite.all() and spread < RIGID * self.distance and not guessed
        #: (P, 3) places of the lights in the cameras' axes if they are one flash that moves with the camera, else None
        self.flash = in_camera if rigid else None
        self.free = torch.tensor([1.0, 1.0, float(ahead or self.flash is None)])  #: components of the lights' offset

        kinds = np.column_stack([intrinsics[:, :2].round(3), distortion.round(6)])
        lens = np.unique(kinds, axis=0, return_inverse=True)[1].ravel()
        relative = lights.positions() / np.where(lights.is_finite(), self.distance, 1.0)[:, None]
        place = np.unique(relative.round(6), axis=0, return_inverse=True)[1].ravel()
        self.lens = torch.from_numpy(lens)  #: (P,) number of each photograph's lens
        self.place = torch.from_numpy(place if self.flash is None else np.zeros_like(place))  #: (P,) of its light
        self.response = CameraResponse(
            None, None, None, torch.tensor([shot.response.gamma for shot in capture.shots]),
            torch.tensor([shot.response.vignetting for shot in capture.shots]), exposure,
            torch.from_numpy(np.stack([shot.response.gain for shot in capture.shots])).float(),
        )  # fmt: skip

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self.lens)

    def count(self, per: str) -> int:
        """Number of photographs, lenses, lights or lamps."""
        several = {"photograph": len(self), "lens": int(self.lens.max()) + 1, "light": int(self.place.max()) + 1,
                   "lamp": len(self.lamps.places)}  # fmt: skip
        return several[per]

    def estimate(self) -> Estimate:
        """Cameras and lights as the capture says."""
        none = torch.zeros(())
        return Estimate(self.views.cameras, self.views.intrinsics, self.views.falloff, self.views.distortion, none,
                        none, none, none, self.response)  # fmt: skip

    def views_of(self, estimate: Estimate, bent: bool) -> Views:
        """Cameras and lights of an estimate. `bent`: some lens has distortion, or an unknown one."""
        offset = (self.free * estimate.offset).expand(self.count("light"), 3)[self.place]
        if self.flash is not None:
            in_camera = self.flash[..., None] + self.held @ (offset * self.distance)[..., None]
            places = estimate.cameras[:, :, 3] + (estimate.cameras[:, :, :3] @ in_camera)[..., 0]
        else:
            lights = LightTensors(self.views.places, self.finite, self.views.strengths)
            places = lights.moved(offset, self.distance).places
        distortion = estimate.distortion
        if bent:  # within the range in which each ray has one pixel
            now = estimate.intrinsics.detach()
            least, most = distortion_range(now[:, :2], now[:, 2:], torch.tensor(self.sizes))
            distortion = distortion.clamp(INSIDE * least, INSIDE * most)
        strengths = self.views.strengths * estimate.log_power.exp()
        return Views(estimate.cameras, estimate.intrinsics, places, strengths, estimate.falloff, distortion)

    def lamps_of(self, estimate: Estimate) -> LightTensors:
        """The scene's own lamps of an estimate."""
        strengths = self.power * estimate.log_lamp_power.exp() * self.lamps.strengths
        return self.lamps._replace(strengths=strengths).moved(estimate.lamp_offset, self.distance)
