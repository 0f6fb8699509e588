"""Mitsuba scenes, put together anew of the parts of another."""

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.scene.lights import LAMPS, Light, emitter_of, light_of, place_lamp
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.xml_elements import load_bsdf

REACH = 4.0  #: radii of the normalising sphere, within which the object is


def own_emitters(scene) -> list:
    """The emitters of a scene that are no part of its shapes, and so do not come along with them."""
    of_shapes = [shape.emitter() for shape in scene.shapes() if shape.is_emitter()]
    return [emitter for emitter in scene.emitters() if emitter not in of_shapes]


def lamps_of(scene) -> list:
    """The point lights and directional ones at the top level of a scene."""
    return [emitter for emitter in own_emitters(scene) if emitter.class_name() in LAMPS]


def lamp_lights(scene) -> list[Light]:
    """The `lamps_of` a scene as numbers."""
    return [light_of(lamp) for lamp in lamps_of(scene)]


def with_lamps(scene, lamps: Iterable[Light]) -> mi.Scene:
    """A scene with these lamps in the place of its `lamps_of`; it shares all else."""
    before = lamps_of(scene)
    others = [emitter for emitter in own_emitters(scene) if emitter not in before]
    return assembled(scene.shapes(), [*others, *map(emitter_of, lamps)], scene.sensors(), scene.integrator())


def place_lamps(scene, places, strengths) -> None:
    """Change the `lamps_of` a scene, made by `emitter_of`: positions or directions, and RGB, Floats of 3 per lamp."""
    for k, lamp in enumerate(lamps_of(scene)):
        place_lamp(lamp, dr.gather(mi.Vector3f, places, k), dr.gather(mi.Color3f, strengths, k))


def assembled(shapes, emitters=(), sensors=(), integrator=None) -> mi.Scene:
    """A scene of these objects. They keep their ids, and meshes are not merged."""
    parts = [*shapes, *emitters, *sensors, *([integrator] if integrator else [])]
    ids = [part.id() for part in parts]
    everything = {"type": "scene"} | {f"part{k}": part for k, part in enumerate(parts)}
    scene = mi.load_dict(everything, optimize=False, parallel=False)
    for part, name in zip(parts, ids):  # which Mitsuba has changed to the keys
        part.set_id(name)
    return scene


def dressed(scene: mi.Scene, shape: mi.Mesh, ring, unit: float = 1.0) -> tuple[mi.Scene, mi.Mesh]:
    """A scene with a new shape in the place of `shape`, with the BSDF and the attributes of a ring; and that shape.

    It is to be drawn in units of `unit` scene units, and is a ball about the object until it is written to: distant
    emitters take nothing to be farther away than a scene reaches when it is put together.
    """
    new = mi.load_dict({
        "type": "shapenet", "id": shape.id(), "subdivisions": 0, "flash": shape.is_emitter(),
        "face_normals": shape.has_face_normals(),
        "bsdf": {"type": "cooktorrance"},
    })  # fmt: skip
    for parameter in ring.brdf_net.bsdf_parameters:
        if not new.has_attribute(f"vertex_{parameter.name}"):
            values = np.zeros(new.vertex_count() * parameter.channels, np.float32)
            new.add_attribute(f"vertex_{parameter.name}", parameter.channels, values)
    new.set_bsdf(load_bsdf(ring.bsdf))
    require_attributes(new)
    params = mi.traverse(new)
    points = np.array(params["vertex_positions"]).reshape(-1, 3)
    ball = ring.center.numpy(force=True) + REACH * float(ring.radius) * points
    params["vertex_positions"] = mi.Float((ball / unit).astype(np.float32).ravel())
    params.update()
    shapes = [new if other == shape else other for other in scene.shapes()]
    return assembled(shapes, own_emitters(scene), scene.sensors(), scene.integrator()), new


def parted(scene) -> tuple[mi.Scene, mi.Scene | None]:
    """A scene without its `table` shapes, the same if it has none, and a scene of these alone, None likewise."""
    tables = [shape for shape in scene.shapes() if is_table(shape)]
    if not tables:
        return scene, None
    others = [shape for shape in scene.shapes() if not is_table(shape)]
    return assembled(others, own_emitters(scene), scene.sensors(), scene.integrator()), assembled(tables)


def has_table(scene) -> bool:
    """Has a scene a `table`?"""
    return any(is_table(shape) for shape in scene.shapes())


def is_table(shape) -> bool:
    """Is it a `table`, whatever the variant that its class belongs to?"""
    return getattr(shape, "of_tables", False)
