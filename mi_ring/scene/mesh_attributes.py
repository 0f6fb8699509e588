"""The textures of a BSDF, and the mesh attributes that it reads."""

import re
from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from mi_ring.errors import SceneError


class Members(mi.TraversalCallback):
    """Collects the named members of an object. `mi.traverse` keeps only numbers.

    This is no local class: Python frees those late, with the objects that they have seen, and Dr.Jit compiles every
    BSDF in memory into the kernels of all scenes.
    """

    def __init__(self, parent):
        super().__init__()
        self.found = []
        parent.traverse(self)

    def put(self, name, value, *flags):
        self.found.append((name, value))


def textures_of(bsdf) -> Iterator[tuple[str, mi.Texture]]:
    """The textures of a BSDF or texture, and of all objects nested in it, each with its name."""
    for name, value in Members(bsdf).found:
        if isinstance(value, mi.Texture):
            yield name, value
        if isinstance(value, mi.Object):
            yield from textures_of(value)


def attribute_of(texture) -> str | None:
    """The name of the mesh attribute that a texture reads; None for other kinds of textures.

    Raises SceneError if the name is not known.
    """
    if texture.class_name() != "MeshAttribute":
        return None
    name = re.match(r'MeshAttribute\[\s*name = "([^"]+)"', str(texture))  # Mitsuba has it nowhere else
    if not name:
        raise SceneError(f"bsdf: the mesh attribute is unknown that is read by {' '.join(str(texture).split())}")
    return name[1]


def attributes_of(bsdf) -> set[str]:
    """The names of the mesh attributes that a BSDF reads. Raises SceneError if they are not known."""
    found = {name for _, texture in textures_of(bsdf) if (name := attribute_of(texture))}
    if not found and "MeshAttribute[" in str(bsdf):
        raise SceneError("bsdf: reads mesh attributes, but does not expose which; it cannot be used")
    return found


def require_attributes(shape) -> None:
    """Raise SceneError if a shape lacks a mesh attribute that its BSDF reads, or if its number of channels is wrong.

    Mitsuba would render such a shape black, without an error.
    """
    bsdf = shape.bsdf()
    for name in sorted(attributes_of(bsdf)):
        if not shape.is_mesh() or not shape.has_attribute(name):
            raise SceneError(f'shape "{shape.id()}": its BSDF reads the mesh attribute "{name}", which the shape does '
                             "not have")  # fmt: skip
    for name, expected in getattr(bsdf, "channels", {}).items():  # of `cooktorrance`
        if attribute := attribute_of(bsdf.textures[name]):
            count = shape.face_count() if attribute.startswith("face_") else shape.vertex_count()
            found = dr.width(mi.traverse(shape)[attribute]) // count
            if found != expected:
                raise SceneError(f'shape "{shape.id()}": {name} of its BSDF needs a mesh attribute of {expected} '
                                 f'channel(s), but "{attribute}" has {found}')  # fmt: skip


def constant_values(bsdf) -> dict[str, list]:
    """The values of a BSDF's constant textures by name. A name has several values where BSDFs are nested."""
    values = {}
    for key, value in mi.traverse(bsdf):
        head, _, tail = key.rpartition(".")
        if tail == "value":
            values.setdefault(head.rpartition(".")[2], []).append(value)
    return values
