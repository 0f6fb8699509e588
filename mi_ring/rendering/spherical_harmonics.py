"""Light from far away as numbers: spherical harmonics in the axes of the world and in those of the camera."""

from collections.abc import Collection, Iterable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.scene.assembly import assembled, own_emitters
from mi_ring.scene.lights import is_room, shared_emitters

ORDER = 4  #: of the harmonics, at most
COUNT = (ORDER + 1) ** 2
#: Of the world's harmonics and the camera's, without the camera's first: it is the world's.
BASIS = 2 * COUNT - 1
ROWS = 128  #: of a picture of a room by latitude and longitude
FINE_ROWS = 512  #: of one that must not miss the sun
FRAMES = {"world": [*range(COUNT)], "camera": [0, *range(COUNT, BASIS)]}  #: which of them are in these axes


def up_to(order: int, frames: Iterable[str]) -> list[int]:
    """Which of the harmonics are in these axes, and of this order or a lower one."""
    return sorted({k for frame in frames for k in FRAMES[frame][: (order + 1) ** 2]})


def degree(k: int) -> int:
    """The degree l of harmonic `k`."""
    return int((k if k < COUNT else k - COUNT + 1) ** 0.5)


def room_of(scene) -> np.ndarray | None:
    """(BASIS, 3) radiance in each harmonic, summed over the `room` emitters of a scene; None if there are none."""
    rooms = [emitter for emitter in scene.emitters() if is_room(emitter)]
    total = np.zeros((BASIS, 3))
    for room in rooms:
        harmonics = np.array(room.harmonics).reshape(-1, 3)
        total[FRAMES[room.frame][: len(harmonics)]] += harmonics
    return total if rooms else None


def without_environment(scene) -> tuple[mi.Scene, np.ndarray | None]:
    """A scene without its `envmap` or `constant` emitters, and their harmonics (BASIS, 3), in the world's axes.

    The same scene and None if it has none.
    """
    found = [lamp for lamp in shared_emitters(scene) if lamp.is_environment()]
    if not found:
        return scene, None
    others = [emitter for emitter in own_emitters(scene) if emitter not in found]
    own = assembled(scene.shapes(), others, scene.sensors(), scene.integrator())
    return own, sum(map(harmonics_of, found), np.zeros((BASIS, 3)))


def harmonics_of(environment) -> np.ndarray:
    """(BASIS, 3) radiance in each harmonic of an emitter that is infinitely far away."""
    directions, angles = directions_of(FINE_ROWS)
    toward, si = mi.Vector3f(*directions.T), dr.zeros(mi.SurfaceInteraction3f, len(angles))
    si.wi = -toward
    radiance = np.stack([np.asarray(dr.detach(v) + dr.zeros(mi.Float, len(angles))) for v in environment.eval(si)])
    room = np.zeros((BASIS, 3))
    room[:COUNT] = (harmonics_in(directions) * angles) @ radiance.T
    return room


def harmonics_in(directions: np.ndarray, order: int = ORDER) -> np.ndarray:
    """The world's harmonics up to this order, ((order + 1)², n), in unit directions (n, 3)."""
    values = dr.sh_eval(mi.Vector3f(*directions.T.astype(np.float32)), order)
    return np.stack([np.asarray(value + dr.zeros(mi.Float, len(directions))) for value in values])


def directions_of(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Of the pixels of a map by latitude and longitude, as Mitsuba's `envmap` has it, with y up and -z in the middle of
    its left and right borders: directions (2 rows², 3) and the solid angles (2 rows²,) about them."""
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    theta, phi = np.pi * v.ravel(), 2 * np.pi * u.ravel()
    directions = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    return directions, np.sin(theta) * (np.pi / rows) ** 2


def frames_of(scene) -> set[str]:
    """In which axes the `room` emitters of a scene have their harmonics; the world's if there are none."""
    return {emitter.frame for emitter in scene.emitters() if is_room(emitter)} or {"world"}


def harmonics_toward(direction, to_world, which: Sequence[int]) -> list:
    """The harmonics `which` in a direction of the world, for a camera with this pose."""
    order = max(map(degree, which))
    world = dr.sh_eval(direction, order) if min(which) < COUNT else []
    camera = dr.sh_eval(in_camera(direction, to_world), order) if max(which) >= COUNT else []
    return [world[k] if k < COUNT else camera[k - COUNT + 1] for k in which]


def in_camera(direction, to_world):
    """A direction of the world in the axes of a camera with this pose."""
    return mi.Vector3f(*(dr.dot(mi.Vector3f(*(to_world[j, i] for j in range(3))), direction) for i in range(3)))


def reflecting(scene) -> list:
    """The BSDFs of a scene that know what they reflect of harmonics, each once: those that have `lobes`."""
    found = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in scene.shapes()) if hasattr(bsdf, "lobes")}
    return list(found.values())


def reflected(bsdfs: Collection, si, to_world, which: Sequence[int], active=True) -> list:
    """Radiance toward the viewer by each of the harmonics `which`, if nothing is in their way: Color3f each, attached.

    By the BSDFs' `lobes`: a lobe reflects each degree of the harmonics about its direction by a factor, as in "A
    Signal-Processing Framework for Inverse Rendering" (Ramamoorthi and Hanrahan 2001). Other BSDFs reflect nothing.
    """
    total = [mi.Color3f(0) for _ in which]
    for bsdf in bsdfs:
        own = active & (si.bsdf() == mi.BSDFPtr(bsdf))
        for direction, factors in bsdf.lobes(si, ORDER, own):
            for n, (k, value) in enumerate(zip(which, harmonics_toward(direction, to_world, which))):
                total[n] += value * factors[degree(k)]
    return total


def shown(scene, photographs, si, view, active=True):
    """Radiance toward the viewer by the room of `photographs`, if nothing is in its way; attached to the surface."""
    which = photographs.harmonics
    buffer = mi.Float(photographs.room[which].astype(np.float32).ravel())
    values = reflected(reflecting(scene), si, photographs.camera(view)[0], which, active)
    return sum((value * dr.gather(mi.Color3f, buffer, n) for n, value in enumerate(values)), mi.Color3f(0))


def seen_from_within(room: np.ndarray, to_world: np.ndarray, rows: int = ROWS) -> np.ndarray:
    """Radiance (rows, 2 rows, 3) of a room (BASIS, 3) as Mitsuba's `envmap` has it, y up, for a camera with this pose.

    A sum of few harmonics may be less than zero, and is so here.
    """
    directions, _ = directions_of(rows)
    which, values = np.flatnonzero(room.any(1)).tolist() or [0], np.zeros((len(directions), 3))
    for k, harmonic in zip(which, harmonics_toward(mi.Vector3f(*directions.T), mi.Matrix4f(to_world), which)):
        values += np.asarray(dr.detach(harmonic) + dr.zeros(mi.Float, len(directions)))[:, None] * room[k]
    return values.reshape(rows, 2 * rows, 3)
