"""The unknowns of calibration: cameras, lenses, lights and the camera's response. Each unknown has a class.

A new unknown is a class here with an entry in `UNKNOWNS`. The unit of its parameters is the standard deviation of its
prior. At 0 the unknown has the value of the capture. The unit of length, the distance, is the median distance from the
cameras to the object.

Only the priors determine some combinations of unknowns. These are: the brightness of the lights and the albedo (so the
logarithms of `power` and `gain` have mean zero in each colour, and `scale` also changes the albedo); position, rotation
and scale of the whole scene; focal length and distance; almost also a flash's cone and vignetting.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mi_ring.calibration.rig import Estimate, Rig
from mi_ring.calibration.unknown import Found, Unknown
from mi_ring.geometry.rotations import rotations

DOUBT_AHEAD = 0.02  #: doubt of how far a flash is ahead of the lens [median distance of cameras and object]
VAGUE = 3.0  #: factor of the priors' widths of lights whose places nobody measured


class Turn(Unknown):
    """Rotation of each camera about its own axes: a rotation vector [rad]."""

    solved = True

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        turned = rig.views.cameras[:, :, :3] @ rotations(value)[rig.camera]
        return now.seen(cameras=torch.cat([turned, now.views.cameras[:, :, 3:]], 2))

    def describe_photograph(self, value: np.ndarray, std: np.ndarray, rig: Rig) -> tuple[str, Any, Any]:
        angle, spread = (float(np.degrees(1.0) * np.linalg.norm(part)) for part in (value, std))
        return "turned_degrees", angle, spread


class Move(Unknown):
    """Translation of each camera along its own axes. The unit is the median distance from cameras to object."""

    solved = True

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        along = rig.views.cameras[:, :, :3] @ (value * rig.distance)[rig.camera, :, None]
        moved = rig.views.cameras[:, :, 3:] + along
        return now.seen(cameras=torch.cat([now.views.cameras[:, :, :3], moved], 2))

    def describe_photograph(self, value: np.ndarray, std: np.ndarray, rig: Rig) -> tuple[str, Any, Any]:
        way, spread = (float(rig.distance * np.linalg.norm(part)) for part in (value, std))
        return "moved", way, spread


class Focal(Unknown):
    """Logarithm of a correction factor of each lens's focal length."""

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        focal, centre = now.views.intrinsics.split(2, 1)
        return now.seen(intrinsics=torch.cat([focal * value.exp()[rig.lens, None], centre], 1))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        before, after = (np.array([camera.focal.mean() for camera in cameras]) for cameras in lens_cameras(found))
        return "focal length [px]", before, after, after * std


class Principal(Unknown):
    """Shift of each lens's principal point [focal lengths]."""

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        focal, centre = now.views.intrinsics.split(2, 1)
        return now.seen(intrinsics=torch.cat([focal, centre + value[rig.lens] * focal], 1))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        before, after = lens_cameras(found)
        focal = np.stack([camera.focal for camera in after])
        return "principal point [px]", *([camera.centre for camera in side] for side in (before, after)), focal * std


class Distortion(Unknown):
    """Correction that is added to the first radial distortion coefficient of each lens."""

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return now.seen(distortion=now.views.distortion + value[rig.lens])

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        before, after = ([camera.distortion for camera in cameras] for cameras in lens_cameras(found))
        return "first radial distortion of the lens", before, after, std


