"""Finds the textures of a BSDF and the mesh attributes that the BSDF reads."""

import re
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from mi_ring.errors import SceneError


class Members(mi.TraversalCallback):
    """The members of a Mitsuba object: `found` is a list of (name, value), also of values that are no numbers.

    This class is not local to a function. Python frees a local class late, together with the objects that it has seen,
    and Dr.Jit compiles every BSDF in memory into the kernels of all scenes.
    """

    def __init__(self, parent):
        super().__init__()
        self.found = []
        parent.traverse(self)

    def put(self, name, value, *flags):
        self.found.append((name, value))


def textures_of(bsdf) -> Iterator[tuple[str, mi.Texture]]:
    """Yield (name, texture) for each texture in a BSDF, and for those in nested BSDFs and textures."""
    for name, value in Members(bsdf).found:
        if isinstance(value, mi.Texture):
            yield name, value
        if isinstance(value, mi.Object):
            yield from textures_of(value)


def attribute_of(texture) -> str | None:
    """Return the name of the mesh attribute that a Mitsuba texture reads; None for other kinds of textures.

    Raises SceneError if the name cannot be found.
    """
    if is_fine(texture):
        return texture.attribute
    if texture.class_name() != "MeshAttribute":
        return None
    name = re.match(r'MeshAttribute\[\s*name = "([^"]+)"', str(texture))  # Mitsuba has it nowhere else
    if not name:
        raise SceneError(f"bsdf: the mesh attribute is unknown that is read by {' '.join(str(texture).split())}")
    return name[1]


def is_fine(texture) -> bool:
    """Return True if a texture is a `fine_attribute`, in any variant of Mitsuba."""
    return hasattr(texture, "set_lattice")


def fine_textures(bsdf) -> list:
    """List the textures of a BSDF that are `fine_attribute`."""
    return [texture for _, texture in textures_of(bsdf) if is_fine(texture)]


def attributes_of(bsdf) -> set[str]:
    """Return the names of the mesh attributes that a BSDF reads. Raises SceneError if they cannot be found."""
    found = {name for _, texture in textures_of(bsdf) if (name := attribute_of(texture))}
    if not found and "MeshAttribute[" in str(bsdf):
        raise SceneError("bsdf: reads mesh attributes, but does not expose which; it cannot be used")
    return found


def optional_of(bsdf) -> set[str]:
    """Return the names of the mesh attributes that a BSDF, or a nested one, takes for 0 if a mesh lacks them."""
    nested = (optional_of(value) for _, value in Members(bsdf).found if isinstance(value, mi.BSDF))
    return set().union(getattr(bsdf, "optional", ()), *nested)


def require_attributes(shape) -> None:
    """Raise SceneError if a shape does not have a mesh attribute that its BSDF reads, or if the channel count is wrong.

    Mitsuba itself would render such a shape black, without an error.
    """
    bsdf = shape.bsdf()
    lacking = {name for name in optional_of(bsdf) if not shape.is_mesh() or not shape.has_attribute(name)}
    for name in sorted(attributes_of(bsdf) - lacking):
        if not shape.is_mesh() or not shape.has_attribute(name):
            raise SceneError(f'shape "{shape.id()}": its BSDF reads the mesh attribute "{name}", which the shape does '
                             "not have")  # fmt: skip
    for name, expected in getattr(bsdf, "channels", {}).items():  # of `cooktorrance`
        attribute = attribute_of(bsdf.textures[name])
        if attribute and attribute not in lacking:
            count = shape.face_count() if attribute.startswith("face_") else shape.vertex_count()
            found = dr.width(mi.traverse(shape)[attribute]) // count
            if found != expected:
                raise SceneError(f'shape "{shape.id()}": {name} of its BSDF needs a mesh attribute of {expected} '
                                 f'channel(s), but "{attribute}" has {found}')  # fmt: skip


def constant_values(bsdf) -> dict[str, list]:
    """Return the constant parameters of a BSDF, such as colours without a texture: lists of values by parameter name.

    A list has several values if nested BSDFs have parameters of the same name.
    """
    values = {}
    for key, value in mi.traverse(bsdf):
        head, _, tail = key.rpartition(".")
        if tail == "value":
            values.setdefault(head.rpartition(".")[2], []).append(value)
    return values
