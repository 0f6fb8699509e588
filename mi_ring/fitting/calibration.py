"""Cameras, lights, room and camera curve as unknowns: what a fit refines besides surface and material.

The paper refines calibration together with the shape (its Table 3). Gauges, what no photograph can tell: brightness
against albedo, but for interreflection (the logarithms of `power` and `gain` have the mean zero in each colour, and
`scale` takes the reflectance along); where the whole is, how it is turned and how large it is, which only the priors
hold; focal length against distance, likewise; the cone of a flash against vignetting, nearly, where it is beside the
lens. A room that is alike from all sides is in the world's axes and in the camera's: it counts as the world's. One
fixed in the camera looks like a flash that is elsewhere, and like another reflectance: it is refined only where the
scene has one.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.fitting.curve import Curve
from mi_ring.fitting.lamps import Lamps
from mi_ring.fitting.room_light import Room
from mi_ring.geometry.camera import Camera, distortion_range, straightening
from mi_ring.geometry.rotations import quarter_turns, rotations
from mi_ring.rendering import bridge
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.spherical_harmonics import BASIS
from mi_ring.scene.assembly import has_table, lamp_lights, lamps_of, with_lamps
from mi_ring.scene.lights import shared_emitters
from mi_ring.system.machine import device

#: What is refined together, and the standard deviation of each unknown: of its prior, and the unit of its steps.
UNKNOWNS: dict[str, dict[str, float]] = {
    "cameras": {
        "turn": 0.01,  # about each axis of the camera [rad]
        "move": 0.005,  # along each axis of the camera [median distance from the cameras to the object]
    },
    "focal": {"focal": 0.01},  # logarithm, one for each lens
    "principal": {"principal": 0.01},  # along both axes of the picture, one for each lens [focal lengths]
    "distortion": {"distortion": 0.05},  # first radial one, for each lens
    "light": {"light": 0.1},  # along each axis [the same distance]; of distant ones [rad]
    "power": {"power": 0.1},  # logarithm, of each photograph and colour
    "falloff": {"falloff": 1.0},  # exponent of the cosine about the flash's axis
    "vignetting": {"vignetting": 1.0},  # exponent of the cosine about the lens'
    "curve": {"curve": 0.2},  # logarithm of the exponent
    "contrast": {"contrast": 0.2},  # logarithm of how steep the curve's S is
    "gain": {"gain": 0.1},  # logarithm, of each photograph and colour
    "scale": {"scale": 0.7},  # logarithm of the power of all lights together
    "ambient": {},  # `Room`
    "lamps": {
        "lamp": 0.1,  # of those of the scene, as `light`
        "strength": 0.5,  # logarithm, of each lamp and colour
    },
}
#: What is refined by default; `scale`, too, where it must be wrong. Of a flash what is beside the lens: one ahead looks
#: like a darker surface. Not `curve`: it looks like another, and takes light and room along (docs/phone.md).
AUTO = "light", "power", "ambient"
#: What is unknown under each `Config.light` that is.
NOBODY_KNOWS = {"environment": {"ambient"}, "turntable": {"ambient"}, "lamps": {"light", "ambient", "lamps"}}
OF_ONE = {"cameras", "power", "gain"}  #: what is another in each photograph; steps of their own find it
#: What is of the photographs' own lights, which an unknown environment takes the place of.
OF_LIGHTS = {"light", "power", "falloff", "scale"}
VAGUE = 3.0  #: times as wide are priors, and steps, of where lights are that nobody has measured
RIGID = 0.02  #: how much the place of a flash may vary in the camera's axes [the same distance]
START = 0.2  #: progress of the fit when refinement begins
LIT = 0.15  #: and when that of the room's light does
RATE = 0.1  #: of Adam, in standard deviations an iteration


def refined_of(capture: Capture, config: Config, albedo: float) -> tuple[str, ...]:
    """Names of what a fit refines: as `Config.refine` says, `auto` by what the capture says of itself.

    `albedo`: the object's, by the lights' intensities.
    """
    names: set[str] = set(config.refine)
    auto = "auto" in names and not capture.known
    unknown = NOBODY_KNOWS.get(config.light)
    if unknown or capture.photographs.dark:
        names |= unknown or ({"ambient"} if auto and not shared_emitters(capture.scene) else set())
        names |= {"gain"} if auto and "power" not in names else set()
    elif auto:
        subtracted = {"ambient"} if all(shot.files.ambient for shot in capture.shots) else set()
        names |= {*AUTO} - subtracted - ({"power"} if "gain" in names else set())
        if config.indirect and albedo >= 1 and not has_table(capture.scene):
            names.add("scale")
    return tuple(name for name in UNKNOWNS if name in names and (name != "lamps" or lamps_of(capture.scene)))


def overall(refined: Sequence[str], albedo: float) -> float:
    """The factor of the lights' power that `scale` begins with: 1, or what makes an impossible albedo a usual one."""
    return albedo / ALBEDO if "scale" in refined and albedo >= 1 else 1.0


