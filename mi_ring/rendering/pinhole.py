"""Pinhole cameras with radial distortion in Dr.Jit: convert pixels to rays, and points to pixels."""

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_ring.geometry.camera import distortion_factor, undistortion_factor

OUTSIDE = 1e6  #: factor of picture coordinates that puts a point outside of every picture


class Pinhole(NamedTuple):
    """A pinhole camera with radial distortion in Dr.Jit: one camera, or one for each lane."""

    to_world: Any  #: Matrix4f camera-to-world, Mitsuba's camera axes: x left, y up, z forward
    focal: Any  #: Point2f, focal lengths (fx, fy) [px]
    centre: Any  #: Point2f, principal point (cx, cy) [px]
    distortion: Any = None  #: Float as in `Camera`; None if it is 0

    @property
    def position(self):
        """The centre of projection, Point3f [scene units]."""
        return mi.Point3f(self.to_world[0, 3], self.to_world[1, 3], self.to_world[2, 3])

    def ray(self, pixel):
        """Compute the ray (origin, unit direction) through a pixel. `pixel`: Point2f [px], x right, y down."""
        x, y = (pixel.x - self.centre.x) / self.focal.x, (pixel.y - self.centre.y) / self.focal.y
        if self.distortion is not None:
            factor = undistortion_factor(self.distortion, x * x + y * y)
            x, y = x * factor, y * factor
        m = self.to_world
        direction = mi.Vector3f(
            -m[0, 0] * x - m[0, 1] * y + m[0, 2],
            -m[1, 0] * x - m[1, 1] * y + m[1, 2],
            -m[2, 0] * x - m[2, 1] * y + m[2, 2],
        )
        return self.position, dr.normalize(direction)

    def local(self, vector):
        """Convert a direction from world to camera coordinates. The result carries gradients of `to_world`."""
        # Not by the transpose, though it is a rotation: the gradient with respect to each entry would be wrong.
        return dr.rcp(mi.Matrix3f([[self.to_world[i, j] for j in range(3)] for i in range(3)])) @ vector

    def project(self, point):
        """Project a point in the world. Returns (pixel coordinates [px], depth along the optical axis [scene units]).

        The depth is negative for a point behind the camera. A point that the lens cannot show is far outside of the
        picture.
        """
        x, y, z = self.local(point - self.position)
        x, y = x / z, y / z
        if self.distortion is not None:
            factor, shown = distortion_factor(self.distortion, x * x + y * y)
            # Points that the lens does not show are outside of the picture, but finite, so that gradients are finite.
            factor = dr.select(shown, factor, OUTSIDE)
            x, y = x * factor, y * factor
        return mi.Point2f(self.centre.x - self.focal.x * x, self.centre.y - self.focal.y * y), z

    def project_tangent(self, point, tangent):
        """Compute the motion in the picture, Vector2f [px], of a point in the world that moves by the vector `tangent`.

        It is the first-order motion: the derivative of the projection at `point`, times `tangent`.
        """
        x, y, z = self.local(point - self.position)
        dx, dy, dz = self.local(tangent)
        moved = mi.Vector2f(dx * z - x * dz, dy * z - y * dz) / (z * z)
        if self.distortion is not None:
            place = mi.Vector2f(x / z, y / z)
            turned = 2 * self.distortion * dr.dot(place, moved) * place
            moved = (1 + self.distortion * dr.squared_norm(place)) * moved + turned
        return -mi.Vector2f(self.focal) * moved
