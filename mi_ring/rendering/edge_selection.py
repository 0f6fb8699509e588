"""Finds the edges at which the picture is discontinuous: outlines, creases and edges of shadows."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ring.errors import SceneError
from mi_ring.rendering.edge_curves import CURVES, OUTLINE_OFFSET, EdgeSamples, outline_of
from mi_ring.scene.alignment import to_flat

SMOOTH, CREASE, BORDER = 0, 1, 2  # kinds of edges: normals of both sides agree, they differ, there is only one side
SAMPLES, MIN_SAMPLES = 4, 2048  #: per edge of a mesh, and at least for all edges of the scene together


class Edges:
    """The edges of all shapes in a scene. Methods find those that are discontinuities as seen from an eye.

    An eye is the camera or the light of each photograph, given as a function: it takes indices of photographs (UInt32)
    and returns (position, True), or (direction toward it, False) for a distant light. The vectors may carry gradients.
    Raises SceneError if a shape is neither a mesh nor a rectangle, disk, sphere or cylinder.
    """

    def __init__(self, scene):
        self.shapes = list(scene.shapes())
        # Mitsuba's rectangle is also a mesh, but its vertices are not attached to its `to_world`.
        self.others = [shape for shape in self.shapes if shape.class_name() in CURVES]
        self.meshes = [shape for shape in self.shapes if shape not in self.others]
        for shape in self.meshes:
            if not shape.is_mesh():
                raise SceneError(
                    f'photometric: no gradients with shape "{shape.id()}", a {shape.class_name()}: '
                    f"use meshes or {', '.join(CURVES)}"
                )
        # `of` compares the indices of these arrays. No other array can have them while these exist.
        self.buffers = [mesh.faces_buffer() for mesh in self.meshes]
        meshes_faces = [np.array(buffer).reshape(-1, 3) for buffer in self.buffers]
        vertices, triangles = 0, 0  # numbers of those of the meshes before
        corners, tables = [np.zeros((0, 3))], [np.zeros((5, 0))]
        for mesh, faces in zip(self.meshes, meshes_faces):
            corners.append(faces + vertices)
            tables.append(edge_table(mesh, faces) + np.array([[vertices, vertices, triangles, triangles, 0]]).T)
            vertices += mesh.vertex_count()
            triangles += len(faces)
        self.corners = to_flat(mi.UInt32, np.concatenate(corners))
        table = np.concatenate(tables, 1)
        self.v0, self.v1, self.f0, self.f1, self.kind = (to_flat(mi.UInt32, row) for row in table)

    @classmethod
    def of(cls, scene, known: "Edges | None" = None) -> "Edges":
        """Return the edges of a scene. `known`: edges from an earlier call, or None.

        If `known` belongs to this scene and its shapes and triangles have not changed since, returns `known` itself.
        Vertices may have moved.
        """
        if known is not None and list(scene.shapes()) == known.shapes:
            now = (mesh.faces_buffer() for mesh in known.meshes)
            if all(a.index == b.index for a, b in zip(now, known.buffers)):
                return known
        return cls(scene)

    def positions(self):
        """Return the vertex positions of all meshes as one flat Float. It is attached (it carries gradients)."""
        buffers = [mesh.vertex_positions_buffer() for mesh in self.meshes]
        return buffers[0] if len(buffers) == 1 else dr.concat(buffers)

    def fronts(self, eye, views):
        """Test which triangles face the eye. Returns a Dr.Jit Bool for each triangle of the meshes in each photograph.

        `eye`: function from photograph indices to (position, True) or (direction toward it, False). `views`: number of
        photographs. The result has the values of all triangles for photograph 0, then for photograph 1, and so on.
        True: the triangle shows its front side to the eye.
        """
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
        """Look up whether the two triangles at edges face the eye (camera or light). Returns (edge, first, second).

        These have one value per lane: the number of the edge, and for its first and second triangle True if it faces
        the eye. `fronts`: a Bool for each triangle in each photograph, one photograph after the other: True if it faces
        the eye. `lanes` (UInt32): photograph · number of edges + edge; None: all edges in `views` photographs.
        """
        count, triangles = dr.width(self.kind), dr.width(self.corners) // 3
        lane = dr.arange(mi.UInt32, count * views) if lanes is None else lanes
        view, edge = lane // count, lane % count
        first, second = (
            dr.gather(mi.Bool, fronts, view * triangles + dr.gather(mi.UInt32, f, edge)) for f in (self.f0, self.f1)
        )
        return edge, first, second

    def sample(self, lanes, seed, before=0, shadow=False) -> EdgeSamples:
        """Choose random points on edges, stratified along each edge. Returns at least four points per edge.

        `lanes` (UInt32): photograph · number of edges + edge. `before`: number of photographs before these that are
        rendered elsewhere; random numbers depend on it. `shadow`: True if the edges are edges of shadows.
        """
        count = dr.width(self.kind)
        each = max(SAMPLES, MIN_SAMPLES // count)
        local = dr.arange(mi.UInt32, dr.width(lanes) * each)
        each = dr.opaque(mi.UInt32, each)  # it changes, so it must not be part of the kernel
        chosen = dr.gather(mi.UInt32, lanes, local // each)
        lane = (chosen + dr.opaque(mi.UInt32, before * count)) * each + local % each
        t = (mi.Float(local % each) + mi.sample_tea_float32(lane, dr.opaque(mi.UInt32, seed))) / mi.Float(each)
        positions, edge = self.positions(), chosen % count
        a, b = (dr.gather(mi.Point3f, positions, dr.gather(mi.UInt32, v, edge)) for v in (self.v0, self.v1))
        piece = dr.detach(b - a) / mi.Float(each)
        p = a * (1 - t) + b * t  # dr.lerp would add its two gradients of `a` in an order that varies
        return EdgeSamples(chosen // count, lane, p, piece, self.middle(edge), mi.Bool(True), OUTLINE_OFFSET, shadow)

    def middle(self, edge):
        """Return the mean of the centres of the two triangles at each edge, Point3f without gradients.

        `edge` (UInt32): numbers of edges. At a border, it is the centre of the one triangle.
        """
        positions, corners = dr.detach(self.positions()), mi.Point3f(0)
        for face in (self.f0, self.f1):
            for vertex in dr.gather(mi.Point3u, self.corners, dr.gather(mi.UInt32, face, edge)):
                corners += dr.gather(mi.Point3f, positions, vertex) / 6
        return corners

    def outlines(self, eye, views, seed, before=0):
        """Sample all edges that may be outlines or creases as seen from the eye. Returns (list of samples, fronts).

        The list has an entry for each curve of a shape, and one for all meshes. `fronts`: a Bool for each triangle in
        each photograph, True if it faces the eye; None if the scene has no mesh. `eye`: function from photograph
        indices to (position, True) or (direction toward it, False). `views`: number of photographs. `before`: number of
        photographs before these that are rendered elsewhere; random numbers depend on it.
        """
        curves = [curve for shape in self.others for curve in outline_of(shape, eye, views, seed, before)]
        fronts = None
        if self.meshes:
            fronts = self.fronts(eye, views)
            edge, first, second = self.sides(fronts, views=views)
            kind = dr.gather(mi.UInt32, self.kind, edge)
            lanes = dr.compress((first != second) | (kind != SMOOTH))
            if dr.width(lanes):
                curves.append(self.sample(lanes, seed, before))
        return curves, fronts

    def shadow_casters(self, light, views, seed, seen, before=0):
        """Sample the edges of shapes that cause edges of shadows. Returns (casters, terminators), two lists of samples.

        Casters are outlines as seen from the light; their shadows fall onto other surfaces. A terminator is a caster of
        a mesh at which the camera sees both adjacent triangles: the shadow begins at this edge itself, because one
        triangle faces the light and the other does not and is black.

        `light`: function from photograph indices to (position, True) or (direction toward it, False). `views`: number
        of photographs. `seen`: a Bool for each triangle in each photograph, one photograph after the other: True if the
        triangle faces the camera. `before`: number of photographs before these that are rendered elsewhere; random
        numbers depend on it.
        """
        casters = [curve for shape in self.others for curve in outline_of(shape, light, views, seed, before)]
        terminators = []
        if self.meshes:
            edge, first, second = self.sides(self.fronts(light, views), views=views)
            kind = dr.gather(mi.UInt32, self.kind, edge)
            lanes = dr.compress((first != second) | (kind == BORDER))
            if dr.width(lanes):
                casters.append(self.sample(lanes, seed, before))
                edge, first, second = self.sides(seen, lanes)
                both = dr.compress(first & second & (dr.gather(mi.UInt32, self.kind, edge) == SMOOTH))
                if dr.width(both):
                    lanes = dr.gather(mi.UInt32, lanes, both)
                    terminators.append(self.sample(lanes, seed + 1, before, shadow=True))
        return casters, terminators


def edge_table(mesh, faces: np.ndarray) -> np.ndarray:
    """Find the E edges of a mesh with the triangles `faces` (F, 3). Returns an integer array (5, E).

    Its rows: first vertex v0, second vertex v1, the triangle that has the side (v0, v1), the triangle that has the side
    (v1, v0), and the kind of the edge. SMOOTH: normals agree across the edge. CREASE: they differ. BORDER: there is
    only one triangle, which is in both rows. Duplicated vertices at the same position count as one.
    """
    weld = np.arange(mesh.vertex_count())
    table = paired_edges(faces, weld)
    if (table[4] == BORDER).any():  # some may be seams, where vertices are duplicated
        positions = np.array(mesh.vertex_positions_buffer()).reshape(-1, 3)
        weld = np.unique(positions, axis=0, return_inverse=True)[1].ravel()
        table = paired_edges(faces, weld)
    if not mesh.has_vertex_normals():
        table[4] = np.maximum(table[4], CREASE)
    return table


def paired_edges(faces: np.ndarray, weld: np.ndarray) -> np.ndarray:
    """Find the E edges of a mesh with smooth normals and triangles `faces` (F, 3). Returns an integer array (5, E).

    `weld` (V,): vertices with equal numbers are one point. The rows: first vertex v0, second vertex v1, the triangle
    that has the side (v0, v1), the triangle that has the side (v1, v0), and the kind. SMOOTH: the triangles share both
    vertices. CREASE: they share points, but not both vertices. BORDER: there is only one triangle, which is in both
    rows.
    """
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, 1).ravel().astype(np.int64)
    triangle = np.repeat(np.arange(len(faces)), 3)
    a, b = weld[start], weld[end]
    key = np.minimum(a, b) * len(weld) + np.maximum(a, b)
    order = np.lexsort((a > b, key))
    first = np.flatnonzero(np.diff(key[order], prepend=-1))  # of each group of half-edges between the same points
    size = np.diff(first, append=len(order))
    h0 = order[first]
    h1 = order[np.minimum(first + 1, len(order) - 1)]
    pair = (size == 2) & (a[h0] == b[h1]) & (a[h1] == b[h0])
    seam = (start[h0] != end[h1]) | (end[h0] != start[h1])
    kind = np.where(pair, np.where(seam, CREASE, SMOOTH), BORDER)
    return np.stack([start[h0], end[h0], triangle[h0], np.where(pair, triangle[h1], triangle[h0]), kind])
