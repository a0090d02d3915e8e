"""Outbox and session: every window repeated until acknowledged, bounded, drops counted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.link.outbox import FULL, Dropped, MemoryOutbox
from servotwin.link.session import Session
from servotwin.messages import WindowMessage, checksum, pack_channel
from servotwin.runtime.retry import Retry

CHANNELS = (pack_channel("position", "m", [0.0, 1.0]),)


def window(sequence: int) -> WindowMessage:
    return WindowMessage(
        "axis-1", "b0", sequence, float(sequence), 5.0, CHANNELS, (), 0, "", "test", checksum(CHANNELS)
    )


def sent(session: Session, now: float) -> list[int]:
    """Send what is due, without an answer; returns the sequences of the windows."""
    due = list(session.due(now))
    for item in due:
        session.retry_later(item, now)
    return [int(item[1]) for item in due]


def test_windows_are_repeated_with_growing_pauses() -> None:
    outbox = MemoryOutbox()
    session = Session(outbox, Retry(first_s=1.0, factor=3.0, longest_s=5.0))
    outbox.put(window(0))
    times = []
    for k in range(200):
        now = 10.0 + 0.25 * k
        times += [now] * len(sent(session, now))
    assert times == [10.0, 11.0, 14.0, 19.0, 24.0, 29.0, 34.0, 39.0, 44.0, 49.0, 54.0, 59.0]


def test_nothing_is_due_after_the_acknowledgement() -> None:
    outbox = MemoryOutbox()
    session = Session(outbox, Retry(1.0))
    outbox.put(window(0))
    outbox.put(window(1))
    assert sent(session, 0.0) == [0, 1]
    assert sent(session, 0.5) == []
    assert session.acknowledge(("b0", 0))
    assert not session.acknowledge(("b0", 0))
    assert not session.acknowledge(("other", 1))
    assert session.next_time == 1.0
    assert sent(session, 1.0) == [1]
    assert session.acknowledge(("b0", 1))
    assert session.next_time is None
    assert outbox.pending() == []


def test_a_full_outbox_drops_the_oldest_and_says_so() -> None:
    outbox = MemoryOutbox(capacity=2)
    session = Session(outbox)
    for k in range(5):
        outbox.put(window(k))
    assert outbox.dropped == {FULL: 3}
    assert list(outbox.recently_dropped) == [Dropped(("b0", k), FULL) for k in range(3)]
    assert sent(session, 0.0) == [3, 4]
    with pytest.raises(KeyError):
        outbox.get(("b0", 0))


def test_windows_of_an_outbox_are_due_at_once_after_a_restart() -> None:
    outbox = MemoryOutbox()
    outbox.put(window(7))
    assert sent(Session(outbox), 0.0) == [7]


@given(st.integers(1, 4), st.lists(st.tuples(st.booleans(), st.integers(0, 9)), max_size=40))
def test_windows_are_conserved(capacity: int, actions: list[tuple[bool, int]]) -> None:
    outbox = MemoryOutbox(capacity)
    session, offered, acknowledged = Session(outbox, Retry(2.0)), 0, 0
    for now, (offer, sequence) in enumerate(actions):
        if offer:
            outbox.put(window(offered))
            offered += 1
        else:
            acknowledged += session.acknowledge(("b0", sequence))
        sent(session, float(now))
        assert offered == acknowledged + len(outbox.pending()) + sum(outbox.dropped.values())
        assert len(outbox.pending()) <= capacity
        assert (session.next_time is None) == (not outbox.pending())


def test_an_outbox_needs_room() -> None:
    with pytest.raises(InvalidInput, match="capacity"):
        MemoryOutbox(0)
