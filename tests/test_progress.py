"""Progress bars that say where the whole command is."""

import io

import pytest

from mi_ring.system import progress
from mi_ring.system.progress import Part, Steps


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def three_steps() -> Steps:
    masks = [Part("reading", 2), Part("masks, round 1", 9), Part("masks, round 2", 9)]
    return Steps([Part("reading", 10)], masks, [Part("writing", 5), Part("reading", 1)])


def test_bars_say_their_step_and_never_go_back(clock):
    with three_steps() as steps:
        assert steps.named("reading masks") == "step 1/3, reading masks"
        assert steps.named("masks, round 2") == "step 2/3, masks, round 2"
        assert steps.named("masks, round 1") == "masks, round 1"
        assert steps.named("a bar of no step") == "a bar of no step"
        assert steps.named("writing").startswith("step 3/3")
        assert steps.named("reading").startswith("step 3/3")
        assert steps.named("masks, round 2") == "masks, round 2"
    assert progress.progress([], "reading", file=io.StringIO()).desc == "reading"


def test_the_time_left_follows_what_is_done(clock):
    """Of 36 s, where it was measured. Here all takes three times as long, until the second round."""
    with three_steps() as steps:
        steps.named("reading")
        assert steps.left(0.0) is None  # nothing is done
        clock[0] += 15
        assert steps.left(0.5) == pytest.approx(15 + 26 * 3)
        clock[0] += 15
        steps.named("masks, round 1")  # the other bar of this step is left out
        assert steps.left(0.0) == pytest.approx(3 * (9 + 9 + 5 + 1))
        clock[0] += 9
        assert steps.left(1 / 3) == pytest.approx(3 * (6 + 9 + 5 + 1))
        clock[0] += 18
        steps.named("masks, round 2")
        clock[0] += 27  # is slower: half of it took as long as all of round 1
        whole = 27 + 0.5 * 27  # of its total, half by its own speed and half by that of the parts before
        assert steps.left(0.5) == pytest.approx(0.5 * whole + 6 * (57 + whole) / 28)


def test_a_small_part_tells_nothing(clock):
    with Steps([Part("sheet", 1)], [Part("features", 99)]) as steps:
        steps.named("sheet")
        clock[0] += 30  # most of it to load libraries
        assert steps.left(1.0) is None
        steps.named("features")
        assert steps.left(0.05) is None
        clock[0] += 20
        assert steps.left(0.2) == pytest.approx(80)


def test_a_part_that_was_not_expected_tells_nothing(clock):
    with Steps([Part("table", 0), Part("masks", 9)]) as steps:
        steps.named("table")
        clock[0] += 3
        assert steps.left(0.5) is None


def test_the_bar_shows_the_time_that_all_steps_need(clock):
    out = io.StringIO()
    with three_steps():
        bar = progress.progress(range(10), "reading", file=out)
        clock[0] += 200
        bar.update(5)
        assert "step 1/3, reading, all done in 21 min: 50%|" in " ".join(str(bar).split())
        other = progress.progress(range(10), "something else", file=out)
        assert "done in" not in str(other)
    assert "done in" not in str(bar)


def test_at_the_end_of_the_last_step_no_time_is_left(clock):
    with Steps([Part("reading", 1)]):
        bar = progress.progress(range(4), "reading", file=io.StringIO())
        clock[0] += 60
        bar.update(3)
        assert "all done in 20 s" in str(bar)
        clock[0] += 20
        bar.update(1)
        assert "step 1/1, reading" in str(bar) and "done in" not in str(bar)


def test_times_are_rounded():
    assert [progress.rounded_time(seconds) for seconds in (0, 44, 89, 91, 3600)] == [
        "10 s",
        "40 s",
        "90 s",
        "2 min",
        "60 min",
    ]


def test_the_step_is_in_the_bar_and_gone_after_an_error():
    with pytest.raises(ZeroDivisionError), Steps([Part("reading", 1)]):
        assert progress.progress([], "reading", file=io.StringIO()).desc == "step 1/1, reading"
        1 / 0  # noqa: B018
    assert Steps.current is None
