"""Outbox and sender: every window repeated until acknowledged, bounded, drops counted."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servotwin.errors import InvalidInput
from servotwin.link.outbox import FULL, Dropped, MemoryOutbox
from servotwin.link.session import Sender
from servotwin.messages import Acknowledge, Window, checksum, pack_channel
from servotwin.runtime.retry import Retry

CHANNELS = (pack_channel("position", "m", [0.0, 1.0]),)


def window(sequence: int) -> Window:
    return Window("axis-1", "b0", sequence, float(sequence), 5.0, CHANNELS, (), 0, "", "test", checksum(CHANNELS))


def sequences(windows: list[Window]) -> list[int]:
    return [w.sequence for w in windows]


def test_windows_are_repeated_with_growing_pauses() -> None:
    sender = Sender(MemoryOutbox(), Retry(first_s=1.0, factor=3.0, longest_s=5.0))
    sender.offer(window(0), 10.0)
    sent = []
    for k in range(200):
        now = 10.0 + 0.25 * k
        sent += [now] * len(sender.due(now))
    assert sent == [10.0, 11.0, 14.0, 19.0, 24.0, 29.0, 34.0, 39.0, 44.0, 49.0, 54.0, 59.0]


def test_nothing_is_due_after_the_acknowledgement() -> None:
    outbox = MemoryOutbox()
    sender = Sender(outbox, Retry(1.0))
    sender.offer(window(0), 0.0)
    sender.offer(window(1), 0.0)
    assert sequences(sender.due(0.0)) == [0, 1]
    assert sender.due(0.5) == []
    assert sender.acknowledged(Acknowledge("axis-1", "b0", 0))
    assert not sender.acknowledged(Acknowledge("axis-1", "b0", 0))
    assert not sender.acknowledged(Acknowledge("axis-1", "other", 1))
    assert sender.next_time == 1.0
    assert sequences(sender.due(1.0)) == [1]
    assert sender.acknowledged(Acknowledge("axis-1", "b0", 1))
    assert sender.next_time is None
    assert outbox.pending() == []


def test_a_full_outbox_drops_the_oldest_and_says_so() -> None:
    outbox = MemoryOutbox(capacity=2)
    sender = Sender(outbox)
    for k in range(5):
        sender.offer(window(k), 0.0)
    assert outbox.dropped == {FULL: 3}
    assert list(outbox.recently_dropped) == [Dropped(("b0", k), FULL) for k in range(3)]
    assert sequences(sender.due(0.0)) == [3, 4]
    with pytest.raises(KeyError):
        outbox.get(("b0", 0))


def test_what_an_outbox_still_holds_after_a_restart_is_due_at_once() -> None:
    outbox = MemoryOutbox()
    outbox.put(window(7))
    assert sequences(Sender(outbox).due(0.0)) == [7]


@given(st.integers(1, 4), st.lists(st.tuples(st.booleans(), st.integers(0, 9)), max_size=40))
def test_windows_are_conserved(capacity: int, actions: list[tuple[bool, int]]) -> None:
    outbox = MemoryOutbox(capacity)
    sender, offered, acknowledged = Sender(outbox, Retry(2.0)), 0, 0
    for now, (offer, sequence) in enumerate(actions):
        if offer:
            sender.offer(window(offered), float(now))
            offered += 1
        else:
            acknowledged += sender.acknowledged(Acknowledge("axis-1", "b0", sequence))
        sender.due(float(now))
        assert offered == acknowledged + len(outbox.pending()) + sum(outbox.dropped.values())
        assert len(outbox.pending()) <= capacity
        assert (sender.next_time is None) == (not outbox.pending())


def test_an_outbox_needs_room() -> None:
    with pytest.raises(InvalidInput, match="capacity"):
        MemoryOutbox(0)
