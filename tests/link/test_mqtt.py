"""The link over MQTT with a real broker: exactly once, whatever dies; nobody speaks for another's servo."""

import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mosquitto import Mosquitto, free_port
from mqttparts import PATIENCE, SERVOS, TOKENS, edge, insist, kept, parcel, raw, refusals, twin
from relay import Relay, State, Weather
from waiting import until

from servotwin.link import mqtt_messages as wire
from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.claim import ExclusiveTransport, HeldClaim
from servotwin.link.mqtt import LiveMqtt
from servotwin.link.seal import TO_EDGE, TO_TWIN, key_of, opened, seal, verifier_of
from servotwin.link.transport import Parcel, Refused, Unreachable
from servotwin.messages import MAX_BYTES, Hello, InvalidMessage, Refusal, Setting, encode
from servotwin.messages.live import LiveColumns
from servotwin.store.store import Store


def test_windows_letters_and_messages_go_both_ways(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there, edge(at, wait_s=20.0) as here, ThreadPoolExecutor(1) as pool:
        here.deliver(parcel(0))
        here.deliver(parcel(0))
        here.deliver(Parcel("axis-1", encode(Hello("axis-1", "b0", 0.0, 10.0, 0, Setting(0.0), ""))))
        assert kept(store) == [0]
        polled = pool.submit(here.listen, 0)
        there.post("axis-1", b"first")
        (sealed,) = polled.result(PATIENCE)
        found = opened(key_of(verifier_of(TOKENS["axis-1"])), TO_EDGE, "axis-1", sealed, 100)
        assert (found.serial, found.body) == (1, b"first")
        assert here.listen(0) == [sealed]
        assert there.metrics.stored.values == {("window", "new"): 1, ("window", "known"): 1, ("letter", "new"): 1}


def test_a_poll_without_news_ends_empty(server: Mosquitto, store: Store) -> None:
    with twin(Broker(server.url), store), edge(Broker(server.url), wait_s=0.1) as here:
        assert here.listen(0) == []


def test_small_packets_leave_at_once(server: Mosquitto, store: Store) -> None:
    """Without TCP_NODELAY a window takes 88 ms there and back on one machine."""
    with edge(Broker(server.url)) as here:
        here._ready.wait(PATIENCE)
        assert here._connection._client.socket().getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


@pytest.mark.slow
def test_two_twins_share_what_edges_send(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as one, twin(at, store) as other, edge(at) as first, edge(at, "axis-2") as second:
        for k in range(20):
            first.deliver(parcel(k))
            second.deliver(parcel(k, "axis-2"))
        taken = [sum(each.metrics.stored.values.values()) for each in (one, other)]
        assert sum(taken) == 40
        assert min(taken) > 0
        assert kept(store) == kept(store, "axis-2") == list(range(20))


@pytest.mark.slow
def test_a_broker_killed_again_and_again_loses_nothing(
    server: Mosquitto, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    at = Broker(server.url)
    with twin(at, store), edge(at, timeout_s=3.0) as here:
        tries = 0
        for k in range(60):
            if k in (20, 40):
                server.kill()
                server.start()
            tries += insist(lambda k=k: here.deliver(parcel(k)))
        assert kept(store) == list(range(60))
    assert {"broker connected", "broker lost"} <= set(caplog.messages)


def test_a_twin_that_begins_late_gets_all(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with edge(at, timeout_s=0.5) as here:
        with pytest.raises(Unreachable, match="no twin listens"):
            here.deliver(parcel(0))
        with twin(at, store):
            insist(lambda: here.deliver(parcel(0)))
        assert kept(store) == [0]


@pytest.mark.slow
def test_a_poll_outlives_a_cut_connection(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there, Relay(server.port) as relay:
        away = Broker(f"mqtt://127.0.0.1:{relay.port}")
        with edge(away, wait_s=20.0) as here, ThreadPoolExecutor(1) as pool:
            here.deliver(parcel(0))
            polled = pool.submit(here.listen, 0)
            relay.cut()
            there.post("axis-1", b"news")
            assert len(polled.result(PATIENCE)) == 1


@pytest.mark.slow
def test_a_delayed_and_cut_line_stores_each_window_once(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store), Relay(server.port, Weather((0.0, 0.05), (0.5, 1.5)), seed=5) as relay:
        with edge(Broker(f"mqtt://127.0.0.1:{relay.port}"), timeout_s=2.0) as here:
            for k in range(30):
                insist(lambda k=k: here.deliver(parcel(k)))
        assert relay.counts["cut"] > 0
    assert kept(store) == list(range(30))


@pytest.mark.slow
def test_news_that_a_twin_is_gone_ends_a_poll(server: Mosquitto, store: Store) -> None:
    """A twin's connection that breaks without a good-bye, as when it is killed."""
    at = Broker(server.url)
    with (
        Relay(server.port) as relay,
        twin(Broker(f"mqtt://127.0.0.1:{relay.port}"), store) as there,
        edge(at, wait_s=30.0, timeout_s=PATIENCE) as here,
        ThreadPoolExecutor(1) as pool,
    ):
        here.deliver(parcel(0))
        polled = pool.submit(here.listen, 0)
        until(lambda: there.polls.waiting)  # otherwise no twin is there to ask
        relay.become(State.DOWN)
        with pytest.raises(Unreachable, match="gone"):
            polled.result(PATIENCE)


def test_another_servos_token_speaks_for_nobody_else(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there:
        for token in (TOKENS["axis-2"], "guess", ""):
            with edge(at, "axis-1", token) as here, pytest.raises(Refused, match="bad_token") as refused:
                here.deliver(parcel(0))
            assert refused.value.reason.temporary
        assert refusals(there) == {"bad_token": 3}
        assert len(there.wrong_tokens) == 3
    assert kept(store) == []


def test_a_window_of_another_servo_is_refused(server: Mosquitto, store: Store) -> None:
    with twin(Broker(server.url), store) as there, edge(Broker(server.url)) as here:
        for wrong, code in ((parcel(0, "axis-2"), "other_name"), (Parcel("axis-1", b"\xc1"), "not_understood")):
            with pytest.raises(Refused, match=code):
                here.deliver(wrong)
        with pytest.raises(Refused, match="not_understood"):
            here.deliver(parcel(0)._replace(encoding="gzip"))
        assert refusals(there) == {"other_name": 1, "not_understood": 2}
    assert kept(store) == kept(store, "axis-2") == []


@pytest.mark.slow
def test_too_large_a_message_is_refused_before_it_is_sent_or_parsed(server: Mosquitto, store: Store) -> None:
    big = bytes(MAX_BYTES + 1)
    with twin(Broker(server.url), store) as there, edge(Broker(server.url), timeout_s=2.0) as here:
        with pytest.raises(Refused, match="too_large"):
            here.deliver(Parcel("axis-1", big))
        raw(server, wire.request_topic("axis-1"), bytes(2 * MAX_BYTES))
        here.deliver(parcel(0))
        assert refusals(there) == {"too_large": 1}


def test_bytes_that_are_no_request_are_counted_and_the_rest_goes_on(server: Mosquitto, store: Store) -> None:
    key = key_of(verifier_of(TOKENS["axis-1"]))
    good = wire.encode_request(key, "axis-1", 5, wire.PollRequest(0, 0.0))
    bad = [
        b"",
        b"\x00",
        b"nonsense",
        good[:-1],
        good[:-1] + bytes([good[-1] ^ 1]),
        seal(key, TO_TWIN, "axis-1", 1, b""),
    ]
    with twin(Broker(server.url), store) as there, edge(Broker(server.url)) as here:
        for payload in bad:
            raw(server, wire.request_topic("axis-1"), payload)
        raw(server, wire.request_topic("axis-9"), good)
        raw(server, "servotwin/bad name/up", good)
        here.deliver(parcel(0))
        assert refusals(there) == {"bad_token": len(bad), "unknown_schema": 1, "not_understood": 1}


def test_answers_are_taken_from_the_twin_only(server: Mosquitto, store: Store) -> None:
    """Whoever may publish to the edge's topic cannot acknowledge a window."""
    key = key_of(verifier_of("another token"))
    forged = [b"", b"\x00" * 100] + [
        wire.encode_response(key, "axis-1", serial, wire.PutResponse()) for serial in range(3)
    ]
    with edge(Broker(server.url), timeout_s=1.0) as here:
        for payload in forged:
            raw(server, wire.response_topic("axis-1"), payload)
        with pytest.raises(Unreachable, match="no twin listens"):
            here.deliver(parcel(0))


@pytest.mark.slow
@pytest.mark.parametrize("way", [wire.request_topic, wire.response_topic])
def test_a_broker_that_swaps_its_clients_topics_loses_nothing_and_brings_no_update_to_the_wrong_edge(
    server: Mosquitto, store: Store, monkeypatch: pytest.MonkeyPatch, way: Callable[[str], str]
) -> None:
    """It gives what one edge sends in the other's name, or the twin's answers to the other edge."""
    swapped, publish = dict[str, str](), Connection.publish

    def astray(connection: Connection, topic: str, *rest: Any) -> int | None:
        return publish(connection, swapped.get(topic, topic), *rest)

    monkeypatch.setattr(Connection, "publish", astray)
    with twin(Broker(server.url), store) as there, ExitStack() as stack:
        edges = (edge(Broker(server.url), each, timeout_s=1.0, wait_s=0.1) for each in SERVOS)
        first, second = map(stack.enter_context, edges)
        first.deliver(parcel(0))
        there.post("axis-1", b"update")
        swapped.update({way("axis-1"): way("axis-2"), way("axis-2"): way("axis-1")})
        for here, servo in ((first, "axis-1"), (second, "axis-2")):
            with pytest.raises((Refused, Unreachable)) as failed:
                here.deliver(parcel(1, servo))
            assert not isinstance(failed.value, Refused) or failed.value.reason.temporary
        with pytest.raises((Refused, Unreachable)):
            second.listen(0)
        assert bool(refusals(there)) == (way is wire.request_topic)
        swapped.clear()
        first.deliver(parcel(1))
        second.deliver(parcel(1, "axis-2"))
        assert len(first.listen(0)) == 1
        assert second.listen(0) == []
    assert (kept(store), kept(store, "axis-2")) == ([0, 1], [1])


def test_a_twin_that_does_not_answer_is_not_waited_for_for_ever(server: Mosquitto) -> None:
    session = MqttSession("deaf", (wire.REQUEST_TOPICS,), 0)
    ready = threading.Event()
    deaf = Connection(
        Broker(server.url), session, MqttCallbacks(lambda *_: None, lambda _: ready.set(), lambda _: None)
    )
    with edge(Broker(server.url), timeout_s=0.3) as here:
        assert ready.wait(PATIENCE)
        with pytest.raises(Unreachable, match=r"no answer of a twin within 0\.3 s"):
            here.deliver(parcel(0))
    deaf.close()


def test_a_response_belongs_to_its_request() -> None:
    key = key_of(verifier_of("token"))
    data = wire.encode_response(key, "axis-1", 7, wire.RefusedResponse(Refusal.CONFLICT, "Another one is kept."))
    assert wire.decode_response(key, "axis-1", data) == (
        7,
        wire.RefusedResponse(Refusal.CONFLICT, "Another one is kept."),
    )
    for foreign in ((key, "axis-2"), (key_of(verifier_of("other")), "axis-1")):
        with pytest.raises(InvalidMessage):
            wire.decode_response(*foreign, data)
    with pytest.raises(InvalidMessage):
        wire.decode_request(key, "axis-1", data)


@given(st.binary(max_size=200))
def test_bytes_from_a_broker_never_do_more_than_be_refused(data: bytes) -> None:
    key = key_of(verifier_of("token"))
    for read in (
        lambda: wire.decode_request(key, "axis-1", data),
        lambda: wire.decode_response(key, "axis-1", data),
    ):
        with suppress(InvalidMessage):
            assert not isinstance(read(), wire.ReceivedRequest)
    assert wire.encode_unknown_peer(data) is None or len(data) > 32


def test_closing_ends_requests_under_way(server: Mosquitto) -> None:
    with edge(Broker(server.url), timeout_s=PATIENCE) as here, ThreadPoolExecutor(1) as pool:
        delivered = pool.submit(here.deliver, parcel(0))
        here.close()
        with pytest.raises(Unreachable):
            delivered.result(PATIENCE)
        with pytest.raises(Unreachable, match="closed"):
            here.listen(0)


@pytest.mark.slow
def test_without_a_broker_the_twin_is_unreachable() -> None:
    with edge(Broker(f"mqtt://127.0.0.1:{free_port()}"), timeout_s=0.5) as here, pytest.raises(Unreachable):
        here.deliver(parcel(0))


@pytest.mark.slow
def test_a_second_edge_of_a_servo_takes_over_over_a_broker_too(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there, edge(at, run="b1-aa") as first, edge(at, run="b1-bb") as second:
        older = ExclusiveTransport(first, "axis-1", HeldClaim("b1-aa"))
        newer = ExclusiveTransport(second, "axis-1", HeldClaim("b1-bb"))
        older.deliver(parcel(0))
        newer.deliver(parcel(1))
        for _ in range(2):
            with pytest.raises(Refused, match="another edge of this servo"):
                older.deliver(parcel(2))
            newer.deliver(parcel(3))
        assert newer.listen(0) == []
        assert kept(store) == [0, 1, 3]
        assert [(event.kind, event.status[:8]) for event in store.events("axis-1")] == [("alarm", "conflict")]
        assert refusals(there)["superseded"] >= 2


@contextmanager
def live_edge(at: Broker, token: str = TOKENS["axis-1"]) -> Iterator[LiveMqtt]:
    link = LiveMqtt(at, "axis-1", token, timeout_s=20.0, wait_s=20.0, run="run")
    try:
        yield link
    finally:
        link.close()


COLUMNS = LiveColumns("axis-1", 1, 0, 0.1, ((-1e-3, 1e-3, -1e-4, 1e-4, -2.0, 3.0),))


def test_a_live_view_waits_for_a_page_and_streams_over_a_broker_too(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there, edge(at) as here, live_edge(at) as live, ThreadPoolExecutor(1) as pool:
        assert not live.send(COLUMNS, HeldClaim())  # nobody looks: they are dropped
        waiting = pool.submit(live.send, LiveColumns("axis-1"), HeldClaim())
        here.deliver(parcel(0))  # windows pass while it waits
        assert there.look("axis-1")["columns"] == []
        assert waiting.result(PATIENCE)
        assert live.send(COLUMNS, HeldClaim())
        shown = there.look("axis-1")
        assert shown["state"] == "live"
        assert shown["columns"] == list(COLUMNS.columns)
        with pytest.raises(Refused) as refused:
            live.send(LiveColumns("axis-2"), HeldClaim())
        assert refused.value.reason is Refusal.OTHER_NAME
    assert kept(store) == [0]


def test_a_live_view_over_a_broker_needs_the_servos_token(server: Mosquitto, store: Store) -> None:
    at = Broker(server.url)
    with twin(at, store) as there, live_edge(at, TOKENS["axis-2"]) as live:
        there.look("axis-1")
        with pytest.raises(Refused) as refused:
            live.send(COLUMNS, HeldClaim())
        assert refused.value.reason is Refusal.BAD_TOKEN
        assert there.look("axis-1")["columns"] == []


def test_a_twin_of_an_earlier_version_has_no_live_view_over_a_broker(server: Mosquitto, store: Store) -> None:
    """It ignores the columns, as it does not know them, and answers a poll."""
    at = Broker(server.url)
    with twin(at, store) as there, live_edge(at) as live:
        there.look("axis-1")
        with pytest.MonkeyPatch.context() as patched:
            older = msgspec.msgpack.Decoder(wire.PutRequest | OlderPoll)
            patched.setattr(wire, "_request_decoder", older)
            patched.setattr("servotwin.twin_service.mqtt.PollRequest", OlderPoll)
            with pytest.raises(Refused) as refused:
                live.send(COLUMNS, HeldClaim())
    assert refused.value.reason is Refusal.UNKNOWN_SCHEMA


class OlderPoll(msgspec.Struct, frozen=True, tag="listen/1"):
    """A poll as versions without live views over a broker knew it."""

    after: int
    wait: float
    claim: str = ""
    question: None = None
    live = None
