"""The lighting of a fit: the lights of the scene, or unknown lights in their place.

Photographs do not tell the brightness of an unknown light from the albedo. So the mean albedo is assumed to be about
one half, in each colour.
"""

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from torch import Tensor

from mi_ring.calibration.unknowns import OWN_LIGHTS
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.rendering.spherical_harmonics import BASIS, frames_of, without_environment
from mi_ring.scene.assembly import lamp_lights, with_lamps
from mi_ring.scene.lights import Light, shared_emitters

Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamps"]
AMBIGUOUS: set[Kind] = {"environment", "turntable"}  #: light that photographs hardly tell from the material
Lamp: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]  #: `vector` and `rgb` of a `Light`, for checkpoints


class Lighting(NamedTuple):
    """The lights of the photographs at the start of a fit, see `mi_ring.choose_lighting`."""

    kind: Kind  #: as `Config.light`, except "auto"
    lamps: tuple[Lamp, ...] = ()
    distant: bool = False  #: Are the lamps infinitely far away?
    one_material_until: float = 0.0  #: progress until which the object has one material; 0: never

    @classmethod
    def of(cls, capture: Capture, config: Config) -> "Lighting":
        """Take the lights of the scene.

        Raises InputError if it has none, or if the settings ask for unknown lights: coarse fits find those.
        """
        require_compatible(capture, config)
        if config.light != "capture":
            raise InputError(f"light: is {config.light}, which coarse fits have to find; give Fit what "
                             "mi_ring.choose_lighting(capture, config) returns")  # fmt: skip
        return cls("capture")

    def __str__(self) -> str:
        """A name for people, for instance: environment, 1 lamp, 2 distant lamps."""
        count = len(self.lamps)
        kind = f"{count} {'distant ' * self.distant}lamp{'s' * (count > 1)}" if count else self.kind
        return kind + " on one material" * (self.one_material_until > 0)

    def material_at(self, progress: float, material: dict[str, Tensor]) -> dict[str, Tensor]:
        """The material (V, …) of a fit at this progress: the mean over all vertices until `one_material_until`.

        Photographs hardly tell slow changes of albedo from slow changes of light. So the light explains both.
        """
        if progress >= self.one_material_until:
            return material
        return {name: value.mean(0, keepdim=True).expand_as(value) for name, value in material.items()}


def require_compatible(capture: Capture, config: Config) -> None:
    """Raise InputError if capture and settings do not go with `Config.light`."""
    others, own = shared_emitters(capture.scene), OWN_LIGHTS & set(config.refine)
    if config.light == "capture":
        if own and capture.photographs.dark:
            raise InputError(f"{capture.path}: --refine {min(own)}: is of the photographs' own lights, of which there "
                             "are none; leave it out")  # fmt: skip
        if is_unlit(capture) and not others:
            raise InputError(f"{capture.path}: emitter: nothing lights the object; give lights, or --light auto")
        return
    if not hasattr(capture.shape.bsdf(), "lobes"):
        raise InputError(f"{capture.path}: bsdf: --light {config.light} is for cooktorrance alone; give that")
    if others:
        names = ", ".join(f'"{emitter.id()}"' for emitter in others)
        raise InputError(f"{capture.path}: emitter {names}: --light {config.light} finds all the light there is; take "
                         "the lamps of the scene out, or leave --light out")  # fmt: skip
    if any(shot.files.ambient for shot in capture.shots):
        raise InputError(f"{capture.path}: ambient: is subtracted, which leaves the photographs' own lights alone; "
                         f"leave out --light {config.light}, or `ambient` in all photographs")  # fmt: skip
    if not any(capture.masks.given):
        raise InputError(f"{capture.path}: mask: no photograph has one, and by --light {config.light} the "
                         "background would be taken for the object; give masks, or have mi-ring photos "
                         "find them")  # fmt: skip
    wrong = own & {"falloff"} if config.light == "lamps" else own
    if wrong:
        raise InputError(f"--refine {min(wrong)}: is of the photographs' own lights, in the place of which --light "
                         f"{config.light} puts another; leave it out")  # fmt: skip


def is_unlit(capture: Capture) -> bool:
    """Have the photographs neither lights of their own nor room light?"""
    return capture.photographs.dark and capture.room is None


def exposures(capture: Capture) -> np.ndarray:
    """Strengths (P, 3) of the photographs' own lights relative to their mean: under one light, the exposures."""
    strengths = capture.photographs.lights.rgb()
    kinds = capture.photographs.lights.is_finite()
    if kinds.any() != kinds.all() or not (strengths > 0).all():
        return np.ones_like(strengths)
    return strengths / strengths.mean(0)


def with_found_lamps(lighting: Lighting, capture: Capture, center: np.ndarray) -> Lighting:
    """Replace the lamps of a lighting by those that a fit has found. `capture`: as the fit has calibrated it.

    All lamps are scaled, so that the first brings as much light to the object at `center` (3,) as before: the albedo is
    an assumption.
    """
    if not lighting.lamps:
        return lighting
    lights = [capture.photographs.lights[0], *lamp_lights(capture.scene)]
    before, _ = lighting.lamps[0]
    distances = [np.linalg.norm(place - center) for place in (before, lights[0].vector)]
    factor = 1.0 if lighting.distant else (distances[1] / distances[0]) ** 2
    lamps = [(light.vector, factor * light.rgb) for light in lights]
    return lighting._replace(lamps=tuple((tuple(vector.tolist()), tuple(rgb.tolist())) for vector, rgb in lamps))


def with_lighting(capture: Capture, lighting: Lighting) -> Capture:
    """Put a capture under other lights: an environment starts grey; lamps after the first become lamps of the scene."""
    if lighting.kind == "capture":
        return capture
    scene, room, gains = capture.scene, None, exposures(capture)
    if lighting.lamps:
        kind: Literal["point", "directional"] = "directional" if lighting.distant else "point"
        first, *others = [Light(kind, np.array(vector), np.array(rgb)) for vector, rgb in lighting.lamps]
        lights = [first] * len(capture)
        scene = with_lamps(scene, others) if others else scene
    else:
        room = np.zeros((BASIS, 3))
        room[0] = math.sqrt(4 * math.pi) * capture.exposure() / ALBEDO
        lights = [Light("point", shot.camera.position, np.zeros(3)) for shot in capture.shots]
    shots = []
    for shot, light, gain in zip(capture.shots, lights, gains):
        shots.append(replace(shot, light=light, falloff=0.0, response=shot.response.changed(gain=gain)))
    return replace(capture, scene=scene, shots=tuple(shots), room=room)


def environment_as_harmonics(capture: Capture) -> tuple[Capture, Any, np.ndarray | None]:
    """Move the scene's environment into the harmonics of the room's light, whose reflection has no noise.

    Returns the capture with that room, the scene without the environment, and its harmonics (BASIS, 3) or None. Nothing
    changes if a photograph has no mask, since the background then shows the environment, and for other reflectances
    than `cooktorrance`.
    """
    if not all(capture.masks.given) or not hasattr(capture.shape.bsdf(), "lobes"):
        return capture, capture.scene, None
    scene, known = without_environment(capture.scene)
    if known is None:
        return capture, scene, None
    room = known if capture.room is None else capture.room + known
    return replace(capture, room=room), scene, known


def room_frames(capture: Capture, lighting: Lighting) -> Collection[str]:
    """The axes in which unknown room light is fixed: "world", "camera"."""
    own = {"environment": ["world"], "lamps": ["world"], "turntable": ["camera"]}
    return own.get(lighting.kind, frames_of(capture.scene))
