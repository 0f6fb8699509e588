"""Which parameters of a scene's BSDF BRDF-Net predicts: the paper's five, or those of any other Mitsuba BSDF."""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ring.brdfnet import COOK_TORRANCE, Parameter
from mi_ring.bsdf import ATTRIBUTES, CookTorrance
from mi_ring.errors import InputError


def predicted(scene: Path, shape, ranges: dict[str, tuple[float, float]]) -> tuple[tuple[Parameter, ...], str]:
    """The parameters of the shapenet's BSDF that BRDF-Net is to predict, and the BSDF that reads them, as XML.

    `ranges`: lowest and highest value by the name of the parameter, as in the BSDF's own documentation; infinity where
    there is none. Empty: the five numbers of `cooktorrance`. Raises InputError, naming what the BSDF has.
    """
    bsdf = shape.bsdf()
    element = bsdf_element(scene)
    kind = element.get("type")
    textures = {name: value for key, value in mi.traverse(bsdf) if (name := texture_name(key))}
    if isinstance(bsdf, CookTorrance):
        textures |= {p.name: None for p in COOK_TORRANCE if p.name not in textures}
    names = ", ".join(textures)
    if not ranges and not isinstance(bsdf, CookTorrance):
        raise InputError(f"{scene}: bsdf: --parameters must say which parameters of {kind} to predict, and their "
                         f"ranges, for instance --parameters {next(iter(textures), 'reflectance')} 0 1; "
                         f"it has {names}")  # fmt: skip
    if not ranges:
        return COOK_TORRANCE, ElementTree.tostring(element, "unicode")
    parameters = []
    for name, (low, high) in ranges.items():
        if not -math.inf < low < high:
            raise InputError(f"--parameters: {name}: range is {low:g} to {high:g}, must be from lower to higher")
        if name not in textures:
            raise InputError(f"{scene}: bsdf: --parameters: {kind} has no texture {name}; it has {names}")
        given = next((e for e in element.iter() if e.get("name") == name), None)
        if given is None and textures[name] is not None:
            raise InputError(f"{scene}: bsdf: {name}: has no value; --parameters needs one to start from, an <rgb> "
                             "for a colour, a <float> for a number")  # fmt: skip
        channels = ATTRIBUTES[f"vertex_{name}"] if textures[name] is None else min(3, np.size(textures[name]))
        parameters.append(Parameter(name, channels, low, high, start(textures[name], low, high)))
        parent = element if given is None else next(e for e in element.iter() if given in list(e))
        if given is not None:
            parent.remove(given)
        texture = ElementTree.SubElement(parent, "texture", name=name, type="mesh_attribute")
        ElementTree.SubElement(texture, "string", name="name", value=f"vertex_{name}")
    xml = ElementTree.tostring(element, "unicode")
    try:
        load(xml)
    except RuntimeError as error:
        raise InputError(f"{scene}: bsdf: --parameters: {' '.join(str(error).split())}") from error
    return tuple(parameters), xml


def load(xml: str) -> mi.BSDF:
    """The BSDF of an XML element."""
    element = ElementTree.fromstring(xml)
    element.set("version", "3.0.0")
    return mi.load_string(ElementTree.tostring(element, "unicode"))


def bsdf_element(scene: Path) -> ElementTree.Element:
    """The XML of the shapenet's BSDF."""
    root = ElementTree.parse(scene).getroot()
    shape = next(e for e in root.iter("shape") if e.get("type") == "shapenet")
    element = shape.find("bsdf")
    for reference in shape.findall("ref"):
        element = next((e for e in root.iter("bsdf") if e.get("id") == reference.get("id")), element)
    if element is None:
        raise InputError(f'{scene}: shapenet: has no <bsdf>; add for instance <bsdf type="cooktorrance"/>')
    return element


def texture_name(key: str) -> str | None:
    """The name of a BSDF's texture from the name of what `mi.traverse` lists of it."""
    head, _, tail = key.rpartition(".")
    return head.rpartition(".")[2] if tail in ("value", "data") else None


def start(value, low: float, high: float) -> float:
    """What BRDF-Net's output must begin with for the parameter to begin with `value`, which the XML says."""
    if value is None or math.isinf(high):
        return 0.0
    share = (float(np.mean(np.array(value))) - low) / (high - low)
    share = min(max(share, 0.05), 0.95)
    return math.log(share / (1 - share))
