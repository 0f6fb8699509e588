"""Makes glTF: a fitted object with metallic-roughness textures, as one GLB file."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import pygltflib
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ring.errors import InputError
from mi_ring.images import encoded_picture, linear_to_srgb, to_bytes
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.output.atlas import Atlas, Texels, rasterise, reflectances, unwrap
from mi_ring.plugins.matte_reflection import mean_albedo
from mi_ring.plugins.microfacets import MIN_ROUGHNESS
from mi_ring.scene.mesh_attributes import constant_values
from mi_ring.scene.visibility import MaskedCamera, visible_points
from mi_ring.scene.xml_elements import load_bsdf

COAT_F0 = 0.04  #: what a clear coat of glTF reflects, seen from above
LOBES = ("anisotropic", "clearcoat", "sheen", "spec_trans", "spec_tint", "flatness")  #: of `principled` that glTF lacks


class Material(NamedTuple):
    """The material of N points as parameters of glTF. Colours are linear, not sRGB."""

    base_color: np.ndarray  # (N, 3), in [0, 1]
    metallic: np.ndarray  # (N,)
    roughness: np.ndarray  # (N,), the square root of the microfacet width
    specular: np.ndarray  # (N,), the weight of KHR_materials_specular
    specular_color: float  # the factor of F₀ in this extension
    scale: float  # of the reflectances, so that they stay within [0, 1]
    coat: np.ndarray | None = None  # (N,), the weight of KHR_materials_clearcoat; None: no coat
    coat_roughness: np.ndarray | None = None  # (N,), the square root of its microfacet width


class Shares(NamedTuple):
    """What the parts of a `cooktorrance` reflect at N points, relative to the incident light."""

    matte: np.ndarray  # (N, 3) π ρᵈ, of Lambert's law
    gloss: np.ndarray  # (N, L) 4 ρᵞ of each of L specular lobes
    widths: np.ndarray  # (N, L) microfacet width of each
    scale: float  # of the reflectances, so that hardly any sum is above 1


def metallic_roughness(bsdf: str, values: dict[str, np.ndarray]) -> Material:
    """Convert a BSDF with its values at N points to glTF's metallic-roughness material.

    `bsdf`: Mitsuba's XML. `values`: parameters of the BSDF by name, (N, 3) or (N,).

    ``cooktorrance``: glTF's dielectric is (1 − F) c/π + F D V with Schlick's F between F₀ = min(0.04 k, 1) w and
    F₉₀ = w, where w is `specular` and k is `specular_color`. With k = 25, F is w at all angles, and

        w = 4 ρᵞ,  c = π ρᵈ / (1 − w),  roughness = √r

    give ρᵈ + 4 ρᵞ D V with the same D (GGX). V = G / (4 (n·i)(n·o)) differs: G is Smith's product in ``cooktorrance``
    and height-correlated in glTF. If the surface conserves energy, π ρᵈ + 4 ρᵞ ≤ 1, then c ≤ 1 and w ≤ 1. If more than
    1 % of the points do not conserve energy, the intensities of the lights were wrong. Then all ρ are scaled. glTF has
    no rough matte surfaces: instead of ρᵈ with a `diffuse_roughness`, c has Lambert's ρᵈ of the same mean albedo.

    A coat becomes KHR_materials_clearcoat, which reflects 4 % of the light from above, and more at grazing angles. What
    is above 4 % is added to the other lobe, whose width then is the mean of both.

    ``diffuse`` is exact in glTF. ``principled`` without other lobes is nearly exact. Raises InputError for other BSDFs.
    """
    value = Values(bsdf, values)
    kind, params = value.kind, mi.traverse(value.bsdf)
    zero = np.zeros(value.count, np.float32)
    if kind == "cooktorrance":
        diffuse, gloss, widths, scale = shares(value)
        above = gloss[:, 1:].sum(1)  # 0 without a coat
        coat = np.minimum(above / COAT_F0, 1)
        both = np.stack([gloss[:, 0], above - COAT_F0 * coat][: gloss.shape[1]], 1)
        width = (both * widths).sum(1) / np.maximum(both.sum(1), 1e-12) if gloss.shape[1] > 1 else widths[:, 0]
        below = 1 - COAT_F0 * coat  # of the light passes the coat
        w = np.clip(both.sum(1) / below, 0, 1)
        c = np.clip(diffuse / (below * np.maximum(1 - w, 1e-3))[:, None], 0, 1)
        width = np.sqrt(np.maximum(width, MIN_ROUGHNESS))
        made = Material(c, zero, width, w, 25.0, scale)
        return made if gloss.shape[1] == 1 else made._replace(coat=coat, coat_roughness=np.sqrt(widths[:, 1]))
    if kind == "diffuse":
        return Material(value("reflectance", 3), zero, zero + 1, zero, 1.0, 1.0)
    if kind == "principled":
        further = [name for name in LOBES if np.any(value(name) != 0)]
        if not further:
            eta = float(np.ravel(params["eta"])[0]) if "eta" in params else None
            f0 = ((eta - 1) / (eta + 1)) ** 2 if eta else 0.08 * float(np.ravel(params["specular"])[0])
            return Material(value("base_color", 3), value("metallic"), value("roughness"), zero + 1, f0 / 0.04, 1.0)
        kind = f"principled with {', '.join(further)}"
    raise InputError(f"{kind}: glTF cannot express this material; write PLY or a scene for Mitsuba (.xml)")


class Values:
    """The parameters of a BSDF at N points: values of a fit, or constants. Call it with the name of a parameter.

    `bsdf`: Mitsuba's XML. `values`: parameters by name, (N, 3) or (N,). A call raises InputError if the parameter has
    no value.
    """

    def __init__(self, bsdf: str, values: dict[str, np.ndarray]) -> None:
        self.bsdf, self.values = load_bsdf(bsdf), values
        self.kind, self.fixed = ElementTree.fromstring(bsdf).get("type"), constant_values(self.bsdf)
        self.count = len(next(iter(values.values())))

    def __contains__(self, name: str) -> bool:
        return name in self.values or name in self.fixed

    def __call__(self, name: str, channels: int = 1) -> np.ndarray:
        if name in self.values:
            return self.values[name]
        if name not in self.fixed:
            raise InputError(f"{self.kind}: {name} is neither fitted nor a constant; write PLY")
        constant = np.broadcast_to(np.asarray(self.fixed[name][0], np.float32).ravel(), (self.count, channels))
        return constant if channels == 3 else constant[:, 0]


def shares(value: Values) -> Shares:
    """Compute what the parts of a `cooktorrance` reflect."""
    rough = value("diffuse_roughness") if "diffuse_roughness" in value else np.zeros(value.count, np.float32)
    matte = math.pi * value("diffuse", 3) * mean_albedo(rough)[:, None]
    lobes = [("specular", "roughness"), ("coat", "coat_roughness")][: 1 + ("coat" in value)]
    gloss = np.stack([4 * value(strength) for strength, _ in lobes], 1)
    widths = np.maximum(np.stack([value(width) for _, width in lobes], 1), MIN_ROUGHNESS)
    scale = 1 / max(1.0, float(np.quantile(matte.max(1) + gloss.sum(1), 0.99)))
    return Shares(scale * matte, scale * gloss, widths, scale)


def require_expressible(ring: FittedObject) -> None:
    """Raise InputError if glTF cannot express the material of an object. This check is quick."""
    metallic_roughness(ring.bsdf, reflectances(ring, ring.domain.sample(2)[0].numpy()))


def textures(material: Material, texels: Texels) -> dict[str, np.ndarray]:
    """Convert a material to textures. Returns uint8 arrays (H, W, 3 or 4), with glTF's names as keys.

    `material`: the material at the N points of `texels`. `texels`: these points, and which of them each pixel shows.
    Base colours are encoded as sRGB, other values linearly. There is no normal map if the mesh has all of the detail.
    """
    ones = np.ones_like(material.roughness)
    images = {
        "baseColorTexture": to_bytes(linear_to_srgb(material.base_color)),
        "metallicRoughnessTexture": to_bytes(np.stack([ones, material.roughness, material.metallic], 1)),
        "specularTexture": to_bytes(np.stack([ones, ones, ones, material.specular], 1)),
    }
    normals = to_bytes(0.5 * texels.normals + 0.5)
    if np.ptp(normals, axis=0).max() > 1:  # not rounding alone
        images["normalTexture"] = normals
    if material.coat is not None and material.coat_roughness is not None:
        images["clearcoatTexture"] = to_bytes(np.stack([material.coat, material.coat_roughness, 0 * ones], 1))
    return {name: image[texels.index] for name, image in images.items()}


def glb(
    ring: FittedObject, subdivisions: int, resolution: int, time: float = 1.0, metres: float | None = None,
    views: Sequence[MaskedCamera] | None = None, up: Sequence[float] | None = None,
) -> bytes:  # fmt: skip
    """Make a GLB file of an object, with positions in scene units. Returns the bytes of the file.

    `subdivisions`: level of the mesh, about 10 · 4^level vertices. `resolution`: width of the textures [texels].
    `time`: state of the deformation, from 0 (start surface) to 1 (fitted object). `metres`: length of a scene unit [m];
    a node scales the positions to metres; None: no scale. `up` (3,): up direction; the node turns it to the y axis;
    None: no rotation. `views`: cameras and masks of photographs; the vertex attribute _SEEN is 1 where one of them
    shows the vertex, otherwise 0; None: no such attribute.

    Raises InputError if glTF cannot express the material.
    """
    require_expressible(ring)
    atlas = unwrap(ring, subdivisions, resolution, time)
    texels = rasterise(ring, atlas, resolution, time)
    material = metallic_roughness(ring.bsdf, reflectances(ring, texels.s))
    seen = None
    if views is not None:
        s = np.zeros((atlas.uncut.max() + 1, 3), np.float32)
        s[atlas.uncut] = atlas.s
        seen = visible_points(ring, s, atlas.uncut[atlas.faces], views)[0][atlas.uncut]
    return assemble_glb(atlas, textures(material, texels), material, ring.bsdf, metres, seen, up)


def assemble_glb(
    atlas: Atlas, images: dict[str, np.ndarray], material: Material, bsdf: str, metres: float | None = None,
    seen: np.ndarray | None = None, up: Sequence[float] | None = None,
) -> bytes:  # fmt: skip
    """Make a GLB file from a mesh with V vertices and its textures. Returns the bytes of the file.

    `images`: uint8 arrays (H, W, 3 or 4) by glTF's names of textures. `material`: its constant factors are used.
    `bsdf`: Mitsuba's XML of the BSDF, which the extras of the material keep. `metres`: length of a scene unit [m],
    None: unknown. `seen` (V,) bool: True where a photograph shows the vertex; None: no such attribute. `up` (3,): up
    direction, which a node turns to the y axis; None: no rotation.
    """
    blob = bytearray()
    buffer_views: list[pygltflib.BufferView] = []
    accessors: list[pygltflib.Accessor] = []
    sources: list[pygltflib.Image] = []

    def view(content: bytes, target: int | None = None) -> int:
        blob.extend(b"\0" * (-len(blob) % 4))
        place = pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(content), target=target)
        buffer_views.append(place)
        blob.extend(content)
        return len(buffer_views) - 1

    def accessor(array: np.ndarray, target: int = pygltflib.ARRAY_BUFFER) -> int:
        accessors.append(pygltflib.Accessor(
            bufferView=view(array.tobytes(), target), count=len(array),
            componentType=pygltflib.UNSIGNED_INT if array.dtype == np.uint32 else pygltflib.FLOAT,
            type="SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
        ))  # fmt: skip
        return len(accessors) - 1

    def texture(name: str, kind: Any = pygltflib.TextureInfo) -> Any:
        content = view(encoded_picture(Image.fromarray(images[name])))
        sources.append(pygltflib.Image(name=name, mimeType="image/png", bufferView=content))
        return kind(index=len(sources) - 1)

    vertices = {"POSITION": atlas.vertices, "NORMAL": atlas.normals, "TANGENT": atlas.tangents, "TEXCOORD_0": atlas.uv}
    # No second attribute of our own: Blender 5.0 mixes them up if their types differ.
    vertices |= {} if seen is None else {"_SEEN": seen}
    attributes = pygltflib.Attributes()
    for name, values in vertices.items():
        setattr(attributes, name, accessor(values.astype(np.float32)))
    bounds, positions = accessors[0], atlas.vertices.astype(np.float32)
    bounds.min, bounds.max = positions.min(0).tolist(), positions.max(0).tolist()
    indices = accessor(atlas.faces.astype(np.uint32).ravel(), target=pygltflib.ELEMENT_ARRAY_BUFFER)
    specular = texture("specularTexture")
    extensions: dict[str, Any] = {"KHR_materials_specular": {
        "specularTexture": {"index": specular.index}, "specularColorFactor": [material.specular_color] * 3,
    }}  # fmt: skip
    if material.coat is not None:
        coat = {"index": texture("clearcoatTexture").index}
        extensions["KHR_materials_clearcoat"] = {
            "clearcoatFactor": 1.0, "clearcoatTexture": coat,
            "clearcoatRoughnessFactor": 1.0, "clearcoatRoughnessTexture": coat,
        }  # fmt: skip
    fitted = pygltflib.Material(
        name="fitted",
        pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
            baseColorTexture=texture("baseColorTexture"), metallicRoughnessTexture=texture("metallicRoughnessTexture")
        ),
        normalTexture=texture("normalTexture", pygltflib.NormalMaterialTexture) if "normalTexture" in images else None,
        extensions=extensions,
        extras={"mi_ring": {"bsdf": bsdf, "scale": material.scale}},
    )  # fmt: skip
    node = pygltflib.Node(
        name="object", mesh=0, scale=[metres] * 3 if metres else None,
        rotation=None if up is None else Rotation.align_vectors([[0, 1.0, 0]], [up])[0].as_quat().tolist(),
        extras={"unit": f"{metres:g} m" if metres else "scene unit of unknown length"},
    )  # fmt: skip
    sampler = pygltflib.Sampler(
        magFilter=pygltflib.LINEAR, minFilter=pygltflib.LINEAR_MIPMAP_LINEAR,
        wrapS=pygltflib.CLAMP_TO_EDGE, wrapT=pygltflib.CLAMP_TO_EDGE,
    )  # fmt: skip
    file = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator="mi_ring"), scene=0, scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[node], materials=[fitted], extensionsUsed=[*extensions],
        meshes=[pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=attributes, indices=indices, material=0)])],
        textures=[pygltflib.Texture(sampler=0, source=k) for k in range(len(sources))], samplers=[sampler],
        images=sources, accessors=accessors, bufferViews=buffer_views,
        buffers=[pygltflib.Buffer(byteLength=len(blob))],
    )  # fmt: skip
    file.set_binary_blob(bytes(blob))
    return b"".join(file.save_to_bytes())
