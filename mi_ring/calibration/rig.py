"""The rig: cameras and lights of a capture as constant tensors; and estimates, which the unknowns of a fit change."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mi_ring.calibration.camera_response import CameraResponse
from mi_ring.calibration.light_tensors import LightTensors
from mi_ring.capture.capture import Capture
from mi_ring.capture.pairs import camera_numbers
from mi_ring.geometry.camera import distortion_range
from mi_ring.geometry.rotations import quarter_turns
from mi_ring.rendering.views import Views
from mi_ring.scene.assembly import lamp_lights

RIGID = 0.02  #: how much a flash may move in the cameras' axes and still be one flash [rig's distance]
BESIDE = 0.35  #: how far from the optical axis a light can still be the flash of a camera [rig's distance]
INSIDE = 0.999  #: share of the range in which a lens distortion can be inverted


@dataclass(frozen=True)
class Estimate:
    """Estimated cameras, lights and camera response: those of the capture, after each unknown has changed them."""

    views: Views  #: lights as in the capture
    offset: Tensor  #: (light places, 3) or (): of the lights [rig's distance], of distant ones [rad]
    log_power: Tensor  #: (P, 3) or (): logarithm of a factor of the lights' strengths
    lamp_offset: Tensor  #: (L, 3) or (): as `offset`, of the scene's own lamps
    log_lamp_power: Tensor  #: (L, 3) or (): as `log_power`, of these lamps
    response: CameraResponse

    def seen(self, **views: Tensor) -> "Estimate":
        """Return a copy in which some fields of `self.views` are replaced, for example `seen(distortion=…)`."""
        return replace(self, views=self.views._replace(**views))


class Rig:
    """Cameras and lights as the capture gives them, as tensors that stay constant during a fit.

    Photographs with equal focal lengths and distortion share a lens. Those with and without their own light that have
    equal cameras share the pose of the camera. Photographs with the same light position share the place of a light. A
    flash that moves with the camera has one place for all photographs, in camera coordinates.
    """

    def __init__(
        self, capture: Capture, center: np.ndarray, exposure: float, fitted: np.ndarray | None = None,
        power: float = 1.0, guessed: bool = False, ahead: bool = True, lamps: bool = False, powers: bool = False,
    ) -> None:  # fmt: skip
        """Take cameras and lights from a capture.

        `center` (3,): centre of the object. `exposure`: mean radiance of the object. `fitted`: indices of the
        photographs that are fitted; default: all. `power`: initial factor of all lights. `guessed`: the places of the
        lights are guesses, not measurements. `ahead`: gradients also move a flash along the camera's axis. `lamps`:
        the fit refines the scene's own lamps. `powers`: the fit refines the power of each photograph's light.
        """
        self.path, self.exposure, self.power, self.guessed = capture.path, exposure, power, guessed
        lights = capture.photographs.lights
        views = Views.of(capture.shots, lights.positions(), power * lights.rgb())
        self.views = Views(*(torch.from_numpy(array).float() for array in views))
        self.sizes = [shot.size for shot in capture.shots]
        frames = [shot.frame for shot in capture.shots]
        self.frames = torch.from_numpy(np.stack(frames)).float()  #: (P, 2, 2) corners of the whole photographs [px]
        photographs, mainly = capture.photographs, capture.photographs.mainly
        self.mixed = photographs.mixed  #: Have some photographs lights of their own, and others none?
        self.lit = torch.from_numpy(photographs.lit)  #: (P,) which photographs have one
        self.mainly = mainly  #: indices of these; of all photographs if there are none
        self.fitted = torch.arange(len(capture.shots)) if fitted is None else torch.from_numpy(fitted)
        #: (n,) indices of the fitted photographs whose power or gain is unknown. Where both are refined, the gain is
        #: that of photographs without a light of their own.
        dark = self.fitted[~self.lit[self.fitted]]
        self.exposed = {"power": self.fitted[self.lit[self.fitted]] if self.mixed else self.fitted,
                        "gain": dark if self.mixed and powers else self.fitted}  # fmt: skip
        self.camera = torch.from_numpy(camera_numbers(capture))  #: (P,) number of each photograph's camera
        self.lamps = LightTensors.of(lamp_lights(capture.scene) if lamps else [])  #: that are unknown

        self.center = torch.from_numpy(np.asarray(center)).float()
        #: the unit of length of unknowns: median distance from the cameras to the object [scene units]
        self.distance = float(np.median(np.linalg.norm(views.cameras[:, :, 3] - center, axis=1)))
        self.finite = torch.from_numpy(lights.is_finite())[:, None]
        of_world = self.views.cameras[:, :, :3]
        in_camera = torch.einsum("pji,pj->pi", of_world, self.views.places - self.views.cameras[:, :, 3])
        #: (P, 3, 3) quarter turns of photographs that were taken with the camera on its side
        self.held = torch.eye(3).repeat(len(in_camera), 1, 1)
        self.held[mainly] = quarter_turns(in_camera[mainly], RIGID * self.distance)
        upright = (self.held[mainly].mT @ in_camera[mainly, :, None])[..., 0]
        self.upright = upright.mean(0)  #: (3,) place of the flash in the axes of a camera that is held upright
        spread = float((upright.amax(0) - upright.amin(0)).max())
        rigid = self.finite[mainly].all() and spread < RIGID * self.distance and not guessed
        #: (P, 3) places of the lights in the cameras' axes if they are one flash that moves with the camera, else None
        self.flash = in_camera if rigid else None
        if self.flash is not None and self.mixed:
            self.flash = torch.where(self.lit[:, None], in_camera, self.upright)
        #: (3,) factors of the gradient of the lights' offset
        self.free = torch.tensor([1.0, 1.0, float(ahead or self.flash is None)])

        focal = np.stack([shot.whole.camera.focal for shot in capture.shots])
        kinds = np.column_stack([focal.round(3), views.distortion.round(6)])
        lens = np.unique(kinds, axis=0, return_inverse=True)[1].ravel()
        relative = lights.positions() / np.where(lights.is_finite(), self.distance, 1.0)[:, None]
        place = np.zeros(len(relative), int)
        place[mainly] = np.unique(relative[mainly].round(6), axis=0, return_inverse=True)[1].ravel()
        self.lens = torch.from_numpy(lens)  #: (P,) number of each photograph's lens
        self.place = torch.from_numpy(place if self.flash is None else np.zeros_like(place))  #: (P,) of its light
        self.response = CameraResponse(
            None, None, None, None, torch.tensor([shot.response.curve.gamma for shot in capture.shots]),
            torch.tensor([shot.response.vignetting for shot in capture.shots]), exposure,
            torch.from_numpy(np.stack([shot.response.gain for shot in capture.shots])).float(),
        )  # fmt: skip

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self.lens)

    def count(self, per: str) -> int:
        """Return the number of photographs, cameras, lenses, places of lights, or lamps in the scene.

        `per`: "photograph", "camera", "lens", "light" or "lamp".
        """
        if per in ("photograph", "lamp"):
            return len(self if per == "photograph" else self.lamps.places)
        return int({"camera": self.camera, "lens": self.lens, "light": self.place}[per].max()) + 1

    @property
    def beside_lens(self) -> bool:
        """True if the photographs' own lights are one flash beside the lens."""
        return self.flash is not None and float(self.upright[:2].norm()) < BESIDE * self.distance

    @property
    def open_cone(self) -> bool:
        """True if the lights are one flash beside the lens, and the capture does not tell its cone."""
        return self.beside_lens and not self.views.cone[self.mainly].any()

    @property
    def turned(self) -> bool:
        """True if cameras were held upright and on their side, and the place of the flash does not tell which.

        Then its tilt is not the same in the axes of all cameras.
        """
        width, height = (self.frames[:, 1] - self.frames[:, 0]).T
        same = bool((self.held == torch.eye(3)).all())
        return same and bool((width > height).any()) and bool((width < height).any())

    def estimate(self) -> Estimate:
        """Return an estimate that equals the capture: no offset of a light, and all factors 1."""
        none = torch.zeros(())
        return Estimate(self.views, none, none, none, none, self.response)

    def views_of(self, estimate: Estimate) -> Views:
        """Return the cameras and lights of an estimate. Its offsets move the lights, its factors scale their strengths.

        Distortions are clipped to the range in which each ray has exactly one pixel.
        """
        now = estimate.views
        offset = estimate.offset.expand(self.count("light"), 3)[self.place]
        if self.flash is not None:
            in_camera = self.flash[..., None] + self.held @ (offset * self.distance)[..., None]
            places = now.cameras[:, :, 3] + (now.cameras[:, :, :3] @ in_camera)[..., 0]
        else:
            lights = LightTensors(self.views.places, self.finite, self.views.strengths)
            places = lights.moved(offset, self.distance).places
        lens = now.intrinsics.detach()
        low, high = self.frames.unbind(1)
        least, most = distortion_range(lens[:, :2], lens[:, 2:] - low, high - low)
        distortion = now.distortion.clamp(INSIDE * least, INSIDE * most)  # so that each ray has one pixel
        return now._replace(places=places, strengths=now.strengths * estimate.log_power.exp(), distortion=distortion)

    def lamps_of(self, estimate: Estimate) -> LightTensors:
        """Return the scene's own lamps, moved by the offsets of an estimate, with strengths scaled by its factors."""
        strengths = self.power * estimate.log_lamp_power.exp() * self.lamps.strengths
        return self.lamps._replace(strengths=strengths).moved(estimate.lamp_offset, self.distance)
