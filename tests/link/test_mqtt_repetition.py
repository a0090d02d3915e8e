"""Requests over a broker that are sent again or replayed, and what comes late of their copies."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from mosquitto import Mosquitto
from mqttparts import PATIENCE, edge, kept, parcel, refusals, twin
from mqttrelay import MqttRelay
from waiting import until

from servotwin.link import mqtt, round_trip
from servotwin.link import mqtt_messages as wire
from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.mqtt import MqttTransport
from servotwin.link.seal import key_of, verifier_of
from servotwin.store.store import Store


@pytest.mark.slow
@pytest.mark.parametrize("way", ["up", "down"])
def test_a_request_or_an_answer_that_is_lost_on_the_way_is_repeated_before_its_time_is_over(
    server: Mosquitto, store: Store, way: str
) -> None:
    with (
        MqttRelay(server.port, lambda each, number: each == way and number % 2 == 0) as relay,
        twin(Broker(server.url), store) as there,
        edge(Broker(f"mqtt://127.0.0.1:{relay.port}"), timeout_s=PATIENCE) as here,
    ):
        for number in range(2):
            here.deliver(parcel(number))
        assert relay.counts["lost"] >= 2
    assert kept(store) == [0, 1]
    assert there.metrics.stored.values[("window", "new")] == 2


@pytest.mark.slow
def test_answers_that_are_lost_for_ever_do_not_use_up_what_the_broker_allows(
    server: Mosquitto, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(round_trip, "SHORTEST_S", 0.02)
    session = MqttSession("any", (), 0)
    with (
        MqttRelay(server.port, lambda way, number: way == "down" and number % 2 == 0) as relay,
        twin(Broker(server.url), store),
        edge(Broker(f"mqtt://127.0.0.1:{relay.port}"), timeout_s=PATIENCE) as here,
    ):
        for number in range(session.receive + 10):
            here.deliver(parcel(number))
        assert relay.counts["lost"] > session.receive
    assert kept(store) == list(range(session.receive + 10))


class NumberedConnection:
    """Connection whose only number is 7, as numbers come again after 65535 messages; its twin answers after 0.1 s."""

    def __init__(self, _broker: Broker, _session: MqttSession, events: MqttCallbacks) -> None:
        self.events = events
        events.ready(True)

    def publish(self, _topic: str, payload: bytes, _expiry_s: float) -> int:
        key = key_of(verifier_of("token"))
        serial = wire.decode_request(key, "ax-1", payload).serial
        answer = wire.encode_response(key, "ax-1", serial, wire.PutResponse())
        threading.Timer(0.1, self.events.message, (wire.response_topic("ax-1"), answer, lambda: None)).start()
        return 7

    def close(self) -> None:
        """Close nothing."""


def test_a_late_report_of_a_copy_that_nobody_waits_for_says_nothing_of_a_later_request_with_its_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = list[NumberedConnection]()

    def connection(*given: Any) -> NumberedConnection:
        made.append(NumberedConnection(*given))
        return made[0]

    monkeypatch.setattr(mqtt, "Connection", connection)
    link = MqttTransport(Broker("mqtt://127.0.0.1"), "ax-1", "token")
    link.deliver(parcel(0))
    made[0].events.not_delivered(7, "")
    link.deliver(parcel(1))
    link.close()


def test_polls_that_somebody_replays_hold_nothing(server: Mosquitto, store: Store) -> None:
    """They would use up the polls of their servo, and its rate: who reads the broker's topics needs no token."""
    recorded, ready, times = list[bytes](), threading.Event(), 30

    def record(_topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        acknowledge()
        recorded.append(payload)

    callbacks = MqttCallbacks(record, lambda _: ready.set(), lambda _: None)
    topic, heard = wire.request_topic("axis-1"), list[list[bytes]]()
    intruder = Connection(Broker(server.url), MqttSession("intruder", (topic,), 0), callbacks)
    try:
        assert ready.wait(PATIENCE)
        with twin(Broker(server.url), store) as there, edge(Broker(server.url), wait_s=25.0) as here:
            here.deliver(parcel(0))
            poll = threading.Thread(target=lambda: heard.append(here.listen(0)))
            poll.start()
            until(lambda: len(recorded) == 2 and there.polls.open == 1)
            for _ in range(times):
                for payload in recorded[:2]:
                    assert intruder.publish(topic, payload, 60.0) is not None
            until(lambda: there.metrics.repeated.values[()] == 2 * times)
            assert there.polls.open == 1
            there.post("axis-1", b"update")
            poll.join(PATIENCE)
            assert [len(messages) for messages in heard] == [1]
            assert refusals(there) == {}
    finally:
        intruder.close()
