"""Refused requests over MQTT: who counts as their sender, and what holding an answer back must not hold up."""

import asyncio
from itertools import count
from typing import Any

import pytest
from mqttparts import TOKENS, VERIFIERS

from servotwin.link import mqtt_messages as wire
from servotwin.link.broker import Broker
from servotwin.link.seal import key_of, verifier_of
from servotwin.messages import Refusal
from servotwin.twin_service import mqtt, refusals
from servotwin.twin_service.auth import AccessControl, EdgeGate
from servotwin.twin_service.limits import RateLimiter, RequestRejected
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.mqtt import MqttRequestHandler, MqttServer
from servotwin.twin_service.refusals import Refusals

SERIALS = count()


class Rejecting:
    """Ingest that refuses whatever it is given."""

    def read(self, *_: Any) -> None:
        raise RequestRejected(Refusal.NOT_UNDERSTOOD, "no window")


class Unclaimed:
    """Claims of edges, none of which is superseded."""

    async def check(self, *_: Any) -> None:
        return


class NotingConnection:
    """Connection to a broker that notes what is published."""

    def __init__(self) -> None:
        self.published: list[bytes] = []

    def publish(self, _topic: str, data: bytes, _expiry: float) -> int:
        self.published.append(data)
        return 1

    def close(self) -> None:
        return


@pytest.fixture
def released(monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """Ends the pauses of all answers that are held back."""
    event = asyncio.Event()

    async def sleep(_seconds: float) -> None:
        await event.wait()

    monkeypatch.setattr(refusals.asyncio, "sleep", sleep)
    return event


def server(metrics: Metrics) -> tuple[MqttServer, NotingConnection]:
    limiter = RateLimiter(1e6, 1e6, lambda: 0.0)
    gate = EdgeGate(AccessControl(VERIFIERS), lambda _: True, limiter, limiter)
    parts: Any = gate, Rejecting(), None, Unclaimed(), None, lambda: None
    handler = MqttRequestHandler(*parts, Refusals(metrics, monotonic=lambda: 0.0), metrics.repeated)
    made = MqttServer(Broker("mqtt://127.0.0.1"), handler, "twins")
    connection: Any = NotingConnection()
    made._connection = connection
    return made, connection


def request(servo: str, token: str) -> bytes:
    content = wire.PutRequest(b"no window")
    return wire.encode_request(key_of(verifier_of(token)), servo, next(SERIALS), content)


async def settle() -> None:
    for _ in range(50):
        await asyncio.get_running_loop().run_in_executor(None, lambda: None)


def test_a_flood_holds_up_neither_the_broker_nor_an_honest_edge(released: asyncio.Event) -> None:
    async def body() -> None:
        metrics, acknowledged = Metrics(), list[str]()
        there, noted = server(metrics)
        flood, honest = request("axis-1", "guess"), request("axis-1", TOKENS["axis-1"])
        for _ in range(150):
            there._receive(wire.request_topic("axis-1"), flood, lambda: acknowledged.append("flood"))
        await settle()
        assert (len(acknowledged), len(noted.published)) == (150, 100)
        # Whoever floods in the name of an edge does not slow down that edge, refused though it is.
        there._receive(wire.request_topic("axis-1"), honest, lambda: acknowledged.append("edge"))
        await settle()
        assert (acknowledged[-1], len(noted.published)) == ("edge", 101)
        assert +metrics.rejected.values == {("bad_token",): 150, ("not_understood",): 1}
        released.set()
        await there.stop()
        assert len(noted.published) == 151

    asyncio.run(body())


def test_messages_to_topics_of_no_servo_leave_the_broker_room_for_those_of_edges(released: asyncio.Event) -> None:
    async def body() -> None:
        metrics, acknowledged = Metrics(), list[str]()
        there, noted = server(metrics)
        for name in ("bad name", "", "x" * 65, "x" * 60000):
            there._receive(wire.request_topic(name), b"x", lambda: acknowledged.append("stranger"))
        await settle()
        assert (len(acknowledged), noted.published) == (4, []), "the broker stops after 1000 without acknowledgement"
        assert +metrics.rejected.values == {("not_understood",): 4}
        await there.stop()

    asyncio.run(body())


def test_an_edge_that_repeats_what_is_refused_is_slowed_down_by_itself(released: asyncio.Event) -> None:
    async def body() -> None:
        there, noted = server(Metrics())
        for servo, number, answered in (("axis-1", 120, 100), ("axis-2", 1, 101)):
            for _ in range(number):
                there._receive(wire.request_topic(servo), request(servo, TOKENS[servo]), lambda: None)
            await settle()
            assert len(noted.published) == answered
        released.set()
        await there.stop()

    asyncio.run(body())


def test_answers_that_are_held_back_are_bounded(released: asyncio.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "_MOST_HELD_BACK", 7)

    async def body() -> None:
        there, noted = server(Metrics())
        acknowledged = list[int]()
        for _ in range(150):
            there._receive(wire.request_topic("axis-1"), request("axis-1", "guess"), lambda: acknowledged.append(1))
        await settle()
        assert (there._held_back, len(acknowledged)) == (7, 150)
        released.set()
        await there.stop()
        assert len(noted.published) == 107

    asyncio.run(body())
