"""An edge and a twin of other versions: nothing is lost, and one sentence says which of the two is older."""

from math import inf

import msgspec
import pytest
from mosquitto import Mosquitto
from mqttparts import edge, parcel, refusals, twin, window

from servotwin.edge_process.twin_limits import version_trouble
from servotwin.link import mqtt
from servotwin.link.broker import Broker
from servotwin.link.outbox import MemoryOutbox
from servotwin.link.seal import TO_EDGE, TO_TWIN, key_of, seal, verifier_of
from servotwin.link.session import Receiver, Sender, Session
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import Acknowledge, Refusal, encode
from servotwin.runtime.retry import Retry
from servotwin.store.store import Store
from servotwin.twin_service import mqtt as twin_mqtt

RETRY = Retry(1.0, 2.0, 8.0)
KEY = key_of(verifier_of("secret"))


class Script:
    """A twin that answers by a script, and then takes everything."""

    def __init__(self) -> None:
        self.faults: list[Exception] = []
        self.listen_faults: list[Exception] = []
        self.news: list[bytes] = []
        self.polls: list[int] = []

    def deliver(self, _parcel: Parcel) -> float:
        if self.faults:
            raise self.faults.pop(0)
        return 0.0

    def listen(self, after: int, at_once: bool = False) -> list[bytes]:  # noqa: ARG002
        self.polls.append(after)
        if self.listen_faults:
            raise self.listen_faults.pop(0)
        return self.news

    def close(self) -> None:
        return


def test_a_window_that_an_older_twin_does_not_know_waits_and_is_named_until_it_is_taken() -> None:
    outbox, script = MemoryOutbox(servo="axis-1"), Script()
    for sequence in range(3):
        outbox.put(window(sequence))
    sender = Sender(Session(outbox, RETRY), script)
    script.faults = [Refused(Refusal.UNKNOWN_SCHEMA, "message not understood: 'window/9'")]
    assert [sender.step(0.0).window for _ in range(3)] == [None, ("b0", 1), ("b0", 2)]
    assert outbox.pending() == [("b0", 0)]
    said = version_trouble(sender.session, None)
    assert said == (
        "the twin is older than this edge and does not know a message, which waits until the twin is upgraded "
        "(unknown_schema: message not understood: 'window/9')"
    )
    assert sender.step(601.0).window == ("b0", 0)
    assert (version_trouble(sender.session, None), sender.step(601.0).wait_s) == ("", inf)


def test_a_message_that_the_twin_did_not_know_goes_again_once_the_twin_is_back() -> None:
    outbox, script = MemoryOutbox(servo="axis-1"), Script()
    outbox.put(window(0))
    session = Session(outbox, RETRY)
    sender, receiver = Sender(session, script), Receiver(script, "axis-1", "secret", 0, RETRY, lambda: 1.0)
    script.faults = [Refused(Refusal.UNKNOWN_SCHEMA, "message not understood: 'window/9'")]
    assert sender.step(0.0).window is None
    assert not receiver.step().reconnected
    script.listen_faults = [Unreachable("it restarts")]
    assert [receiver.step().reconnected for _ in range(3)] == [False, True, False]
    assert sender.step(20.0).window is None
    session.twin_is_back(20.0)
    assert sender.step(20.0).window == ("b0", 0)


def test_a_message_that_an_older_edge_does_not_know_is_named_and_later_ones_are_read() -> None:
    script = Script()
    receiver = Receiver(script, "axis-1", "secret", 0, RETRY, lambda: 1.0)
    newer = msgspec.msgpack.encode({"type": "future/1", "servo": "axis-1"})
    known = encode(Acknowledge("axis-1", "b0", 0))
    script.news = [seal(KEY, TO_EDGE, "axis-1", 1, newer)]
    assert (receiver.step().messages, receiver.trouble) == (
        [],
        "the twin is newer: this edge does not know its message",
    )
    script.news = [seal(KEY, TO_EDGE, "axis-1", serial, body) for serial, body in ((2, newer), (3, known))]
    assert receiver.step().messages == [(3, known)]
    assert (script.polls, receiver.trouble) == ([0, 1], "")
    session = Session(MemoryOutbox())
    assert version_trouble(session, receiver) == (
        "the twin is newer than this edge and has sent 2 messages that the edge does not know; upgrade the edge"
    )


@pytest.mark.slow
def test_a_request_of_a_newer_edge_over_a_broker_is_not_taken_for_one_with_another_token(
    server: Mosquitto, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = msgspec.msgpack.encode({"type": "carry/9"})
    monkeypatch.setattr(mqtt, "encode_request", lambda key, servo, serial, _: seal(key, TO_TWIN, servo, serial, newer))
    with twin(Broker(server.url), store) as running, edge(Broker(server.url)) as sender:
        for ask in (lambda: sender.deliver(parcel(0)), lambda: sender.listen(0)):
            with pytest.raises(Refused, match="unknown_schema: request not understood: "):
                ask()
        assert refusals(running) == {"unknown_schema": 2}
        assert running.wrong_tokens == []


@pytest.mark.slow
def test_an_answer_of_a_newer_twin_over_a_broker_is_named(
    server: Mosquitto, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was said not to have come."""
    newer = msgspec.msgpack.encode({"type": "refused/1", "code": "another", "detail": ""})
    monkeypatch.setattr(
        twin_mqtt, "encode_response", lambda key, servo, serial, _: seal(key, "answer to edge", servo, serial, newer)
    )
    words = "this edge does not know the twin's answer: response not understood: "
    with (
        twin(Broker(server.url), store),
        edge(Broker(server.url), timeout_s=3.0) as sender,
        pytest.raises(Unreachable, match=words),
    ):
        sender.deliver(parcel(0))
