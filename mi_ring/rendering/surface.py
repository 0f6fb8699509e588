"""The surface that is rendered: the `shapenet` shape of a scene, to whose mesh torch tensors are written."""

import math

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.rendering.bridge import to_drjit
from mi_ring.rendering.edge_selection import Edges
from mi_ring.scene.alignment import to_flat
from mi_ring.scene.assembly import RenderedObject, lamp_lights, move_lamps, split_tables, with_fitted_shape, with_lamps
from mi_ring.scene.lights import shared_emitters
from mi_ring.scene.mesh_texture import remove_texture, write_texture
from mi_ring.scene.plain_mesh import FACES, POSITIONS

RADII_IN_SCENE_UNITS = 1e-3, 1e4  #: the least and the largest radius that float32 renders well in scene units


class Surface:
    """The surface that is rendered: a mesh in a scene, to which vertices and attributes are written.

    `scene`, `shape`: a scene and its `shapenet` shape. `ring`: a fitted object. If it is given, the surface is a new
    shape with the BSDF of this object, in a new scene. The new scene shares all other objects with `scene`, which does
    not change. If `ring` is None, the surface is `shape` itself. Other shapes and emitters of the scene are part of
    every picture. A `table` is invisible: it only reflects light onto the other shapes.

    `unit` is the length unit of the new scene [scene units]. It is 1, except for a tiny or enormous object that is
    alone in its scene, because float32 could not represent its areas. `in_scene_units`: True: `unit` is always 1.
    """

    def __init__(
        self, scene: mi.Scene, shape: mi.Mesh, ring: RenderedObject | None = None, in_scene_units: bool = False
    ) -> None:
        self.given = scene, shape  #: kept alive: Dr.Jit fails if objects go between a picture and its backward pass
        scene, self.table = split_tables(scene)
        self.unit = 1.0
        if ring is not None:
            alone = self.table is None and len(scene.shapes()) == 1
            if alone and not in_scene_units and all(lamp.is_environment() for lamp in shared_emitters(scene)):
                self.unit = unit_for(float(ring.radius))
            scene, shape = with_fitted_shape(scene, shape, ring, self.unit)
        self.scene, self.shape = scene, shape
        self.params = mi.traverse(scene)
        self.owns_lamps = False  #: False while the lamps are those of the given scene, which must not be changed
        self.prefix = f"{shape.id()}."
        self.faces = np.array(shape.faces_buffer()).reshape(-1, 3)  #: (F, 3) triangles, from the next `write` on
        self.faces_changed = False
        self.edges: Edges | None = None  #: those of the last picture with gradients of moving edges
        self.written = 0  #: number of times that vertices were written

    def set_faces(self, faces: np.ndarray) -> None:
        """Set other triangles (F, 3). Vertices and attributes must be written again before the next rendering.

        If they are others, the texture is removed.
        """
        if faces is not self.faces:
            self.faces, self.faces_changed = faces, True
            remove_texture(self.shape)  # it is for other triangles

    def parameters(self, vertices: Tensor, attributes: dict[str, Tensor]) -> dict[str, Tensor]:
        """Convert tensors to the parameters of the mesh. Writes nothing.

        `vertices` (V, 3) [scene units]. `attributes`: (V, 3) or (V,) by name. Returns tensors with Mitsuba's names as
        keys: first the vertices, in units of `unit`, then the attributes. Raises ValueError if V is not the number of
        vertices that the triangles need, or if an attribute has another size.
        """
        needed = int(self.faces.max()) + 1
        if vertices.shape != (needed, 3):
            raise ValueError(f"vertices: of shape {tuple(vertices.shape)}, but the triangles need ({needed}, 3)")
        for name, value in attributes.items():
            channels = 1 if value.ndim == 1 else value.shape[-1]
            if value.numel() != needed * channels or channels not in (1, 3):
                raise ValueError(
                    f"attribute {name}: of shape {tuple(value.shape)}, must be ({needed},) or ({needed}, 3)"
                )
        return {POSITIONS: vertices / self.unit} | {f"vertex_{name}": value for name, value in attributes.items()}

    def write(self, vertices: Tensor, attributes: dict[str, Tensor]) -> None:
        """Write vertices and attributes to the mesh, without gradients. A texture that it had is removed.

        `vertices` (V, 3) [scene units]. `attributes`: (V, 3) or (V,) by name. Raises ValueError if V is not the number
        of vertices that the triangles need, or if an attribute has another size.
        """
        remove_texture(self.shape)  # it is of another object
        self.write_arrays({name: to_drjit(t) for name, t in self.parameters(vertices, attributes).items()})

    def write_arrays(self, arrays: dict[str, mi.Float]) -> None:
        """Write parameters of the mesh. `arrays`: flat Dr.Jit Floats by Mitsuba's names; they may carry gradients.

        If the number of vertices changes, an attribute that is not in `arrays` becomes 0. The BSDF must not read it.
        """
        if self.faces_changed:
            self.params[self.prefix + FACES] = to_flat(mi.UInt32, self.faces)
            self.faces_changed = False
        for name, array in arrays.items():
            self.params[self.prefix + name] = array
        self.params.update()
        self.written += 1

    def relight(self, places: mi.Float, strengths: mi.Float) -> None:
        """Change the L lamps in the scene of this surface. The scene that was given to the constructor does not change.

        Lamps are point and directional emitters that do not belong to a shape. `places` (3 L numbers): positions [scene
        units], or unit directions toward directional lights. `strengths` (3 L numbers): intensities [W/sr], or
        irradiances [W/m²] of directional lights. Both may carry gradients.
        """
        if not self.owns_lamps:
            self.scene, self.owns_lamps = with_lamps(self.scene, lamp_lights(self.scene)), True
            self.params = mi.traverse(self.scene)
        move_lamps(self.scene, places, strengths)

    def show(self, ring: RenderedObject, s: Tensor, faces: np.ndarray, time: float = 1.0) -> None:
        """Evaluate a fitted object at points `s` (V, 3) of its domain. Write surface, material and texture to the mesh.

        `faces` (F, 3): triangles of the points. `time`: state of the deformation, from 0 (start surface) to 1 (fitted
        object).
        """
        with torch.no_grad():
            self.set_faces(faces)
            self.write(*ring(s.to(ring.center.device), time))
            write_texture(self.shape, ring.brdf_net, s, faces)


def unit_for(radius: float) -> float:
    """Choose the length unit [scene units] in which an object of this `radius` is rendered.

    It is 1 for usual radii. For tiny and enormous objects, it is the power of 2 next to the radius.
    """
    least, largest = RADII_IN_SCENE_UNITS
    return 1.0 if least <= radius <= largest else 2.0 ** round(math.log2(radius))
