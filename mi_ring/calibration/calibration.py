"""The calibration that a fit refines: the unknowns of cameras and lights with their values, and the room's light.

The paper refines calibration together with the shape (its Table 3). Room light may be fixed in the axes of the world or
of the camera. Light from all sides counts as fixed in the world. Light that is fixed in the camera can be confused with
a flash at another place or with another reflectance. So it is refined only if the scene already has such light.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mi_ring.calibration.camera_response import CameraResponse
from mi_ring.calibration.light_tensors import LightTensors
from mi_ring.calibration.rig import Estimate, Rig
from mi_ring.calibration.room_light import RoomLight
from mi_ring.calibration.unknown import Unknown
from mi_ring.calibration.unknowns import UNKNOWNS, Exposure
from mi_ring.capture.capture import Capture
from mi_ring.errors import InputError
from mi_ring.geometry.camera import undistortion_factor
from mi_ring.rendering import bridge, prediction
from mi_ring.rendering.lobe_light import LobeLight
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.rendering.surface import Surface
from mi_ring.rendering.views import Views
from mi_ring.scene.assembly import with_lamps
from mi_ring.scene.lights import shared_emitters
from mi_ring.scene.lobes import Lobes
from mi_ring.scene.tone_curve import ToneCurve
from mi_ring.system.machine import device

#: All options of `--refine` with values in a calibration, in order.
OPTIONS = [*dict.fromkeys(unknown.option for unknown in UNKNOWNS.values())]
OPTIONS.insert(OPTIONS.index("lamps"), "ambient")


class Calibration(nn.Module):
    """The unknowns of calibration as trainable parameters. At 0, an unknown has the value of the capture.

    The unit of each parameter is the standard deviation of its Gaussian prior.
    """

    turn: nn.Parameter  #: (cameras, 3) rotations about the camera's axes, if poses are refined
    move: nn.Parameter  #: (cameras, 3) translations along them

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
        # A flash farther ahead looks like a darker surface: by default no gradient moves it there.
        if "light" in self.unknowns:
            self.get_parameter("light").register_hook(lambda gradient: gradient * rig.free)
        #: Is one flash that moves with the cameras the only light that scene and photographs state?
        self.flash_alone = rig.flash is not None and bool(rig.lit.all()) and not shared_emitters(capture.scene)
        given = capture.room
        room = torch.zeros(BASIS, 3) if given is None else rig.power * torch.from_numpy(given).float()
        alone = not capture.photographs.lit.all() and not shared_emitters(capture.scene)
        lobes = None if capture.lobes is None else capture.lobes.scaled(rig.power)
        self.room = RoomLight(room, rig.exposure, frames, alone, lobes)

    def value(self, name: str) -> Tensor:
        """Return the current correction of one kind of calibration parameter, in the parameter's unit.

        `name`: a key of `UNKNOWNS`. Returns a scalar 0 if the fit does not refine it.
        """
        return getattr(self, name) * self.widths[name] if name in self.widths else torch.zeros(())

    def estimate(self) -> Estimate:
        """Return the capture's cameras, lights and response, changed by the current values of all unknowns."""
        now = self.rig.estimate()
        for name, unknown in self.unknowns.items():
            now = unknown.apply(now, self.value(name), self.rig)
        return now

    def forward(self, scale: int = 1) -> Views:
        """Return the current cameras and lights of all photographs.

        `scale`: factor by which pictures are reduced. The intrinsics [px] are divided by it.
        """
        views = self.rig.views_of(self.estimate())
        return views if scale == 1 else views._replace(intrinsics=views.intrinsics / scale)

    def lamps(self) -> LightTensors:
        """Return the scene's own lamps, which light all photographs, with their current places and strengths."""
        return self.rig.lamps_of(self.estimate())

    def lamp_tensors(self) -> list[Tensor]:
        """Return [places, strengths] of the scene's own L lamps, two tensors (L, 3); [] if lamps are not refined.

        A place is a position [scene units], or the unit direction toward a distant lamp.
        """
        if "lamps" not in self.refined:
            return []
        now = self.lamps()
        return [now.places.to(device()), now.strengths.to(device())]

    @property
    def exposure_of_flash(self) -> str | None:
        """The unknown that the joint solution finds together with the flash's place: "power", "gain" or None."""
        refined = [name for name in ("power", "gain") if name in self.unknowns]
        return refined[0] if refined and self.flash_alone else None

    @property
    def follows_room(self) -> bool:
        """Tell whether each iteration estimates the room's light: if some or all photographs have no other light."""
        return "ambient" in self.refined and self.room.alone

    @torch.no_grad()
    def relight(self, surface: Surface) -> None:
        """Set the lamps in the scene that contains `surface` to their current values.

        Does nothing if lamps are not refined.
        """
        if lamps := self.lamp_tensors():
            surface.relight(*map(bridge.to_drjit, lamps))

    @property
    def albedo_factor(self) -> float:
        """Factor of the albedo that cancels the unknown `scale`, the common factor of all lights, in direct light."""
        return math.exp(-float(self.value("scale").detach()))

    @property
    def power_factor(self) -> float:
        """Common factor of the strengths of all lights, relative to the capture, as estimated so far."""
        return self.rig.power / self.albedo_factor

    def indirect(self, light: Tensor) -> Tensor:
        """Give interreflection a gradient with respect to the unknown `scale`, the common factor of all lights.

        `light` (n, H, W, 3): linear radiance. Returns the same values. If the lights are stronger, the albedo is lower
        by the same factor. Each bounce after the first is then weaker by this factor.
        """
        scale = self.value("scale").to(light)
        return light * (scale.detach() - scale).exp()

    def directions(self, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Compute the unit direction (N, H, W, 3) of the ray of each pixel in the camera's axes: left, up, forward.

        `index` (N,): indices of the photographs. `scale`: factor by which they are reduced. The result has no gradient.
        """
        width, height = (size // scale for size in self.rig.sizes[index[0]])
        views = self(scale)
        fx, fy, cx, cy = (views.intrinsics[index].detach().T)[..., None, None]
        x = (cx - torch.arange(width) - 0.5) / fx
        y = (cy - torch.arange(height)[:, None] - 0.5) / fy
        factor = undistortion_factor(views.distortion[index].detach()[:, None, None], x**2 + y**2)
        x, y = factor * x, factor * y
        return F.normalize(torch.stack([x, y, torch.ones_like(x)], -1), dim=-1)

    def cosines(self, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Compute the cosine (N, H, W, 1) of the angle between the optical axis and the ray of each pixel.

        `index` (N,): indices of the photographs. `scale`: factor by which they are reduced. The result has no gradient.
        """
        return self.directions(index, scale)[..., 2:]

    def response(self) -> CameraResponse:
        """Return the camera response (vignetting, gains and tone curve) with the current values of the unknowns."""
        return self.estimate().response

    def recorded(self, radiance: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Convert scene radiance (N, H, W, 3) to the values that the cameras record with the current camera response.

        `index` (N,): indices of the photographs. `scale`: factor by which the photographs are reduced.
        """
        response = self.response()
        return response.recorded(radiance, index, self.cosines(index, scale) if response.has_vignetting else None)

    @torch.no_grad()
    def linear(self, recorded: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """Convert recorded values (N, H, W, 3) to scene radiance with the current camera response, without gradients.

        `index` (N,): indices of the photographs. `scale`: factor by which the photographs are reduced.
        """
        response = self.response()
        return response.linear(recorded, index, self.cosines(index, scale) if response.has_vignetting else None)

    def refined_photographs(self, photographs: Photographs, views: Views) -> Photographs:
        """Return a copy of `photographs` with other cameras and lights, and with the current room light, for rendering.

        `views`: the new cameras and lights of all photographs. The result has no gradients.
        """
        room = self.room_harmonics().double().numpy(force=True)
        lobes = LobeLight.of(self.room_lobes())
        return replace(prediction.with_views(photographs, views), room=room if room.any() else None, lobes=lobes)

    def room_harmonics(self) -> Tensor:
        """Return the current spherical harmonics (BASIS, 3) of the room's light.

        If the room's light is not refined, the harmonics of the capture are multiplied by the common factor of all
        lights.
        """
        harmonics = self.room.harmonics
        return harmonics if "ambient" in self.refined else harmonics / self.albedo_factor

    def room_lobes(self) -> Lobes | None:
        """Return the current lobes of the room's light; None if there are none.

        If the room's light is not refined, those of the capture are multiplied by the common factor of all lights.
        """
        lobes = self.room.lobes()
        return lobes if lobes is None or "ambient" in self.refined else lobes.scaled(1 / self.albedo_factor)

    @torch.no_grad()
    def room_share(self, harmonics: Tensor, lobes: Lobes | None = None) -> Tensor:
        """Compare the room's light with the photographs' own lights, of those that have one, at the object.

        Returns a ratio (3,), one for each colour. `harmonics` (BASIS, 3), `lobes`: the room's light. The ratio is the
        mean irradiance by the room, divided by the irradiance of a surface that faces the photograph's light. If
        photographs have no lights of their own, the result is the mean radiance (3,) of the room.
        """
        now = self()
        distance2 = torch.where(self.rig.finite, (now.places - self.rig.center).square().sum(-1, keepdim=True), 1.0)
        mean = math.pi * harmonics[0].cpu() / math.sqrt(4 * math.pi)
        if lobes is not None:
            mean = mean + math.pi * torch.from_numpy(lobes.mean_radiance()).to(mean)
        own = (now.strengths / distance2)[self.rig.mainly].median(0).values
        own = torch.where(own > 0, own, own.mean())  # a light may lack a colour
        return mean / own if bool((own > 0).all()) else mean / math.pi

    def prior(self) -> Tensor:
        """Compute the loss of the Gaussian priors: half the sum of squares of all parameters.

        It is divided by the number of photographs.
        """
        return sum((getattr(self, name).square().sum() for name in self.widths), torch.zeros(())) / 2 / len(self.rig)

    def parameters_without_solver(self) -> list[list[Tensor]]:
        """List the parameters that Adam must train. The other unknowns have solvers, for example for camera poses.

        Returns a list of lists: the parameters of each option of `--refine`.
        """
        groups: dict[str, list[Tensor]] = {}
        for name, unknown in self.unknowns.items():
            if not unknown.solved:
                groups.setdefault(unknown.option, []).append(getattr(self, name))
        return list(groups.values())

    def current_and_given(self, option: str) -> list[tuple[Tensor, Tensor]]:
        """List (current value, value of the capture) of each unknown that an `option` of `--refine` refines.

        Both are tensors in the unit of the parameter. The caller may change the current value in place.
        """
        if option == "ambient":
            return self.room.current_and_given()
        own = [getattr(self, name) for name, unknown in self.unknowns.items() if unknown.option == option]
        return [(tensor, torch.zeros_like(tensor)) for tensor in own]

    @torch.no_grad()
    def applied(self, capture: Capture) -> Capture:
        """Return a copy of `capture` with the current cameras, lights, lamps, room light and camera response."""
        estimate = self.estimate()
        views, lamps = self.rig.views_of(estimate), self.rig.lamps_of(estimate)
        gamma, contrast = (float(self.value(name).exp()) for name in ("curve", "contrast"))
        curve = ToneCurve(gamma, contrast, float(self.value("toe")))
        gains = np.ones((len(self.rig), 3))
        if "gain" in self.refined:
            unknown = self.unknowns["gain"]
            assert isinstance(unknown, Exposure)
            gains = unknown.centred(self.value("gain"), self.rig).double().exp().numpy()
        # The curve keeps the exposure here, and full scale in a scene file.
        level = self.rig.exposure ** ((1 - gamma) / gamma)
        lights = LightTensors(views.places, self.rig.finite, level * views.strengths.double()).lights()
        views = Views(*(part.double().numpy() for part in views))
        shots = []
        for k, shot in enumerate(capture.shots):
            response = shot.response.changed(curve, float(self.value("vignetting")), gains[k])
            shot = replace(shot, camera=views.camera(k, shot.size), response=response)
            if not self.rig.mixed or self.rig.lit[k]:
                falloff, left, up = views.cone[k].tolist()
                shot = replace(shot, light=lights[k], falloff=falloff, tilt=(left, up))
            shots.append(shot)
        scene, room = capture.scene, None
        if "lamps" in self.refined:
            scene = with_lamps(scene, lamps._replace(strengths=level * lamps.strengths).lights())
        if "ambient" in self.refined or capture.room is not None:
            room = self.room_harmonics().double().numpy(force=True) * level
        lobes = self.room_lobes()
        return replace(capture, scene=scene, shots=tuple(shots), room=room, lobes=lobes and lobes.scaled(level))
