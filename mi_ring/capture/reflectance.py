"""Chooses the parameters of a scene's BSDF that BRDF-Net predicts: those of `cooktorrance`, or of another BSDF."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np

from mi_ring.capture.capture import Capture
from mi_ring.capture.scenefile import bsdf_element
from mi_ring.errors import InputError
from mi_ring.nets.brdf_net import COAT, COOK_TORRANCE, ROUGH, Parameter
from mi_ring.scene.mesh_attributes import attributes_of, constant_values, optional_of
from mi_ring.scene.xml_elements import load_bsdf


def predicted_parameters(
    capture: Capture, ranges: dict[str, tuple[float, float]], rough: bool = False, coat: bool = False
) -> tuple[tuple[Parameter, ...], str]:
    """Choose the BSDF parameters that BRDF-Net predicts. Returns (parameters, XML of the BSDF that reads them).

    `ranges`: a dict from parameter names, as in the BSDF's documentation, to (lowest, highest) value; the highest may
    be infinite. If the dict is empty, all parameters of `cooktorrance` that are not constant are chosen. `rough`: among
    these is `diffuse_roughness`, which the paper's reflectance lacks. `coat`: among these are strength and roughness of
    a coat, a second lobe of highlights, even if the scene's BSDF has no coat. Raises InputError if the scene's BSDF
    lacks a parameter. The message lists those that exist.
    """
    scene, bsdf = capture.path, capture.shape.bsdf()
    element = bsdf_element(ElementTree.fromstring(capture.xml), scene)[1]
    kind = element.get("type")
    for inner in element.iter():
        if inner.tag == "ref" or inner.get("name") == "filename":
            raise InputError(f"{scene}: bsdf: <{inner.tag}> {inner.get('id') or inner.get('value')}: a fit takes BSDFs "
                             "without files and references; use constants")  # fmt: skip
        inner.attrib.pop("id", None)  # the scene may contain it, too, if the shape refers to it
    textures = constant_values(bsdf)
    own = {p.name: p for p in (*COOK_TORRANCE, ROUGH, *COAT) if kind == "cooktorrance" and p.name not in textures}
    if kind == "cooktorrance" and ((coat and not ranges) or {p.name for p in COAT} & {*ranges}):
        add_coat(element)
    coated = any(element.find(f"*[@name='{p.name}']") is not None for p in COAT)
    names = ", ".join([*textures, *own])
    if not ranges and kind != "cooktorrance":
        raise InputError(f"{scene}: bsdf: --parameters must say which parameters of {kind} to predict, and their "
                         f"ranges, for instance --parameters {next(iter(textures), 'reflectance')} 0 1; "
                         f"it has {names}")  # fmt: skip
    parameters = []
    absent = (() if rough else (ROUGH,)) + (() if coated else COAT)
    default = {p.name: (p.low, p.high) for p in own.values() if p not in absent}
    for name, (low, high) in (ranges or default).items():
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
        parameters.append(Parameter(name, 3 if value.size == 3 else 1, low, high, initial_output(value, low, high)))
        texture.clear()
        texture.tag, texture.attrib = "texture", {"name": name, "type": "mesh_attribute"}
        ElementTree.SubElement(texture, "string", name="name", value=f"vertex_{name}")
    xml = ElementTree.tostring(element, "unicode")
    try:
        loaded = load_bsdf(xml)
        left = attributes_of(loaded) - optional_of(loaded) - {p.attribute for p in parameters}
    except InputError as error:
        raise InputError(f"{scene}: {error}; see --parameters") from error
    if left:
        raise InputError(f"{scene}: bsdf: nothing writes {min(left)}, which {kind} reads; give that parameter a "
                         "constant, or a range with --parameters")  # fmt: skip
    if not parameters:
        raise InputError(f"{scene}: bsdf: every parameter of {kind} is a constant; --parameters must say which of "
                         f"{names} to predict")  # fmt: skip
    return tuple(parameters), xml


def add_coat(element: ElementTree.Element) -> None:
    """Let a BSDF `cooktorrance` read a coat from mesh attributes, unless it has one. `element`: its XML, changed."""
    for p in COAT:
        if element.find(f"*[@name='{p.name}']") is None:
            texture = ElementTree.SubElement(element, "texture", name=p.name, type="mesh_attribute")
            ElementTree.SubElement(texture, "string", name="name", value=p.attribute)


def initial_output(value: np.ndarray, low: float, high: float) -> float:
    """Return the network output for which BRDF-Net predicts the mean of the array `value`.

    `low`, `high`: range of the parameter. If `high` is infinite, returns 0.
    """
    if math.isinf(high):
        return 0.0
    share = (float(value.mean()) - low) / (high - low)
    share = min(max(share, 0.05), 0.95)
    return math.log(share / (1 - share))
