"""The light of a room as spherical harmonics, in the axes of the world and in the axes of the camera.

Room light is an array (BASIS, 3): the RGB coefficient of each harmonic of the radiance. The first PER_FRAME harmonics
are in the axes of the world, the others in the axes of the camera, without degree 0, which is the same in both.
"""

from collections.abc import Collection, Iterable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.scene.assembly import changed_scene, top_level_emitters
from mi_ring.scene.lights import is_room, shared_emitters
from mi_ring.scene.lobes import Lobes

MAX_ORDER = 4  #: of the harmonics
PER_FRAME = (MAX_ORDER + 1) ** 2  #: harmonics in the axes of the world
BASIS = 2 * PER_FRAME - 1  #: harmonics in both
ENVMAP_ROWS = 128  #: of an environment map of a room
FINE_ROWS = 512  #: of one in which the sun must be found
FRAMES = {"world": [*range(PER_FRAME)], "camera": [0, *range(PER_FRAME, BASIS)]}  #: the harmonics in these axes


def harmonics_up_to(order: int, frames: Iterable[str]) -> list[int]:
    """List the indices of the harmonics up to degree `order`, sorted.

    `frames`: the axes whose harmonics are listed: "world", "camera" or both.
    """
    return sorted({k for frame in frames for k in FRAMES[frame][: (order + 1) ** 2]})


def degree(k: int) -> int:
    """Return the degree l of the harmonic with index `k`, 0 to BASIS − 1."""
    return int((k if k < PER_FRAME else k - PER_FRAME + 1) ** 0.5)


def room_of(scene) -> np.ndarray | None:
    """Return the sum of all `room` emitters of a scene as harmonics (BASIS, 3); None if there is no such emitter."""
    rooms = [emitter for emitter in scene.emitters() if is_room(emitter)]
    total = np.zeros((BASIS, 3))
    for room in rooms:
        harmonics = np.array(room.harmonics).reshape(-1, 3)
        total[FRAMES[room.frame][: len(harmonics)]] += harmonics
    return total if rooms else None


def without_environment(scene) -> tuple[mi.Scene, np.ndarray | None]:
    """Make a scene without `envmap` and `constant` emitters. Returns (new scene, their light as harmonics (BASIS, 3)).

    If the scene has no such emitters, returns (`scene`, None).
    """
    found = [lamp for lamp in shared_emitters(scene) if lamp.is_environment()]
    if not found:
        return scene, None
    others = [emitter for emitter in top_level_emitters(scene) if emitter not in found]
    return changed_scene(scene, emitters=others), sum(map(harmonics_of, found), np.zeros((BASIS, 3)))


def harmonics_of(environment) -> np.ndarray:
    """Project the radiance of an `envmap` or `constant` emitter onto spherical harmonics. Returns (BASIS, 3).

    The harmonics are in the axes of the world.
    """
    directions, angles = envmap_directions(FINE_ROWS)
    toward, si = mi.Vector3f(*directions.T), dr.zeros(mi.SurfaceInteraction3f, len(angles))
    si.wi = -toward
    radiance = np.stack([np.asarray(dr.detach(v) + dr.zeros(mi.Float, len(angles))) for v in environment.eval(si)])
    room = np.zeros((BASIS, 3))
    room[:PER_FRAME] = (world_harmonics(directions) * angles) @ radiance.T
    return room


def world_harmonics(directions: np.ndarray, order: int = MAX_ORDER) -> np.ndarray:
    """Evaluate spherical harmonics up to degree `order` in unit directions (n, 3). Returns ((order + 1)², n).

    The harmonics have the axes of the directions.
    """
    values = dr.sh_eval(mi.Vector3f(*directions.T.astype(np.float32)), order)
    return np.stack([np.asarray(value + dr.zeros(mi.Float, len(directions))) for value in values])


