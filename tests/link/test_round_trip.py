"""The wait for an answer follows the measured round trips."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.link.round_trip import SHORTEST_S, RoundTrip


def test_at_first_it_waits_the_shortest_time() -> None:
    assert RoundTrip(10.0).wait_s == SHORTEST_S
    assert RoundTrip(0.3).wait_s == 0.3


@pytest.mark.parametrize("seconds", [2.0, 5.0])
def test_equal_round_trips_are_waited_for_and_hardly_longer(seconds: float) -> None:
    trip = RoundTrip(10.0)
    trip.answered(seconds)
    assert trip.wait_s == min(3.0 * seconds, 10.0)
    for _ in range(50):
        trip.answered(seconds)
    assert seconds <= trip.wait_s < 1.01 * seconds


def test_round_trips_that_vary_are_waited_for_longer_than_their_mean() -> None:
    trip = RoundTrip(60.0)
    for k in range(100):
        trip.answered(2.0 + 2.0 * (k % 2))
    assert 5.0 < trip.wait_s < 9.0


@given(st.lists(st.floats(0.0, 1e6), max_size=20), st.floats(0.01, 100.0))
def test_it_stays_between_floor_and_ceiling(trips: list[float], longest: float) -> None:
    trip = RoundTrip(longest)
    for seconds in trips:
        trip.answered(seconds)
    assert min(SHORTEST_S, longest) <= trip.wait_s <= longest
