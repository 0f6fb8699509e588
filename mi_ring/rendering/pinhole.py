"""Pinhole cameras in Dr.Jit, perhaps with a lens: rays through pixels and back."""

import drjit as dr
import mitsuba as mi

from mi_ring.geometry.camera import distortion_factor, undistortion_factor

OUTSIDE = 1e6  #: a factor of places in the picture


def camera_ray(to_world, focal, centre, distortion, pixel):
    """Ray through continuous pixel coordinates, Mitsuba's camera frame (x left, y up, z forward).

    `to_world`: Matrix4f camera-to-world; `focal`, `centre`: Point2f (fx, fy), (cx, cy) [px]; `distortion`: Float as
    `mi_ring.geometry.camera.Camera` has it, None for none; `pixel`: Point2f [px], x right, y down. Arguments may hold
    one camera or one camera per lane. Returns (origin, unit direction).
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
    """A direction in the world in the axes of a camera: the inverse of the upper left 3 × 3 of `to_world`."""
    # Not its transpose, though it is a rotation: its entries are differentiated one by one.
    return dr.rcp(mi.Matrix3f([[to_world[i, j] for j in range(3)] for i in range(3)])) @ vector


def project(to_world, focal, centre, distortion, point):
    """The inverse of `camera_ray`: (pixel coordinates [px], depth along the optical axis [scene units]) of a point."""
    x, y, z = camera_coordinates(to_world, point - mi.Point3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]))
    x, y = x / z, y / z
    if distortion is not None:
        factor, shown = distortion_factor(distortion, x * x + y * y)
        # What is not shown is outside every picture, and finite for the sake of gradients.
        factor = dr.select(shown, factor, OUTSIDE)
        x, y = x * factor, y * factor
    return mi.Point2f(centre.x - focal.x * x, centre.y - focal.y * y), z


def project_tangent(to_world, focal, distortion, point, tangent):
    """Pixels that a point moves in the picture for a step `tangent` in the world: the derivative of `project`."""
    x, y, z = camera_coordinates(to_world, point - mi.Point3f(to_world[0, 3], to_world[1, 3], to_world[2, 3]))
    dx, dy, dz = camera_coordinates(to_world, tangent)
    moved = mi.Vector2f(dx * z - x * dz, dy * z - y * dz) / (z * z)
    if distortion is not None:
        place = mi.Vector2f(x / z, y / z)
        turned = 2 * distortion * dr.dot(place, moved) * place
        moved = (1 + distortion * dr.squared_norm(place)) * moved + turned
    return -mi.Vector2f(focal) * moved
