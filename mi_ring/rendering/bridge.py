"""The one seam between torch and Dr.Jit: from torch tensors to photographs, and the gradients back."""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from mi_ring.images import blur
from mi_ring.nets.brdf_net import COOK_TORRANCE, Parameter
from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.image_formation import render_maps, render_photographs
from mi_ring.rendering.indirect_light import BOUNCES, render_indirect
from mi_ring.rendering.photographs import Photographs
from mi_ring.scene.assembly import dressed, lamp_lights, lamps_of, parted, with_lamps
from mi_ring.scene.lights import place_lamp, shared_emitters
from mi_ring.scene.plain_mesh import FACES, POSITIONS

WIDTH, SPP = 32, 16  #: of interreflection [px], which varies slowly, and its paths per pixel
USUAL = 1e-3, 1e4  #: radii [scene units] that are drawn as they are
FLAT = 1e-6  #: twice the area of a triangle by the square of its sides, below which float32 knows no normal
PATTERNED = 128, 3  #: the same where a table has a pattern, which glossy surfaces mirror


def to_drjit(tensor: Tensor):
    """A tensor, flattened, as a Dr.Jit Float of the same memory (DLPack). Neither side may write to it."""
    return mi.Float(tensor.detach().contiguous().ravel())


def to_torch(array) -> Tensor:
    """A Dr.Jit Float as a tensor (n,) of the same memory (DLPack). Neither side may write to it."""
    return dr.detach(array).torch()


