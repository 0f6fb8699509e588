"""Renders the object of a synthetic capture on its table, under one light."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from mi_ring.capture.emitter_elements import Element, emitter_element
from mi_ring.capture.scenefile import table_element
from mi_ring.colour_profiles import srgb_to_linear
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import read_mesh
from mi_ring.images import linear_to_srgb, to_bytes, write_image
from mi_ring.photogrammetry.marker_sheet import DOTS, page
from mi_ring.scene.lights import Light
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.xml_elements import load_element
from mi_ring.synthesis.materials import COLOURS, Pattern
from mi_ring.synthesis.tracing import LensCamera, clamped_radiance_along, hits_along, pixel_means, radiance_along

SMOOTH = 10_000  #: least number of vertices after subdivision
TABLE, BELOW = 8.0, 2e-3  #: side of the table, and its distance below the sheet [radius of the object]
WOOD = 0.42, 0.3, 0.2  #: sRGB colour of the table
BRIGHTEST = 4.0  #: largest indirect radiance of a path [radiance of a white surface in the light]
PAPER, INK = 0.8, 0.05  #: albedos
DOTS_PER_PIXEL = 3  #: dots of the printed page per pixel of the sheet's texture


class ObjectOnTable:
    """An object with its BSDF, and the table on which it stands.

    `mesh`: the object. `vertices` (V, 3): its vertices. `tables`: shapes of the table and of a printed sheet on it;
    empty: no table.
    """

    def __init__(self, mesh: mi.Mesh, vertices: np.ndarray, tables: Iterable[mi.Object] = ()) -> None:
        """Join the object `mesh` and the shapes of the table. `vertices` (V, 3): the vertices of the object."""
        self.object, self.vertices, self.tables = mesh, vertices, list(tables)
        self.scenes: dict[str, mi.Scene] = {}  #: by kind of light

    def under(self, emitter: mi.Object) -> mi.Scene:
        """Make a scene of object and table, with this emitter as its only light."""
        shapes = {f"shape{k}": shape for k, shape in enumerate([self.object, *self.tables])}
        return mi.load_dict({"type": "scene", **shapes, "lamp": emitter}, optimize=False)

    def lit_by(self, light: Light) -> mi.Scene:
        """Return the scene of object and table under this light only. The next call may change this scene.

        Lights of a kind share a scene, because it takes Mitsuba seconds to prepare a fine mesh for rays.
        """
        emitter = load_element(emitter_element(light))
        if light.kind not in self.scenes:
            self.scenes[light.kind] = self.under(emitter)
        params = mi.traverse(self.scenes[light.kind])
        params.update({f"lamp.{name}": value for name, value in mi.traverse(emitter)})
        return self.scenes[light.kind]

    def radiance(
        self, view: LensCamera, light: Light | mi.Object, spp: int, seed: int, depth: int, hidden: bool = True
    ) -> np.ndarray:
        """Render object and table under one light. Returns linear radiance (H, W, 3).

        `light`: a point or directional light, for which rare very bright paths are clipped, or a Mitsuba emitter.
        `spp`: paths per pixel, a square number. `depth`: largest length of paths; 2: direct light only. `hidden`: True:
        the emitter is invisible to the camera, and without a table only the part of the picture around the object is
        rendered; the rest is 0.
        """
        if isinstance(light, Light):
            middle = (self.vertices.min(0) + self.vertices.max(0)) / 2
            falloff = np.square(light.vector - middle).sum() if light.kind == "point" else 1.0
            white = light.rgb.max() / (np.pi * falloff)  # radiance of a white surface in the middle of the object
            limit = BRIGHTEST * white
            trace: Any = partial(clamped_radiance_along, scene=self.lit_by(light), depth=depth, limit=limit)
        else:
            trace = partial(radiance_along, scene=self.under(light), depth=depth, hidden=hidden)
        window = view.around(self.vertices) if hidden and not self.tables else (0, 0, *view.camera.size)
        return pixel_means(trace, view, window, spp, seed)

    def coverage(self, view: LensCamera, spp: int = 64) -> np.ndarray:
        """Render which share of each pixel shows the object. Returns (H, W) in [0, 1].

        `spp`: rays per pixel, a square number.
        """
        if "none" not in self.scenes:
            self.scenes["none"] = self.under(mi.load_dict({"type": "constant"}))
        trace = partial(hits_along, scene=self.scenes["none"], shape=self.object)
        return pixel_means(trace, view, view.around(self.vertices), spp, 0)[..., 0]


def load_object(path: Path, radius: float, smooth: bool) -> tuple[trimesh.Trimesh, np.ndarray | None, np.ndarray]:
    """Read a mesh file, move it to the origin and scale it. Returns (mesh, colours (V, 3) or None, transform (4, 4)).

    The middle of the bounding box is moved to the origin, and the farthest vertex gets the distance `radius`. The
    returned transform from the file's coordinates has been applied. Colours are linear, at the vertices; None if the
    file has none. `smooth`: subdivide the mesh by Loop's rule to at least 10,000 vertices. Raises InputError if the
    file has no surface or cannot be subdivided.
    """
    mesh = read_mesh(path, "MESH")
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all() or not np.ptp(mesh.vertices, axis=0).any():
        raise InputError(f"{path}: MESH: has {len(mesh.faces)} triangles; must have some, of finite size")
    colours = None
    visual: Any = mesh.visual
    names = "image", "baseColorTexture"  # attributes of trimesh's materials
    if visual.kind == "texture" and visual.uv is not None:
        has_picture = any(getattr(visual.material, name, None) is not None for name in names)
        visual = visual.to_color() if has_picture else visual
    if visual.kind in ("vertex", "face"):
        colours = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    while smooth and len(mesh.vertices) < SMOOTH:
        if colours is not None:  # a new vertex in the middle of an edge has the mean colour of the edge's ends
            colours = np.concatenate([colours, colours[mesh.edges_unique].mean(1)])
        try:
            mesh = mesh.subdivide_loop(1)
        except ValueError as error:
            raise InputError(f"{path}: MESH: has edges of more than two triangles, which --smooth cannot subdivide; "
                             "leave it out") from error  # fmt: skip
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0:
        mesh.invert()
    middle = mesh.bounds.mean(0)
    scale = radius / np.linalg.norm(mesh.vertices - middle, axis=1).max()
    matrix = trimesh.transformations.scale_and_translate(scale, -scale * middle)
    mesh.apply_transform(matrix)
    mesh.vertices = mesh.vertices.astype(np.float32)
    return mesh, colours, matrix


def shape_of(mesh: trimesh.Trimesh, colours: np.ndarray | None, bsdf: mi.BSDF, pattern: Pattern | None) -> mi.Mesh:
    """Make a Mitsuba mesh with smooth normals and the material `bsdf`.

    `colours` (V, 3): linear colours of the vertices, for the mesh attribute vertex_color; None: no such attribute.
    `pattern`: has the texture coordinates; None: no texture coordinates.
    """
    shape = mesh_of(mesh.vertices, mesh.faces, uv=None if pattern is None else pattern.uv)
    if colours is not None:
        shape.add_attribute(COLOURS, 3, colours.ravel().tolist())
    shape.set_bsdf(bsdf)
    return shape


def table_elements(folder: Path, ground: np.ndarray, up: np.ndarray, radius: float, sheet: bool) -> list[Element]:
    """Make the XML elements of a table, and write their textures as PNG files into `folder`.

    `ground` (3,): centre of the table. `up` (3,): unit normal of the table, one of the axes. `radius`: radius of the
    object, which sets the table's size. `sheet`: True: a second element is the printed sheet of mi-ring board on the
    table.
    """
    right = np.roll(up, 1)
    pictures = {"table": (np.broadcast_to(WOOD, (2, 2, 3)), np.full(2, TABLE * radius / 2), BELOW * radius)}
    if sheet:
        printed = page("a4").convert("L").reduce(DOTS_PER_PIXEL)
        albedo = INK + (PAPER - INK) * np.asarray(printed, float)[::-1, :, None] / 255
        side = np.array(printed.size) * DOTS_PER_PIXEL / DOTS
        pictures["sheet"] = (np.repeat(linear_to_srgb(albedo), 3, 2), side / 2, 0.0)
    result = []
    for name, (picture, half, below) in pictures.items():
        square = np.eye(4)
        square[:3] = np.stack([half[0] * right, half[1] * np.cross(up, right), up, ground - below * up], 1)
        write_image(to_bytes(picture), folder / f"{name}.png")
        result.append(table_element(f"{name}.png", square))
    return result
