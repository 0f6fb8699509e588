"""Edges: curves along which a photograph jumps and whose motion shading does not see: outlines, creases, shadows."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

SMOOTH, CREASE, BORDER = 0, 1, 2  # edges of a mesh where the normals of both sides agree or differ, or where it ends
SAMPLES, SAMPLES_IN_ALL = 4, 1024  #: per edge of a mesh, and at least in all
CURVE_SAMPLES = 256  #: samples per curve of any other shape
LEAVE = 2.0**-19  #: see `leave`

#: How far to both sides of an edge one has to look for the jump [px]. Radiance grows like the square root of the
#: distance to an outline, so that there it must be little; the edge of a shadow is known with less precision.
ROOT, JUMP = 1e-4, 1e-2


def leave(point, distance):
    """How far from `point` a ray must start so as not to meet the surface that it leaves [scene units].

    In proportion to the rounding error of a point that was found `distance` away from where one looked.
    """
    return LEAVE * (dr.max(dr.abs(point)) + distance)


@dataclass
class Curve:
    """Samples of curves in space, any number per photograph."""

    view: mi.UInt32  #: the photograph
    point: mi.Point3f  #: attached to what moves the curve
    tangent: mi.Vector3f  #: detached: the piece of the curve that the sample stands for [scene units]
    inside: mi.Point3f  #: detached: what the curve bounds lies on this side of it
    active: mi.Bool
    offset: float  #: how far to both sides of it one has to look [px]
    shadow: bool = False  #: is it an edge of light and not of a shape?


class Edges:
    """The edges of all shapes of a scene, and which of them an eye sees as outlines.

    An eye is a function of the photograph (UInt32) that returns (Vector3f, Bool): a point and True, or the direction
    toward an eye that is infinitely far away and False. It may be attached.

    Raises ValueError for a kind of shape whose outline is not known.
    """

    def __init__(self, scene):
        self.shapes = list(scene.shapes())
        # Mitsuba's rectangle is a mesh as well, whose vertices are not attached to its `to_world`.
        self.others = [shape for shape in self.shapes if shape.class_name() in CURVES]
        self.meshes = [shape for shape in self.shapes if shape not in self.others]
        for shape in self.meshes:
            if not shape.is_mesh():
                raise ValueError(
                    f'photometric: no gradients with shape "{shape.id()}", a {shape.class_name()}: '
                    f"use meshes or {', '.join(CURVES)}"
                )
        # While they are held, no other array can have their indices.
        self.buffers = [mesh.faces_buffer() for mesh in self.meshes]
        meshes_faces = [np.array(buffer).reshape(-1, 3) for buffer in self.buffers]
        vertices, triangles = 0, 0  # of the meshes before
        corners, tables = [np.zeros((0, 3))], [np.zeros((5, 0))]
        for mesh, faces in zip(self.meshes, meshes_faces):
            corners.append(faces + vertices)
            tables.append(edge_table(mesh, faces) + np.array([[vertices, vertices, triangles, triangles, 0]]).T)
            vertices += mesh.vertex_count()
            triangles += len(faces)
        self.corners = mi.UInt32(np.concatenate(corners).astype(np.uint32).ravel())
        table = np.concatenate(tables, 1).astype(np.uint32)
        self.v0, self.v1, self.f0, self.f1, self.kind = (mi.UInt32(row) for row in table)

    @classmethod
    def of(cls, scene, known: "Edges | None" = None) -> "Edges":
        """The edges of a scene: `known`, if they are still those."""
        if known is not None and list(scene.shapes()) == known.shapes:
            now = (mesh.faces_buffer() for mesh in known.meshes)
            if all(a.index == b.index for a, b in zip(now, known.buffers)):
                return known
        return cls(scene)

    def positions(self):
        """Vertices of all meshes, one after another (Float), attached."""
        buffers = [mesh.vertex_positions_buffer() for mesh in self.meshes]
        return buffers[0] if len(buffers) == 1 else dr.concat(buffers)

    def fronts(self, eye, views):
        """Which triangles show their front to the eye: Bool, all triangles of photograph 0, those of 1, …"""
        count = dr.width(self.corners) // 3
        lane = dr.arange(mi.UInt32, count * views)
        where, finite = eye(lane // count)
        corner = dr.gather(mi.Point3u, self.corners, lane % count)
        positions = dr.detach(self.positions())
        a, b, c = (dr.gather(mi.Point3f, positions, index) for index in corner)
        front = dr.dot(dr.cross(b - a, c - a), where - dr.select(finite, a, 0)) > 0
        dr.eval(front)
        return front

    def sides(self, fronts, lanes=None, views=1):
        """(edge, do its first and its second triangle show their fronts?) of these lanes, or of all `views`."""
        count, triangles = dr.width(self.kind), dr.width(self.corners) // 3
        lane = dr.arange(mi.UInt32, count * views) if lanes is None else lanes
        view, edge = lane // count, lane % count
        first, second = (
            dr.gather(mi.Bool, fronts, view * triangles + dr.gather(mi.UInt32, f, edge)) for f in (self.f0, self.f1)
        )
        return edge, first, second

    def sample(self, lanes, seed, shadow=False) -> Curve:
        """Stratified points on each of these edges (UInt32: photograph · number of edges + edge)."""
        count, n = dr.width(self.kind), dr.width(lanes)
        each = max(SAMPLES, SAMPLES_IN_ALL // n)
        lane = dr.arange(mi.UInt32, n * each)
        each = dr.opaque(mi.UInt32, each)  # it changes: no part of the kernel
        chosen = dr.gather(mi.UInt32, lanes, lane // each)
        t = (mi.Float(lane % each) + mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))) / mi.Float(each)
        positions, edge = self.positions(), chosen % count
        a, b = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, v, edge)) for v in (self.v0, self.v1))
        piece = dr.detach(b - a) / mi.Float(each)
        p = a * (1 - t) + b * t  # dr.lerp would add its two gradients of `a` in an order that is not always the same
        return Curve(chosen // count, p, piece, self.middle(edge), mi.Bool(True), ROOT, shadow)

    def middle(self, edge):
        """The centre of the two triangles at an edge, detached."""
        positions, corners = dr.detach(self.positions()), mi.Point3f(0)
        for face in (self.f0, self.f1):
            for vertex in dr.gather(mi.Point3u, self.corners, dr.gather(mi.UInt32, face, edge)):
                corners += dr.gather(mi.Point3f, positions, vertex) / 6
        return corners

    def outlines(self, eye, views, seed):
        """(curves, fronts): what may be an outline or a crease to the eye of each of so many photographs."""
        curves = [curve for shape in self.others for curve in outline_of(shape, eye, views, seed)]
        fronts = None
        if self.meshes:
            fronts = self.fronts(eye, views)
            edge, first, second = self.sides(fronts, views=views)
            kind = dr.gather(mi.UInt32, self.kind, edge)
            lanes = dr.compress((first != second) | (kind != SMOOTH))
            if dr.width(lanes):
                curves.append(self.sample(lanes, seed))
        return curves, fronts

    def shadow_casters(self, light, views, seed, seen):
        """(casters, terminators): what may cast the edge of a shadow, and where one may begin on a shape itself.

        `light` is an eye; `seen` are the `fronts` of the cameras. Casters are the outlines that the light sees.
        Terminators are those edges of meshes among them that a camera sees from the front on both sides: the triangle
        that turns away from the light is black even where interpolated normals still face it.
        """
        casters = [curve for shape in self.others for curve in outline_of(shape, light, views, seed)]
        terminators = []
        if self.meshes:
            edge, first, second = self.sides(self.fronts(light, views), views=views)
            kind = dr.gather(mi.UInt32, self.kind, edge)
            lanes = dr.compress((first != second) | (kind == BORDER))
            if dr.width(lanes):
                casters.append(self.sample(lanes, seed))
                edge, first, second = self.sides(seen, lanes)
                both = dr.compress(first & second & (dr.gather(mi.UInt32, self.kind, edge) == SMOOTH))
                if dr.width(both):
                    terminators.append(self.sample(dr.gather(mi.UInt32, lanes, both), seed + 1, shadow=True))
        return casters, terminators


def cast(scene, curve: Curve, light, camera) -> Curve:
    """The shadow of a curve: where the rays that leave the light and graze the curve arrive.

    Attached to the light, to the curve and to what the shadow falls on. `light` and `camera` are eyes.
    """
    where, finite = light(curve.view)
    d = dr.normalize(dr.select(finite, curve.point - where, -where))
    away = dr.detach(dr.select(finite, dr.norm(curve.point - where), 0))
    start = leave(dr.detach(curve.point), away)
    ray = mi.Ray3f(curve.point, d)
    with dr.suspend_grad():
        # A ray that grazes the shape may not meet it again: it passes a little outside. Where the shape is hollow that
        # is inside it, and such an edge casts no shadow.
        aside = dr.normalize(dr.cross(curve.tangent, ray.d))
        aside *= dr.mulsign(start, dr.dot(aside, ray.o - curve.inside))
        origin = dr.detach(curve.point) + dr.select(dr.isfinite(aside.x), aside, 0)
        reach = dr.select(finite, (1 - 2.0**-10) * away, dr.largest(mi.Float))
        active = curve.active & ~scene.ray_test(mi.Ray3f(origin, -d, reach, 0, []), curve.active)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(origin, d), active=active)
    si = hit.compute_surface_interaction(ray, active=active)
    d, n, t = dr.detach(d), dr.detach(si.n), dr.detach(si.t)
    slope = dr.dot(n, d)
    # The shadow of a step along the curve: stretched by the distance from the light, and sheared into the plane that
    # it falls on.
    tangent = curve.tangent - d * (dr.dot(n, curve.tangent) / slope)
    tangent *= dr.select(finite, 1 + t / away, 1)
    with dr.suspend_grad():
        to_camera = dr.detach(camera(curve.view)[0] - si.p)
        above = leave(dr.detach(si.p), dr.norm(to_camera))
        # What hides the shadow from the camera would not jump, but its shading differs between the two sides as well.
        start = dr.detach(si.p) + n * dr.mulsign(above, dr.dot(n, to_camera))
        active &= si.is_valid() & (dr.abs(slope) > 1e-4)
        active &= ~scene.ray_test(mi.Ray3f(start, to_camera, 1 - 2.0**-10, 0, []), active)
        # Whether a point is in shadow is asked a little above the surface.
        above = dr.mulsign(above, -slope)
        shift = d * (above / slope) - n * above
    return Curve(curve.view, si.p + shift, tangent, curve.inside, active, JUMP, shadow=True)


def edge_table(mesh, faces: np.ndarray) -> np.ndarray:
    """Edges of a mesh: (5, E), the vertices v0 and v1, the triangles that hold (v0, v1) and (v1, v0), and the kind."""
    weld = np.arange(mesh.vertex_count())
    table = paired(faces, weld)
    if (table[4] == BORDER).any():  # perhaps only a seam, where vertices are there twice
        positions = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
        weld = np.unique(positions, axis=0, return_inverse=True)[1].ravel()
        table = paired(faces, weld)
    if not mesh.has_vertex_normals():
        table[4] = np.maximum(table[4], CREASE)
    return table


def paired(faces: np.ndarray, weld: np.ndarray) -> np.ndarray:
    """`edge_table` with smooth normals; vertices of equal `weld` (V,) are the same point."""
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, 1).ravel().astype(np.int64)
    triangle = np.repeat(np.arange(len(faces)), 3)
    a, b = weld[start], weld[end]
    key = np.minimum(a, b) * len(weld) + np.maximum(a, b)
    order = np.lexsort((a > b, key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))  # of each group of half-edges at the same place
    size = np.diff(first, append=len(order))
    h0 = order[first]
    h1 = order[np.minimum(first + 1, len(order) - 1)]
    pair = (size == 2) & (a[h0] == b[h1]) & (a[h1] == b[h0])
    seam = (start[h0] != end[h1]) | (end[h0] != start[h1])
    kind = np.where(pair, np.where(seam, CREASE, SMOOTH), BORDER)
    return np.stack([start[h0], end[h0], triangle[h0], np.where(pair, triangle[h1], triangle[h0]), kind])


# Curves of the other shapes in local coordinates: (p, dp/dt, a point of the shape beside p) as functions of t in
# [0, 1), and of the eye: a point for w = 1, a direction for w = 0.


def circle(u, v, t):
    """A unit circle in the plane of `u` and `v`."""
    s, c = dr.sincos(2 * dr.pi * t)
    return u * c + v * s, 2 * dr.pi * (v * c - u * s)


def square_border(e, w, t):
    """Border of [-1, 1]²."""
    side, along = dr.floor(4 * t), 8 * (t - 0.25 * dr.floor(4 * t)) - 1
    x = dr.select(side == 0, along, dr.select(side == 1, 1, dr.select(side == 2, -along, -1)))
    y = dr.select(side == 0, -1, dr.select(side == 1, along, dr.select(side == 2, 1, -along)))
    dx = dr.select(side == 0, 8, dr.select(side == 2, -8, 0))
    dy = dr.select(side == 1, 8, dr.select(side == 3, -8, 0))
    return mi.Point3f(x, y, 0), mi.Vector3f(dx, dy, 0), mi.Point3f(0)


def disk_border(e, w, t):
    """Border of the unit disk."""
    p, dp = circle(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), t)
    return mi.Point3f(p), dp, mi.Point3f(0)


def cylinder_border(e, w, t, z):
    """Border of the cylinder at its end `z`."""
    p, dp = circle(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), t)
    return mi.Point3f(p.x, p.y, z), dp, mi.Point3f(p.x, p.y, 0.5)


def sphere_outline(e, w, t):
    """Points of the unit sphere with p · e = w, where its normal is at right angles to the view."""
    e2 = dr.squared_norm(e)
    frame = mi.Frame3f(e * dr.rsqrt(e2))
    p, dp = circle(frame.s, frame.t, t)
    r = dr.sqrt(dr.maximum(1 - w * w / e2, 0))
    return mi.Point3f(e * (w / e2) + r * p), r * dp, mi.Point3f(0)


def cylinder_outline(e, w, t, side=1.0):
    """A line along the cylinder x² + y² = 1, 0 < z < 1, where its normal is at right angles to the view."""
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


def outline_of(shape, eye, views, seed) -> list[Curve]:
    """The outline and the border of a shape that is no mesh, as `views` eyes see it."""
    to_world = mi.traverse(shape)["to_world"]
    curves = []
    for k, curve in enumerate(CURVES[shape.class_name()]):
        lane = dr.arange(mi.UInt32, views * CURVE_SAMPLES)
        view = lane // CURVE_SAMPLES
        jitter = mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed) + k)
        t = (mi.Float(lane % CURVE_SAMPLES) + jitter) / CURVE_SAMPLES
        with dr.suspend_grad():
            where, finite = eye(view)
            inverse = dr.detach(to_world).inverse()
            e = dr.select(finite, mi.Vector3f(inverse @ mi.Point3f(where)), inverse @ where)
            p, tangent, inside = curve(e, dr.select(finite, mi.Float(1), 0), t)
            tangent = dr.detach(to_world) @ mi.Vector3f(tangent) / CURVE_SAMPLES
            inside = dr.detach(to_world) @ inside
            dr.eval(p, tangent, inside)
        curves.append(Curve(view, to_world @ p, tangent, inside, dr.isfinite(p.x), ROOT))
    return curves
