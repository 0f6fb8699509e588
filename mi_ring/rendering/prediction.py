"""Renders photographs of a surface as tensors: with gradients for a fit, without gradients for pictures and maps."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

import mitsuba as mi
import numpy as np
import torch
from torch import Tensor

from mi_ring.geometry.meshes import area_vectors
from mi_ring.nets.brdf_net import COOK_TORRANCE, SPECULAR, Parameter
from mi_ring.rendering.bridge import differentiable, evaluated, to_drjit
from mi_ring.rendering.edge_selection import Edges
from mi_ring.rendering.global_illumination import GlobalIllumination
from mi_ring.rendering.image_formation import render_maps, render_photographs
from mi_ring.rendering.photographs import Photographs
from mi_ring.rendering.surface import Surface
from mi_ring.rendering.views import Views
from mi_ring.scene.plain_mesh import POSITIONS

NO_AREA = 1e-6  #: twice a triangle's area / (longest side)² below which float32 gives no normal


def render(
    surface: Surface, photographs: Photographs, vertices: Tensor, attributes: dict[str, Tensor], spp: int = 4,
    seed: int = 0, shadows: bool = True, views: Views | None = None, lamps: Sequence[Tensor] = (),
    lobes: Sequence[Tensor] = (),
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Render N photographs of the surface, each under its own light. Returns differentiable tensors.

    `vertices` (V, 3) [scene units]. `attributes`: the mesh attributes that the BSDF reads, (V, 3) or (V,), by name.
    `photographs`: which photographs to render, and at what size. `spp`: stratified samples per pixel. `seed`: the same
    seed gives the same samples. `shadows`: the photographs' own lights cast shadows. `views`: other cameras and lights
    of all photographs, as tensors; None: those in `photographs`. `lamps`: empty, or (places, strengths) of the scene's
    L lamps, both (L, 3): positions or unit directions toward distant lamps; intensities, or irradiances of distant
    lamps. `lobes`: empty, or (unit directions (n, 3), sharpness (n,)) of the lobes in `photographs`.

    Returns (linear radiance (N, H, W, 3), coverage (N, H, W) in [0, 1]). Gradients with respect to all tensors contain
    shading, outlines and edges of cast shadows. Writes the mesh of `surface`, whose texture stays. Call backward at
    most once, before the surface is written again; otherwise it raises RuntimeError. Raises ValueError if a tensor does
    not fit the mesh.
    """
    parameters = surface.parameters(vertices, attributes)
    others = [*(views or ()), *lamps]
    count = len(parameters) + len(others)
    moving = any(tensor.requires_grad for tensor in (vertices, *others))

    def program(arrays: list[mi.Float]) -> list[mi.Float]:
        surface.write_arrays(dict(zip(parameters, arrays)))
        if lamps:
            surface.relight(*arrays[count - len(lamps) : count])
        moved = photographs.with_views(Views(*arrays[len(parameters) :][: len(views)])) if views else photographs
        if lobes and moved.lobes is not None:
            toward, sharpness = arrays[count:]
            moved = replace(moved, lobes=replace(moved.lobes, toward=toward, sharpness=sharpness))
        if moving:  # gradients with respect to the material alone need no edges
            surface.edges = Edges.of(surface.scene, surface.edges)
        edges = surface.edges if moving else None
        return render_photographs(surface.scene, moved.in_units(surface.unit), spp, seed, shadows, edges)

    if parameters[POSITIONS].requires_grad:
        points, faces = parameters[POSITIONS].detach(), surface.faces
        parameters[POSITIONS].register_hook(lambda gradient: finite_gradient(gradient, points, faces))
    channels = differentiable(program, [*parameters.values(), *others, *lobes], surface)
    *rgb, coverage = (channel.reshape(photographs.shape) for channel in channels)
    return torch.stack(rgb, dim=-1), coverage.clone()


def finite_gradient(gradient: Tensor, vertices: Tensor, faces: np.ndarray) -> Tensor:
    """Replace infinite and NaN entries of a gradient (V, 3) by 0 at vertices of triangles without area.

    Mitsuba's vertex normals cause such entries. Infinite and NaN entries at other vertices stay. `vertices` (V, 3),
    `faces` (F, 3): the mesh. Returns the corrected gradient.
    """
    if gradient.isfinite().all():
        return gradient
    corners = torch.from_numpy(np.asarray(faces, np.int64)).to(vertices.device)
    a, b, c = vertices[corners.T]
    areas = area_vectors(vertices, corners).norm(dim=-1)
    longest = torch.maximum((b - a).norm(dim=-1), (c - a).norm(dim=-1))
    flat = ~(areas > NO_AREA * longest**2) | ((b - c).norm(dim=-1) == 0)
    degenerate = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
    degenerate[corners[flat].ravel()] = True
    return torch.where(degenerate[:, None], gradient.nan_to_num(0, 0, 0), gradient)


