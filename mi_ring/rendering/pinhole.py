"""Pinhole cameras with radial distortion in Dr.Jit: rays of pixels, and pixels of points."""

import drjit as dr
import mitsuba as mi

from mi_ring.geometry.camera import distortion_factor, undistortion_factor

OUTSIDE = 1e6  #: factor of picture coordinates that puts a point outside of every picture


def camera_ray(to_world, focal, centre, distortion, pixel):
    """The ray through continuous pixel coordinates: (origin, unit direction).

    `to_world`: Matrix4f camera-to-world, Mitsuba's camera axes (x left, y up, z forward); `focal`, `centre`: Point2f
    (fx, fy), (cx, cy) [px]; `distortion`: Float as in `mi_ring.geometry.camera.Camera`, or None; `pixel`: Point2f [px],
    x right, y down. Arguments have one camera, or one camera per lane.
    """
    x, y = (pixel.x - centre.x) / focal.x, (pixel.y - centre.y) / focal.y
    if distortion is not None:
        factor = undistortion_factor(distortion, x * x + y * y)
        x, y = x * factor, y * factor
    m = to_world
    direction = mi.Vector3f(
        -m[0, 0] * x - m[0, 1] * y + m[0, 2],
        -m[1, 0] * x - m[1, 1] * y + m[1, 2],
        -m[2, 0] * x - m[2, 1] * y + m[2, 2],
    )
    return mi.Point3f(m[0, 3], m[1, 3], m[2, 3]), dr.normalize(direction)


def camera_coordinates(to_world, vector):
    """A direction of the world in the axes of a camera, by the inverse of the upper left 3 × 3 of `to_world`."""
    # Not by the transpose, though it is a rotation: the gradient with respect to each entry would be wrong.
    return dr.rcp(mi.Matrix3f([[to_world[i, j] for j in range(3)] for i in range(3)])) @ vector


def project(to_world, focal, centre, distortion, point):
    """The inverse of `camera_ray`: (pixel coordinates [px], depth along the optical axis [scene units]) of a point."""
    x, y, z = camera_coordinates(to_world, point - mi.Point3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]))
    x, y = x / z, y / z
    if distortion is not None:
        factor, shown = distortion_factor(distortion, x * x + y * y)
        # Points that the lens does not show are outside of the picture. They are finite, so that gradients are, too.
        factor = dr.select(shown, factor, OUTSIDE)
        x, y = x * factor, y * factor
    return mi.Point2f(centre.x - focal.x * x, centre.y - focal.y * y), z


def project_tangent(to_world, focal, distortion, point, tangent):
    """How far a point moves in the picture [px] for a step `tangent` in the world: the derivative of `project`."""
    x, y, z = camera_coordinates(to_world, point - mi.Point3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]))
    dx, dy, dz = camera_coordinates(to_world, tangent)
    moved = mi.Vector2f(dx * z - x * dz, dy * z - y * dz) / (z * z)
    if distortion is not None:
        place = mi.Vector2f(x / z, y / z)
        turned = 2 * distortion * dr.dot(place, moved) * place
        moved = (1 + distortion * dr.squared_norm(place)) * moved + turned
    return -mi.Vector2f(focal) * moved
