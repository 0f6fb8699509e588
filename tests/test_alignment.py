"""Arrays that Dr.Jit shares are aligned as its own are. Otherwise a repeated fit would compile its kernels again."""

import mitsuba as mi
import numpy as np
import pytest
import torch

from mi_ring.rendering.bridge import to_drjit
from mi_ring.scene.alignment import ALIGNMENT, to_flat, to_vectors
from mi_ring.scene.plain_mesh import mesh_of


def begins_at(array):
    """The address of an array, modulo the alignment."""
    return array.torch().data_ptr() % ALIGNMENT


@pytest.mark.parametrize("kind", [mi.Float, mi.UInt32])
@pytest.mark.parametrize("shift", range(1, 4))
def test_numpys_arrays_are_copied_to_aligned_memory(kind, shift):
    values = np.arange(60.0)[shift:].reshape(-1, 1).repeat(2, 1)
    array = to_flat(kind, values)
    assert begins_at(array) == 0
    np.testing.assert_array_equal(array.numpy(), values.ravel())


def test_vectors_keep_their_components():
    values = np.arange(15.0).reshape(5, 3)
    vectors = to_vectors(values[1:])
    np.testing.assert_array_equal(np.array(vectors).T, values[1:])
    assert [begins_at(part) for part in vectors] == [0, 0, 0]


def test_an_empty_array_stays_empty():
    assert len(to_flat(mi.Float, np.zeros((0, 3)))) == 0


@pytest.mark.parametrize("shift", range(4))
def test_parts_of_tensors_are_copied_and_whole_ones_are_shared(shift):
    tensor = torch.arange(60.0)
    array = to_drjit(tensor[shift:])
    assert begins_at(array) == 0
    assert (array.torch().data_ptr() == tensor.data_ptr()) == (shift == 0)
    np.testing.assert_array_equal(array.numpy(), tensor[shift:])


def test_meshes_have_aligned_arrays():
    vertices = np.random.default_rng(0).normal(size=(5, 3))
    params = mi.traverse(mesh_of(vertices[1:], [[0, 1, 2], [1, 2, 3]]))
    assert begins_at(params["vertex_positions"]) == begins_at(params["faces"]) == 0
    np.testing.assert_allclose(np.reshape(params["vertex_positions"], (4, 3)), vertices[1:], rtol=1e-6)
