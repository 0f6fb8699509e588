"""The lighting of a fit: the lights of the scene, or unknown lights that replace them.

A brighter unknown light and a darker object give the same photographs. So the mean albedo of the object is assumed to
be about one half, in each colour.
"""

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from torch import Tensor

from mi_ring.calibration.unknowns import OWN_LIGHTS
from mi_ring.capture.capture import ALBEDO, Capture
from mi_ring.capture.turntable import object_turned
from mi_ring.errors import InputError
from mi_ring.fitting.config import Config
from mi_ring.rendering.spherical_harmonics import BASIS, frames_of, without_environment
from mi_ring.scene.assembly import lamp_lights, with_lamps
from mi_ring.scene.lights import Light, shared_emitters

Kind: TypeAlias = Literal["capture", "environment", "turntable", "lamps"]
AMBIGUOUS: set[Kind] = {"environment", "turntable"}  #: light that photographs hardly tell from the material
Lamp: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]  #: `vector` and `rgb` of a `Light`, for checkpoints


class Lighting(NamedTuple):
    """The light that a fit assumes: its kind, the initial lamps, and whether the object has one material at first.

    `mi_ring.choose_lighting` makes one.
    """

    kind: Kind  #: as `Config.light`, except "auto"
    lamps: tuple[Lamp, ...] = ()
    distant: bool = False  #: Are the lamps infinitely far away?
    one_material_until: float = 0.0  #: progress until which the object has one material; 0: never

    @classmethod
    def of(cls, capture: Capture, config: Config) -> "Lighting":
        """Return the lighting of a fit that uses the lights of the scene.

        Raises InputError if nothing lights the scene, or if `config.light` is not "capture": `mi_ring.choose_lighting`
        must then find the light.
        """
        require_compatible(capture, config)
        if config.light != "capture":
            raise InputError(f"light: is {config.light}, which coarse fits have to find; give Fit what "
                             "mi_ring.choose_lighting(capture, config) returns")  # fmt: skip
        return cls("capture")

    def __str__(self) -> str:
        """Return a name for messages, for example: environment, 1 lamp, 2 distant lamps."""
        count = len(self.lamps)
        kind = f"{count} {'distant ' * self.distant}lamp{'s' * (count > 1)}" if count else self.kind
        return kind + " on one material" * (self.one_material_until > 0)

    def material_at(self, progress: float, material: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the BSDF parameters (V, …) to render at this `progress` of the fit, 0 to 1.

        `material`: a dict from names of parameters to their values at V vertices. Before progress `one_material_until`,
        each vertex gets the mean of all vertices, because photographs hardly distinguish slow changes of the albedo
        along the surface from slow changes of the light. Later, the values are returned unchanged.
        """
        if progress >= self.one_material_until:
            return material
        return {name: value.mean(0, keepdim=True).expand_as(value) for name, value in material.items()}


def require_lighting(lighting: Lighting | None) -> None:
    """Raise InputError if `lighting`, which a caller gave to a fit, is no lighting. None is allowed."""
    if lighting is None:
        return
    if not (isinstance(lighting, Lighting) and lighting.kind in get_args(Kind)
            and bool(lighting.lamps) == (lighting.kind == "lamps")):  # fmt: skip
        raise InputError(f"lighting: is {lighting!r}; give Fit what mi_ring.choose_lighting(capture, config) returns, "
                         "and the kind of light as Config(light=...)")  # fmt: skip


def require_compatible(capture: Capture, config: Config) -> None:
    """Raise InputError if the setting `light` contradicts the capture or another setting."""
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
                         f"leave out --light {config.light}; --pairs both finds the room's light")  # fmt: skip
    if capture.photographs.mixed:
        raise InputError(f"{capture.path}: emitter: some photographs have a light of their own, others none, but "
                         f"--light {config.light} finds one light for all; leave it out: the fit finds that of the "
                         "others itself")  # fmt: skip
    if capture.threshold is not None or not any(capture.masks.given):
        raise InputError(f"{capture.path}: mask: no photograph has one, and by --light {config.light} the "
                         "background would be taken for the object; give masks, or have mi-ring photos "
                         "find them")  # fmt: skip
    wrong = own & {"falloff"} if config.light == "lamps" else own
    if wrong:
        raise InputError(f"--refine {min(wrong)}: is of the photographs' own lights, in the place of which --light "
                         f"{config.light} puts another; leave it out")  # fmt: skip


def is_unlit(capture: Capture) -> bool:
    """Test whether a capture has no light at all: neither lights of photographs nor room light."""
    return capture.photographs.dark and capture.room is None and capture.lobes is None


def exposures(capture: Capture) -> np.ndarray:
    """Compute the relative exposures (P, 3) of the photographs, under the assumption that one light lit them all.

    They are the strengths of the photographs' own lights, divided by their mean. All are 1 if a light is black, or if
    some lights are point lights and others distant.
    """
    strengths = capture.photographs.lights.rgb()
    kinds = capture.photographs.lights.is_finite()
    if kinds.any() != kinds.all() or not (strengths > 0).all():
        return np.ones_like(strengths)
    return strengths / strengths.mean(0)


def with_found_lamps(lighting: Lighting, capture: Capture, center: np.ndarray) -> Lighting:
    """Return a copy of `lighting` with the lamps that a fit has found. Without lamps, `lighting` itself is returned.

    `capture`: the calibrated capture of this fit. `center` (3,): centre of the object. All strengths are multiplied by
    one factor, so that the first lamp lights the object as strongly as in `lighting`.
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
    """Return a copy of the capture with the lights of `lighting`.

    If its kind is "capture", the same capture is returned. The first lamp becomes the light of each photograph, the
    others become lamps of the scene. An unknown environment is grey at the start.
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
        response = shot.response.changed(gain=gain)
        shots.append(replace(shot, light=light, falloff=0.0, tilt=(0.0, 0.0), response=response))
    return replace(capture, scene=scene, shots=tuple(shots), room=room, lobes=None)


def environment_as_harmonics(capture: Capture) -> tuple[Capture, Any, np.ndarray | None]:
    """Replace the environment map of a capture's scene by spherical harmonics, which are rendered without noise.

    Returns (capture whose `room` contains the harmonics, scene without the environment map, harmonics (BASIS, 3)).
    Nothing is replaced, and the last is None, if there is no environment map, if a photograph has no mask (its
    background shows the map), or if the BSDF is not `cooktorrance`.
    """
    if not all(capture.masks.given) or not hasattr(capture.shape.bsdf(), "lobes"):
        return capture, capture.scene, None
    scene, known = without_environment(capture.scene)
    if known is None:
        return capture, scene, None
    room = known if capture.room is None else capture.room + known
    return replace(capture, room=room), scene, known


def room_frames(capture: Capture, lighting: Lighting) -> Collection[str]:
    """Return the axes in which the unknown light of the room is fixed: a collection of "world" and "camera".

    If some photographs alone show this light, and the scene does not tell, their cameras and backgrounds tell.
    """
    photographs = capture.photographs
    if photographs.mixed and capture.room is None and object_turned(capture.part(np.flatnonzero(~photographs.lit))):
        return ["camera"]
    own = {"environment": ["world"], "lamps": ["world"], "turntable": ["camera"]}
    return own.get(lighting.kind, frames_of(capture.scene))
