"""Loads parts of scene files (XML elements) as Mitsuba objects."""

import xml.etree.ElementTree as ElementTree

import mitsuba as mi

from mi_ring.errors import InputError


def require_parts(root: ElementTree.Element) -> None:
    """Raise RuntimeError if a bitmap in `root` has no file name, or a blendbsdf is empty. Mitsuba would crash."""
    for element in root.iter():
        if element.get("type") == "bitmap" and element.find("string[@name='filename']") is None:
            raise RuntimeError("bitmap: filename is missing")
        if element.get("type") == "blendbsdf" and not len(element):
            raise RuntimeError("blendbsdf: is empty; it takes two BSDFs and a weight")


def load_element(element: ElementTree.Element) -> mi.Object:
    """Load an XML element as a Mitsuba object. Raises RuntimeError if Mitsuba refuses the element."""
    require_parts(element)
    whole = ElementTree.Element(element.tag, element.attrib | {"version": "3.0.0"})
    whole.extend(element)
    return mi.load_string(ElementTree.tostring(whole, "unicode"))


def load_bsdf(xml: str) -> mi.BSDF:
    """Load a BSDF. `xml`: text of a <bsdf> element. Raises InputError if it is not XML or if Mitsuba refuses it."""
    try:
        return load_element(ElementTree.fromstring(xml))
    except (ElementTree.ParseError, RuntimeError) as error:
        raise InputError(f"bsdf: {' '.join(str(error).split())}") from error


def with_fine_attribute(xml: str, attribute: str) -> str:
    """Return the XML of a BSDF that reads a mesh attribute by `fine_attribute` instead of `mesh_attribute`.

    `xml`: a <bsdf> element. It is returned if it does not read the attribute.
    """
    element = ElementTree.fromstring(xml)
    found = [texture for texture in element.iter("texture") if texture.get("type") == "mesh_attribute"
             and texture.find(f"string[@name='name'][@value='{attribute}']") is not None]  # fmt: skip
    for texture in found:
        texture.set("type", "fine_attribute")
    return ElementTree.tostring(element, "unicode") if found else xml
