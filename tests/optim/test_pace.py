"""Where in its schedule a training is that is stretched or cut on the way."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.optim.pace import Pace

lefts = st.lists(st.integers(1, 300), max_size=4)


def turned(planned: int, lefts: list[int]) -> Pace:
    pace, step = Pace(planned), 0
    for left in lefts:
        step += max((pace.end - step) // 3, 0)
        pace.end_after(step, left)
    return pace


@given(st.integers(1, 5000))
def test_without_a_turn_it_is_the_step_itself(planned):
    pace = Pace(planned)
    assert pace.end == planned
    assert [pace.place(step) for step in (0, planned // 2, planned)] == [0, planned // 2, planned]


def test_what_is_left_is_spread_over_what_is_left():
    pace = Pace(100)
    pace.end_after(40, 20)  # 60 in 20 steps
    assert [pace.place(step) for step in (39, 40, 41, 50, 60)] == [39, 40, 43, 70, 100]
    pace.end_after(50, 60)  # then 30 in 60
    assert [pace.place(step) for step in (50, 52, 110)] == [70, 71, 100]
    assert pace.end == 110


@given(st.integers(1, 400), lefts)
def test_it_never_goes_back_and_ends_where_it_was_planned(planned, lefts):
    pace = turned(planned, lefts)
    places = [pace.place(step) for step in range(pace.end + 1)]
    assert places == sorted(places)
    assert places[-1] == pytest.approx(planned)
    again = Pace(planned, [tuple(turn) for turn in pace.turns])  # as a checkpoint has it
    assert [again.place(step) for step in range(pace.end + 1)] == places


@given(st.integers(1, 400), lefts, st.integers(1, 50))
def test_each_multiple_is_passed_once(planned, lefts, every):
    """Or with others in one step, where the schedule is cut."""
    pace = turned(planned, lefts)
    passed = [step for step in range(pace.end + 1) if pace.passes(step, every)]
    assert len(passed) <= planned // every
    if not lefts:
        assert passed == [*range(every, planned + 1, every)]
    for number in range(every, int(pace.place(pace.end)) + 1, every):
        assert any(pace.place(step - 1) < number <= pace.place(step) for step in passed)
