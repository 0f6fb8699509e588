"""Makes the material of a synthetic object: any Mitsuba BSDF, a measured BRDF, or two of these in a pattern."""

import re
import shlex
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from mi_ring.capture.loading import reason
from mi_ring.capture.scenefile import move_names
from mi_ring.errors import InputError, require_file
from mi_ring.foreign import reading
from mi_ring.images import read_image
from mi_ring.scene.xml_elements import load_element

COLOURS = "vertex_color"  #: name of the mesh attribute with the colours of the mesh file
COLOURED = f"principled base_color={COLOURS} roughness=0.4"  #: default material of a mesh with colours
PLAIN = "principled base_color=0.55,0.4,0.25 roughness=0.4"  #: default material of other meshes
#: Glossy materials by name. Their highlights are sharp and wide at once: no single lobe describes them.
NAMED: dict[str, dict[str, Any]] = {
    "brass": {"type": "blendbsdf", "weight": 0.5, **{
        f"bsdf_{k}": {"type": "principled", "base_color": {"type": "rgb", "value": [0.89, 0.79, 0.43]}, "metallic": 1.0,
                      "roughness": roughness} for k, roughness in enumerate((0.35, 0.65))
    }},
    "varnish": {"type": "principled", "base_color": {"type": "rgb", "value": [0.45, 0.22, 0.09]}, "roughness": 0.7,
                "specular": 0.5, "clearcoat": 1.0, "clearcoat_gloss": 0.85},
}  # fmt: skip
FORMS = ("a file .xml with one <bsdf>, a .binary of MERL, FILE.npz:MATERIAL, brass, varnish, or a plugin with its "
         "parameters")  # fmt: skip


class Pattern(NamedTuple):
    """A texture that says where a surface has the second of two materials."""

    weights: np.ndarray  #: (rows, columns) share of the second material; the texture repeats
    uv: np.ndarray  #: (V, 2) texture coordinates of the vertices

    def blend(self, first: mi.BSDF, second: mi.BSDF) -> mi.BSDF:
        """Make a BSDF that blends two BSDFs: it is `first` where the texture is 0 and `second` where it is 1."""
        pixels = mi.Bitmap(np.ascontiguousarray(self.weights[..., None], np.float32))
        nearest = {"type": "bitmap", "bitmap": pixels, "raw": True, "filter_type": "nearest", "wrap_mode": "repeat"}
        return mi.load_dict({"type": "blendbsdf", "weight": nearest, "bsdf_0": first, "bsdf_1": second})


def pattern_of(kind: str, vertices: np.ndarray, bands: int, up: int, field: str) -> Pattern:
    """Make the pattern for an object with these `vertices` (V, 3).

    `kind`: "stripes", "checks", or the path of an image, whose bright pixels get the second material. `bands`: number
    of stripes or checks along the axis `up` (0, 1 or 2 for x, y, z). The pattern is projected along a horizontal axis,
    so that its edges are sharp on coarse meshes, too. `field`: name of the option, for the message. Raises InputError
    if the image cannot be read.
    """
    low, high = vertices.min(0), vertices.max(0)
    across, height = (up + 1) % 3 if up != 1 else 0, max(high[up] - low[up], 1e-9)
    v = (vertices[:, up] - low[up]) / height
    if kind in ("stripes", "checks"):
        u = (vertices[:, across] - low[across]) / height
        weights = np.array([[0, 1], [1, 0]] if kind == "checks" else [[0, 0], [1, 1]])
        return Pattern(weights, bands / 2 * np.stack([u, v], 1))
    require_file(Path(kind), "stripes, checks or the file of a picture", field)
    with reading(f"{kind}: {field}", "an image"):
        picture = read_image(Path(kind))
    grey = picture[..., :3].astype(np.float32).mean(-1)
    u = (vertices[:, across] - low[across]) / (high[across] - low[across])
    inside = 0.5 / np.array(grey.shape[::-1])  # stay away from the borders, where the texture repeats
    return Pattern(grey > 0.5 * grey.max(), np.clip(np.stack([u, 1 - v], 1), inside, 1 - inside))


