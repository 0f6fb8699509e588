"""Makes scenes from the objects of other scenes: with other lamps, with another object, or without tables."""

from collections.abc import Iterable
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.scene.alignment import to_flat
from mi_ring.scene.lights import LAMP_CLASSES, Light, emitter_of, light_of, move_lamp
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.xml_elements import load_bsdf, with_fine_attribute

MAX_EXTENT = 4.0  #: radius of a ball that contains the object during a fit [radius of the normalising sphere]


class RenderedObject(Protocol):
    """What a renderer needs of a reconstructed object: its surface and its material. Tensors are torch's.

    `mi_ring.objects.FittedObject` is such an object. This protocol exists because this package must not import
    `mi_ring.objects`.
    """

    center: Any  #: (3,) tensor of the normalising sphere [scene units]
    radius: Any  #: its radius, a tensor
    bsdf: str  #: the BSDF as Mitsuba's XML
    brdf_net: Any  #: a `MaterialNet`; its `bsdf_parameters` have the attributes that the BSDF reads

    def surface(self, s: Any, time: float = 1.0) -> Any:
        """Compute the surface points (V, 3) [scene units] for points `s` (V, 3) of the domain, the start surface.

        `time`: state of the deformation, from 0 (start surface) to 1 (finished object).
        """
        ...

    def __call__(self, s: Any, time: float = 1.0) -> tuple[Any, dict[str, Any]]:
        """Compute (surface points (V, 3), BSDF parameters by name) at domain points `s` (V, 3)."""
        ...


def top_level_emitters(scene) -> list:
    """List the emitters of a scene that do not belong to a shape."""
    of_shapes = [shape.emitter() for shape in scene.shapes() if shape.is_emitter()]
    return [emitter for emitter in scene.emitters() if emitter not in of_shapes]


def lamps_of(scene) -> list:
    """List the lamps of a scene: the point and directional emitters that do not belong to a shape."""
    return [emitter for emitter in top_level_emitters(scene) if emitter.class_name() in LAMP_CLASSES]


def lamp_lights(scene) -> list[Light]:
    """Return the lamps of a scene as lights: its point and directional emitters that do not belong to a shape.

    Their order is that of the scene.
    """
    return [light_of(lamp) for lamp in lamps_of(scene)]


def with_lamps(scene, lamps: Iterable[Light]) -> mi.Scene:
    """Make a scene in which `lamps` replace the point and directional emitters of `scene`.

    Emitters that belong to shapes stay. All other objects are shared with `scene`.
    """
    before = lamps_of(scene)
    others = [emitter for emitter in top_level_emitters(scene) if emitter not in before]
    return changed_scene(scene, emitters=[*others, *map(emitter_of, lamps)])


def move_lamps(scene, places, strengths) -> None:
    """Change the L point and directional emitters of a scene, in place. They must have RGB intensities or irradiances.

    `places` (3 L numbers): positions [scene units] of point lights, unit directions toward directional lights.
    `strengths` (3 L numbers): intensities of point lights, irradiances of directional lights. Both are Dr.Jit Floats in
    the order of the scene's lamps, and may carry gradients.
    """
    for k, lamp in enumerate(lamps_of(scene)):
        move_lamp(lamp, dr.gather(mi.Vector3f, places, k), dr.gather(mi.Color3f, strengths, k))


def assembled(shapes, emitters=(), sensors=(), integrator=None) -> mi.Scene:
    """Make a Mitsuba scene of shapes, emitters, sensors and an integrator. Returns the scene.

    These objects keep their ids. Meshes are not merged. `emitters`: those that do not belong to a shape.
    """
    parts = [*shapes, *emitters, *sensors, *([integrator] if integrator else [])]
    ids = [part.id() for part in parts]
    everything = {"type": "scene"} | {f"part{k}": part for k, part in enumerate(parts)}
    scene = mi.load_dict(everything, optimize=False, parallel=False)
    for part, name in zip(parts, ids):  # Mitsuba has changed the ids to the keys
        part.set_id(name)
    return scene


def changed_scene(scene, shapes=None, emitters=None) -> mi.Scene:
    """Make a scene with other shapes or other emitters. It shares all other objects with `scene`.

    `shapes`: replace all shapes; None: the shapes stay. `emitters`: replace all emitters that do not belong to a shape;
    None: these emitters stay.
    """
    shapes = scene.shapes() if shapes is None else shapes
    emitters = top_level_emitters(scene) if emitters is None else emitters
    return assembled(shapes, emitters, scene.sensors(), scene.integrator())


def with_fitted_shape(
    scene: mi.Scene, shape: mi.Mesh, ring: RenderedObject, unit: float = 1.0
) -> tuple[mi.Scene, mi.Mesh]:
    """Make a scene in which a new shape replaces `shape`. Returns (new scene, new shape).

    The new shape has the BSDF of `ring`, which reads the albedo by `fine_attribute`, and the mesh attributes that this
    BSDF reads, with arbitrary values. Its vertices are not those of the object yet. They lie on a sphere around the
    object, because Mitsuba places distant emitters outside of the scene's bounding sphere when the scene is made.
    `unit`: length unit of the new scene [units of `ring`].
    """
    new = mi.load_dict({
        "type": "shapenet", "id": shape.id(), "subdivisions": 0, "flash": shape.is_emitter(),
        "face_normals": shape.has_face_normals(),
        "bsdf": {"type": "cooktorrance"},
    })  # fmt: skip
    for parameter in ring.brdf_net.bsdf_parameters:
        if not new.has_attribute(parameter.attribute):
            values = np.zeros(new.vertex_count() * parameter.channels, np.float32)
            new.add_attribute(parameter.attribute, parameter.channels, values)
    albedo = ring.brdf_net.albedo
    new.set_bsdf(load_bsdf(with_fine_attribute(ring.bsdf, albedo.attribute) if albedo else ring.bsdf))
    require_attributes(new)
    params = mi.traverse(new)
    points = np.array(params["vertex_positions"]).reshape(-1, 3)
    ball = ring.center.numpy(force=True) + MAX_EXTENT * float(ring.radius) * points
    params["vertex_positions"] = to_flat(mi.Float, ball / unit)
    params.update()
    return changed_scene(scene, shapes=[new if other == shape else other for other in scene.shapes()]), new


def split_tables(scene) -> tuple[mi.Scene, mi.Scene | None]:
    """Split a scene into its `table` shapes and all else. Returns (scene without tables, scene with only the tables).

    If there is no `table`, returns (`scene`, None).
    """
    tables = [shape for shape in scene.shapes() if is_table(shape)]
    if not tables:
        return scene, None
    return changed_scene(scene, shapes=[s for s in scene.shapes() if not is_table(s)]), assembled(tables)


def has_table(scene) -> bool:
    """Return True if a scene has a `table` shape."""
    return any(is_table(shape) for shape in scene.shapes())


def is_table(shape) -> bool:
    """Return True if a shape is a `table`, in any variant of Mitsuba."""
    return getattr(shape, "of_tables", False)
