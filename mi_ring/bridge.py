"""The one seam between torch and Dr.Jit: from torch tensors to photographs, and the gradients back."""

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.edges import Edges
from mi_ring.integrator import render_maps, render_photographs
from mi_ring.mesh import FACES, POSITIONS

DIFFUSE, SPECULAR, ROUGHNESS = "vertex_diffuse", "vertex_specular", "vertex_roughness"


class Surface:
    """The `shapenet` shape of a loaded scene, as something that torch tensors are written to.

    Other shapes and top-level emitters of the scene take part in every picture but are not changed.
    """

    def __init__(self, scene, shape):
        self.scene = scene
        self.params = mi.traverse(scene)
        self.prefix = next(
            name.removesuffix(POSITIONS) for name, _ in self.params if name == f"{shape.id()}.{POSITIONS}"
        )
        self.faces, self.edges = None, None
        self.written = 0

    def set_faces(self, faces: np.ndarray) -> None:
        """Change the triangles (F, 3); vertices and attributes must be written before the next picture."""
        self.faces = np.ascontiguousarray(faces, np.uint32)

    def write(self, vertices: Tensor, diffuse: Tensor, specular: Tensor, roughness: Tensor, gradients: bool = False):
        """Write (V, 3) vertices [scene units], (V, 3), (V,), (V,) attributes. Returns the Dr.Jit arrays."""
        arrays = [mi.Float(t.detach().contiguous().numpy().ravel()) for t in (vertices, diffuse, specular, roughness)]
        if gradients:
            dr.enable_grad(arrays)
        if self.faces is not None:
            self.params[self.prefix + FACES] = mi.UInt32(self.faces.ravel())
            self.faces = None
        for name, array in zip((POSITIONS, DIFFUSE, SPECULAR, ROUGHNESS), arrays):
            self.params[self.prefix + name] = array
        self.params.update()
        self.written += 1
        return arrays

    def show(self, ring, s: Tensor, faces: np.ndarray) -> None:
        """Write a `Ring` at domain points (V, 3) with these triangles."""
        with torch.no_grad():
            self.set_faces(faces)
            self.write(ring.surface(s), *ring.brdf_net(s))


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, vertices, diffuse, specular, roughness, surface, photographs, spp, seed, shadows):
        gradients = any(t.requires_grad for t in (vertices, diffuse, specular, roughness))
        arrays = surface.write(vertices, diffuse, specular, roughness, gradients)
        surface.edges = Edges.of(surface.scene, surface.edges)
        channels = render_photographs(surface.scene, photographs, spp, seed, shadows, surface.edges)
        dr.eval(channels)
        ctx.save = (surface, surface.written, arrays, channels)
        return pictures(channels, photographs)

    @staticmethod
    def backward(ctx, rgb_grad, alpha_grad):
        surface, written, arrays, channels = ctx.save
        if surface.written != written:
            raise RuntimeError("the surface was written again since this picture: call backward before the next one")
        for channel, grad in zip(channels, (*rgb_grad.unbind(-1), alpha_grad)):
            if dr.grad_enabled(channel):
                dr.set_grad(channel, mi.Float(grad.contiguous().numpy().ravel()))
                dr.enqueue(dr.ADMode.Backward, channel)
        dr.traverse(dr.ADMode.Backward)
        out = [torch.from_numpy(np.array(dr.grad(a))) for a in arrays]
        return out[0].reshape(-1, 3), out[1].reshape(-1, 3), out[2], out[3], None, None, None, None, None


def render(surface, photographs, vertices, diffuse, specular, roughness, spp=4, seed=0, shadows=True):
    """Predicted photographs of the surface, each under its own light, differentiable.

    `vertices` (V, 3) [scene units], `diffuse` (V, 3), `specular` (V,), `roughness` (V,): attributes as `cooktorrance`
    defines them. `photographs`: `integrator.Photographs`, which to render and at what size; `spp` stratified samples
    per pixel; the same `seed` gives the same samples.

    Returns ((N, H, W, 3) linear radiance, (N, H, W) coverage in [0, 1]). Gradients with respect to all four tensors are
    those of shading, of outlines and of edges of cast shadows, for radiance and for coverage.
    """
    return _Render.apply(vertices, diffuse, specular, roughness, surface, photographs, spp, seed, shadows)


def draw(surface, photographs, spp=16, seed=0, shadows=True):
    """Like `render`, of the surface as last written and without gradients."""
    channels = render_photographs(surface.scene, photographs, spp, seed, shadows)
    dr.eval(channels)
    return pictures(channels, photographs)


def pictures(channels, photographs):
    """The renderer's four Floats as tensors ((N, H, W, 3), (N, H, W))."""
    width, height = photographs.size
    shape = (len(photographs), height, width)
    picture = [torch.from_numpy(np.array(dr.detach(c)).reshape(shape)) for c in channels]
    return torch.stack(picture[:3], dim=-1), picture[3]


def maps(surface, photographs) -> dict[str, np.ndarray]:
    """What the pixels of `photographs` see of the surface as last written, zero where they see none.

    `normal` (N, H, W, 3) in world space, `diffuse` (N, H, W, 3), `specular` and `roughness` (N, H, W).
    """
    width, height = photographs.size
    channels = [np.array(c).reshape(len(photographs), height, width) for c in render_maps(surface.scene, photographs)]
    return {
        "normal": np.stack(channels[:3], -1),
        "diffuse": np.stack(channels[3:6], -1),
        "specular": channels[6],
        "roughness": channels[7],
    }
