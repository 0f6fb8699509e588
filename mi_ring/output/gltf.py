"""glTF: a fitted object with metallic-roughness textures, as one GLB file."""

import io
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
from mi_ring.images import linear_to_srgb, to_bytes
from mi_ring.objects.fitted_object import FittedObject
from mi_ring.output.atlas import Atlas, Texels, rasterise, reflectances, unwrap
from mi_ring.plugins.cooktorrance import MIN_ROUGHNESS
from mi_ring.scene.mesh_attributes import constant_values
from mi_ring.scene.visibility import MaskedCamera, visible_points
from mi_ring.scene.xml_elements import load_bsdf

LOBES = ("anisotropic", "clearcoat", "sheen", "spec_trans", "spec_tint", "flatness")  #: of `principled`, but for glTF's


class Material(NamedTuple):
    """Reflectances of N points in glTF's terms; what is linear is not encoded."""

    base_color: np.ndarray  # (N, 3), linear, in [0, 1]
    metallic: np.ndarray  # (N,)
    roughness: np.ndarray  # (N,), the square root of the microfacet width
    specular: np.ndarray  # (N,), the weight of KHR_materials_specular
    specular_color: float  # its factor of F₀
    scale: float  # by which the reflectances were multiplied to stay within [0, 1]


def metallic_roughness(bsdf: str, values: dict[str, np.ndarray]) -> Material:
    """A BSDF, Mitsuba's XML, with these parameters, (N, 3) or (N,) by name, in glTF's terms.

    ``cooktorrance``: glTF's dielectric is (1 − F) c/π + F D V with Schlick's F between F₀ = min(0.04 k, 1) w and
    F₉₀ = w, where w is `specular` and k `specular_color`. With k = 25 F is w at all angles, and

        w = 4 ρᵞ,  c = π ρᵈ / (1 − w),  roughness = √r

    make it ρᵈ + 4 ρᵞ D V, with the same D (GGX). V = G / (4 (n·i)(n·o)) differs: G is Smith's product in ours,
    correlated with height in glTF. c ≤ 1 and w ≤ 1 where the surface conserves energy, π ρᵈ + 4 ρᵞ ≤ 1. If one point in
    a hundred does not, the intensities of the lights were not true, and all ρ are scaled until it does.

    ``diffuse`` is itself in glTF; ``principled`` without its further lobes nearly is. Raises InputError for others.
    """
    loaded = load_bsdf(bsdf)
    kind = ElementTree.fromstring(bsdf).get("type")
    fixed, params = constant_values(loaded), mi.traverse(loaded)
    count = len(next(iter(values.values())))

    def value(name: str, channels: int = 1) -> np.ndarray:
        if name in values:
            return values[name]
        if name not in fixed:
            raise InputError(f"{kind}: {name} is neither fitted nor a constant; write PLY")
        constant = np.broadcast_to(np.asarray(fixed[name][0], np.float32).ravel(), (count, channels))
        return constant if channels == 3 else constant[:, 0]

    zero = np.zeros(count, np.float32)
    if kind == "cooktorrance":
        diffuse, specular = math.pi * value("diffuse", 3), 4 * value("specular")
        scale = 1 / max(1.0, float(np.quantile(diffuse.max(1) + specular, 0.99)))
        w = np.clip(scale * specular, 0, 1)
        c = np.clip(scale * diffuse / np.maximum(1 - w, 1e-3)[:, None], 0, 1)
        return Material(c, zero, np.sqrt(np.maximum(value("roughness"), MIN_ROUGHNESS)), w, 25.0, scale)
    if kind == "diffuse":
        return Material(value("reflectance", 3), zero, zero + 1, zero, 1.0, 1.0)
    if kind == "principled":
        further = [name for name in LOBES if np.any(value(name) != 0)]
        if not further:
            eta = float(np.ravel(params["eta"])[0]) if "eta" in params else None
            f0 = ((eta - 1) / (eta + 1)) ** 2 if eta else 0.08 * float(np.ravel(params["specular"])[0])
            return Material(value("base_color", 3), value("metallic"), value("roughness"), zero + 1, f0 / 0.04, 1.0)
        kind = f"principled with {', '.join(further)}"
    raise InputError(f"{kind}: this material cannot be told in glTF's terms; write PLY or a scene for Mitsuba (.xml)")


def require_expressible(ring: FittedObject) -> None:
    """Raise InputError if the material of a ring cannot be told in glTF's terms: before the work of baking it."""
    metallic_roughness(ring.bsdf, reflectances(ring, ring.domain.sample(2)[0].numpy()))


def textures(material: Material, texels: Texels) -> dict[str, np.ndarray]:
    """The material's images (H, W, 3 or 4) uint8, by the names that glTF has for them."""
    ones = np.ones_like(material.roughness)
    images = {
        "baseColorTexture": linear_to_srgb(material.base_color),
        "metallicRoughnessTexture": np.stack([ones, material.roughness, material.metallic], 1),
        "specularTexture": np.stack([ones, ones, ones, material.specular], 1),
        "normalTexture": 0.5 * texels.normals + 0.5,
    }
    return {name: to_bytes(image)[texels.index] for name, image in images.items()}