def with_views(photographs: Photographs, views: Views) -> Photographs:
    """Return a copy of the photographs with other cameras and lights. `views`: tensors for all photographs.

    The copy carries no gradients.
    """
    return photographs.with_views(Views(*map(to_drjit, views)))


def draw(
    surface: Surface, photographs: Photographs, spp: int = 16, seed: int = 0, shadows: bool = True,
    indirect: bool = False, paths: int = 32, occlusion: bool = True,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Render N photographs of the surface as it was last written, without gradients.

    Returns CPU tensors: (linear radiance (N, H, W, 3), coverage (N, H, W) in [0, 1]). `photographs`: which photographs
    to render, and at what size. `spp`: samples per pixel. `shadows`: the photographs' own lights cast shadows.
    `indirect`: add interreflection, rendered with `paths` paths per pixel in a picture that is at most 128 pixels wide.
    The light of the room in `photographs` is always added. A texture that `show` has written is in the picture.
    `occlusion`: True: the surface blocks a part of the room light; False: only of its lobes, which is faster.

    However many pixels and samples there are, this needs about a gigabyte of memory besides the pictures. `indirect` or
    room light need about 100 MB more for each photograph.
    """
    own, parts = photographs.in_units(surface.unit), []
    for pixels in photographs.chunks(spp):
        parts.append(evaluated(render_photographs(surface.scene, own, spp, seed, shadows, pixels=pixels)))
    *colours, coverage = (torch.cat(channel).reshape(photographs.shape) for channel in zip(*parts))
    rgb = torch.stack(colours, dim=-1)
    if indirect or (occlusion and photographs.room_rows):
        rows = photographs.room_rows
        added = GlobalIllumination.of(surface, photographs, coverage, seed + 1, 128, paths, indirect, rows)
        if indirect:
            rgb = rgb + added.interreflection
        if rows and occlusion:
            rgb = (rgb + added.occlusion(torch.from_numpy(photographs.room_strengths).to(rgb))).clamp(min=0)
    return rgb.cpu(), coverage.cpu()


@contextmanager
def with_material(surface: Surface, values: Mapping[str, float]) -> Iterator[None]:
    """Show the surface with these parameters of its BSDF, the same everywhere; those that it does not have are ignored.

    `values`: numbers by name, such as "roughness".
    """
    wanted = {f"vertex_{name}": value for name, value in values.items()}
    own = {name: mi.Float(surface.params[surface.prefix + name])  # not references
           for name in wanted if surface.prefix + name in surface.params}  # fmt: skip
    surface.write_arrays({name: 0 * value + wanted[name] for name, value in own.items()})
    try:
        yield
    finally:
        surface.write_arrays(own)


def without_gloss(surface: Surface) -> AbstractContextManager[None]:
    """Show the surface without highlights."""
    return with_material(surface, dict.fromkeys(SPECULAR, 0.0))


def maps(
    surface: Surface, photographs: Photographs, parameters: Sequence[Parameter] = COOK_TORRANCE
) -> dict[str, np.ndarray]:
    """Render normals and BSDF parameters at pixel centres of N photographs, for the surface as it was last written.

    A texture that `show` has written is in the colours, at the centres of pixels like all else.

    Returns NumPy arrays by name: `normal` (N, H, W, 3) in world space, and each of `parameters`, (N, H, W, 3) or (N, H,
    W). Pixels without a surface are 0.
    """
    own, parts = photographs.in_units(surface.unit), []
    attributes = {p.attribute: p.channels for p in parameters}
    for pixels in photographs.chunks(1):
        parts.append(torch.stack(evaluated(render_maps(surface.scene, own, attributes, pixels)), -1))
    channels = torch.cat(parts).reshape(*photographs.shape, -1).cpu().numpy()
    result, first = {"normal": channels[..., :3]}, 3
    for p in parameters:
        result[p.name] = channels[..., first : first + 3] if p.channels == 3 else channels[..., first]
        first += p.channels
    return result
