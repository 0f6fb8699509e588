"""The calibration that a fit refines: the unknowns of cameras and lights with their values, and the room's light.

The paper refines calibration together with the shape (its Table 3). Room light that is the same from all sides counts
as fixed in the world. Room light that is fixed in the camera has an effect like a flash elsewhere or another
reflectance. So it is refined only if the scene has such light.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from mi_ring.calibration.camera_response import CameraResponse
from mi_ring.calibration.light_tensors import LightTensors
from mi_ring.calibration.rig import Estimate, Rig
from mi_ring.calibration.room_light import RoomLight
from mi_ring.calibration.unknowns import UNKNOWNS, Unknown, centred
from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.camera import undistortion_factor
from mi_ring.rendering import bridge, prediction
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.rendering.surface import Surface
from mi_ring.rendering.views import Views
from mi_ring.scene.assembly import with_lamps
from mi_ring.scene.lights import shared_emitters
from mi_ring.system.machine import device

#: All options of `--refine` with values in a calibration, in order.
OPTIONS = [*dict.fromkeys(unknown.option for unknown in UNKNOWNS.values())]
OPTIONS.insert(OPTIONS.index("lamps"), "ambient")
ROOM_START = 0.15  #: progress of a fit at which refinement of the room's light begins


class Calibration(nn.Module):
    """The unknowns of calibration as trainable parameters. 0 is the capture's value.

    The unit of each parameter is the standard deviation of its prior.
    """

    def __init__(
        self, capture: Capture, refined: Sequence[str], rig: Rig, frames: Collection[str] = ("world",)
    ) -> None:
        """Start from the values of the capture: every unknown is 0.

        `refined`: the options of `--refine` that are refined. `rig`: cameras and lights of the capture. `frames`: the
        axes in which the room's light is fixed, "world" or "camera" or both.

        Raises InputError if `falloff` is refined without a flash that moves with the camera.
        """
        super().__init__()
        self.refined, self.rig = tuple(refined), rig
        self.unknowns: dict[str, Unknown] = {n: u for n, u in UNKNOWNS.items() if u.option in refined}
        if "falloff" in refined and rig.flash is None:
            raise InputError(f"{rig.path}: emitter: the lights do not move with the cameras, but --refine falloff "
                             "is for a flash that does; leave it out")  # fmt: skip
        self.widths = {name: unknown.width_for(rig) for name, unknown in self.unknowns.items()}
        for name, unknown in self.unknowns.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(unknown.shape(rig))))
        given = capture.room
        room = torch.zeros(BASIS, 3) if given is None else rig.power * torch.from_numpy(given).float()
        alone = capture.photographs.dark and not shared_emitters(capture.scene)
        self.room = RoomLight(room, rig.exposure, frames, alone)

    def value(self, name: str) -> Tensor:
        """Return the current value of the unknown `name` in its own unit; 0 if it is not refined."""
        return getattr(self, name) * self.widths[name] if name in self.widths else torch.zeros(())

    def estimate(self) -> Estimate:
        """Apply the current values of all unknowns to the capture's cameras, lights and response."""
        now = self.rig.estimate()
        for name, unknown in self.unknowns.items():
            now = unknown.apply(now, self.value(name), self.rig)
        return now

    def forward(self, scale: int = 1) -> Views:
        """Return the current cameras and lights of all photographs. `scale`: how many times smaller pictures are."""
        views = self.rig.views_of(self.estimate())
        return views if scale == 1 else views._replace(intrinsics=views.intrinsics / scale)

    def lamps(self) -> LightTensors:
        """Return the lamps of the scene with their current places and strengths."""
        return self.rig.lamps_of(self.estimate())

    def lamp_tensors(self) -> list[Tensor]:
        """List [places (L, 3), strengths (L, 3)] of the scene's L lamps; [] if lamps are not refined."""
        if "lamps" not in self.refined:
            return []
        now = self.lamps()
        return [now.places.to(device()), now.strengths.to(device())]

    def solves_room(self, progress: float) -> bool:
        """Test whether the fit estimates the room's light at this `progress`, 0 to 1.

        If the room's light is the only one, the fit estimates it from the start. Otherwise it begins at `ROOM_START`.
        """
        return "ambient" in self.refined and (self.rig.dark or progress >= ROOM_START)

    @torch.no_grad()
    def relight(self, surface: Surface) -> None:
        """Set the lamps in the scene of `surface` to their current values. Does nothing if lamps are not refined."""
        if lamps := self.lamp_tensors():
            surface.relight(*map(bridge.to_drjit, lamps))

    @property
    def albedo_factor(self) -> float:
        """Factor of the albedo: with it, a change of the unknown `scale` does not change directly lit surfaces."""
        return math.exp(-float(self.value("scale").detach()))

    @property
    def power_factor(self) -> float:
        """Common factor of the strengths of all lights, as estimated so far."""
        return self.rig.power / self.albedo_factor

    def indirect(self, light: Tensor) -> Tensor:
        """Attach interreflection `light` (n, H, W, 3) to the unknown `scale`. Returns the same values with a gradient.

        If the lights are stronger, the surface is darker, and each bounce after the first is weaker by this factor.
        """
        scale = self.value("scale").to(light)
        return light * (scale.detach() - scale).exp()

    def cosines(self, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Compute the cosine (N, H, W, 1) of the angle between the optical axis and the ray of each pixel.

        `index` (N,): the photographs. `scale`: how many times smaller they are.
        """
        width, height = (size // scale for size in self.rig.sizes[index[0]])
        views = self(scale)
        fx, fy, cx, cy = (views.intrinsics[index].detach().T)[..., None, None]
        x = (torch.arange(width) + 0.5 - cx) / fx
        y = (torch.arange(height)[:, None] + 0.5 - cy) / fy
        distance2 = x**2 + y**2
        distance2 = distance2 * undistortion_factor(views.distortion[index].detach()[:, None, None], distance2) ** 2
        return (1 + distance2)[..., None] ** -0.5

    def response(self) -> CameraResponse:
        """Return the camera response with the current values."""
        return self.estimate().response

    def recorded(self, radiance: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Convert scene radiance (N, H, W, 3) to the values that the cameras record, by the current response.

        `index` (N,): the photographs. `scale`: how many times smaller they are.
        """
        response = self.response()
        return response.recorded(radiance, index, self.cosines(index, scale) if response.has_vignetting else None)

    @torch.no_grad()
    def linear(self, recorded: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Convert recorded values (N, H, W, 3) to scene radiance: the inverse of `recorded`, without gradients."""
        response = self.response()
        return response.linear(recorded, index, self.cosines(index, scale) if response.has_vignetting else None)

    def refined_photographs(self, photographs: Photographs, views: Views) -> Photographs:
        """Return `photographs`, for the renderer, with other cameras and lights and with the current room light.

        `views`: the cameras and lights of all P photographs. The result has no gradients.
        """
        room = self.room_harmonics().double().numpy(force=True)
        return replace(prediction.with_views(photographs, views), room=room if room.any() else None)

    def room_harmonics(self) -> Tensor:
        """Return the current spherical harmonics (BASIS, 3) of the room.

        If they are not refined, they are those of the capture times the factor of all lights, `scale`.
        """
        harmonics = self.room.harmonics
        return harmonics if "ambient" in self.refined else harmonics / self.albedo_factor

    @torch.no_grad()
    def room_share(self, harmonics: Tensor) -> Tensor:
        """Compare room light, `harmonics` (BASIS, 3), with the photographs' own lights at the object.

        Returns the mean irradiance by the room, divided by the irradiance of a surface that faces the photograph's
        light (3,). If photographs have no lights of their own, it returns the mean radiance (3,) of the room.
        """
        now = self()
        distance2 = torch.where(self.rig.finite, (now.places - self.rig.center).square().sum(-1, keepdim=True), 1.0)
        mean = math.pi * harmonics[0].cpu() / math.sqrt(4 * math.pi)
        own = (now.strengths / distance2).median(0).values
        return mean / own if bool((own > 0).all()) else mean / math.pi

    def prior(self) -> Tensor:
        """Compute the loss of the Gaussian priors: half the sum of squares of all unknowns, per photograph."""
        return sum((getattr(self, name).square().sum() for name in self.widths), torch.zeros(())) / 2 / len(self.rig)

    def parameters_without_solver(self) -> list[list[Tensor]]:
        """List the parameters that an optimiser must train, because no solver estimates them.

        Returns a list of parameters for each option of `--refine`.
        """
        groups: dict[str, list[Tensor]] = {}
        for name, unknown in self.unknowns.items():
            if not unknown.solved:
                groups.setdefault(unknown.option, []).append(getattr(self, name))
        return list(groups.values())

    def current_and_given(self, option: str) -> list[tuple[Tensor, Tensor]]:
        """List (current value, value of the capture), two tensors, for each unknown of an `option` of `--refine`.

        The caller may change the current value in place.
        """
        if option == "ambient":
            return [(self.room.harmonics, self.room.given)]
        own = [getattr(self, name) for name, unknown in self.unknowns.items() if unknown.option == option]
        return [(tensor, torch.zeros_like(tensor)) for tensor in own]

    @torch.no_grad()
    def applied(self, capture: Capture) -> Capture:
        """Return the capture with the current cameras, lights, lamps and camera response."""
        estimate = self.estimate()
        views, lamps = self.rig.views_of(estimate), self.rig.lamps_of(estimate)
        gamma, contrast = (float(self.value(name).exp()) for name in ("curve", "contrast"))
        gains = np.ones((len(self.rig), 3))
        if "gain" in self.refined:
            gains = centred(self.value("gain"), self.rig).double().exp().numpy()
        # The curve keeps the exposure here, and full scale in a scene file.
        level = self.rig.exposure ** ((1 - gamma) / gamma)
        lights = LightTensors(views.places, self.rig.finite, level * views.strengths.double()).lights()
        views = Views(*(part.double().numpy() for part in views))
        shots = []
        for k, shot in enumerate(capture.shots):
            response = shot.response.changed(gamma, contrast, float(self.value("vignetting")), gains[k])
            shots.append(replace(shot, camera=views.camera(k, shot.size), light=lights[k],
                                 falloff=float(views.falloff[k]), response=response))  # fmt: skip
        scene, room = capture.scene, None
        if "lamps" in self.refined:
            scene = with_lamps(scene, lamps._replace(strengths=level * lamps.strengths).lights())
        if "ambient" in self.refined or capture.room is not None:
            room = self.room_harmonics().double().numpy(force=True) * level
        return replace(capture, scene=scene, shots=tuple(shots), room=room)
