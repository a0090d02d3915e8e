"""Sender and receiver over a scripted transport; time and chance come from the test."""

from collections.abc import Callable, Iterator
from math import inf
from pathlib import Path

import pytest
from exploration import examples
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from servotwin.link.outbox_index import AcknowledgedLimits
from servotwin.link.seal import TO_EDGE, TO_TWIN, key_of, seal, verifier_of
from servotwin.link.session import Receiver, Sender, Session
from servotwin.link.sqlite_outbox import SqliteOutbox
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import (
    Acknowledge,
    Hello,
    Refusal,
    Setting,
    Update,
    WindowMessage,
    checksum,
    encode,
    pack_channel,
)
from servotwin.runtime.retry import Retry

RETRY = Retry(1.0, 2.0, 8.0)
KEY = key_of(verifier_of("secret"))


def window(sequence: int) -> WindowMessage:
    channels = (pack_channel("position", "m", [0.0, 1e-3]),)
    return WindowMessage("axis-1", "b0", sequence, 0.0, 10.0, channels, (), 0, "", "reference", checksum(channels))


class Script:
    """A transport that answers by a script; when that is at its end everything is delivered."""

    def __init__(self) -> None:
        self.delivered: list[Parcel] = []
        self.faults: list[Exception | None] = []
        self.news: list[bytes] = []
        self.polls: list[int] = []
        self.at_once: list[bool] = []
        self.pause_s = 0.0

    def deliver(self, parcel: Parcel) -> float:
        self._fail()
        self.delivered.append(parcel)
        return self.pause_s

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:
        self.polls.append(after)
        self.at_once.append(at_once)
        self._fail()
        return self.news

    def listen_anew(self) -> None:
        """Nothing is under way."""

    def close(self) -> None:
        """Nothing is open."""

    def _fail(self) -> None:
        fault = self.faults.pop(0) if self.faults else None
        if fault is not None:
            raise fault


@pytest.fixture
def script() -> Script:
    return Script()


@pytest.fixture
def outbox(tmp_path: Path) -> Iterator[SqliteOutbox]:
    box = SqliteOutbox(tmp_path / "outbox.sqlite", "axis-1")
    yield box
    box.close()


@pytest.fixture
def sender(outbox: SqliteOutbox, script: Script) -> Sender:
    return Sender(Session(outbox, RETRY), script)


def test_letters_go_first_then_windows_in_order(sender: Sender, outbox: SqliteOutbox, script: Script) -> None:
    for k in range(2):
        outbox.put(window(k))
    outbox.put_letter(b"letter")
    assert [sender.step(0.0).window for _ in range(3)] == [None, ("b0", 0), ("b0", 1)]
    assert [parcel.is_window for parcel in script.delivered] == [False, True, True]
    assert sender.step(0.0).wait_s == inf
    assert (outbox.pending(), outbox.letters()) == ([], [])
    assert sender.session.counts == {"letters": 1, "windows": 2}


def test_where_a_backlog_takes_long_the_newest_window_goes_first_from_time_to_time(
    sender: Sender, outbox: SqliteOutbox, script: Script
) -> None:
    """Fresh settings of all follow soon after an outage of many; a backlog that goes quickly stays in order."""
    for k in range(8):
        outbox.put(window(k))
    script.faults = [Unreachable("gone")]
    assert sender.step(0.0).window is None
    sent = [sender.step(60.0 + 4.0 * n).window for n in range(4)]
    assert sent == [("b0", 0), ("b0", 1), ("b0", 2), ("b0", 7)]
    outbox.put(window(8))
    assert [sender.step(75.0 + 4.0 * n).window for n in range(3)] == [("b0", 3), ("b0", 4), ("b0", 8)]
    assert [sender.step(84.0 + 0.1 * n).window for n in range(2)] == [("b0", 5), ("b0", 6)]
    assert sender.step(85.0).wait_s == inf
    outbox.put(window(9))
    outbox.put(window(10))
    assert [sender.step(100.0 + n).window for n in range(2)] == [("b0", 9), ("b0", 10)]