def load_material(text: str, field: str, coloured: bool) -> mi.BSDF:
    """Make the BSDF that an option describes.

    `text`: a name in `NAMED`, path of an XML file with one <bsdf>, path of a .binary file of the MERL database,
    FILE.npz:MATERIAL, or a Mitsuba plugin with parameters, such as `principled roughness=0.3`. `field`: name of the
    option, for messages. `coloured`: the mesh has colours, to which a plugin may refer as vertex_color. Raises
    InputError if there is no such BSDF.
    """
    file, _, name = text.partition(".npz:")
    path = Path(f"{file}.npz" if name else text)
    found: Any = None
    try:
        if text in NAMED:
            found = mi.load_dict(NAMED[text])
        elif text.lower().endswith(".xml"):
            require_file(path, FORMS, field)
            with reading(f"{path}: {field}", "XML"):
                root = ElementTree.fromstring(path.read_bytes())
            if root.tag != "bsdf":
                raise InputError(f"{path}: {field}: begins with <{root.tag}>, must be one <bsdf>")
            move_names(root, path.resolve().parent, Path.cwd())  # names are relative to the file
            found = load_element(root)
        elif ".npz" in text.lower() or text.lower().endswith(".binary"):
            require_file(path, FORMS, field)
            material = {"material": name} if name else {}
            found = mi.load_dict({"type": "merl", "filename": str(path.resolve()), **material})
        elif path.is_file():
            what = "give measured filename=FILE.bsdf" if path.suffix.lower() == ".bsdf" else f"give {FORMS}"
            raise InputError(f"{field}: {text}: is a file {path.suffix}; {what}")
        else:
            found = mi.load_dict(parse_plugin(text, field, coloured))
    except RuntimeError as error:
        raise InputError(f"{field}: {text}: {explain(str(error))}") from error
    if not isinstance(found, mi.BSDF):
        raise InputError(f"{field}: {text}: is no BSDF; give {FORMS}")
    return found


def explain(message: str) -> str:
    """Rewrite Mitsuba's error message about a plugin or its parameters in words for the user. Returns one line."""
    if unknown := re.findall(r"^ *- \w+ \"([^\"]*)\":", message, re.M):
        return f"has no parameter {' and '.join(unknown)}; Mitsuba's documentation lists those of each plugin"
    if kind := re.search(r"Plugin \"(.*?)\" not found", message):
        return f"Mitsuba has no plugin {kind[1]}; give {FORMS}"
    if wrong := re.search(r"property \"(.*?)\" has the wrong type \(expected (.*?), got (.*?)\)", message):
        wanted = "a number or a colour R,G,B" if "color" in wrong[2] else wrong[2].replace("float", "a number")
        return f"{wrong[1]} is a {wrong[3]}, must be {wanted}"
    return re.sub(r"^.*? plugin of type \"\w*\": (\[.*?\] )?", "", reason(RuntimeError(message)))


def parse_plugin(text: str, field: str, coloured: bool) -> dict[str, Any]:
    """Parse a text like `principled base_color=0.6,0.2,0.1 roughness=0.3`. Returns a dictionary for `mi.load_dict`.

    `field`: name of the option, for messages. `coloured`: the mesh has colours, so a value may be vertex_color. Raises
    InputError if the text is invalid.
    """
    try:
        name, *words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"{field}: is {text!r} ({error}); give {FORMS}") from error
    if name in ("bitmap", "blendbsdf"):  # Mitsuba crashes if their nested parts are missing
        raise InputError(f"{field}: {text}: needs nested parts, which only an .xml can give; give {FORMS}")
    result: dict[str, Any] = {"type": name}
    for word in words:
        key, sign, value = word.partition("=")
        if not (key and sign and value):
            raise InputError(f"{field}: {text}: found {word!r}; each parameter must be NAME=VALUE")
        result[key] = parse_value(value)
        if value == COLOURS and not coloured:
            raise InputError(f"{field}: {text}: {key} is {COLOURS}, but the mesh's file has no colours")
    return result


def parse_value(value: str) -> Any:
    """Convert the text of a parameter to a value for `mi.load_dict`.

    "0.3" becomes a number, "0.6,0.2,0.1" an RGB colour, "true" and "false" booleans, and "vertex_color" a texture that
    reads the colours of the mesh. Any other text stays a string.
    """
    if value == COLOURS:
        return {"type": "mesh_attribute", "name": COLOURS}
    if value in ("true", "false"):
        return value == "true"
    number = r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?"
    if re.fullmatch(number, value):
        return float(value)
    if re.fullmatch(f"{number},{number},{number}", value):
        return {"type": "rgb", "value": [float(part) for part in value.split(",")]}
    return value
