"""Makes scenes from parts of other scenes: with other lamps, with another object, or without tables."""

from collections.abc import Iterable
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.scene.lights import LAMP_CLASSES, Light, emitter_of, light_of, move_lamp
from mi_ring.scene.mesh_attributes import require_attributes
from mi_ring.scene.xml_elements import load_bsdf

MAX_EXTENT = 4.0  #: radius of a ball that contains the object during a fit [radius of the normalising sphere]


class RenderedObject(Protocol):
    """The part of `FittedObject` that renderers need. Tensors are torch's.

    The package `mi_ring.scene` must not import `mi_ring.objects`. So its functions name this protocol instead of
    `FittedObject`.
    """

    center: Any  #: (3,) tensor of the normalising sphere [scene units]
    radius: Any  #: its radius, a tensor
    bsdf: str  #: the BSDF as Mitsuba's XML
    brdf_net: Any  #: its `bsdf_parameters` have the attributes that the BSDF reads

    def surface(self, s: Any, time: float = 1.0) -> Any:
        """Compute the surface points (V, 3) of domain points `s` (V, 3). `time`: of the deformation, 0 to 1."""
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
    """Convert the lamps of a scene (see `lamps_of`) to lights, in the same order."""
    return [light_of(lamp) for lamp in lamps_of(scene)]


def with_lamps(scene, lamps: Iterable[Light]) -> mi.Scene:
    """Make a scene in which `lamps` replace the lamps of `scene`. All other objects are shared with `scene`."""
    before = lamps_of(scene)
    others = [emitter for emitter in top_level_emitters(scene) if emitter not in before]
    return changed_scene(scene, emitters=[*others, *map(emitter_of, lamps)])


def move_lamps(scene, places, strengths) -> None:
    """Change the L lamps of a scene from `with_lamps`, in place.

    `places` (3 L numbers): positions [scene units], or unit directions toward distant lamps. `strengths` (3 L numbers):
    intensities, or irradiances of distant lamps. Both are Dr.Jit Floats and may be attached.
    """
    for k, lamp in enumerate(lamps_of(scene)):
        move_lamp(lamp, dr.gather(mi.Vector3f, places, k), dr.gather(mi.Color3f, strengths, k))


def assembled(shapes, emitters=(), sensors=(), integrator=None) -> mi.Scene:
    """Make a scene of these Mitsuba objects. The objects keep their ids, and meshes are not merged."""
    parts = [*shapes, *emitters, *sensors, *([integrator] if integrator else [])]
    ids = [part.id() for part in parts]
    everything = {"type": "scene"} | {f"part{k}": part for k, part in enumerate(parts)}
    scene = mi.load_dict(everything, optimize=False, parallel=False)
    for part, name in zip(parts, ids):  # Mitsuba has changed the ids to the keys
        part.set_id(name)
    return scene


def changed_scene(scene, shapes=None, emitters=None) -> mi.Scene:
    """Make a scene with these shapes and these top-level emitters; None stands for those of `scene`.

    The new scene shares all other objects with `scene`.
    """
    shapes = scene.shapes() if shapes is None else shapes
    emitters = top_level_emitters(scene) if emitters is None else emitters
    return assembled(shapes, emitters, scene.sensors(), scene.integrator())


def with_fitted_shape(
    scene: mi.Scene, shape: mi.Mesh, ring: RenderedObject, unit: float = 1.0
) -> tuple[mi.Scene, mi.Mesh]:
    """Make a scene in which a new shape replaces `shape`. Returns (new scene, new shape).

    The new shape has the BSDF of `ring` and the mesh attributes that this BSDF reads, but not yet the surface. It is a
    ball that contains the object: when a scene is assembled, Mitsuba places distant emitters outside of the scene's
    bounding sphere. `unit`: length of the unit of the new scene [scene units].
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
    ball = ring.center.numpy(force=True) + MAX_EXTENT * float(ring.radius) * points
    params["vertex_positions"] = mi.Float((ball / unit).astype(np.float32).ravel())
    params.update()
    return changed_scene(scene, shapes=[new if other == shape else other for other in scene.shapes()]), new


def split_tables(scene) -> tuple[mi.Scene, mi.Scene | None]:
    """Split a scene. Returns (scene without its `table` shapes, scene of these shapes only).

    If there is no `table`, it returns (`scene`, None).
    """
    tables = [shape for shape in scene.shapes() if is_table(shape)]
    if not tables:
        return scene, None
    return changed_scene(scene, shapes=[s for s in scene.shapes() if not is_table(s)]), assembled(tables)


def has_table(scene) -> bool:
    """Test whether a scene has a `table` shape."""
    return any(is_table(shape) for shape in scene.shapes())


def is_table(shape) -> bool:
    """Test whether a shape is a `table`. This works for the classes of all variants of Mitsuba."""
    return getattr(shape, "of_tables", False)
