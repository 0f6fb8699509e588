"""Renders photographs of a scene, each under its own light, and maps of normals and materials."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, trace
from mi_ring.rendering.edge_gradients import boundary_terms
from mi_ring.rendering.photographs import center_rays, pixel_rays
from mi_ring.scene.mesh_attributes import fine_textures


def render_photographs(scene, photographs, spp, seed, shadows=True, edges=None, pixels=None):
    """Render the N selected photographs together. Returns [R, G, B, coverage], Floats of N·H·W pixels.

    R, G, B are linear radiance, the mean over each pixel. The result is attached (it carries gradients). `spp`: samples
    per pixel. `shadows`: the photographs' own lights cast shadows. `edges`: the edges of the scene; gradients then
    include moving outlines and shadows; None: gradients of shading only. `pixels`: render only this range of pixels
    (first, last + 1), numbered through all photographs; None: all. Do not give it together with `edges`.
    """
    ray, view = pixel_rays(photographs, spp, seed, pixels)
    lane = dr.arange(mi.UInt32, dr.width(ray)) + photographs.first_lane(spp, pixels[0] if pixels else 0)
    channels = trace(scene, ray, view, photographs, shadows, next_2d(seed, dr.width(ray), lane))
    dr.schedule(channels)  # together: else block_sum renders once for each channel
    channels = [dr.block_sum(c, spp) / spp for c in channels]
    if edges is None:
        return channels
    width, height = photographs.size
    for where, view, step, active in boundary_terms(scene, photographs, edges, seed, shadows):
        pixel = view * (width * height) + mi.UInt32(where.y) * width + mi.UInt32(where.x)
        for k, value in enumerate(step):
            motion = dr.zeros(mi.Float, dr.width(channels[k]))
            dr.scatter_add(motion, value, pixel, active)
            channels[k] += motion
    return channels


def render_maps(scene, photographs, attributes, pixels=None):
    """Render normals and mesh attributes at pixel centres. Returns [nx, ny, nz, first attribute, …].

    These are Floats of N·H·W pixels for the N selected photographs. Normals are in world space. Values are 0 where a
    pixel shows no surface, or a surface without the attribute. Those of a `fine_attribute` are as fine as it is.
    `attributes`: number of channels (1 or 3) by name of the attribute. `pixels`: range of pixels (first, last + 1),
    numbered through all photographs; None: all.
    """
    si = scene.ray_intersect(center_rays(photographs, pixels)[0])
    maps = [dr.select(si.is_valid(), n, 0) for n in si.sh_frame.n]
    for name, channels in attributes.items():
        values = [mi.Float(0)] * channels
        for shape in scene.shapes():
            if shape.is_mesh() and shape.has_attribute(name):
                here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
                fine = {texture.attribute: texture for texture in fine_textures(shape.bsdf())}
                if channels == 1:
                    found = [shape.eval_attribute_1(name, si, here)]
                elif name in fine:
                    found = fine[name].eval_3(si, here)
                else:
                    found = shape.eval_attribute_3(name, si, here)
                values = [dr.select(here, new, old) for new, old in zip(found, values)]
        maps += values
    return maps


def find_triangles(scene, shape, photographs, spp, seed, pixels):
    """Trace the rays of `render_photographs` to the mesh `shape`. Returns arrays with an entry for each ray.

    These are: whether the ray meets the mesh first, the index of its triangle, and two barycentric coordinates. `spp`:
    rays per pixel. `pixels`: range of pixels (first, last + 1), numbered through all photographs.
    """
    hit = scene.ray_intersect_preliminary(pixel_rays(photographs, spp, seed, pixels)[0])
    found = hit.is_valid() & (hit.shape == mi.ShapePtr(shape)), hit.prim_index, *hit.prim_uv
    dr.eval(found)  # together: else each array traces the rays anew
    return found