class Surface:
    """The `shapenet` shape of a loaded scene, as something that torch tensors are written to.

    With a `FittedObject` it is a shape of its own, with the BSDF that the ring's parameters are those of, in a scene of
    its own that shares all other objects with the given one and leaves that as it is. Without, it is the given shape
    itself. Other shapes and top-level emitters of the scene take part in every picture but are not changed; a `table`
    does so only by the light that it reflects onto the others.

    `unit` is how many scene units are one of `scene`'s. Areas and their squares must be numbers in float32: a ring
    alone that is tiny or enormous is drawn in units of about its radius, unless it is to be drawn `as_it_is`.
    """

    def __init__(self, scene: mi.Scene, shape: mi.Mesh, ring=None, as_it_is: bool = False):
        scene, self.table = parted(scene)
        self.unit = 1.0
        if ring is not None:
            alone = self.table is None and len(scene.shapes()) == 1
            if alone and not as_it_is and all(lamp.is_environment() for lamp in shared_emitters(scene)):
                self.unit = unit_for(float(ring.radius))
            scene, shape = dressed(scene, shape, ring, self.unit)
        self.scene, self.shape = scene, shape
        self.params = mi.traverse(scene)
        self.own_lamps = False  #: or the given scene's, which are not to be changed?
        self.prefix = f"{shape.id()}."
        self.faces = np.array(shape.faces_buffer()).reshape(-1, 3)  # as they are, or will be with the next vertices
        self.faces_changed, self.edges = False, None
        self.written = 0

    def set_faces(self, faces: np.ndarray) -> None:
        """Change the triangles (F, 3); vertices and attributes must be written before the next picture."""
        if faces is not self.faces:
            self.faces, self.faces_changed = faces, True

    def write(self, vertices: Tensor, attributes: dict[str, Tensor], gradients: bool = False) -> list:
        """Write (V, 3) vertices [scene units] and (V, 3) or (V,) attributes. Returns the Dr.Jit arrays, in that order.

        The array of the vertices is in units of `unit`.
        Attributes that are not written become 0 when the number of vertices changes: the BSDF must not read them.
        Raises ValueError for another number of vertices than the triangles have, and for attributes of another size.
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
        tensors = {POSITIONS: vertices} | {f"vertex_{name}": value for name, value in attributes.items()}
        attached = [name for name, tensor in tensors.items() if gradients and tensor.requires_grad]
        if self.unit != 1:
            tensors[POSITIONS] = vertices.detach() / self.unit
        arrays = {name: to_drjit(t) for name, t in tensors.items()}
        dr.enable_grad([arrays[name] for name in attached])
        if self.faces_changed:
            self.params[self.prefix + FACES] = mi.UInt32(np.ascontiguousarray(self.faces, np.uint32).ravel())
            self.faces_changed = False
        for name, array in arrays.items():
            self.params[self.prefix + name] = array
        self.params.update()
        self.written += 1
        return list(arrays.values())

    def relight(self, places, strengths) -> None:
        """Change the L `lamps_of` the scene, in this one alone: Dr.Jit Floats, three for each, that may be attached.

        Places are positions [scene units], of distant lamps unit directions toward them.
        """
        if not self.own_lamps:
            self.scene, self.own_lamps = with_lamps(self.scene, lamp_lights(self.scene)), True
            self.params = mi.traverse(self.scene)
        for k, lamp in enumerate(lamps_of(self.scene)):
            place_lamp(lamp, dr.gather(mi.Vector3f, places, k), dr.gather(mi.Color3f, strengths, k))

    def show(self, ring, s: Tensor, faces: np.ndarray, time: float = 1.0) -> None:
        """Write a `FittedObject` at domain points (V, 3) with triangles, at this `time` of the flow, in [0, 1]."""
        with torch.no_grad():
            self.set_faces(faces)
            s = s.to(ring.center.device)
            self.write(*ring(s, time))


def degenerate(vertices: Tensor, faces: np.ndarray) -> Tensor:
    """Which of the vertices (V, 3) belong to triangles (F, 3) without an area, (V,) bool: these have no normal.

    Mitsuba's normals of their vertices have gradients that are not finite.
    """
    corners = torch.from_numpy(np.asarray(faces, np.int64)).to(vertices.device)
    a, b, c = vertices[corners.T]
    areas = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    longest = torch.maximum((b - a).norm(dim=-1), (c - a).norm(dim=-1))
    flat = ~(areas > FLAT * longest**2) | ((b - c).norm(dim=-1) == 0)
    found = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
    found[corners[flat].ravel()] = True
    return found


def unit_for(radius: float) -> float:
    """The unit of length that an object of this radius is drawn in: 1 where that will do, else a power of 2."""
    return 1.0 if USUAL[0] <= radius <= USUAL[1] else 2.0 ** round(math.log2(radius))


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx, surface, photographs, spp, seed, shadows, names, lamps, vertices, *tensors):
        attributes, others = tensors[: len(names)], tensors[len(names) :]
        arrays = surface.write(vertices, dict(zip(names, attributes)), gradients=True)
        buffers = [to_drjit(t) for t in others]
        for buffer, tensor in zip(buffers, others):
            if tensor.requires_grad:
                dr.enable_grad(buffer)
        arrays += buffers
        if lamps:
            surface.relight(*buffers[-lamps:])
        if calibration := buffers[: len(buffers) - lamps]:
            photographs = photographs.moved(*calibration)
        photographs = photographs.in_units(surface.unit)
        moving = any(t.requires_grad for t in (vertices, *others))  # or is it but the material?
        if moving:
            surface.edges = Edges.of(surface.scene, surface.edges)
        edges = surface.edges if moving else None
        channels = render_photographs(surface.scene, photographs, spp, seed, shadows, edges)
        dr.eval(channels)
        ctx.save = (surface, surface.written, arrays, channels, [t.shape for t in (vertices, *tensors)])
        ctx.thread = threading.get_ident()
        return pictures([to_torch(channel) for channel in channels], photographs)

    @staticmethod
    @once_differentiable
    def backward(ctx, rgb_grad, alpha_grad):
        if ctx.save is None:
            raise RuntimeError("the backward pass of a picture was taken a second time; render it again instead")
        surface, written, arrays, channels, shapes = ctx.save
        if surface.written != written:
            raise RuntimeError("the surface was written again since this picture: call backward before the next one")
        ctx.save = None  # Dr.Jit's graph is used up
        if ctx.thread != threading.get_ident():  # torch has one of its own for a GPU
            dr.detail.new_scope(dr.backend_v(mi.Float))
        for channel, grad in zip(channels, (*rgb_grad.unbind(-1), alpha_grad)):
            if dr.grad_enabled(channel):
                dr.set_grad(channel, to_drjit(grad))
                dr.enqueue(dr.ADMode.Backward, channel)
        dr.traverse(dr.ADMode.Backward)
        # Copied: torch may add to a gradient in place.
        grads = [
            to_torch(dr.grad(a)).clone().reshape(shape) if dr.grad_enabled(a) else None
            for a, shape in zip(arrays, shapes)
        ]
        if grads[0] is not None:
            if not grads[0].isfinite().all():
                own = degenerate(to_torch(arrays[0]).reshape(-1, 3), surface.faces)
                grads[0] = torch.where(own[:, None], grads[0].nan_to_num(0, 0, 0), grads[0])
            grads[0] = grads[0] / surface.unit
        return None, None, None, None, None, None, None, *grads


def render(
    surface: Surface, photographs: Photographs, vertices: Tensor, attributes: dict[str, Tensor], spp: int = 4,
    seed: int = 0, shadows: bool = True, calibration: Sequence[Tensor] = (), lamps: Sequence[Tensor] = (),
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Predicted photographs of the surface, each under its own light, differentiable.

    `vertices` (V, 3) [scene units]; `attributes`: by name, (V, 3) or (V,), what the surface's BSDF reads of the mesh.
    `photographs`: which to render and at what size; `spp` stratified samples per pixel; the same `seed` gives the same
    samples. `calibration`: other cameras and lights of all photographs, as `Photographs.moved` takes them: (P, 3, 4),
    (P, 4) [px of these sizes], (P, 3), (P, 3), and (P,) each if flashes have cones and lenses distortion. `lamps`:
    other places and strengths (L, 3) of the scene's L lamps, point lights or distant ones, as `Surface.relight` has
    them.

    Returns ((N, H, W, 3) linear radiance, (N, H, W) coverage in [0, 1]). Gradients with respect to all tensors are
    those of shading, of outlines and of edges of cast shadows, for radiance and for coverage; by one backward pass,
    before the surface is written again, else RuntimeError.
    """
    return _Render.apply(surface, photographs, spp, seed, shadows, list(attributes), len(lamps), vertices,
                         *attributes.values(), *calibration, *lamps)  # fmt: skip


