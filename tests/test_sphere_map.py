"""The map between domains and the sphere: one to one, conformal, and as symmetric as the surface."""

import numpy as np
import pytest
import trimesh

from mi_ring.errors import InputError
from mi_ring.geometry.domain import Domain, Sphere
from mi_ring.geometry.sphere_map import SphericalMap

BALL = trimesh.creation.icosphere(subdivisions=5)


def with_arm():
    """A ball with an arm that is twice as long as the ball is thick, aside."""
    direction = np.array([0.6, -0.48, 0.64])
    away = np.arccos((BALL.vertices @ direction).clip(-1, 1))
    return Domain(BALL.vertices * (1 + 4 * np.exp(-((away / 0.25) ** 4)))[:, None], BALL.faces)


def angles(points, faces):
    return trimesh.Trimesh(points, faces, process=False).face_angles


@pytest.mark.parametrize("domain", [Domain(BALL.vertices * [1, 0.6, 1.7], BALL.faces), with_arm()],
                         ids=["ellipsoid", "arm"])  # fmt: skip
def test_it_is_one_to_one_and_conformal(domain):
    mapped = SphericalMap(domain)
    directions, faces = mapped.directions, mapped.faces
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-6)
    corners = directions[faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * corners.mean(1)).sum(1) > 0).all()
    assert np.linalg.norm(outward, axis=1).sum() / 2 == pytest.approx(4 * np.pi, rel=0.02)  # all of it, and once
    bent = np.degrees(np.abs(angles(directions, faces) - angles(mapped.points, faces)))
    assert np.median(bent) < 3
    points = domain.sample(3)[0].numpy()
    np.testing.assert_allclose(mapped.to_domain(mapped.to_sphere(mapped.points)), mapped.points, atol=1e-6)
    assert np.linalg.norm(mapped.to_domain(mapped.to_sphere(points)) - points, axis=1).mean() < 0.01


def test_what_is_symmetric_stays_so():
    mapped, flip = SphericalMap(Domain(BALL.vertices * [1, 0.6, 1.7], BALL.faces)), np.array([-1, 1, -1])
    points = BALL.vertices[::97] * [1, 0.6, 1.7]
    np.testing.assert_allclose(mapped.to_sphere(points * flip), mapped.to_sphere(points) * flip, atol=0.02)
    ends = np.diag([1, 0.6, 1.7])
    np.testing.assert_allclose(mapped.to_sphere(ends), np.eye(3), atol=0.03)
    # Conformal maps spread what is far out less: the ends of the long axis are smaller on the sphere.
    top = mapped.to_domain(np.array([[0, np.sin(0.5), np.cos(0.5)]]))[0]
    assert np.arctan2(top[1] / 0.6, top[2] / 1.7) > 0.6


def test_the_sphere_is_itself():
    points = np.random.default_rng(1).normal(size=(5, 3))
    assert SphericalMap(Sphere()).to_sphere(points) is points


@pytest.mark.parametrize("mesh", [
    trimesh.creation.torus(1.0, 0.4), trimesh.util.concatenate([BALL, BALL.copy().apply_translation([3, 1, 0])]),
], ids=["handle", "pieces"])  # fmt: skip
def test_handles_and_pieces_are_refused(mesh):
    with pytest.raises(InputError, match="handles and . pieces"):
        SphericalMap(Domain(mesh.vertices, mesh.faces))
