"""Both ends of the link over MQTT, without the rest of edge and twin, for its tests."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mosquitto import Mosquitto

from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.mqtt import MqttTransport
from servotwin.link.seal import verifier_of
from servotwin.link.transport import Parcel, Unreachable
from servotwin.messages import WindowMessage, checksum, encode, pack_channel
from servotwin.messages.codec import deflated
from servotwin.store.group_commit import AwaitedCommits, GroupCommit
from servotwin.store.records import OutgoingMessage, WorkResult
from servotwin.store.store import Store
from servotwin.twin_service.auth import AccessControl, EdgeGate, Verifiers
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.http_edge import LongPolls
from servotwin.twin_service.ingest import Clocks, Ingest
from servotwin.twin_service.limits import RateLimiter, SampleTimeLimiter
from servotwin.twin_service.live_views import LiveIntake, LiveViews
from servotwin.twin_service.monitoring import Metrics
from servotwin.twin_service.mqtt import MqttRequestHandler, MqttServer
from servotwin.twin_service.refusals import Refusals
from servotwin.twin_service.store_executor import StoreExecutor

CHANNEL = pack_channel("position", "m", [(k // 50) * 1e-6 for k in range(500)])
SERVOS = ("axis-1", "axis-2")
TOKENS = {servo: f"token of {servo}" for servo in SERVOS}
VERIFIERS = Verifiers({servo: verifier_of(token) for servo, token in TOKENS.items()})
PATIENCE = 60.0


def window(sequence: int, servo: str = "axis-1") -> WindowMessage:
    return WindowMessage(servo, "b0", sequence, 0.0, 10.0, (CHANNEL,), (), 0, "", "reference", checksum((CHANNEL,)))


def parcel(sequence: int, servo: str = "axis-1") -> Parcel:
    return Parcel(servo, *deflated(encode(window(sequence, servo))), "b0", sequence)


class Twin:
    """The service without HTTP and without estimation, on a thread of its own."""

    def __init__(self, at: Broker, store: Store) -> None:
        self.metrics, self.store, self.wrong_tokens = Metrics(), store, list[str]()
        self.commits = GroupCommit(store)
        self._broker, self._began, self._thread = at, threading.Event(), threading.Thread(target=self._run)
        self._thread.start()
        assert self._began.wait(PATIENCE)

    def post(self, servo: str, body: bytes) -> None:
        """Post messages, as a worker's result does."""
        (claim,) = (each for each in self.store.lease("test", 10, 60.0, 0.0) if each.servo == servo)
        done = tuple(message.id for message in claim.messages)
        assert self.store.commit([WorkResult(servo, claim.serial, b"state", None, done, outgoing=(body,))], 0.0) == [
            True
        ]
        self._loop.call_soon_threadsafe(self.polls.notify, servo)

    def look(self, servo: str) -> dict[str, Any]:
        """As a page asks for the live view."""

        async def asked() -> dict[str, Any]:
            return self.views.look(servo, 0, 0)

        return asyncio.run_coroutine_threadsafe(asked(), self._loop).result(PATIENCE)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(PATIENCE)
        self.commits.close()

    def _run(self) -> None:
        asyncio.run(self._main())

    async def _main(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self.polls = LongPolls(self._posted, 100, shared=True)
        known = SERVOS.__contains__
        limits = SampleTimeLimiter(1.0, 1e9)
        ingest = Ingest(AwaitedCommits(self.commits).put, known, limits, self.metrics)
        limiter = RateLimiter(1e6, 1e6, self._loop.time)
        gate = EdgeGate(AccessControl(VERIFIERS), known, limiter, limiter)
        executor = StoreExecutor()
        claims = EdgeClaims(
            self.store, executor, self.polls.evict, self.metrics, Clocks(), True, "test", lambda *_: None
        )
        self.views = LiveViews(self._loop.time, lambda _: None, 5, 5)
        live = LiveIntake(claims, self.views, self._loop.time)
        refused = Refusals(self.metrics, self.wrong_tokens.append)
        handler = MqttRequestHandler(
            gate, ingest, self.polls, claims, live, lambda: None, refused, self.metrics.repeated
        )
        server = MqttServer(self._broker, handler, "twins")
        await server.start()
        while not server.connected:
            await asyncio.sleep(0.01)
        self._began.set()
        await self._stop.wait()
        self.polls.close()
        await server.stop()
        executor.close()

    async def _posted(self, servo: str, serial: int) -> list[OutgoingMessage]:
        return list(await asyncio.to_thread(self.store.outgoing, servo, serial))


@contextmanager
def twin(at: Broker, store: Store) -> Iterator[Twin]:
    running = Twin(at, store)
    try:
        yield running
    finally:
        running.close()


@contextmanager
def edge(at: Broker, servo: str = "axis-1", token: str | None = None, **times: Any) -> Iterator[MqttTransport]:
    options = {"timeout_s": 10.0, "wait_s": 5.0} | times
    transport = MqttTransport(at, servo, TOKENS[servo] if token is None else token, **options)
    try:
        yield transport
    finally:
        transport.close()


def insist(deliver: Callable[[], None]) -> int:
    """As an outbox does: again and again; how often it took."""
    for times in range(1, 100):
        try:
            deliver()
        except Unreachable:
            continue
        return times
    raise AssertionError("never delivered")


def kept(store: Store, servo: str = "axis-1") -> list[int]:
    """Sequences of the windows in the store."""
    return sorted(held.sequence for held in store.windows(servo, 10_000))


def refusals(running: Twin) -> dict[str, int]:
    return {code: number for (code,), number in running.metrics.rejected.values.items() if number}


def raw(server: Mosquitto, topic: str, payload: bytes) -> None:
    """Publish as anybody may."""
    arrived, ready = threading.Event(), threading.Event()

    def message(_topic: str, _payload: bytes, acknowledge: Callable[[], None]) -> None:
        acknowledge()
        arrived.set()

    events = MqttCallbacks(message, lambda _: ready.set(), lambda _: None)
    subscription = MqttSession("anybody", (topic.replace("servotwin/bad name/up", "servotwin/+/up"),), 0)
    connection = Connection(Broker(server.url), subscription, events)
    try:
        assert ready.wait(PATIENCE)
        assert connection.publish(topic, payload, 60.0) is not None
        assert arrived.wait(PATIENCE)
    finally:
        connection.close()
