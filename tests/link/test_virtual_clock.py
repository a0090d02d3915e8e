"""Event queue in virtual time."""

import math
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.link.simulated import VirtualClock


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 1)), max_size=30))
def test_order_is_time_then_priority_then_insertion(plan: list[tuple[int, int]]) -> None:
    clock = VirtualClock()
    done: list[tuple[int, int, int]] = []
    for serial, (time, priority) in enumerate(plan):
        clock.schedule(time, partial(done.append, (time, priority, serial)), priority)
    clock.run_until(10.0)
    assert done == sorted(done)
    assert len(done) == len(plan)
    assert clock.now == 10.0


def test_events_see_their_own_time_and_may_schedule_more() -> None:
    clock, seen = VirtualClock(1.0), []

    def again() -> None:
        seen.append(clock.now)
        clock.schedule(clock.now + 0.5, again)

    clock.schedule(1.0, again)
    clock.run_until(2.5)
    assert seen == [1.0, 1.5, 2.0, 2.5]
    assert clock.next_time == 3.0


def test_events_after_the_end_stay_scheduled() -> None:
    clock, seen = VirtualClock(), []
    clock.schedule(2.0, lambda: seen.append(2))
    clock.run_until(1.0)
    assert (seen, clock.next_time, clock.now) == ([], 2.0, 1.0)
    clock.run_until(0.5)
    assert clock.now == 1.0


def test_cancelled_events_do_not_happen() -> None:
    clock, seen = VirtualClock(), []
    events = [clock.schedule(float(k), partial(seen.append, k)) for k in range(6)]
    assert clock.cancel(events[2])
    assert not clock.cancel(events[2])
    clock.run_until(10.0)
    assert seen == [0, 1, 3, 4, 5]
    assert not clock.cancel(events[0])


@pytest.mark.parametrize("time", [0.5, math.nan])
def test_the_past_is_refused(time: float) -> None:
    clock = VirtualClock(1.0)
    with pytest.raises(ValueError, match="cannot schedule"):
        clock.schedule(time, lambda: None)
