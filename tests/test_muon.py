"""Muon: PyTorch's own in bfloat16, and close to the polar factor in float32."""

import pytest
import torch

from mi_ring.fitting.config import Config
from mi_ring.fitting.muon import Muon, orthogonalised
from mi_ring.fitting.optimisation import network_steppers
from mi_ring.objects.fitted_object import FittedObject

SHAPES = (24, 17), (9, 31), (16, 16)


def steps(optimizer, parameters):
    """The parameters after three steps on gradients that do not depend on the optimiser."""
    random = torch.Generator().manual_seed(5)
    for _ in range(3):
        for p in parameters:
            p.grad = torch.randn(p.shape, generator=random)
        optimizer.step()
    return [p.detach().clone() for p in parameters]


def parameters():
    random = torch.Generator().manual_seed(4)
    return [torch.nn.Parameter(torch.randn(shape, generator=random)) for shape in SHAPES]


def test_in_bfloat16_it_is_pytorchs_own():
    ours, theirs = parameters(), parameters()
    a = steps(Muon(ours, lr=0.02, dtype=torch.bfloat16), ours)
    b = steps(torch.optim.Muon(theirs, lr=0.02, weight_decay=0.0), theirs)
    assert all(torch.equal(x, y) for x, y in zip(a, b))


def test_in_float32_it_goes_the_same_way():
    ours, theirs = parameters(), parameters()
    start = [p.detach().clone() for p in ours]
    a = steps(Muon(ours, lr=0.02, dtype=torch.float32), ours)
    b = steps(torch.optim.Muon(theirs, lr=0.02, weight_decay=0.0), theirs)
    for x, y, s in zip(a, b, start):
        assert (x - y).norm() < 0.03 * (y - s).norm()  # bfloat16 has eight bits


@pytest.mark.parametrize("shape", SHAPES)
def test_singular_values_are_brought_near_one_and_vectors_stay(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1)) * 1e-3
    u, s, v = torch.linalg.svd(matrix, full_matrices=False)
    inside = u.T @ orthogonalised(matrix, torch.float32) @ v.T
    kept = s > 0.1 * s.max()  # five iterations do not raise what is far below the others
    values = inside.diagonal()[kept]
    assert values.min() > 0.6 and values.max() < 1.25
    assert (inside - inside.diagonal().diag()).abs().max() < 1e-3


def test_its_state_can_be_saved_and_taken_up():
    ours = parameters()
    optimizer = Muon(ours, lr=0.02, dtype=torch.float32)
    steps(optimizer, ours)
    other = Muon(parameters(), lr=0.5, dtype=torch.float32)
    other.load_state_dict(optimizer.state_dict())
    assert other.param_groups[0]["lr"] == 0.02
    assert torch.equal(other.state[other.param_groups[0]["params"][1]]["momentum_buffer"],
                       optimizer.state[ours[1]]["momentum_buffer"])  # fmt: skip


def test_muon_has_the_hidden_weights_and_adam_all_the_others():
    ring = FittedObject([0, 0, 0], 1.0)
    adam, muon = (stepper.optimizer for stepper in network_steppers(ring, Config(), torch.device("cpu")))
    assert isinstance(adam, torch.optim.Adam) and isinstance(muon, Muon)
    ours, theirs = ([p for group in o.param_groups for p in group["params"]] for o in (muon, adam))
    assert [tuple(p.shape) for p in ours] == 2 * [(256, 96), (256, 256), (256, 256)] + 2 * [(256, 256)]
    assert sorted(map(id, ours + theirs)) == sorted(map(id, ring.parameters()))
    (alone,) = network_steppers(ring, Config(optimizer="adam"), torch.device("cpu"))
    assert len(alone.optimizer.param_groups[0]["params"]) == len(list(ring.parameters()))
