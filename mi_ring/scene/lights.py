"""Point and directional lights, as numbers and as Mitsuba emitters. Also tests the kinds of emitters."""

from typing import Literal, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import InputError, require_numbers

LAMP_CLASSES = "PointLight", "DirectionalEmitter"  #: Mitsuba's classes of emitters that can be a `Light`


class Light(NamedTuple):
    """A point light or a directional light, in world coordinates: the light of one photograph, or a lamp."""

    kind: Literal["point", "directional"]
    vector: np.ndarray  #: (3,) position [scene units], or direction in which the light travels
    rgb: np.ndarray  #: (3,) intensity [W/sr], or irradiance [W/m²]


def usable_light(light: Light | None, what: str) -> Light | None:
    """Check a light that a user gave. Returns it with numbers rounded to float32. None stays None.

    `what`: beginning of the message. Raises InputError if the light cannot be used.
    """
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
    """Find where a Mitsuba emitter is. Its position or direction keeps the gradients of the emitter's parameters.

    Returns (position, True) for a point light or a spot light, (unit direction toward the light, False) for a
    directional light, and None for other emitters, such as area lights and environment maps.
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
    """Convert a point or directional emitter of Mitsuba to NumPy values, without gradients."""
    where, finite = position_of(emitter)
    vector, rgb = (np.array(dr.detach(part), float).ravel() for part in (where, strength_of(emitter)))
    return Light("point", vector, rgb) if finite else Light("directional", -vector, rgb)


def emitter_of(light: Light) -> mi.Emitter:
    """Make a Mitsuba emitter, point or directional, from a light."""
    vector = light.vector.tolist()
    where = {"position": vector} if light.kind == "point" else {"direction": vector}
    strength = "intensity" if light.kind == "point" else "irradiance"
    return mi.load_dict({"type": light.kind, **where, strength: {"type": "rgb", "value": light.rgb.tolist()}})


def move_lamp(emitter, place, strength) -> None:
    """Change a point or directional emitter in place. The new values may carry gradients.

    `place`: position of a point light, or unit direction toward a directional light. `strength`: RGB intensity of a
    point light, or RGB irradiance of a directional light. The emitter must have RGB values, not spectra.
    """
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
    """Return the RGB intensity of a point light, or the RGB irradiance of a directional light, with its gradients."""
    name = "intensity.value" if emitter.class_name() == "PointLight" else "irradiance.value"
    return mi.Color3f(mi.traverse(emitter)[name])


def shared_emitters(scene, rooms: bool = False) -> list:
    """List the emitters of a scene that light every photograph. `flash` emitters are left out: they light only one.

    `rooms`: also list `room` emitters, whose light most renderers of mi_ring compute in another way.
    """
    return [e for e in scene.emitters() if not is_flash(e) and (rooms or not is_room(e))]


def is_flash(emitter) -> bool:
    """Return True if an emitter is a `flash`, in any variant of Mitsuba."""
    return getattr(emitter, "of_photographs", False)


def is_room(emitter) -> bool:
    """Return True if an emitter is a `room`, in any variant of Mitsuba."""
    return getattr(emitter, "of_rooms", False)
