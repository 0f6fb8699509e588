"""Mesh attributes and textures: what a BSDF reads of the mesh that it is on."""

import re
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from mi_ring.errors import SceneError


def textures_of(bsdf) -> Iterator[tuple[str, mi.Texture]]:
    """The textures of a BSDF, or of a texture, and of all that is nested in it, each with its name."""
    found = []

    class Collect(mi.TraversalCallback):  # what `mi.traverse` walks by, which keeps the numbers only
        def put(self, name, value, *flags):
            found.append((name, value))

    bsdf.traverse(Collect())
    for name, value in found:
        if isinstance(value, mi.Texture):
            yield name, value
        if isinstance(value, mi.Object):
            yield from textures_of(value)


def attribute_of(texture) -> str | None:
    """The mesh attribute that a texture reads, None if it is another kind of texture.

    Raises SceneError if it does not say which.
    """
    if texture.class_name() != "MeshAttribute":
        return None
    name = re.match(r'MeshAttribute\[\s*name = "([^"]+)"', str(texture))  # Mitsuba says it nowhere else
    if not name:
        raise SceneError(f"bsdf: it cannot be told which mesh attribute is read by {' '.join(str(texture).split())}")
    return name[1]


def attributes_of(bsdf) -> set[str]:
    """The mesh attributes that a BSDF reads. Raises SceneError if that cannot be told."""
    found = {name for _, texture in textures_of(bsdf) if (name := attribute_of(texture))}
    if not found and "MeshAttribute[" in str(bsdf):
        raise SceneError("bsdf: reads mesh attributes, but does not expose which; it cannot be used")
    return found


def require_attributes(shape) -> None:
    """Raise SceneError if a BSDF asks `shape` for a mesh attribute that it lacks or has with other channels.

    Mitsuba renders such a surface black without a word. Attributes work with 1 or 3 channels only.
    """
    bsdf = shape.bsdf()
    for name in sorted(attributes_of(bsdf)):
        if not shape.is_mesh() or not shape.has_attribute(name):
            raise SceneError(
                f'shape "{shape.id()}": its BSDF reads the mesh attribute "{name}", which the shape does not have'
            )
    for name, expected in getattr(bsdf, "channels", {}).items():  # `cooktorrance` says how many it needs
        if attribute := attribute_of(bsdf.textures[name]):
            count = shape.face_count() if attribute.startswith("face_") else shape.vertex_count()
            found = dr.width(mi.traverse(shape)[attribute]) // count
            if found != expected:
                raise SceneError(
                    f'shape "{shape.id()}": {name} of its BSDF needs a mesh attribute of {expected} channel(s), '
                    f'"{attribute}" has {found}'
                )


def constants(bsdf) -> dict[str, list]:
    """The values of a BSDF's constant textures, by the texture's name; of several where BSDFs are nested."""
    values = {}
    for key, value in mi.traverse(bsdf):
        head, _, tail = key.rpartition(".")
        if tail == "value":
            values.setdefault(head.rpartition(".")[2], []).append(value)
    return values
