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


def three_steps() -> Steps:
    return Steps(Step(("reading",), 10), Step(("masks", "table"), 20), Step(("writing", "table"), 5))


def test_bars_say_their_step_and_never_go_back(clock):
    with three_steps() as steps:
        assert steps.named("reading masks") == "step 1/3, reading masks"
        assert steps.named("masks, round 2") == "step 2/3, masks, round 2"
        assert steps.named("table").startswith("step 2/3")
        assert steps.named("a bar of no step") == "a bar of no step"
        assert steps.named("writing").startswith("step 3/3")
        assert steps.named("table").startswith("step 3/3")
        assert steps.named("reading") == "reading"
    assert progress.progress([], "reading", file=io.StringIO()).desc == "reading"


def test_the_time_left_follows_the_steps_that_are_done(clock):
    with three_steps() as steps:
        steps.named("reading")
        assert steps.left(None) is None  # nothing is done, and the bar cannot tell yet
        clock[0] += 10
        assert steps.left(5) == pytest.approx(42.5)  # 15 s for what took 10 s elsewhere: 5, then 30, then 7.5
        clock[0] += 20
        steps.named("masks")
        assert steps.left(None) == 75  # three times as long as where it was measured: 60 + 15
        clock[0] += 20
        assert steps.left(None) == 55  # it goes down within a step
        clock[0] += 60
        assert steps.left(20) == pytest.approx(20 + 5 * 130 / 30)  # the step takes longer than the first one told


def test_a_small_step_tells_nothing(clock):
    with Steps(Step(("sheet",), 1), Step(("features",), 99)) as steps:
        clock[0] += 30  # most of it to load libraries
        steps.named("features")
        assert steps.left(None) is None
        assert steps.left(60) == 60


def test_the_bar_shows_the_time_that_all_steps_need(clock):
    out = io.StringIO()
    with three_steps():
        clock[0] += 100
        bar = progress.progress(range(10), "reading", file=out)
        bar.update(5)
        bar.start_t -= 100  # half of the bar took 100 s
        assert "step 1/3, reading, all done in " in str(bar)
        assert "min: " in str(bar)
    assert "done in" not in str(bar)


def test_times_are_rounded():
    assert [progress.rounded_time(seconds) for seconds in (0, 44, 89, 91, 3600)] == [
        "10 s",
        "40 s",
        "90 s",
        "2 min",
        "60 min",
    ]


def test_the_step_is_in_the_bar_and_gone_after_an_error():
    with pytest.raises(ZeroDivisionError), Steps(Step(("reading",), 1)):
        assert progress.progress([], "reading", file=io.StringIO()).desc == "step 1/1, reading"
        1 / 0  # noqa: B018
    assert Steps.current is None