def png(image: np.ndarray) -> bytes:
    """An (H, W, 3 or 4) uint8 image."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def glb(
    ring: FittedObject, subdivisions: int, resolution: int, time: float = 1.0, metres: float | None = None,
    views: Sequence[MaskedCamera] | None = None, up: Sequence[float] | None = None,
) -> bytes:  # fmt: skip
    """The object as a GLB file with textures of `resolution` texels a side.

    Positions are in scene units and in the scene's frame; with `metres`, the length of one, a node scales them to
    glTF's, and with `up` (3,) it turns them so that this is its y. The parameters of the
    BSDF are also there as they are, as vertex attributes (_DIFFUSE, …) and, what they mean, in the material's extras.
    With `views` there is also _SEEN: 1 where one of them shows the object, 0 where none does.
    """
    require_expressible(ring)
    atlas = unwrap(ring, subdivisions, resolution, time)
    texels = rasterise(ring, atlas, resolution, time)
    material = metallic_roughness(ring.bsdf, reflectances(ring, texels.s))
    exact, seen = reflectances(ring, atlas.s), None
    if views is not None:
        s = np.zeros((atlas.whole.max() + 1, 3), np.float32)
        s[atlas.whole] = atlas.s
        seen = visible_points(ring, s, atlas.whole[atlas.faces], views)[0][atlas.whole]
    return assemble_glb(atlas, textures(material, texels), material, exact, ring.bsdf, metres, seen, up)


def assemble_glb(
    atlas: Atlas, images: dict[str, np.ndarray], material: Material, exact: dict[str, np.ndarray], bsdf: str,
    metres: float | None = None, seen: np.ndarray | None = None, up: Sequence[float] | None = None,
) -> bytes:  # fmt: skip
    """The GLB file of a mesh, its `textures` and its exact parameters at the vertices; `seen` (V,) bool."""
    file = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0", generator="mi_ring"))
    blob = bytearray()

    def view(content: bytes, target: int | None = None) -> int:
        blob.extend(b"\0" * (-len(blob) % 4))
        place = pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(content), target=target)
        file.bufferViews.append(place)
        blob.extend(content)
        return len(file.bufferViews) - 1

    def accessor(array: np.ndarray, bounds: bool = False, target: int = pygltflib.ARRAY_BUFFER) -> int:
        kind = pygltflib.UNSIGNED_INT if array.dtype == np.uint32 else pygltflib.FLOAT
        columns = 1 if array.ndim == 1 else array.shape[1]
        entry = pygltflib.Accessor(
            bufferView=view(array.tobytes(), target), componentType=kind, count=len(array),
            type=["", "SCALAR", "VEC2", "VEC3", "VEC4"][columns],
        )  # fmt: skip
        if bounds:
            entry.min, entry.max = array.min(0).tolist(), array.max(0).tolist()
        file.accessors.append(entry)
        return len(file.accessors) - 1

    def texture(name: str, kind: Any = pygltflib.TextureInfo) -> Any:
        file.images.append(pygltflib.Image(name=name, mimeType="image/png", bufferView=view(png(images[name]))))
        file.textures.append(pygltflib.Texture(sampler=0, source=len(file.images) - 1))
        return kind(index=len(file.textures) - 1)

    attributes = pygltflib.Attributes(
        POSITION=accessor(atlas.vertices.astype(np.float32), bounds=True),
        NORMAL=accessor(atlas.normals.astype(np.float32)),
        TANGENT=accessor(atlas.tangents.astype(np.float32)),
        TEXCOORD_0=accessor(atlas.uv.astype(np.float32)),
    )
    for name, values in exact.items():
        setattr(attributes, f"_{name.upper()}", accessor(values.astype(np.float32)))
    if seen is not None:
        attributes._SEEN = accessor(seen.astype(np.float32))
    indices = accessor(atlas.faces.astype(np.uint32).ravel(), target=pygltflib.ELEMENT_ARRAY_BUFFER)
    file.samplers.append(pygltflib.Sampler(
        magFilter=pygltflib.LINEAR, minFilter=pygltflib.LINEAR_MIPMAP_LINEAR,
        wrapS=pygltflib.CLAMP_TO_EDGE, wrapT=pygltflib.CLAMP_TO_EDGE,
    ))  # fmt: skip
    specular = texture("specularTexture")
    file.extensionsUsed.append("KHR_materials_specular")
    file.materials.append(pygltflib.Material(
        name="fitted",
        pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
            baseColorTexture=texture("baseColorTexture"), metallicRoughnessTexture=texture("metallicRoughnessTexture")
        ),
        normalTexture=texture("normalTexture", pygltflib.NormalMaterialTexture),
        extensions={"KHR_materials_specular": {
            "specularTexture": {"index": specular.index}, "specularColorFactor": [material.specular_color] * 3,
        }},
        extras={"mi_ring": {
            "bsdf": bsdf, "attributes": {name: f"_{name.upper()}" for name in exact}, "scale": material.scale,
        }},
    ))  # fmt: skip
    file.meshes.append(pygltflib.Mesh(primitives=[
        pygltflib.Primitive(attributes=attributes, indices=indices, material=0)
    ]))  # fmt: skip
    extras = {"unit": f"{metres:g} m" if metres else "that of the scene; its length is not known"}
    turn = None if up is None else Rotation.align_vectors([[0, 1.0, 0]], [up])[0].as_quat().tolist()
    scale = [metres] * 3 if metres else None
    file.nodes.append(pygltflib.Node(name="object", mesh=0, scale=scale, rotation=turn, extras=extras))
    file.scenes.append(pygltflib.Scene(nodes=[0]))
    file.scene = 0
    file.buffers.append(pygltflib.Buffer(byteLength=len(blob)))
    file.set_binary_blob(bytes(blob))
    return b"".join(file.save_to_bytes())