def envmap_directions(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute directions and solid angles of the pixels of an environment map with `rows` rows and 2 `rows` columns.

    Returns (unit directions (2 rows², 3), solid angles (2 rows²,) [sr]), row by row. Latitude and longitude are as in
    Mitsuba's `envmap`: y is up, and -z is at the left and right borders.
    """
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    theta, phi = np.pi * v.ravel(), 2 * np.pi * u.ravel()
    directions = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    return directions, np.sin(theta) * (np.pi / rows) ** 2


def frames_of(scene) -> set[str]:
    """Return the axes in which a scene's `room` emitters are given: a set of "world" and "camera".

    If the scene has no such emitters, returns {"world"}.
    """
    return {emitter.frame for emitter in scene.emitters() if is_room(emitter)} or {"world"}


def evaluated_harmonics(direction, to_world, which: Sequence[int]) -> list:
    """Evaluate the harmonics with indices `which` in directions (Vector3f in the world). Returns a Float for each.

    `to_world`: pose of the camera, for harmonics in the axes of the camera.
    """
    order = max(map(degree, which))
    world = dr.sh_eval(direction, order) if min(which) < PER_FRAME else []
    camera = dr.sh_eval(to_camera_axes(direction, to_world), order) if max(which) >= PER_FRAME else []
    return [world[k] if k < PER_FRAME else camera[k - PER_FRAME + 1] for k in which]


def to_camera_axes(direction, to_world):
    """Convert directions (mi.Vector3f) from world to camera coordinates. Returns a mi.Vector3f.

    `to_world`: camera-to-world transform of each direction, a mi.Transform4f or its matrix.
    """
    return mi.Vector3f(*(dr.dot(mi.Vector3f(*(to_world[j, i] for j in range(3))), direction) for i in range(3)))


def to_world_axes(direction, to_world):
    """Convert directions (mi.Vector3f) from camera to world coordinates. Returns a mi.Vector3f.

    `to_world`: camera-to-world transform of each direction, a mi.Transform4f or its matrix.
    """
    return mi.Vector3f(*(dr.dot(mi.Vector3f(*(to_world[i, j] for j in range(3))), direction) for i in range(3)))


def bsdfs_with_lobes(scene) -> list:
    """List the BSDFs of a scene that can reflect spherical harmonics in closed form (they have a method `lobes`).

    A BSDF that several shapes use is listed once.
    """
    found = {id(bsdf): bsdf for bsdf in (shape.bsdf() for shape in scene.shapes()) if hasattr(bsdf, "lobes")}
    return list(found.values())


def reflected_harmonics(bsdfs: Collection, si, to_world, which: Sequence[int], active=True) -> list:
    """Compute the radiance that surface interactions reflect to the viewer in a room whose radiance is a harmonic.

    Nothing blocks this light. Returns a Color3f for each index of a harmonic in `which`; they carry gradients. `bsdfs`:
    BSDFs with a method `lobes`; all other BSDFs reflect nothing. `to_world`: pose of the camera. Each lobe of a BSDF
    multiplies each degree of the harmonics by a factor, as in "A Signal-Processing Framework for Inverse Rendering"
    (Ramamoorthi and Hanrahan 2001).
    """
    total = [mi.Color3f(0) for _ in which]
    for bsdf in bsdfs:
        own = active & (si.bsdf() == mi.BSDFPtr(bsdf))
        for direction, factors in bsdf.lobes(si, MAX_ORDER, own):
            for n, (k, value) in enumerate(zip(which, evaluated_harmonics(direction, to_world, which))):
                total[n] += value * factors[degree(k)]
    return total


def room_envmap(
    room: np.ndarray, to_world: np.ndarray, rows: int = ENVMAP_ROWS, lobes: Lobes | None = None
) -> np.ndarray:
    """Convert room light (BASIS, 3) to an environment map (rows, 2 rows, 3), with the axes of Mitsuba's `envmap`.

    `to_world`: pose of the camera, for light in the axes of the camera. `lobes`: small lights, which are added. The
    radiance may be negative in some directions, because there are few harmonics.
    """
    directions, _ = envmap_directions(rows)
    which, values = np.flatnonzero(room.any(1)).tolist() or [0], np.zeros((len(directions), 3))
    for k, harmonic in zip(which, evaluated_harmonics(mi.Vector3f(*directions.T), mi.Matrix4f(to_world), which)):
        values += np.asarray(dr.detach(harmonic) + dr.zeros(mi.Float, len(directions)))[:, None] * room[k]
    if lobes is not None:
        values += lobes.radiance(directions, np.asarray(to_world))
    return values.reshape(rows, 2 * rows, 3)
