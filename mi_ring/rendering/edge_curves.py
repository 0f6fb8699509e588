"""Edges as curves in space: samples of them, and the outlines and borders of shapes that are not meshes.

`CURVES` has the functions of these curves for each kind of shape, in the shape's coordinates. Their arguments: `e`, the
position of a camera or light (`w` = 1) or the direction toward it (`w` = 0), and the curve parameter `t` in [0, 1).
They return (point of the curve, its derivative with respect to `t`, a point of the shape beside the curve).
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

CURVE_SAMPLES = 256  #: samples per curve of such a shape
RELATIVE_OFFSET = 2.0**-19  #: see `ray_offset`
#: Distance from an edge to the rays on both of its sides [px]. It is small for outlines, from which radiance grows like
#: the square root of this distance. The place of a shadow's edge is less precise.
OUTLINE_OFFSET, SHADOW_OFFSET = 1e-4, 1e-2


def ray_offset(point, distance):
    """Compute at which distance from `point` a ray must start so that it does not hit the surface on which it starts.

    `distance`: length of the ray that found the point. The result [scene units] is proportional to the rounding error
    of the point.
    """
    return RELATIVE_OFFSET * (dr.max(dr.abs(point)) + distance)


@dataclass
class EdgeSamples:
    """Samples of curves in space, one per lane. The curves are outlines, creases, borders and edges of shadows."""

    view: mi.UInt32  #: the photograph
    lane: mi.UInt32  #: the number of the sample, the same whichever photographs are rendered together
    point: mi.Point3f  #: attached
    tangent: mi.Vector3f  #: detached: the piece of the curve that the sample represents [scene units]
    inside: mi.Point3f  #: detached: a point of the shape that the curve bounds
    active: mi.Bool
    offset: float  #: distance to the rays on both sides [px]
    shadow: bool = False  #: is it the edge of a shadow?


# Curves of such shapes in local coordinates: (p, dp/dt, a point of the shape beside p) as functions of t in [0, 1) and
# of the eye e, which is a point for w = 1 and a direction for w = 0.
def circle(u, v, t):
    """Evaluate a unit circle at parameter `t` in [0, 1). Returns (point, derivative with respect to `t`).

    `u`, `v`: orthogonal unit vectors in the plane of the circle, whose centre is the origin.
    """
    s, c = dr.sincos(2 * dr.pi * t)
    return u * c + v * s, 2 * dr.pi * (v * c - u * s)


def square_border(e, w, t):
    """Evaluate the border of the square [-1, 1]² at parameter `t` in [0, 1).

    Returns (point, derivative with respect to `t`, a point inside). The viewpoint `e`, `w` does not matter.
    """
    side, along = dr.floor(4 * t), 8 * (t - 0.25 * dr.floor(4 * t)) - 1
    x = dr.select(side == 0, along, dr.select(side == 1, 1, dr.select(side == 2, -along, -1)))
    y = dr.select(side == 0, -1, dr.select(side == 1, along, dr.select(side == 2, 1, -along)))
    dx = dr.select(side == 0, 8, dr.select(side == 2, -8, 0))
    dy = dr.select(side == 1, 8, dr.select(side == 3, -8, 0))
    return mi.Point3f(x, y, 0), mi.Vector3f(dx, dy, 0), mi.Point3f(0)


def disk_border(e, w, t):
    """Evaluate the border of the unit disk at parameter `t` in [0, 1).

    Returns (point, derivative with respect to `t`, a point inside). The viewpoint `e`, `w` does not matter.
    """
    p, dp = circle(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), t)
    return mi.Point3f(p), dp, mi.Point3f(0)


def cylinder_border(e, w, t, z):
    """Evaluate the circle at the end `z` (0 or 1) of the unit cylinder at parameter `t` in [0, 1).

    Returns (point, derivative with respect to `t`, a point of the cylinder). The viewpoint `e`, `w` does not matter.
    """
    p, dp = circle(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), t)
    return mi.Point3f(p.x, p.y, z), dp, mi.Point3f(p.x, p.y, 0.5)


def sphere_outline(e, w, t):
    """Evaluate the outline of the unit sphere at parameter `t` in [0, 1), for a viewpoint outside of it.

    `e`: position of the viewpoint (`w` = 1), or direction toward it (`w` = 0). The outline has the points p with p · e
    = w: their normals are perpendicular to the line of sight. Returns (point, derivative with respect to `t`, a point
    inside).
    """
    e2 = dr.squared_norm(e)
    frame = mi.Frame3f(e * dr.rsqrt(e2))
    p, dp = circle(frame.s, frame.t, t)
    r = dr.sqrt(dr.maximum(1 - w * w / e2, 0))
    return mi.Point3f(e * (w / e2) + r * p), r * dp, mi.Point3f(0)


def cylinder_outline(e, w, t, side=1.0):
    """Evaluate one of the two straight outlines of the cylinder x² + y² = 1, 0 < z < 1, at parameter `t` in [0, 1).

    `e`: position of the viewpoint (`w` = 1), or direction toward it (`w` = 0). `side`: 1 or -1, for the one or the
    other line. Returns (point, derivative with respect to `t`, a point inside).
    """
    e2 = e.x * e.x + e.y * e.y
    r = side * dr.sqrt(dr.maximum(1 - w * w / e2, 0)) * dr.rsqrt(e2)
    p = mi.Point3f(e.x * w / e2 - e.y * r, e.y * w / e2 + e.x * r, t)
    return p, mi.Vector3f(0, 0, dr.full(mi.Float, 1, dr.width(t))), mi.Point3f(0, 0, t)


CURVES = {
    "Rectangle": [square_border],
    "Disk": [disk_border],
    "Sphere": [sphere_outline],
    "Cylinder": [
        lambda e, w, t: cylinder_border(e, w, t, z=0.0),
        lambda e, w, t: cylinder_border(e, w, t, z=1.0),
        cylinder_outline,
        lambda e, w, t: cylinder_outline(e, w, t, side=-1.0),
    ],
}


def outline_of(shape, eye, views, seed, before=0) -> list[EdgeSamples]:
    """Sample the outline and border curves of a shape that is not a mesh. Returns samples for each curve of the shape.

    `eye`: viewpoint, a function from photograph indices (UInt32) to (position, True) or (direction toward it, False).
    `views`: number of photographs. `before`: number of photographs before these that are rendered elsewhere; random
    numbers depend on it.
    """
    to_world = mi.traverse(shape)["to_world"]
    curves = []
    for k, curve in enumerate(CURVES[shape.class_name()]):
        lane = dr.arange(mi.UInt32, views * CURVE_SAMPLES)
        view = lane // CURVE_SAMPLES
        t = mi.Float(lane % CURVE_SAMPLES)
        lane += dr.opaque(mi.UInt32, before * CURVE_SAMPLES)
        t = (t + mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed) + k)) / CURVE_SAMPLES
        with dr.suspend_grad():
            where, finite = eye(view)
            inverse = dr.detach(to_world).inverse()
            e = dr.select(finite, mi.Vector3f(inverse @ mi.Point3f(where)), inverse @ where)
            p, tangent, inside = curve(e, dr.select(finite, mi.Float(1), 0), t)
            tangent = dr.detach(to_world) @ mi.Vector3f(tangent) / CURVE_SAMPLES
            inside = dr.detach(to_world) @ inside
            dr.eval(p, tangent, inside)
        curves.append(EdgeSamples(view, lane, to_world @ p, tangent, inside, dr.isfinite(p.x), OUTLINE_OFFSET))
    return curves
