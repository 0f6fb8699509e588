"""Domains: near-uniform samplings of any closed surface, and points that wander on it."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from mi_ring.errors import InputError
from mi_ring.geometry.domain import CANDIDATES, Domain, Sphere, closed_domain, samplings
from mi_ring.geometry.meshes import load_closed_mesh
from mi_ring.system import cache

MAJOR, MINOR = 1.0, 0.35


@pytest.fixture(scope="module")
def torus():
    """A torus of very uneven triangles."""
    mesh = trimesh.creation.torus(MAJOR, MINOR, major_sections=150, minor_sections=24)
    return closed_domain(mesh, center=[0, 0, 0], radius=1.0)[0]


def off_torus(points):
    """Distance of points (N, 3) from the true torus."""
    ring = np.hypot(points[:, 0], points[:, 1]) - MAJOR
    return np.abs(np.hypot(ring, points[:, 2]) - MINOR)


@pytest.mark.parametrize("level", [3, 4])
def test_samplings_are_near_uniform_and_of_the_surfaces_genus(torus, level):
    points, faces = torus.sample(level)
    mesh = trimesh.Trimesh(points.numpy(), faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 0 and mesh.volume > 0
    assert len(faces) == pytest.approx(20 * 4**level, rel=0.25)
    lengths = mesh.edges_unique_length
    assert lengths.std() < 0.2 * lengths.mean()
    assert off_torus(points.numpy()).max() < 0.01  # the given mesh is that far off
    assert torus.sample(level)[0] is points


def test_points_wander_over_all_of_the_surface_and_faces_stay_faces(torus):
    random = torch.Generator().manual_seed(1)
    still, faces = torus.sample(3)
    normals = trimesh.Trimesh(still.numpy(), faces, process=False).face_normals
    drawn = [torus.sample(3, random)[0].numpy() for _ in range(2 * CANDIDATES)]
    for points in drawn:
        assert off_torus(points).max() < 0.01
        turned = trimesh.Trimesh(points, faces, process=False).face_normals
        assert (turned * normals).sum(1).min() > 0.2  # none is folded over
    assert np.linalg.norm(drawn[0] - drawn[1], axis=1).mean() > 0.1 * np.sqrt(4 * np.pi**2 * MAJOR * MINOR / len(still))
    surface = trimesh.sample.sample_surface(trimesh.Trimesh(torus.points, torus.faces), 4000, seed=2)[0]
    at_rest = cKDTree(still.numpy()).query(surface)[0]
    wandering = cKDTree(np.concatenate(drawn)).query(surface)[0]
    assert wandering.mean() < 0.5 * at_rest.mean()  # all of the surface is nearer to some vertex than it was


def test_a_domains_mesh_is_kept_for_the_next_fit(torus, monkeypatch, tmp_path):
    pytest.importorskip("gpytoolbox")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    points, faces = torus.triangulate(3)
    monkeypatch.setattr(Domain, "remesh", lambda *_: pytest.fail("is computed again"))
    again = torus.triangulate(3)
    assert np.array_equal(again[0], points) and np.array_equal(again[1], faces)


def test_beyond_the_finest_level_triangles_are_cut_in_four(torus, monkeypatch, tmp_path):
    pytest.importorskip("gpytoolbox")
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    monkeypatch.setattr("mi_ring.geometry.domain.REMESHED", 3)
    torus.levels.pop(4, None)
    try:
        assert len(torus.sample(4)[1]) == 4 * len(torus.sample(3)[1])
    finally:
        torus.levels.pop(4)


def test_domains_of_one_surface_share_its_samplings_which_are_the_same_when_they_are_made_anew(
    torus, monkeypatch, tmp_path
):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    again, other = Domain(torus.points, torus.faces), Domain(1.001 * torus.points, torus.faces)
    points, faces = again.sample(3)
    assert points is torus.sample(3)[0]
    assert not torch.equal(other.sample(3)[0], points)
    samplings.cache_clear()
    anew = Domain(torus.points, torus.faces).sample(3)
    assert anew[0] is not points and torch.equal(anew[0], points) and np.array_equal(anew[1], faces)


def test_a_level_too_coarse_for_the_handles_keeps_them():
    """A ring as thin as wire: twenty triangles cannot have its shape."""
    wire = closed_domain(trimesh.creation.torus(1.0, 0.02, major_sections=90, minor_sections=8))[0]
    points, faces = wire.sample(0)
    mesh = trimesh.Trimesh(points.numpy(), faces)
    assert mesh.is_watertight and mesh.euler_number == 0


def test_normalisation_and_orientation():
    mesh = trimesh.creation.torus(3.0, 1.0)
    mesh.apply_translation([10, 20, 30])
    mesh.invert()
    domain, center, radius = closed_domain(mesh)
    np.testing.assert_allclose(center, [10, 20, 30], atol=1e-6)
    assert np.linalg.norm(domain.points, axis=1).mean() == pytest.approx(1)
    assert trimesh.Trimesh(domain.points, domain.faces).volume > 0 and 2.9 < radius < 3.2


def test_a_mesh_with_a_hole_is_no_domain(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.update_faces(np.arange(len(ball.faces)) > 5)
    ball.export(tmp_path / "open.ply")
    with pytest.raises(InputError, match=r"open.ply: domain: is not a closed surface"):
        load_closed_mesh(tmp_path / "open.ply", "domain")
    with pytest.raises(InputError, match=r"gone.ply: domain: no such file"):
        load_closed_mesh(tmp_path / "gone.ply", "domain")


def test_what_a_domain_contains():
    torus = trimesh.creation.torus(2.0, 0.5)
    torus.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    tilt = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    points = np.array([[2, 0, 0.4], [0, -2.3, 0], [0, 0, 0], [2, 0, 0.6], [0, 1.4, 0], [9, 0, 0]]) @ tilt.T
    assert Domain(torus.vertices, torus.faces).contains(points).tolist() == [True, True, False, False, False, False]
    assert Sphere().contains(np.array([[0.57, 0.57, 0.57], [0.58, 0.58, 0.58]])).tolist() == [True, False]


@pytest.mark.parametrize("level", [3, 4, 5, 6])
def test_all_levels_are_of_the_same_surface(level):
    """Each point of each sampling lies on the domain, here with edges, which coarser samplings cut off."""
    gpytoolbox = pytest.importorskip("gpytoolbox")
    box = trimesh.creation.box((1.0, 0.7, 1.4)).subdivide_loop(1).subdivide().subdivide().subdivide().subdivide()
    domain = Domain(box.vertices, box.faces)
    points, faces = domain.sample(level)
    squared = gpytoolbox.squared_distance(points.numpy().astype(float), box.vertices, box.faces, use_cpp=True)[0]
    assert squared.max() < 1e-12
    mesh = trimesh.Trimesh(points.numpy(), faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(box.volume, rel=0.02)
    assert 0.7 < len(faces) / (20 * 4**level) < 1.4
