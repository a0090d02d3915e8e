"""Between the control and the link process, without processes: frames and outlet."""

from collections.abc import Iterator

import pytest
from edge_process_parts import RATE, LinkEnd, cut, exchange_all

from servotwin.edge.parameters import Parameters
from servotwin.edge_process import frames, outlet
from servotwin.edge_process.outlet import BEHIND, PipeOutlet
from servotwin.messages import (
    Acknowledge,
    Hello,
    InvalidMessage,
    Setting,
    encode,
)


@pytest.fixture
def far() -> Iterator[LinkEnd]:
    made = LinkEnd()
    yield made
    made.close()


def test_a_cut_crosses_as_it_is() -> None:
    frame = frames.to_link(frames.encode(frames.window_frame(cut(), "b0", 5)))
    assert isinstance(frame, frames.WindowFrame)
    assert (frame.cut, frame.boot, frame.serial) == (cut(), "b0", 5)
    with pytest.raises(InvalidMessage):
        frames.to_link(b"rubbish")
    with pytest.raises(InvalidMessage):
        frames.to_control(frames.encode(frame))


def test_an_outlet_sends_unacknowledged_frames_to_the_next_link_process(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.boot = "b0"
    box.offer(cut(0))
    assert box.unacknowledged
    box.connect(far.near)
    box.send_letter(Hello("axis-1", "b0", 0.0, RATE, 0, Setting(0.0), ""))
    box.save(Parameters(3, Setting(1e-4)))
    exchange_all(box)
    assert [type(frame).__name__ for frame in far.received()] == ["WindowFrame", "LetterFrame", "SaveFrame"]
    far.send(frames.PendingFrame(1, {"outbox full": 2}), frames.AckFrame(1), frames.AckFrame(2))
    received = box.exchange()
    assert received is not None
    assert received.pending_changed
    assert box.unacknowledged
    assert box.dropped == {"outbox full": 2}
    again = LinkEnd()
    box.connect(again.near)
    exchange_all(box)
    assert [type(frame).__name__ for frame in again.received()] == ["SaveFrame"]
    assert not box.idle
    again.send(frames.AckFrame(3), frames.PendingFrame(0, {}))
    exchange_all(box)
    assert box.idle
    assert not box.unacknowledged
    again.close()


def test_a_repeated_message_of_the_twin_counts_once(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    body = encode(Acknowledge("axis-1", "b0", 0))
    far.send(
        frames.MessageFrame(4, body),
        frames.MessageFrame(0, body),
        frames.MessageFrame(4, body),
        frames.ReconnectedFrame(),
    )
    received = box.exchange()
    assert received is not None
    assert len(received.messages) == 2
    assert received.reconnected
    exchange_all(box)
    assert far.received() == [frames.ProcessedFrame(4), frames.ProcessedFrame(4)]


def test_an_outlet_is_bounded_and_disconnects_a_link_process_that_acknowledges_nothing(
    far: LinkEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outlet, "MOST", 100_000)
    box = PipeOutlet(True)
    box.connect(far.near)
    for k in range(20):
        box.offer(cut(k, 500))
    assert box.dropped[BEHIND] == 20 - 100_000 // len(frames.encode(frames.window_frame(cut(0, 500), "", 1)))
    assert not box.connected


def test_without_a_twin_no_answer_is_expected() -> None:
    box = PipeOutlet(False)
    box.offer(cut())
    assert not box.unacknowledged


def test_rubbish_from_the_link_process_breaks_the_pipe_only(far: LinkEnd) -> None:
    box = PipeOutlet(True)
    box.connect(far.near)
    far.pipe.post(b"rubbish")
    while far.pipe.backlog:
        far.pipe.send()
    assert box.exchange() is None
    assert not box.connected