class LightPlace(Unknown):
    """Offset of each light's position [median distance of cameras and object]; of a distant light's direction [rad]."""

    doubt = 0.002

    def width_for(self, rig: Rig) -> float:
        return self.width * (VAGUE if rig.guessed else 1.0)

    def doubt_for(self, rig: Rig) -> float | np.ndarray:
        return self.doubt if rig.flash is None else np.array([self.doubt, self.doubt, DOUBT_AHEAD])

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, offset=value)

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        rig = found.rig
        if rig.flash is not None:
            before = rig.upright.numpy()
            what = "place of the flash in the cameras' axes: to the left, up, ahead [scene units]"
            return what, before, before + rig.distance * value[0], rig.distance * std[0]
        first = rig.mainly[np.unique(rig.place.numpy()[rig.mainly], return_index=True)[1]]
        places = (side.photographs.lights.positions()[first] for side in (found.before, found.after))
        units = np.where(rig.finite.numpy()[first], rig.distance, 1.0)
        which = "place of the first lamp" if found.several else "places of the lights"
        return f"{which} [scene units], directions to distant ones", *places, units * std


class Exposure(Unknown):
    """Base of `Power` and `Gain`: log of a factor for each photograph and channel. In each channel its mean is 0.

    It is 0 for photographs that are held out, and for those whose factor is known: see `Rig.exposed`.
    """

    doubt = 0.015
    solved = True

    def concerns(self, rig: Rig, lit: bool) -> bool:
        return bool((rig.lit[rig.exposed[self.name]] == lit).any()) if rig.mixed else True

    def centred(self, value: Tensor, rig: Rig) -> Tensor:
        """Subtract from log factors (P, 3) their mean over the photographs whose factors are unknown; 0 for others."""
        result, index = torch.zeros_like(value), rig.exposed[self.name]
        result[index] = value[index] - value[index].mean(0)
        return result

    def describe_photograph(self, value: np.ndarray, std: np.ndarray, rig: Rig) -> tuple[str, Any, Any]:
        factor = np.exp(value)
        return self.name, factor.tolist(), (factor * std).tolist()


class Power(Exposure):
    """Logarithm of a factor of the strength of each photograph's own light, for each colour channel."""

    changes = "light"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, log_power=now.log_power + self.centred(value, rig))


class Falloff(Unknown):
    """Correction that is added to the cosine exponent of the flash's cone. Gradients ignore it.

    It makes the flash darker off its axis.
    """

    solved = True

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return now.seen(cone=now.views.cone + torch.cat([value.detach()[None], torch.zeros(2)]))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        return "exponent of the flash's cone", *found.means(lambda shot: shot.falloff), std


class Tilt(Unknown):
    """Correction that is added to the tilt of the flash's cone. Gradients ignore it.

    Its numbers are to the left and up in the axes of the first photograph's camera.
    """

    solved = True

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return now.seen(cone=now.views.cone + F.pad(rig.held[:, :2, :2] @ value.detach(), (1, 0)))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        held = found.rig.held[:, :2, :2].numpy()
        before, after = (np.einsum("pji,pj->pi", held, [shot.tilt for shot in side.shots])[found.rig.mainly].mean(0)
                         for side in (found.before, found.after))  # fmt: skip
        return "tilt of the flash's cone, to the left and up", before, after, std


class Vignetting(Unknown):
    """Correction that is added to the cosine exponent of vignetting, which darkens the corners of photographs."""

    changes = "recording"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, response=now.response._replace(vignetting=value))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        return "exponent of the lens' vignetting", *found.means(lambda shot: shot.response.vignetting), std


class CurveExponent(Unknown):
    """Logarithm of the exponent of the camera's tone curve. One number for all photographs."""

    changes = "recording"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, response=now.response._replace(exponent=value))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        before, after = found.means(lambda shot: shot.response.curve.gamma)
        return "exponent of the camera's curve", before, after, after * std


class Toe(Unknown):
    """How much longer the dark end of the tone curve's S is than the bright end. One number for all photographs."""

    changes = "recording"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, response=now.response._replace(toe=value))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        return "toe of the camera's curve", *found.means(lambda shot: shot.response.curve.toe), std


class Contrast(Unknown):
    """Logarithm of the steepness of the S-curve in the camera's tone curve. One number for all photographs.

    It is at least 0. Gradients ignore it.
    """

    changes = "recording"
    solved = True

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, response=now.response._replace(contrast=value.detach()))

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        before, after = found.means(lambda shot: shot.response.curve.contrast)
        return "contrast of the camera's curve", before, after, after * std


