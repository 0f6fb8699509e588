"""Which parameters of a scene's BSDF BRDF-Net predicts: the paper's five, or those of any other Mitsuba BSDF."""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ring.brdfnet import COOK_TORRANCE, Parameter
from mi_ring.bsdf import attributes_of
from mi_ring.errors import InputError


def predicted(scene: Path, shape, ranges: dict[str, tuple[float, float]]) -> tuple[tuple[Parameter, ...], str]:
    """The parameters of the shapenet's BSDF that BRDF-Net is to predict, and the BSDF that reads them, as XML.

    `ranges`: lowest and highest value by the name of the parameter, as in the BSDF's own documentation; infinity where
    there is none. Empty: those of the five numbers of `cooktorrance` that have no constant. Raises InputError, naming
    what the BSDF has.
    """
    bsdf = shape.bsdf()
    element = bsdf_element(ElementTree.parse(scene).getroot(), scene)[1]
    kind = element.get("type")
    for inner in element.iter():
        if inner.tag == "ref" or inner.get("name") == "filename":
            raise InputError(f"{scene}: bsdf: <{inner.tag}> {inner.get('id') or inner.get('value')}: a fit takes BSDFs "
                             "without files and references; use constants")  # fmt: skip
        inner.attrib.pop("id", None)  # else it would be there twice in scenes that have the BSDF by reference
    textures = constants(bsdf)
    own = {p.name: p for p in COOK_TORRANCE if kind == "cooktorrance" and p.name not in textures}
    names = ", ".join([*textures, *own])
    if not ranges and kind != "cooktorrance":
        raise InputError(f"{scene}: bsdf: --parameters must say which parameters of {kind} to predict, and their "
                         f"ranges, for instance --parameters {next(iter(textures), 'reflectance')} 0 1; "
                         f"it has {names}")  # fmt: skip
    parameters = []
    for name, (low, high) in (ranges or {p.name: (p.low, p.high) for p in own.values()}).items():
        if not -math.inf < low < high:
            raise InputError(f"--parameters: {name}: range is {low:g} to {high:g}, must be from lower to higher")
        if name in own:
            parameters.append(own[name]._replace(low=low, high=high))
            continue
        if len(textures.get(name, [])) != 1:
            found = "more than one" if name in textures else "no"
            raise InputError(f"{scene}: bsdf: --parameters: {kind} has {found} texture {name}; it has {names}")
        texture = next((e for e in element.iter() if e.get("name") == name), None)
        if texture is None:
            raise InputError(f"{scene}: bsdf: {name}: has no value; --parameters needs one to start from, an <rgb> "
                             "for a colour, a <float> for a number")  # fmt: skip
        value = np.array(textures[name][0])
        if not low <= value.mean() <= high:
            raise InputError(f"{scene}: bsdf: {name}: is {value.mean():g}, must be within the range of --parameters, "
                             f"{low:g} to {high:g}")  # fmt: skip
        parameters.append(Parameter(name, 3 if value.size == 3 else 1, low, high, start(value, low, high)))
        texture.clear()
        texture.tag, texture.attrib = "texture", {"name": name, "type": "mesh_attribute"}
        ElementTree.SubElement(texture, "string", name="name", value=f"vertex_{name}")
    xml = ElementTree.tostring(element, "unicode")
    try:
        left = attributes_of(load(xml)) - {f"vertex_{p.name}" for p in parameters}
    except RuntimeError as error:
        raise InputError(f"{scene}: bsdf: --parameters: {' '.join(str(error).split())}") from error
    if left:
        raise InputError(f"{scene}: bsdf: nothing writes {min(left)}, which {kind} reads; give that parameter a "
                         "constant, or a range with --parameters")  # fmt: skip
    if not parameters:
        raise InputError(f"{scene}: bsdf: every parameter of {kind} is a constant; --parameters must say which of "
                         f"{names} to predict")  # fmt: skip
    return tuple(parameters), xml


def constants(bsdf) -> dict[str, list]:
    """The values of a BSDF's constant textures, by the texture's name; of several where BSDFs are nested."""
    values = {}
    for key, value in mi.traverse(bsdf):
        head, _, tail = key.rpartition(".")
        if tail == "value":
            values.setdefault(head.rpartition(".")[2], []).append(value)
    return values


def load(xml: str) -> mi.BSDF:
    """The BSDF of an XML element."""
    element = ElementTree.fromstring(xml)
    element.set("version", "3.0.0")
    return mi.load_string(ElementTree.tostring(element, "unicode"))


def bsdf_element(root: ElementTree.Element, scene: Path) -> tuple[ElementTree.Element, ElementTree.Element]:
    """The shapenet's <bsdf>, or its <ref> to one, and the BSDF meant, in the XML of a scene.

    Raises InputError if there is none, and where a part of the scene is not in the file.
    """
    for tag in ("include", "default", "path"):
        if root.find(f".//{tag}") is not None:
            raise InputError(f"{scene}: <{tag}>: a fit needs a scene without it; write out what it stands for")
    shape = next(e for e in root.iter("shape") if e.get("type") == "shapenet")
    known = {e.get("id"): e for e in root.iter("bsdf")}
    for child in shape:
        if child.tag == "bsdf":
            return child, child
        if child.tag == "ref" and child.get("id") in known:
            return child, known[child.get("id")]
    raise InputError(f'{scene}: shapenet: has no <bsdf>; add for instance <bsdf type="cooktorrance"/>')


def start(value: np.ndarray, low: float, high: float) -> float:
    """What BRDF-Net's output must begin with for the parameter to begin with the mean of `value`; 0 without an end."""
    if math.isinf(high):
        return 0.0
    share = (float(value.mean()) - low) / (high - low)
    share = min(max(share, 0.05), 0.95)
    return math.log(share / (1 - share))