def test_after_a_long_outage_the_newest_window_goes_at_once_and_older_ones_at_the_twins_pace(
    sender: Sender, outbox: SqliteOutbox, script: Script
) -> None:
    """In a large fleet the twin has said so before the outage."""
    script.pause_s = 20.0
    outbox.put(window(0))
    assert sender.step(0.0).window == ("b0", 0)
    for k in range(1, 6):
        outbox.put(window(k))
    script.faults = [Unreachable("gone")]
    assert sender.step(0.0).window is None
    assert [sender.step(60.0).window for _ in range(2)] == [("b0", 5), None]
    assert sender.step(62.0).wait_s == pytest.approx(18.0)
    outbox.put(window(6))
    outbox.put_letter(b"letter")
    assert [sender.step(70.0).window for _ in range(3)] == [None, ("b0", 6), None]
    assert [sender.step(at).window for at in (80.0, 100.0)] == [("b0", 1), ("b0", 2)]
    assert [parcel.waiting for parcel in script.delivered] == [0, 4, 0, 4, 3, 2]
    script.pause_s = 0.0
    assert [sender.step(120.0 + n).window for n in range(2)] == [("b0", k) for k in (3, 4)]
    assert sender.step(123.0).wait_s == inf


def test_a_pause_loses_no_window_of_an_earlier_boot_and_the_new_boots_do_not_wait_for_it(
    sender: Sender, outbox: SqliteOutbox, script: Script
) -> None:
    script.pause_s = 20.0
    for k in range(2):
        outbox.put(window(k))
    assert [sender.step(0.0).window for _ in range(2)] == [("b0", 0), ("b0", 1)]
    for k in range(2, 5):
        outbox.put(window(k))
    outbox.put(replace(window(0), boot="b1"))
    assert [sender.step(1.0).window for _ in range(2)] == [("b1", 0), None]
    outbox.put(replace(window(1), boot="b1"))
    assert [sender.step(2.0).window for _ in range(2)] == [("b1", 1), None]
    assert [sender.step(at).window for at in (21.0, 41.0, 61.0)] == [("b0", 2), ("b0", 3), ("b0", 4)]
    assert sender.step(61.0).wait_s == inf


def test_a_window_that_is_refused_for_a_while_does_not_hold_up_what_waits_for_the_pause(
    sender: Sender, outbox: SqliteOutbox, script: Script
) -> None:
    script.pause_s = 4.0
    for k in range(3):
        outbox.put(window(k))
    assert sender.step(0.0).window == ("b0", 0)
    script.faults = [Refused(Refusal.FUTURE, "early", 9.0)]
    assert sender.step(0.0).window is None
    assert sender.step(0.0).wait_s == pytest.approx(4.0)
    assert sender.step(4.0).window == ("b0", 1)
    assert sender.step(4.0).wait_s == pytest.approx(5.0)
    assert sender.step(9.0).window == ("b0", 2)


def test_windows_that_the_twin_asked_for_again_are_not_the_newest(tmp_path: Path, script: Script) -> None:
    box = SqliteOutbox(tmp_path / "again.sqlite", "axis-1", kept=AcknowledgedLimits(10**7, 3600.0))
    for k in range(4):
        box.put(window(k))
    box.remove(("b0", 3))
    box.resend(lambda *_: True)
    sender = Sender(Session(box, RETRY), script)
    assert (box.waiting, box.oldest()) == (4, box.pending()[0])
    assert [sender.step(11.0 * n).window for n in range(4)] == [("b0", k) for k in (0, 2, 1, 3)]
    box.close()