class Calibrated(NamedTuple):
    """Cameras and lights of all P photographs."""

    cameras: Tensor  #: (P, 3, 4) camera-to-world
    intrinsics: Tensor  #: (P, 4) fx, fy, cx, cy [px]
    places: Tensor  #: (P, 3) of lights: positions [scene units], of distant ones unit directions toward them
    strengths: Tensor  #: (P, 3) intensities, of distant ones irradiances
    falloff: Tensor  #: (P,) exponents of flashes' cones
    distortion: Tensor  #: (P,) first radial ones of the lenses


class Calibration(nn.Module):
    """The unknowns, each in units of its prior's standard deviation: zero where the capture is right."""

    base: Calibrated

    def __init__(
        self, capture: Capture, refined: Sequence[str], center: np.ndarray, exposure: float, power: float = 1.0,
        fitted: np.ndarray | None = None, frames: Collection[str] = ("world",), guessed: bool = False,
        ahead: bool = True,
    ) -> None:  # fmt: skip
        """`refined`: of `UNKNOWNS`; `center` (3,): of the object; `exposure`: its radiance, where the curve stays.

        `power`: a factor of what the capture says of the lights' intensities, to begin with; `fitted`: indices of the
        photographs that are not kept out, by default all; `frames`: axes in which a room's light is fixed; `guessed`:
        has nobody measured where the lights are? `ahead`: may a flash be found along its camera's axis, too?
        """
        super().__init__()
        self.refined, self.exposure, self.first_power = tuple(refined), exposure, power
        cameras, lights = [shot.camera for shot in capture.shots], capture.photographs.lights
        to_world = np.stack([camera.to_world[:3] for camera in cameras])
        intrinsics = np.array([[*camera.focal, *camera.centre] for camera in cameras])
        cones = np.array([shot.falloff for shot in capture.shots])
        distortion = np.array([camera.distortion for camera in cameras])
        #: Does any lens have a distortion, or one that is to be found?
        self.bent = bool(distortion.any()) or "distortion" in refined
        arrays = to_world, intrinsics, lights.positions(), power * lights.rgb(), cones, distortion
        self.base = Calibrated(*(torch.from_numpy(array).float() for array in arrays))
        self.center = torch.from_numpy(np.asarray(center)).float()
        self.finite = torch.from_numpy(lights.is_finite())[:, None]
        self.distance = float(np.median(np.linalg.norm(to_world[:, :, 3] - center, axis=1)))
        inside = torch.einsum("pji,pj->pi", self.base.cameras[:, :, :3], self.base.places - self.base.cameras[:, :, 3])
        #: (P, 3, 3) turns of the cameras' axes, of photographs that are held on their side
        self.held = quarter_turns(inside, RIGID * self.distance)
        level = (self.held.mT @ inside[..., None])[..., 0]
        self.level = level.mean(0)  #: (3,) where the flash is in the axes of a camera that is held upright
        #: (P, 3) where the lights are in the cameras' axes if they are one flash that moves with the camera, else None
        spread = float((level.amax(0) - level.amin(0)).max())
        self.flash = inside if self.finite.all() and spread < RIGID * self.distance and not guessed else None
        self.free = torch.tensor([1.0, 1.0, float(ahead or self.flash is None)])  # components of `light`
        if "falloff" in refined and self.flash is None:
            raise InputError(f"{capture.path}: emitter: the lights do not move with the cameras, but --refine "
                             "falloff is for a flash that does; leave it out")  # fmt: skip
        self.lamps = Lamps.of(lamp_lights(capture.scene) if "lamps" in refined else [])  #: unknown
        self.sizes = [shot.size for shot in capture.shots]
        self.gammas = torch.tensor([shot.response.gamma for shot in capture.shots])
        self.dimmed = torch.tensor([shot.response.vignetting for shot in capture.shots])
        self.gains = torch.from_numpy(np.array([shot.response.gain for shot in capture.shots])).float()
        kinds = np.column_stack([intrinsics[:, :2].round(3), distortion.round(6)])
        lenses = np.unique(kinds, axis=0, return_inverse=True)[1].ravel()
        relative = lights.positions() / np.where(lights.is_finite(), self.distance, 1.0)[:, None]
        places = np.unique(relative.round(6), axis=0, return_inverse=True)[1].ravel()
        places = places if self.flash is None else np.zeros_like(places)
        self.lens, self.place = torch.from_numpy(lenses), torch.from_numpy(places)
        count = len(cameras)
        self.fitted = torch.arange(count) if fitted is None else torch.from_numpy(fitted)
        shapes = {"turn": (count, 3), "move": (count, 3), "focal": (int(lenses.max()) + 1,),
                  "principal": (int(lenses.max()) + 1, 2), "distortion": (int(lenses.max()) + 1,),
                  "falloff": (), "vignetting": (),
                  "light": (int(places.max()) + 1, 3), "power": (count, 3), "gain": (count, 3),
                  "curve": (), "contrast": (), "scale": (),
                  "lamp": self.lamps.places.shape, "strength": self.lamps.places.shape}  # fmt: skip
        vague = dict.fromkeys(("light", "lamp"), VAGUE if guessed else 1.0)
        self.widths = {name: width * vague.get(name, 1.0)
                       for group in self.refined for name, width in UNKNOWNS[group].items()}  # fmt: skip
        for name in self.widths:
            self.register_parameter(name, nn.Parameter(torch.zeros(shapes[name])))
        given = capture.photographs.room
        room = torch.zeros(BASIS, 3) if given is None else power * torch.from_numpy(given).float()
        self.room = Room(room, exposure, frames, capture.photographs.dark and not shared_emitters(capture.scene))

    def value(self, name: str) -> Tensor:
        """An unknown in its own unit; 0 if it is none."""
        return getattr(self, name) * self.widths[name] if name in self.widths else torch.zeros(())

    def forward(self) -> Calibrated:
        """Cameras and lights as they are by now."""
        cameras, intrinsics, places, strengths, falloff, distortion = self.base
        if "cameras" in self.refined:
            turned = cameras[:, :, :3] @ rotations(self.value("turn"))
            moved = cameras[:, :, 3:] + cameras[:, :, :3] @ (self.value("move") * self.distance)[..., None]
            cameras = torch.cat([turned, moved], 2)
        if "focal" in self.refined:
            factor = self.value("focal").exp()[self.lens, None]
            intrinsics = torch.cat([intrinsics[:, :2] * factor, intrinsics[:, 2:]], 1)
        if "principal" in self.refined:
            shift = self.value("principal")[self.lens] * intrinsics[:, :2]
            intrinsics = torch.cat([intrinsics[:, :2], intrinsics[:, 2:] + shift], 1)
        if self.bent:
            now = intrinsics.detach()
            least, most = distortion_range(now[:, :2], now[:, 2:], torch.tensor(self.sizes))
            if "distortion" in self.refined:
                distortion = distortion + self.value("distortion")[self.lens]
            distortion = distortion.clamp(0.999 * least, 0.999 * most)
        offset = (self.free * self.value("light")).expand(int(self.place.max()) + 1, 3)[self.place]
        if self.flash is not None:
            moved = self.flash[..., None] + self.held @ (offset * self.distance)[..., None]
            places = cameras[:, :, 3] + (cameras[:, :, :3] @ moved)[..., 0]
        else:
            places = Lamps(places, self.finite, strengths).moved(offset, self.distance).places
        scale = self.value("scale").detach()  # the reflectance is as much less: only `bounced` tells of it
        strengths = strengths * (scale + self.centred("power")).exp()
        return Calibrated(cameras, intrinsics, places, strengths, falloff + self.value("falloff"), distortion)

    def lamps_now(self) -> Lamps:
        """The lamps of the scene as they are by now."""
        factor = self.first_power * (self.value("strength") + self.value("scale").detach()).exp()
        return self.lamps._replace(strengths=factor * self.lamps.strengths).moved(self.value("lamp"), self.distance)

    def lamp_tensors(self) -> list[Tensor]:
        """What `bridge.render` takes as `lamps`: nothing if these stay as they are."""
        if "lamps" not in self.refined:
            return []
        now = self.lamps_now()
        return [now.places.to(device()), now.strengths.to(device())]

    @torch.no_grad()
    def relight(self, surface: bridge.Surface) -> None:
        """Light a surface by the lamps of the scene as they are by now."""
        if lamps := self.lamp_tensors():
            surface.relight(*map(bridge.to_drjit, lamps))

    def centred(self, name: str) -> Tensor:
        """(P, 3) `power` or `gain`, logarithms of factors, of mean 0; 0 of photographs that are kept out."""
        found = self.value(name).expand(len(self.lens), 3)
        result = torch.zeros_like(found)
        result[self.fitted] = found[self.fitted] - found[self.fitted].mean(0)
        return result

    def scaled(self, scale: int) -> Calibrated:
        """For photographs `scale` times smaller."""
        calibrated = self()
        return calibrated._replace(intrinsics=calibrated.intrinsics / scale)

    @property
    def reflecting(self) -> float:
        """The factor of the reflectance that keeps directly lit surfaces as bright as they are, whatever `scale` is."""
        return math.exp(-float(self.value("scale").detach()))

    @property
    def strengthened(self) -> float:
        """The factor of the power of all lights that has been found."""
        return self.first_power / self.reflecting

    def bounced(self, interreflection: Tensor) -> Tensor:
        """Light that has bounced between surfaces, attached to `scale`.

        All other unknowns keep it as it is: it is one more reflection by a surface that is darker by as much as lights
        are stronger.
        """
        scale = self.value("scale").to(interreflection)
        return interreflection * (scale.detach() - scale).exp()

    def cosines(self, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """(N, H, W, 1) of the angles between the optical axis and the rays of photographs, `scale` times smaller."""
        width, height = (size // scale for size in self.sizes[index[0]])
        at = self.scaled(scale)
        fx, fy, cx, cy = (at.intrinsics[index].detach().T)[..., None, None]
        x = (torch.arange(width) + 0.5 - cx) / fx
        y = (torch.arange(height)[:, None] + 0.5 - cy) / fy
        distance2 = x**2 + y**2
        if self.bent:
            distance2 = distance2 * straightening(at.distortion[index].detach()[:, None, None], distance2) ** 2
        return (1 + distance2)[..., None] ** -0.5

    @property
    def curve_now(self) -> Curve:
        """What lens and curve make of radiance by now."""
        exponent, contrast, vignetting = (
            self.value(name) if name in self.widths else None for name in ("curve", "contrast", "vignetting")
        )
        gain = self.centred("gain").detach().exp() if "gain" in self.widths else None
        return Curve(exponent, contrast, vignetting, self.gammas, self.dimmed, self.exposure, self.gains, gain)

    def recorded(self, radiance: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """`Curve.recorded` of photographs `index`, `scale` times smaller: radiance (N, H, W, 3)."""
        curve = self.curve_now
        return curve.recorded(radiance, index, self.cosines(index, scale) if curve.shading else None)

    @torch.no_grad()
    def linear(self, recorded: Tensor, index: Sequence[int] | np.ndarray, scale: int) -> Tensor:
        """The inverse of `recorded`, without gradients."""
        curve = self.curve_now
        return curve.linear(recorded, index, self.cosines(index, scale) if curve.shading else None)

    def as_found(self, photographs: Photographs, calibrated: Sequence[Tensor]) -> Photographs:
        """Photographs with cameras and lights as `calibrated`, and the room as it is by now; without gradients."""
        room = self.roomlight().double().numpy(force=True)
        return replace(bridge.calibrated(photographs, calibrated), room=room if room.any() else None)

    def roomlight(self) -> Tensor:
        """(BASIS, 3) harmonics of the room's light as they are by now; what a scene says goes with `scale`."""
        harmonics = self.room.harmonics
        return harmonics if "ambient" in self.refined else harmonics / self.reflecting

    def room_share(self, harmonics: Tensor) -> Tensor:
        """(3,) a room's light on the object, mean over all directions, by that of the flash where it faces it.

        Where there is none, its mean radiance.
        """
        with torch.no_grad():
            now = self()
            distance2 = torch.where(self.finite, (now.places - self.center).square().sum(-1, keepdim=True), 1.0)
            mean = math.pi * harmonics[0].cpu() / math.sqrt(4 * math.pi)
            own = (now.strengths / distance2).median(0).values
            return mean / own if bool((own > 0).all()) else mean / math.pi

    def prior(self) -> Tensor:
        """Half the mean over the photographs of the squares, of the unknowns in their standard deviations."""
        return sum((getattr(self, name).square().sum() for name in self.widths), torch.zeros(())) / 2 / len(self.lens)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """Adam, whose groups say when they begin, for all but what is `OF_ONE`; none if nothing is left to find."""
        found = [UNKNOWNS[group] for group in self.refined if group not in OF_ONE]
        groups = [{"params": [getattr(self, name) for name in names], "initial_lr": RATE, "start": START}
                  for names in found if names]  # fmt: skip
        return [torch.optim.Adam(groups, lr=RATE)] if groups else []

    def unknown(self, name: str) -> tuple[Tensor, Tensor]:
        """An unknown of all photographs as it is, to be changed in place, and as the capture says."""
        if name == "ambient":
            return self.room.harmonics, self.room.given
        return getattr(self, name), torch.zeros_like(getattr(self, name))

    def applied(self, capture: Capture) -> Capture:
        """The capture with cameras, lights and curve as they are by now."""
        with torch.no_grad():
            now, lamps, gains = self(), self.lamps_now(), self.centred("gain").double().exp().numpy()
            gamma, contrast = (float(self.value(name).exp()) for name in ("curve", "contrast"))
            vignetting = float(self.value("vignetting"))
        # The curve's fixed point is the exposure here, full scale in a scene file.
        level = self.exposure ** ((1 - gamma) / gamma)
        lights, shots = Lamps(now.places, self.finite, level * now.strengths.double()).lights(), []
        matrices, intrinsics, _, _, falloff, distortion = (part.numpy() for part in now)
        for k, shot in enumerate(capture.shots):
            pose = np.vstack([matrices[k], np.eye(4, dtype=np.float32)[3]])
            camera = Camera(pose, intrinsics[k, :2], intrinsics[k, 2:], shot.size, float(distortion[k]))
            response = shot.response.changed(gamma, contrast, vignetting, gains[k])
            shots.append(replace(shot, camera=camera, light=lights[k], falloff=float(falloff[k]), response=response))
        found, lit = lamps._replace(strengths=level * lamps.strengths).lights(), "ambient" in self.refined
        scene = with_lamps(capture.scene, found) if "lamps" in self.refined else capture.scene
        room = self.roomlight().double().numpy(force=True) * level if lit or capture.room is not None else None
        return replace(capture, scene=scene, shots=tuple(shots), room=room)
