"""Importer of cameras in glTF files, as Blender exports them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pygltflib

from mi_ring.errors import InputError
from mi_ring.fields import Fields
from mi_ring.importers.camera_models import Lens, pose_of, rotation_of
from mi_ring.importers.frames import OPENGL, Frame
from mi_ring.importers.photogrammetry import Photogrammetry
from mi_ring.importers.reading import image_size, matrix, read_as

SUFFIXES = (".gltf", ".glb")
#: Older versions of Blender give each camera a child node, which turns it.
CHILD = "_Orientation"


@dataclass(frozen=True)
class GltfCameras(Photogrammetry):
    """Blender's cameras: File > Export > glTF 2.0 with cameras. The light is fixed to the camera.

    SRC is the .gltf or .glb file. A photograph must have the name of its camera object in Blender, or of its camera.
    glTF stores neither lens distortion nor lens shift. The principal point is therefore in the middle.
    """

    fields = Fields(
        used={
            "nodes/name nodes/camera nodes/children cameras/name": "photographs",
            "nodes/matrix nodes/translation nodes/rotation nodes/scale": "poses",
            "perspective/yfov perspective/aspectRatio": "lenses",
        },
        refused={"cameras/type=orthographic": "lenses without perspective"},
        told={
            "KHR_lights_*": "the light is where the options say",
            "animations": "cameras are taken from where they are without it",
            "EXT_mesh_gpu_instancing": "copies",
        },
        harmless={
            "perspective/znear perspective/zfar": "the range of depth",
            "meshes/* materials/* textures/* skins/* buffers/*": "the scene",
            "KHR_draco_* KHR_mat* KHR_mesh_* KHR_texture_* EXT_mesh* EXT_texture_* KHR_xmp*": "extensions of the scene",
        },
    )

    def posed(self) -> Iterator[Frame]:
        gltf = read_gltf(self.src)
        placed = dict(placed_nodes(gltf, self.src))
        found = [k for k in sorted(placed) if gltf.nodes[k].camera is not None]
        if not found:
            raise InputError(f"{self.src}: SRC: has no node with a camera; export with Include > Cameras")
        for k in found:
            node = gltf.nodes[k]
            camera = entry(gltf.cameras, node.camera, f"{self.src}: nodes[{k}].camera")
            names = [str(own) for own in (node.name, str(node.name).removesuffix(CHILD), camera.name) if own]
            if not node.name and not camera.name:
                raise InputError(f"{self.src}: nodes[{k}].name: is missing; must be the name of a photograph")
            what = f"{self.src}: camera {names[0]!r}"
            name = next((own for own in names if self.photograph_files.find(own)[0]), names[0])
            if (image := self.photograph(name, what)) is None:
                continue
            if camera.perspective is None:
                raise InputError(f"{what}: type: is {str(camera.type)!r}; must be perspective")
            yield Frame(image, lens_of(camera.perspective, image, what), rigid(placed[k], what) @ OPENGL, said=name)
        self.tell_unused(self.src, [*map(str, gltf.extensionsUsed or ()), *["animations"] * bool(gltf.animations)])


def read_gltf(path: Path) -> pygltflib.GLTF2:
    """Read a glTF file, without the buffer files that it names. Raises InputError if the file is damaged."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: SRC: must end in {' or '.join(SUFFIXES)}")
    return read_as(path, "glTF", lambda file: pygltflib.GLTF2().load(str(file)))


def has_cameras(path: Path) -> bool:
    """Return True if a glTF file has at least two cameras. A single camera may be that of a viewer."""
    return sum(node.camera is not None for node in read_gltf(path).nodes) > 1


def entry(things: list, index: object, what: str) -> pygltflib.Property:
    """Return `things[index]`, where `index` was read from a file and may be anything.

    Raises InputError if it is no valid index. The message begins with `what`.
    """
    if not isinstance(index, int) or not 0 <= index < len(things):
        raise InputError(f"{what}: is {str(index)[:40]}; there is none of this number")
    return things[index]


def placed_nodes(gltf: pygltflib.GLTF2, path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (node number, node-to-world transform (4, 4)) for each node of a glTF file.

    Raises InputError if a node has several parents, or is inside itself. The message begins with `path`.
    """
    inner = {child for node in gltf.nodes for child in node.children or ()}
    waiting = [(k, np.eye(4)) for k in range(len(gltf.nodes)) if k not in inner]
    for _ in gltf.nodes:
        if not waiting:
            return
        k, above = waiting.pop()
        what = f"{path}: nodes[{k}]"
        place = above @ transform_of(entry(gltf.nodes, k, what), what)
        yield k, place
        waiting += [(child, place) for child in gltf.nodes[k].children or ()]
    if waiting:
        raise InputError(f"{path}: nodes: some are children of several nodes, or of themselves")


def transform_of(node: pygltflib.Node, what: str) -> np.ndarray:
    """Return the node-to-parent transform (4, 4) of a node: its matrix, or its translation, rotation and scale.

    Raises InputError if these are invalid. The message begins with `what`.
    """
    if node.matrix is not None:
        return matrix(node.matrix, (16,), f"{what}.matrix").reshape(4, 4).T
    R = rotation_of(node.rotation or [0, 0, 0, 1], f"{what}.rotation")
    scale = matrix(node.scale or [1, 1, 1], (3,), f"{what}.scale")
    return pose_of(R * scale, matrix(node.translation or [0, 0, 0], (3,), f"{what}.translation"))


def rigid(place: np.ndarray, what: str) -> np.ndarray:
    """Return a node-to-world transform (4, 4) without its scale, as the pose of a camera.

    `place` (4, 4): the transform. Raises InputError if it shears or mirrors, or scales axes differently. The message
    begins with `what`.
    """
    scale = np.cbrt(np.linalg.det(place[:3, :3]))
    if not scale > 0 or not np.allclose(place[:3, :3].T @ place[:3, :3], scale**2 * np.eye(3), atol=1e-4 * scale**2):
        raise InputError(f"{what}: scale: it and its parents scale axes differently, or mirror; apply the scales in "
                         "Blender")  # fmt: skip
    return pose_of(place[:3, :3] / scale, place[:3, 3])


def lens_of(perspective: pygltflib.Perspective, image: Path, what: str) -> Lens:
    """Make the lens of a glTF camera for the photograph `image`, whose size is read from its file.

    `perspective`: vertical field of view [rad] and aspect ratio of the camera. Raises InputError if these are invalid
    or do not fit the photograph. The message begins with `what`.
    """
    yfov = float(matrix(perspective.yfov, (), f"{what}: yfov"))
    if not 0 < yfov < math.pi:
        raise InputError(f"{what}: yfov: is {yfov:g}; must be between 0 and pi")
    width, height = size = image_size(image)
    ratio = perspective.aspectRatio
    ratio = width / height if ratio is None else float(matrix(ratio, (), f"{what}: aspectRatio"))
    if abs(ratio * height - width) > 1:
        raise InputError(f"{what}: aspectRatio: is {ratio:.5g}, but {image.name} has {width} x {height} pixels; set "
                         "the resolution of the photographs in Blender, and export again")  # fmt: skip
    fy = height / 2 / math.tan(yfov / 2)
    return Lens("PINHOLE", size, (fy * width / (ratio * height), fy, width / 2, height / 2))
