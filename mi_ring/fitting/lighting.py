"""What lights the photographs of a fit, where that is not what the scene says.

How bright an unknown light is and how much the object reflects cannot be told apart: the object's albedo is taken to be
about one half, in each colour.
"""

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from torch import Tensor

from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.errors import InputError
from mi_ring.fitting.calibration import OF_LIGHTS
from mi_ring.fitting.config import Config
from mi_ring.rendering.spherical_harmonics import BASIS, frames_of, without_environment
from mi_ring.scene.assembly import lamp_lights, with_lamps
from mi_ring.scene.lights import Light, shared_emitters

Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamps"]
AMBIGUOUS: set[Kind] = {"environment", "turntable"}  #: light that can hardly be told from what the material is
Lamp: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]  #: `vector` and `rgb` of a `Light`, that can be saved


class Lighting(NamedTuple):
    """The lights of the photographs, as a fit begins."""

    kind: Kind  #: of `Config.light`, but for "auto"
    lamps: tuple[Lamp, ...] = ()
    distant: bool = False  #: Are they infinitely far away?
    plain: float = 0.0  #: progress of the fit until which the object is taken to be of one material

    def __str__(self) -> str:
        """For people: environment, 1 lamp, 2 distant lamps."""
        count = len(self.lamps)
        kind = f"{count} {'distant ' * self.distant}lamp{'s' * (count > 1)}" if count else self.kind
        return kind + " on one material" * (self.plain > 0)

    def shared(self, material: dict[str, Tensor], progress: float) -> dict[str, Tensor]:
        """The material (V, …) as a fit takes it by now: as long as it is `plain`, its mean all over.

        Slow changes of albedo and of light can hardly be told apart. So the light explains what both can.
        """
        if progress >= self.plain:
            return material
        return {name: value.mean(0, keepdim=True).expand_as(value) for name, value in material.items()}


def require_unknown(capture: Capture, config: Config) -> None:
    """Raise InputError for what does not go with `Config.light`."""
    others, own = shared_emitters(capture.scene), OF_LIGHTS & set(config.refine)
    if config.light == "capture":
        if own and capture.photographs.dark:
            raise InputError(f"{capture.path}: --refine {min(own)}: is of the photographs' own lights, of which there "
                             "are none; leave it out")  # fmt: skip
        if unlit(capture) and not others:
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


def unlit(capture: Capture) -> bool:
    """Have photographs neither lights of their own nor a room?"""
    return capture.photographs.dark and capture.photographs.room is None


def exposures(capture: Capture) -> np.ndarray:
    """(P, 3) how strong the photographs' own lights are, by their mean: under one light that is how they were exposed.

    1 where the scene does not say.
    """
    strengths = capture.photographs.lights.rgb()
    kinds = capture.photographs.lights.is_finite()
    if kinds.any() != kinds.all() or not (strengths > 0).all():
        return np.ones_like(strengths)
    return strengths / strengths.mean(0)


def moved(lighting: Lighting, capture: Capture, center: np.ndarray) -> Lighting:
    """The same with lamps as a fit that began so has them in the end, `capture` as it has calibrated it.

    As strong together as makes the first bring the object, at `center` (3,), as much light as before, for the albedo's
    sake.
    """
    if not lighting.lamps:
        return lighting
    lights = [capture.photographs.lights[0], *lamp_lights(capture.scene)]
    before, _ = lighting.lamps[0]
    distances = [np.linalg.norm(place - center) for place in (before, lights[0].vector)]
    factor = 1.0 if lighting.distant else (distances[1] / distances[0]) ** 2
    lamps = [(light.vector, factor * light.rgb) for light in lights]
    return lighting._replace(lamps=tuple((tuple(vector.tolist()), tuple(rgb.tolist())) for vector, rgb in lamps))


def lit(capture: Capture, lighting: Lighting) -> Capture:
    """The capture under these lights: an environment is grey and alike from all sides to begin with.

    More lamps than one are the scene's.
    """
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


def smoothed(capture: Capture) -> tuple[Capture, Any, np.ndarray | None]:
    """The capture with the environment that its scene says among its room's harmonics, and the scene without it.

    And these harmonics (BASIS, 3); None if there are none. What a surface reflects of them has no noise. That the
    environment may be seen beside the object, which is not predicted then, does not matter where all photographs have
    masks; else it stays as it is, to be sampled, and where the reflectance is another than `cooktorrance`.
    """
    if not all(capture.masks.given) or not hasattr(capture.shape.bsdf(), "lobes"):
        return capture, capture.scene, None
    scene, known = without_environment(capture.scene)
    if known is None:
        return capture, scene, None
    room = known if capture.room is None else capture.room + known
    return replace(capture, room=room), scene, known


def frames(capture: Capture, lighting: Lighting) -> Collection[str]:
    """In which axes the unknown light of a room is fixed."""
    own = {"environment": ["world"], "lamps": ["world"], "turntable": ["camera"]}
    return own.get(lighting.kind, frames_of(capture.scene))
