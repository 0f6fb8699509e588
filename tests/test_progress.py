"""Progress bars that say where the whole command is."""

import io

import pytest

from mi_ring.system import progress
from mi_ring.system.progress import Step, Steps


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_bars_say_their_step_and_how_long_all_steps_take(clock):
    with Steps(Step(("reading",), 10), Step(("masks", "table"), 20), Step(("writing", "table"), 5)) as steps:
        assert steps.named("reading masks") == "step 1/3, reading masks"
        clock[0] += 30  # three times as long as on the machine that was measured
        assert steps.named("masks, round 2") == "step 2/3, masks, round 2, all steps 01:15 more"
        assert steps.named("table").startswith("step 2/3")
        assert steps.named("a bar of no step") == "a bar of no step"
        assert steps.named("writing").startswith("step 3/3")
        assert steps.named("table").startswith("step 3/3")  # never back
        assert steps.named("reading") == "reading"
    assert progress.progress([], "reading", file=io.StringIO()).desc == "reading"


def test_the_step_is_in_the_bar_and_gone_after_an_error():
    with pytest.raises(ZeroDivisionError), Steps(Step(("reading",), 1)):
        assert progress.progress([], "reading", file=io.StringIO()).desc == "step 1/1, reading"
        1 / 0  # noqa: B018
    assert Steps.current is None
