"""Image formation: photographs of a scene, each lit by its own light, and maps of its surface."""

import drjit as dr
import mitsuba as mi

from mi_ring.rendering.direct_light import next_2d, trace
from mi_ring.rendering.edge_gradients import boundary_terms
from mi_ring.rendering.photographs import center_rays, pixel_rays


def render_photographs(scene, photographs, spp, seed, shadows=True, edges=None, pixels=None):
    """Render the selected photographs in one launch. Returns [R, G, B, coverage]: Floats of N·H·W pixels, attached.

    They are box-filtered linear radiance. `spp`: samples per pixel. `shadows`: do the photographs' own lights cast
    shadows? With `edges`, gradients contain the boundary terms of moving edges; otherwise only those of shading.
    `pixels`: render only pixels from first to last, (first, last + 1), numbered through all photographs; not together
    with `edges`.
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
    """Render normals and mesh attributes at pixel centres; 0 where there is no surface or no such attribute.

    `attributes`: number of channels by name. `pixels`: as in `render_photographs`. Returns [nx, ny, nz, first
    attribute, …]: Floats of N·H·W pixels; normals are in world space.
    """
    si = scene.ray_intersect(center_rays(photographs, pixels)[0])
    maps = [dr.select(si.is_valid(), n, 0) for n in si.sh_frame.n]
    for name, channels in attributes.items():
        values = [mi.Float(0)] * channels
        for shape in scene.shapes():
            if shape.is_mesh() and shape.has_attribute(name):
                here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
                one = channels == 1
                found = [shape.eval_attribute_1(name, si, here)] if one else shape.eval_attribute_3(name, si, here)
                values = [dr.select(here, new, old) for new, old in zip(found, values)]
        maps += values
    return maps