class Gain(Exposure):
    """Logarithm of a factor of all values of a photograph, for each colour channel. Gradients ignore it."""

    changes = "gain"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, response=now.response._replace(gain=self.centred(value, rig).detach().exp()))


class Scale(Unknown):
    """Logarithm of a common factor of all lights.

    Only interreflection determines it. In direct light, a lower albedo cancels the factor.
    """

    changes = "indirect"

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        value = value.detach()
        return replace(now, log_power=value + now.log_power, log_lamp_power=now.log_lamp_power + value)

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        return "power of all lights together", 1, found.power, found.power * std


class LampPlace(LightPlace):
    """Offset of each lamp's position [median distance of cameras and object]; of a distant lamp's direction [rad]."""

    def doubt_for(self, rig: Rig) -> float | np.ndarray:
        return self.doubt

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, lamp_offset=value)

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        lamps, which = found.rig.lamps, "the other lamps" if found.several else "the scene's lamps"
        unit = np.where(lamps.finite, found.rig.distance, 1.0)
        what = f"places of {which} [scene units], directions to distant ones"
        return what, lamps.places, found.lamps.places, unit * std


class LampPower(Unknown):
    """Logarithm of a factor of each lamp of the scene, for each colour channel."""

    def apply(self, now: Estimate, value: Tensor, rig: Rig) -> Estimate:
        return replace(now, log_lamp_power=value + now.log_lamp_power)

    def describe(self, value: np.ndarray, std: np.ndarray, found: Found) -> tuple[str, Any, Any, Any]:
        what = "strengths of the scene's lamps: red, green, blue"
        if found.several:
            first = found.after.photographs.lights[0].rgb[0]
            what = f"strengths of the other lamps: red, green, blue (of the first, by which all are, {first:.4g})"
        after = found.lamps.strengths
        return what, found.rig.lamps.strengths, after, after.numpy() * std


#: All unknowns but the room's light, by name, in the order in which they are applied.
UNKNOWNS: dict[str, Unknown] = {unknown.name: unknown for unknown in (
    Turn("turn", "cameras", 0.01, "camera", 3),
    Move("move", "cameras", 0.005, "camera", 3),
    Focal("focal", "focal", 0.01, "lens"),
    Principal("principal", "principal", 0.01, "lens", 2),
    Distortion("distortion", "distortion", 0.05, "lens"),
    LightPlace("light", "light", 0.1, "light", 3, own_lights=True),
    Power("power", "power", 0.1, "photograph", 3, own_lights=True),
    Falloff("falloff", "falloff", 5.0, "capture", own_lights=True),
    Tilt("tilt", "falloff", 1.0, "capture", 2, own_lights=True),
    Vignetting("vignetting", "vignetting", 1.0, "capture"),
    CurveExponent("curve", "curve", 0.2, "capture"),
    Toe("toe", "curve", 0.3, "capture"),
    Contrast("contrast", "contrast", 0.2, "capture"),
    Gain("gain", "gain", 0.1, "photograph", 3),
    Scale("scale", "scale", 0.7, "capture", own_lights=True),
    LampPlace("lamp", "lamps", 0.1, "lamp", 3),
    LampPower("strength", "lamps", 0.5, "lamp", 3),
)}  # fmt: skip

#: Options about the photographs' own lights, which an unknown light replaces.
OWN_LIGHTS = {unknown.option for unknown in UNKNOWNS.values() if unknown.own_lights}


def lens_cameras(found: Found) -> Iterable[list]:
    """Yield two lists of cameras: before the fit and after the fit. Each has one camera for each lens."""
    first = np.unique(found.rig.lens.numpy(), return_index=True)[1]
    return ([side.shots[k].whole.camera for k in first] for side in (found.before, found.after))
