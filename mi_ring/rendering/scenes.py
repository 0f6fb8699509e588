"""Mitsuba scenes, put together anew of the parts of another."""

import mitsuba as mi


def own_emitters(scene) -> list:
    """The emitters of a scene that are no part of its shapes, and so do not come along with them."""
    of_shapes = [shape.emitter() for shape in scene.shapes() if shape.is_emitter()]
    return [emitter for emitter in scene.emitters() if emitter not in of_shapes]


def assembled(shapes, emitters=(), sensors=(), integrator=None) -> mi.Scene:
    """A scene of these objects. They keep their ids, and meshes are not merged."""
    parts = [*shapes, *emitters, *sensors, *([integrator] if integrator else [])]
    ids = [part.id() for part in parts]
    everything = {"type": "scene"} | {f"part{k}": part for k, part in enumerate(parts)}
    scene = mi.load_dict(everything, optimize=False, parallel=False)
    for part, name in zip(parts, ids):  # which Mitsuba has changed to the keys
        part.set_id(name)
    return scene


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
