"""The stage: a known object in its place, what it stands on, and pictures of both under a light."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from mi_ring.capture.scenefile import Element, emitter_element, table_element
from mi_ring.errors import InputError
from mi_ring.geometry.meshes import read_mesh
from mi_ring.images import linear_to_srgb, srgb_to_linear, to_bytes, write_image
from mi_ring.photogrammetry.marker_sheet import DOTS, page
from mi_ring.scene.lights import Light
from mi_ring.scene.plain_mesh import mesh_of
from mi_ring.scene.xml_elements import load_element
from mi_ring.synthesis.materials import COLOURS, Pattern
from mi_ring.synthesis.tracing import LensCamera, Window, averaged, covered, flashed_along, radiance_along, rays_of

SMOOTH = 10_000  #: vertices that a surface is subdivided to
WIDTH, BELOW = 8.0, 2e-3  #: of a table, and how far it is below a sheet on it, in radii of the object
WOOD = 0.42, 0.3, 0.2  #: sRGB of a table
BRIGHTEST = 4.0  #: of what one path brings by way of other surfaces, by a white surface in the light
PAPER, INK = 0.8, 0.05  #: albedos
COARSER = 3  #: dots of the printed page that are one of its picture


class Stage:
    """An object with its BSDF, and tables below it."""

    def __init__(self, mesh: mi.Mesh, corners: np.ndarray, tables: Iterable[mi.Object] = ()) -> None:
        """`corners` (V, 3): of the object, which is all that there is to be seen if there is no table."""
        self.object, self.corners, self.tables = mesh, corners, list(tables)

    def under(self, lamp: mi.Object) -> mi.Scene:
        """The scene with this light alone."""
        shapes = {f"shape{k}": shape for k, shape in enumerate([self.object, *self.tables])}
        return mi.load_dict({"type": "scene", **shapes, "lamp": lamp}, optimize=False)

    def radiance(
        self, lens_camera: LensCamera, light: Light | mi.Object, spp: int, seed: int, depth: int, hidden: bool = True
    ) -> np.ndarray:
        """Linear radiance (H, W, 3) under one light. `hidden`: an environment is not seen itself."""
        scene = self.under(load_element(emitter_element(light)) if isinstance(light, Light) else light)
        white = 0.0  # what a white surface in the middle sends back
        if isinstance(light, Light):
            middle = (self.corners.min(0) + self.corners.max(0)) / 2
            falloff = np.square(light.vector - middle).sum() if light.kind == "point" else 1.0
            white = light.rgb.max() / (np.pi * falloff)
        window = lens_camera.around(self.corners) if hidden and not self.tables else lens_camera.whole

        def traced(window: Window, spp: int, seed: int) -> list:
            rays = rays_of(lens_camera, window, spp, seed)
            if isinstance(light, Light):
                return flashed_along(rays, scene, seed, depth, BRIGHTEST * white)
            return radiance_along(rays, scene, seed, depth, hidden)

        return averaged(traced, lens_camera, window, spp, seed)

    def coverage(self, lens_camera: LensCamera, spp: int = 64) -> np.ndarray:
        """How much of each pixel shows the object (H, W)."""
        scene = self.under(mi.load_dict({"type": "constant"}))

        def traced(window: Window, spp: int, seed: int) -> list:
            return [covered(rays_of(lens_camera, window, spp, seed), scene, self.object)]

        return averaged(traced, lens_camera, lens_camera.around(self.corners), spp, 0)[..., 0]


def load_object(path: Path, radius: float, smooth: bool) -> tuple[trimesh.Trimesh, np.ndarray | None, np.ndarray]:
    """A mesh from a file, placed: the middle of its bounding box at the origin, its farthest vertex at `radius`.

    And its linear colours (V, 3) if it has any, and the matrix (4, 4) that has moved it. `smooth`: subdivided, by
    Loop's rule, to `SMOOTH` vertices. Raises InputError for what has no surface.
    """
    mesh = read_mesh(path, "MESH")
    mesh.remove_unreferenced_vertices()
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all() or not np.ptp(mesh.vertices, axis=0).any():
        raise InputError(f"{path}: MESH: has {len(mesh.faces)} triangles, and must have some, of finite size")
    colours = None
    visual: Any = mesh.visual
    if visual.kind == "texture" and visual.uv is not None and has_picture(visual.material):
        visual = visual.to_color()
    if visual.kind in ("vertex", "face"):
        colours = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    while smooth and len(mesh.vertices) < SMOOTH:
        if colours is not None:  # in the middle of an edge, the mean of its ends'
            colours = np.concatenate([colours, colours[mesh.edges_unique].mean(1)])
        try:
            mesh = mesh.subdivide_loop(1)
        except ValueError as error:
            raise InputError(f"{path}: MESH: has edges of more than two triangles, which --smooth cannot subdivide; "
                             "leave that out") from error  # fmt: skip
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume < 0:
        mesh.invert()
    middle = mesh.bounds.mean(0)
    scale = radius / np.linalg.norm(mesh.vertices - middle, axis=1).max()
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = -scale * middle
    mesh.apply_transform(matrix)
    mesh.vertices = mesh.vertices.astype(np.float32)
    return mesh, colours, matrix


def has_picture(material: Any) -> bool:
    """Has a texture's material, as trimesh reads it, a picture of its colours?"""
    return any(getattr(material, name, None) is not None for name in ("image", "baseColorTexture"))


def shape_of(mesh: trimesh.Trimesh, colours: np.ndarray | None, bsdf: mi.BSDF, pattern: Pattern | None) -> mi.Mesh:
    """The object as Mitsuba sees it, with smooth normals."""
    shape = mesh_of(mesh.vertices, mesh.faces, uv=None if pattern is None else pattern.uv)
    if colours is not None:
        shape.add_attribute(COLOURS, 3, colours.ravel().tolist())
    shape.set_bsdf(bsdf)
    return shape


def table_elements(folder: Path, ground: np.ndarray, up: np.ndarray, radius: float, sheet: bool) -> list[Element]:
    """A table, and perhaps the printed sheet on it (its unit is a millimetre), as elements of a scene in the `folder`.

    Their pictures are written there.
    """
    right = np.roll(up, 1)
    pictures = {"table": (np.broadcast_to(WOOD, (2, 2, 3)), np.full(2, WIDTH * radius / 2), BELOW * radius)}
    if sheet:
        printed = page("a4").convert("L").reduce(COARSER)
        albedo = INK + (PAPER - INK) * np.asarray(printed, float)[::-1, :, None] / 255
        side = np.array(printed.size) * COARSER / DOTS
        pictures["sheet"] = (np.repeat(linear_to_srgb(albedo), 3, 2), side / 2, 0.0)
    result = []
    for name, (picture, half, below) in pictures.items():
        square = np.eye(4)
        square[:3] = np.stack([half[0] * right, half[1] * np.cross(up, right), up, ground - below * up], 1)
        write_image(to_bytes(picture), folder / f"{name}.png")
        result.append(table_element(f"{name}.png", square))
    return result
