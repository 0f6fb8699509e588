"""The regulariser: it weakens during a fit, unless something is wrong with the surface."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from mi_ring.capture.capture import Observation
from mi_ring.capture.loading import load_capture
from mi_ring.fitting import terms
from mi_ring.fitting.config import Config
from mi_ring.fitting.fit import Fit
from mi_ring.fitting.iteration import Iteration
from mi_ring.fitting.processes import ALONE
from mi_ring.fitting.regulariser_strength import RegulariserStrength
from mi_ring.geometry.domain import Sphere


def test_regulariser_is_relaxed_and_nothing_else():
    regulariser = RegulariserStrength()
    regulariser.weakened, regulariser.unexplained = 0.5, 0.06
    assert regulariser.strength(0.04) == pytest.approx(0.2)
    regulariser.unexplained = 0.18  # photographs that disagree with the model
    assert regulariser.strength(0.04) == pytest.approx(0.9**4)
    regulariser.unexplained = 0.5
    assert regulariser.strength(0.04) == 1
    it = SimpleNamespace(context=SimpleNamespace(regulariser=0.3))
    assert terms.default_terms["velocity"].schedule(it) == 0.3
    scheduled = {name for name, term in terms.default_terms.items() if term.schedule}
    assert scheduled == {"velocity", "settling"}  # the latter in the last stage alone


def test_what_is_unexplained_is_a_share_of_the_objects_light():
    observed = torch.tensor([0.5, 0.25, 0.1, 0.4, 9.0]).reshape(1, 1, 5, 1).expand(1, 1, 5, 3)
    predicted = torch.tensor([0.4, 0.30, 9.0, 0.7, 0.0]).reshape(1, 1, 5, 1).expand(1, 1, 5, 3)
    clipped = torch.zeros(1, 1, 5, 3, dtype=torch.bool)
    clipped[..., 3, :] = True  # brighter than observed: no error
    seen = Observation(observed, clipped, torch.tensor([[[1.0, 1, 1, 1, 0]]]), torch.tensor([True]), None)
    shown = SimpleNamespace(rgb=predicted, coverage=torch.tensor([[[1.0, 1, 0.5, 1, 1]]]))
    batch = SimpleNamespace(share=ALONE.share(1))
    found = Iteration(batch, seen, shown, None).unexplained()
    assert found == pytest.approx((0.1 + 0.05) / (0.5 + 0.25 + 0.4))
    seen = seen._replace(masked=torch.tensor([False]))  # then what is predicted to be the object is
    found = Iteration(batch, seen, shown, None).unexplained()
    assert found == pytest.approx((0.1 + 0.05 + 9) / (0.5 + 0.25 + 0.4 + 9))


def test_regulariser_is_held_while_the_surface_crosses_itself_and_catches_up_unless_it_is_late():
    ball = trimesh.creation.icosphere(2)
    two = ball + trimesh.creation.icosphere(2).apply_translation([0.5, 0, 0])
    state = RegulariserStrength()
    state.unexplained = 0.5

    def go(numbers, mesh):
        for number in numbers:
            vertices, faces = torch.from_numpy(np.array(mesh.vertices)), np.array(mesh.faces)
            share = 0.1 if number < 20 else math.nan
            schedule = SimpleNamespace(shaping=200)
            state.note(SimpleNamespace(number=number, progress=(number - 1) / 200, batch=SimpleNamespace(faces=faces),
                                       prediction=SimpleNamespace(vertices=vertices),
                                       context=SimpleNamespace(schedule=schedule),
                                       unexplained=lambda share=share: share))  # fmt: skip

    go(range(1, 20), ball)
    assert state.weakened == pytest.approx(19 / 200)  # as planned
    assert state.unexplained == pytest.approx(0.1 + 0.4 * 0.9**19)
    go(range(20, 80), two)
    assert state.crossing > 0.05 and state.weakened == pytest.approx(-0.3)
    go(range(80, 100), ball)
    assert not state.held and state.weakened == pytest.approx(-0.3 + 20 * 0.015)
    go(range(100, 139), ball)
    assert state.weakened == pytest.approx(39 * 0.015)
    go(range(139, 160), two)
    assert state.held and state.weakened == pytest.approx(40 * 0.015 - 20 * 0.01)
    go(range(160, 180), ball)
    assert state.weakened == pytest.approx(0.4 + 20 * 0.005)


def test_regulariser_does_not_suffer_from_bfloat16(small_capture):
    s, _ = Sphere().sample(3)

    def value(precision):
        running = Fit(load_capture(small_capture), Config(precision=precision, domain="sphere"))
        running.ring.shape_net.output.weight.data.mul_(30)
        batch = SimpleNamespace(points=s, seeds={"regulariser": 3})
        it = SimpleNamespace(batch=batch, context=running.context(), stage=running.schedule.stages[0])
        return terms.velocity(it).item()

    assert value("bfloat16") == pytest.approx(value("float32"), rel=0.01)