def calibrated(photographs: Photographs, calibration: Sequence[Tensor]) -> Photographs:
    """Photographs with these cameras and lights, without gradients."""
    return photographs.moved(*map(to_drjit, calibration))


def draw(
    surface: Surface, photographs: Photographs, spp: int = 16, seed: int = 0, shadows: bool = True,
    indirect: bool = False, paths: int = 32, in_the_way: bool = True,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Like `render`, of the surface as last written, without gradients, in the processor's memory.

    `indirect`: with interreflection, of so many `paths` for each pixel of a picture 128 pixels wide; the light of the
    photographs' room is always part of them, without `in_the_way` as if nothing were in its way. However many pixels
    and samples, it takes about a gigabyte (`mi_ring.rendering.photographs.LANES` rays at once) and what the pictures
    themselves take; `indirect` or a room add about 100 MB for each photograph.
    """
    parts = []
    for pixels in photographs.chunks(spp):
        own = photographs.in_units(surface.unit)
        channels = render_photographs(surface.scene, own, spp, seed, shadows, pixels=pixels)
        dr.eval(channels)
        parts.append([to_torch(channel) for channel in channels])
    rgb, coverage = pictures([torch.cat(channel) for channel in zip(*parts)], photographs)
    if indirect or (in_the_way and photographs.room is not None):
        which = photographs.harmonics
        around = surroundings(surface, photographs, coverage, seed + 1, 128, paths, indirect, which)
        rgb = rgb + (around.interreflection if indirect else 0)
        if which and in_the_way:
            rgb = (rgb + around.in_the_way(torch.from_numpy(photographs.room).to(rgb))).clamp(min=0)
    return rgb.cpu(), coverage.cpu()


@dataclass(frozen=True)
class Surroundings:
    """What reaches the camera from a surface by other ways than from its photograph's light at once; small pictures."""

    radiance: Tensor  #: (N, h, w, 3) of interreflection
    which: list[int]  #: harmonics of `mi_ring.rendering.spherical_harmonics`
    harmonics: Tensor  #: (n, N, h, w, 3) of a room whose radiance is one of these harmonics
    free: Tensor  #: the same as the large picture has it, as if nothing were in the way of the light
    alpha: Tensor  #: (N, h, w) coverage
    coverage: Tensor  #: (N, H, W) of the large picture
    factor: int  #: by which it is larger

    @property
    def interreflection(self) -> Tensor:
        """What interreflection adds to the large picture: linear radiance (N, H, W, 3)."""
        return self.spread(self.radiance)

    def room(self, harmonics: Tensor) -> Tensor:
        """What a room adds to a picture without one, whose radiance is `harmonics` (BASIS, 3)."""
        return self.spread(torch.einsum("jnhwc,jc->nhwc", self.harmonics, harmonics[self.which]))

    def in_the_way(self, harmonics: Tensor) -> Tensor:
        """What a picture with such a room lacks: shadow, which is less than 0, and light that bounced."""
        return self.spread(torch.einsum("jnhwc,jc->nhwc", self.harmonics - self.free, harmonics[self.which]))

    def spread(self, rgb: Tensor) -> Tensor:
        """Pictures (N, h, w, 3) of light that varies slowly over what the large picture's object covers.

        Its edges are then those of the large picture, through whose coverage alone gradients flow: the outline feels
        this light too, shape and material do not (they are corrected for it, as in "Shape from Interreflections",
        Nayar, Ikeuchi and Kanade, IJCV 1991).
        """
        images = torch.cat([rgb, self.alpha[..., None]], -1).movedim(-1, 1)
        images = blur(images.flatten(0, 1), 1.0).reshape(images.shape)
        images = F.interpolate(images, scale_factor=self.factor, mode="bilinear", align_corners=False)
        below, right = self.coverage.shape[1] - images.shape[2], self.coverage.shape[2] - images.shape[3]
        images = F.pad(images, (0, right, 0, below), mode="replicate")
        return (images[:, :3] / images[:, 3:].clamp(min=1e-2)).movedim(1, -1) * self.coverage[..., None]


def surroundings(
    surface: Surface, photographs: Photographs, coverage: Tensor, seed: int, width: int | None = None,
    spp: int | None = None, indirect: bool = True, room: Sequence[int] = (),
) -> Surroundings:  # fmt: skip
    """Interreflection in pictures of the surface as last written, and what a `room` of these harmonics adds to them.

    Not `indirect`: of the room's light what the surface reflects but once; `interreflection` is then not to be used.

    `photographs`: as they were rendered; `coverage` (N, H, W): of that picture. This light varies slowly: it is
    rendered at most `width` pixels wide, with `spp` paths per pixel (a few good pixels did better than many noisy
    ones), and smoothed. Where there is a table both are by default others, `PATTERNED`.
    """
    bounces = BOUNCES if indirect else 1
    table = surface.table if indirect else None  # it would only keep the room's light from the object
    usual = (WIDTH, SPP) if table is None else PATTERNED
    width, spp = width or usual[0], spp or usual[1]
    factor = -(-max(photographs.size) // width)
    small = photographs.select(np.array(photographs.index), photographs.size, factor).in_units(surface.unit)
    channels = [to_torch(c) for c in render_indirect(surface.scene, small, spp, seed, bounces, room, table)]
    rgb, alpha = pictures(channels[:4], small)
    empty = rgb.new_zeros(0)
    basis = torch.stack(channels[4:]).reshape(2, -1, 3, *alpha.shape).movedim(2, -1) if room else (empty, empty)
    return Surroundings(rgb, list(room), *basis, alpha, coverage, factor)


def pictures(channels: list[Tensor], photographs: Photographs) -> tuple[Tensor, Tensor]:
    """The renderer's four channels (N·H·W,) as pictures ((N, H, W, 3), (N, H, W))."""
    width, height = photographs.size
    shape = (len(photographs), height, width)
    picture = [channel.reshape(shape) for channel in channels]
    return torch.stack(picture[:3], dim=-1), picture[3].clone()


def maps(
    surface: Surface, photographs: Photographs, parameters: Sequence[Parameter] = COOK_TORRANCE
) -> dict[str, np.ndarray]:
    """What the pixels of `photographs` see of the surface as last written, zero where they see none.

    `normal` (N, H, W, 3) in world space, and these BSDF parameters by name, (N, H, W, 3) or (N, H, W).
    """
    width, height = photographs.size
    attributes, parts = {f"vertex_{p.name}": p.channels for p in parameters}, []
    for pixels in photographs.chunks(1):
        channels = render_maps(surface.scene, photographs.in_units(surface.unit), attributes, pixels)
        dr.eval(channels)  # together: each would otherwise trace the rays again
        parts.append(np.stack([np.array(c) for c in channels], -1))
    channels = np.concatenate(parts).reshape(len(photographs), height, width, -1)
    result, first = {"normal": channels[..., :3]}, 3
    for p in parameters:
        result[p.name] = channels[..., first : first + 3] if p.channels == 3 else channels[..., first]
        first += p.channels
    return result
