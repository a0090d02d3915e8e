"""The travel over a sliding time equals what looking at every move gives."""

from collections import deque

from hypothesis import given
from hypothesis import strategies as st

from servotwin.edge.watch import ReferenceMoves

VALUES = st.sampled_from([0.0, 1.0, 2.0, 3.0])
STEPS = st.lists(st.tuples(st.integers(0, 3), st.integers(-4, 12), VALUES, VALUES), max_size=40)


@given(STEPS)
def test_travel_is_the_distance_between_the_extremes_of_the_moves(steps: list[tuple[int, int, float, float]]) -> None:
    moves, every, sample = ReferenceMoves(), deque[tuple[int, float, float]](), 0
    for ahead, lasting, a, b in steps:
        sample += ahead
        every.append((sample + lasting, min(a, b), max(a, b)))
        moves.add(sample + lasting, min(a, b), max(a, b))
        while every and every[0][0] <= sample:
            every.popleft()
        moves.expire(sample)
        assert bool(moves) == bool(every)
        if every:
            assert moves.travel == max(high for _, _, high in every) - min(low for _, low, _ in every)
