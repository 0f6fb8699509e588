"""Point and directional lights, as numbers and as Mitsuba emitters; the emitters that light every photograph."""

from typing import Literal, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import InputError, require_numbers

LAMP_CLASSES = "PointLight", "DirectionalEmitter"  #: Mitsuba's classes of emitters that can be a `Light`


class Light(NamedTuple):
    """A point light or distant light: that of one photograph, or a lamp, in the world."""

    kind: Literal["point", "directional"]
    vector: np.ndarray  #: (3,) position [scene units], or direction in which the light travels
    rgb: np.ndarray  #: (3,) intensity [W/sr], or irradiance [W/m²]


def usable_light(light: Light | None, what: str) -> Light | None:
    """Check a light and round its numbers to float32; None stays None. Raises InputError; `what` begins the message."""
    if light is None:
        return None
    if not isinstance(light, Light) or light.kind not in ("point", "directional"):
        kind = f'of kind "{light.kind}"' if isinstance(light, Light) else type(light).__name__
        raise InputError(f"{what}: is {kind}; must be a mi_ring.Light, point or directional, or None")
    vector, rgb = (
        require_numbers(getattr(light, name), (3,), f"{what}: {name}").astype(float) for name in ("vector", "rgb")
    )
    if light.kind == "directional" and not vector.any():
        raise InputError(f"{what}: vector is 0; must be the direction in which the light travels")
    return Light(light.kind, vector, rgb)


def position_of(emitter):
    """The position of an emitter and True, or the direction toward a distant emitter and False; attached.

    Returns None for other emitters, such as area lights and environment maps.
    """
    params = mi.traverse(emitter)
    match emitter.class_name():
        case "PointLight":
            return mi.Vector3f(params["position"]), True
        case "SpotLight":
            m = params["to_world"].matrix
            return mi.Vector3f(m[0, 3], m[1, 3], m[2, 3]), True
        case "DirectionalEmitter":
            m = params["to_world"].matrix
            return -mi.Vector3f(m[0, 2], m[1, 2], m[2, 2]), False


def light_of(emitter) -> Light:
    """Convert a point light or directional light of Mitsuba to plain values."""
    where, finite = position_of(emitter)
    vector, rgb = (np.array(dr.detach(part), float).ravel() for part in (where, strength_of(emitter)))
    return Light("point", vector, rgb) if finite else Light("directional", -vector, rgb)


def emitter_of(light: Light) -> mi.Emitter:
    """Convert a light to an emitter of Mitsuba."""
    vector = light.vector.tolist()
    where = {"position": vector} if light.kind == "point" else {"direction": vector}
    strength = "intensity" if light.kind == "point" else "irradiance"
    return mi.load_dict({"type": light.kind, **where, strength: {"type": "rgb", "value": light.rgb.tolist()}})


def move_lamp(emitter, place, strength) -> None:
    """Set position, or unit direction toward it, and RGB strength of an emitter from `emitter_of`; may be attached."""
    params = mi.traverse(emitter)
    if emitter.class_name() == "PointLight":
        params["position"], params["intensity.value"] = mi.Point3f(place), strength
    else:
        frame = mi.Frame3f(-mi.Vector3f(place))
        rows = [[frame.s[k], frame.t[k], frame.n[k], 0] for k in range(3)]
        params["to_world"] = mi.Transform4f(mi.Matrix4f(*rows, [0, 0, 0, 1]))
        params["irradiance.value"] = strength
    params.update()


def strength_of(emitter):
    """The RGB intensity of a point light, or irradiance of a directional light; attached."""
    name = "intensity.value" if emitter.class_name() == "PointLight" else "irradiance.value"
    return mi.Color3f(mi.traverse(emitter)[name])


def shared_emitters(scene, rooms: bool = False) -> list:
    """The emitters of a scene that light every photograph: all but `flash`, which is the light of one photograph.

    `rooms`: also the `room` emitters, whose light is in `Photographs.room`.
    """
    return [e for e in scene.emitters() if not is_flash(e) and (rooms or not is_room(e))]


def is_flash(emitter) -> bool:
    """Is an emitter a `flash`, of any variant of Mitsuba?"""
    return getattr(emitter, "of_photographs", False)


def is_room(emitter) -> bool:
    """Is an emitter a `room`, of any variant of Mitsuba?"""
    return getattr(emitter, "of_rooms", False)
