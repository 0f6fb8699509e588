"""The light of the room as numbers: spherical harmonics in the axes of the world and in those of the camera."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.rendering.shading import is_room

ORDER = 2  #: of the harmonics
COUNT = (ORDER + 1) ** 2
#: Of the world's harmonics and the camera's, without the camera's first: it is the world's.
BASIS = 2 * COUNT - 1
FRAMES = {"world": [*range(COUNT)], "camera": [0, *range(COUNT, BASIS)]}  #: which of them are in these axes


def room_of(scene) -> np.ndarray | None:
    """(BASIS, 3) radiance in each harmonic, summed over the `room` emitters of a scene; None if there are none."""
    rooms = [emitter for emitter in scene.emitters() if is_room(emitter)]
    total = np.zeros((BASIS, 3))
    for room in rooms:
        harmonics = np.array(room.harmonics).reshape(COUNT, 3)
        if room.frame == "camera":
            total[0] += harmonics[0]
            total[COUNT:] += harmonics[1:]
        else:
            total[:COUNT] += harmonics
    return total if rooms else None


def frames_of(scene) -> set[str]:
    """In which axes the `room` emitters of a scene have their harmonics; the world's if there are none."""
    return {emitter.frame for emitter in scene.emitters() if is_room(emitter)} or {"world"}


def harmonics_toward(direction, to_world) -> list:
    """The BASIS harmonics in a direction of the world, for a camera with this pose."""
    return [*dr.sh_eval(direction, ORDER), *dr.sh_eval(in_camera(direction, to_world), ORDER)[1:]]


def in_camera(direction, to_world):
    """A direction of the world in the axes of a camera with this pose."""
    return mi.Vector3f(*(dr.dot(mi.Vector3f(*(to_world[j, i] for j in range(3))), direction) for i in range(3)))