def test_a_window_is_sent_without_a_look_at_all_that_wait(
    sender: Sender, outbox: SqliteOutbox, script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link process took 8 ms of the processor for each of 10 000 windows after an outage."""
    for k in range(9):
        outbox.put(window(k))
    assert sender.step(0.0).window == ("b0", 0)
    looks = list[str]()
    monkeypatch.setattr(outbox, "pending", lambda: looks.append("look") or [])
    assert [sender.step(0.0).window for _ in range(3)] == [("b0", k) for k in (1, 2, 3)]
    script.pause_s = 60.0
    assert (sender.step(0.0).window, sender.session.next_time) == (("b0", 4), -inf)
    assert not looks


def test_pauses_grow_while_the_twin_is_out_of_reach(sender: Sender, outbox: SqliteOutbox, script: Script) -> None:
    outbox.put(window(0))
    script.faults = [Unreachable("gone")] * 6
    now, waits = 0.0, []
    while script.faults:
        waits.append(sender.step(now).wait_s)
        assert sender.session.trouble == "gone"
        assert sender.step(now + 0.25 * waits[-1]).wait_s == pytest.approx(0.75 * waits[-1])
        now += waits[-1]
    assert waits == [1.0, 2.0, 4.0, 8.0, 8.0, 8.0]
    sent = sender.step(now)
    assert (sent.window, sent.reconnected, sender.session.trouble) == (("b0", 0), True, "")
    outbox.put(window(1))
    assert not sender.step(now).reconnected


@pytest.mark.parametrize("reason", [reason for reason in Refusal if not reason.temporary])
def test_a_message_refused_for_good_is_dropped_and_counted(
    sender: Sender, outbox: SqliteOutbox, script: Script, reason: Refusal
) -> None:
    outbox.put(window(0))
    outbox.put(window(1))
    script.faults = [Refused(reason, "no")]
    assert sender.step(0.0).wait_s == 0.0
    assert sender.step(0.0).window == ("b0", 1)
    assert outbox.dropped == {reason.value: 1}
    outbox.put_letter(b"letter")
    script.faults = [Refused(reason, "no")]
    sender.step(0.0)
    assert outbox.letters() == []
    assert sender.session.counts[f"refused: {reason.value}"] == 2


OF_ONE = (Refusal.FUTURE, Refusal.UNKNOWN_SCHEMA)
"""Temporary refusals that concern one message only."""


@pytest.mark.parametrize("reason", [reason for reason in Refusal if reason.temporary and reason not in OF_ONE])
def test_a_message_refused_for_now_stays_in_the_outbox(
    sender: Sender, outbox: SqliteOutbox, script: Script, reason: Refusal
) -> None:
    outbox.put(window(0))
    script.faults = [Refused(reason, "not now", 5.0)]
    assert sender.step(0.0).wait_s == 5.0
    assert sender.step(5.0).window == ("b0", 0)


def test_a_window_from_the_future_holds_up_no_other(sender: Sender, outbox: SqliteOutbox, script: Script) -> None:
    outbox.put(window(0))
    outbox.put(window(1))
    script.faults = [Refused(Refusal.FUTURE, "too early")]
    sender.step(0.0)
    assert sender.step(0.0).window == ("b0", 1)
    assert sender.step(0.0).wait_s == 1.0
    assert sender.step(1.0).window == ("b0", 0)


def test_a_window_that_an_older_twin_does_not_know_waits_and_holds_up_no_other(
    sender: Sender, outbox: SqliteOutbox, script: Script
) -> None:
    outbox.put(window(0))
    outbox.put(window(1))
    script.faults = [Refused(Refusal.UNKNOWN_SCHEMA, "not known")]
    sender.step(0.0)
    assert sender.step(0.0).window == ("b0", 1)
    assert sender.step(0.0).wait_s == 600.0
    assert sender.step(600.0).window == ("b0", 0)
    assert outbox.dropped == {}


FAULTS = st.lists(
    st.sampled_from([None, Unreachable("gone"), *(Refused(reason, "no") for reason in Refusal)]), max_size=30
)


def test_a_message_that_cannot_be_read_holds_up_no_other_and_is_not_tried_without_a_pause(
    sender: Sender, outbox: SqliteOutbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox.put(window(0))
    outbox.put(window(1))
    parcel, tries = outbox.parcel, 0

    def read(key: tuple[str, int]) -> Parcel:
        nonlocal tries
        tries += key == ("b0", 0)
        if key == ("b0", 0) and tries < 3:
            raise KeyError(key)
        return parcel(key)

    monkeypatch.setattr(outbox, "parcel", read)
    assert sender.step(0.0).window is None
    assert sender.step(0.0).window == ("b0", 1)
    assert [sender.step(0.0).wait_s, sender.step(1.0).wait_s, sender.step(1.0).wait_s] == [1.0, 0.0, 2.0]
    assert sender.step(3.0).window == ("b0", 0)


@pytest.mark.slow
@examples(40, deadline=None)
@given(FAULTS, st.sampled_from((0.0, 3.0, 20.0)))
def test_every_window_is_delivered_once_or_counted(
    tmp_path_factory: pytest.TempPathFactory, faults: list[Exception | None], pause: float
) -> None:
    outbox, script = SqliteOutbox(tmp_path_factory.mktemp("box") / "o", "axis-1"), Script()
    script.pause_s = pause
    sender, now = Sender(Session(outbox, RETRY, lambda: 0.5), script), 0.0
    script.faults = list(faults)
    for k in range(5):
        outbox.put(window(k))
    while (wait := sender.step(now).wait_s) < inf:
        now += wait
    delivered = [parcel.sequence for parcel in script.delivered]
    assert len(delivered) == len(set(delivered))
    assert len(delivered) + sum(outbox.dropped.values()) == 5
    permanent = sum(isinstance(fault, Refused) and not fault.reason.temporary for fault in faults[: len(faults)])
    assert sum(outbox.dropped.values()) <= permanent
    outbox.close()


@pytest.fixture
def receiver(script: Script) -> Receiver:
    return Receiver(script, "axis-1", "secret", 0, RETRY, lambda: 1.0)


def sealed(serial: int, body: bytes | None = None, key: bytes = KEY, direction: str = TO_EDGE) -> bytes:
    return seal(key, direction, "axis-1", serial, encode(Acknowledge("axis-1", "b0", serial)) if body is None else body)


def test_messages_of_the_twin_are_received_once_and_in_order(receiver: Receiver, script: Script) -> None:
    script.news = [sealed(2), sealed(3), sealed(2), sealed(1)]
    assert [serial for serial, _ in receiver.step().messages] == [2, 3]
    script.news = [sealed(3), sealed(7)]
    assert [serial for serial, _ in receiver.step().messages] == [7]
    assert script.polls == [0, 3]
    assert receiver.counts == {"received": 3, "repeated": 3}


def test_a_message_with_a_broken_seal_is_rejected(receiver: Receiver, script: Script) -> None:
    other, good = key_of(verifier_of("other")), sealed(1)
    script.news = [sealed(9, key=other), sealed(9, direction=TO_TWIN), good[:-1] + bytes([good[-1] ^ 1]), b"rubbish"]
    received = receiver.step()
    assert (received.messages, received.wait_s) == ([], 1.0)
    assert receiver.counts["broken seal"] == 4
    script.news += [sealed(1)]
    assert [serial for serial, _ in receiver.step().messages] == [1]


def test_a_message_not_understood_or_not_for_an_edge_is_skipped(receiver: Receiver, script: Script) -> None:
    hello = encode(Hello("axis-1", "b0", 0.0, 1.0, 0, Setting(0.0), ""))
    script.news = [sealed(1, b"rubbish"), sealed(2, hello), sealed(3)]
    assert [serial for serial, _ in receiver.step().messages] == [3]
    assert receiver.counts["not understood"] == 2


def test_polls_that_fail_come_less_and_less_often(receiver: Receiver, script: Script) -> None:
    script.faults = [Unreachable("gone"), Refused(Refusal.BAD_TOKEN, "no"), Refused(Refusal.TOO_MANY, "slowly", 30.0)]
    assert [receiver.step().wait_s for _ in range(4)] == [1.0, 2.0, 30.0, 0.0]
    assert receiver.trouble == ""


def test_after_a_trouble_the_twin_is_asked_to_answer_at_once(receiver: Receiver, script: Script) -> None:
    """Otherwise the trouble would seem to last for as long as the twin has no news, up to 25 s."""
    script.faults = [None, Unreachable("gone"), Refused(Refusal.TOO_MANY, "slowly")]
    for _ in range(5):
        receiver.step()
    assert script.at_once == [False, False, True, True, False]


@given(st.binary(max_size=300))
def test_a_receiver_survives_any_bytes(data: bytes) -> None:
    script = Script()
    script.news = [data]
    assert Receiver(script, "axis-1", "secret", 0, RETRY, lambda: 1.0).step().messages == []


def test_an_update_is_handed_on_as_it_was(receiver: Receiver, script: Script) -> None:
    update = Update("axis-1", 1, 0, ("b0", 0), 0.0, None, None, (None, None), "OK", Setting(1e-4), 60.0)
    script.news = [sealed(5, encode(update))]
    assert receiver.step().messages == [(5, encode(update))]


def test_the_token_is_not_shown(receiver: Receiver, script: Script) -> None:
    shown: Callable[[object], str] = repr
    assert "secret" not in shown(receiver)
