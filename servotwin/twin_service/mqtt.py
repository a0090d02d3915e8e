"""MQTT 5 end of the service: one of a group of twins among whom the broker distributes the requests of edges.

The same checks, in the same order, as over HTTP.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import NamedTuple
from uuid import uuid4

from servotwin.link.broker import Broker, Connection, MqttCallbacks, MqttSession
from servotwin.link.claim import HeldClaim
from servotwin.link.mqtt_messages import (
    REQUEST_TOPICS,
    TWIN_GONE,
    MqttRequest,
    MqttResponse,
    NotKnown,
    PollRequest,
    PollResponse,
    PutResponse,
    ReceivedRequest,
    RefusedResponse,
    decode_request,
    encode_response,
    encode_unknown_peer,
    response_topic,
    servo_of,
)
from servotwin.link.seal import key_of
from servotwin.link.transport import Unreachable
from servotwin.messages import InvalidMessage, Refusal
from servotwin.store.records import MessageKind, PutResult
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.http_edge import LongPolls, seal_messages
from servotwin.twin_service.ingest import Ingest
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.live_views import LiveIntake
from servotwin.twin_service.monitoring import Counter
from servotwin.twin_service.refusals import Refusals
from servotwin.twin_service.request_serials import RequestSerials

log = logging.getLogger(__name__)

_RETRY_AFTER_S = 1.0
"""Pause that a rejection asks of an edge while nothing can be accepted."""
_SESSION_S = 0
"""No session outlives its connection: the broker would send a share of the requests to a twin that is gone."""
_MAX_IN_FLIGHT = 1000
"""Unacknowledged requests to one twin."""
_RESPONSE_EXPIRY_S = 60.0
"""A response that is older is worthless: its edge has repeated the request."""
_MOST_HELD_BACK = 1000
"""Answers to refused requests that are held back at once; further ones are left out, since nobody waits for so many."""

_TOPIC_SHOWN, _LONGEST_DETAIL = 100, 500
"""Characters of a topic that is no servo's in the log, and of a refusal's reason: anybody on the broker may choose
65,535."""


class MqttAnswer(NamedTuple):
    """Answer to a request.

    Attributes
    ----------
    data : bytes or None
        The response; None: none is possible.
    refused : str
        Sender of a request that is refused; empty: it is not.
    """

    data: bytes | None
    refused: str = ""


class MqttRequestHandler:
    """Decodes requests of edges and makes the responses.

    Parameters
    ----------
    gate : EdgeGate
    ingest : Ingest
    polls : LongPolls
    claims : EdgeClaims
    live : LiveIntake
    wake : callable
        Wakes the dispatcher after a new message.
    refusals : Refusals
    repeated : Counter
        Of requests that came before.
    """

    def __init__(
        self,
        gate: EdgeGate,
        ingest: Ingest,
        polls: LongPolls,
        claims: EdgeClaims,
        live: LiveIntake,
        wake: Callable[[], None],
        refusals: Refusals,
        repeated: Counter,
    ) -> None:
        self._gate, self._ingest, self._polls, self._wake = gate, ingest, polls, wake
        self._claims, self._live, self._refusals = claims, live, refusals
        self._serials, self._repeated = RequestSerials(), repeated

    def decode(self, servo: str, data: bytes) -> ReceivedRequest | MqttAnswer:
        """Decode a request; where that fails, return the answer to it."""
        verifier = self._gate.find_verifier(servo)
        try:
            if verifier is None:
                raise InvalidMessage(f"servo {servo!r} has no token", Refusal.BAD_TOKEN)
            return self._decoded(key_of(verifier), servo, data)
        except InvalidMessage as error:
            too_large = error.refusal is Refusal.TOO_LARGE
            self._refusals.log(Refusal.TOO_LARGE if too_large else Refusal.BAD_TOKEN, servo, True, why=str(error))
            # Anybody on the broker may write the name of an edge, which must not slow down that edge.
            return MqttAnswer(None if too_large else encode_unknown_peer(data), f"name {servo}")

    def _decoded(self, key: bytes, servo: str, data: bytes) -> ReceivedRequest | MqttAnswer:
        """Decode a request; where its edge is of a newer version, return a refusal. Raises InvalidMessage."""
        try:
            request = decode_request(key, servo, data)
        except NotKnown as newer:
            self._refusals.log(newer.refusal, servo, True, why=str(newer))
            refused = RefusedResponse(newer.refusal, str(newer)[:_LONGEST_DETAIL])
            return MqttAnswer(encode_response(key, servo, newer.serial, refused), f"owner {servo}")
        if self._serials.is_new(servo, _run_of(request.content), request.serial):
            return request
        self._repeated.add()
        return MqttAnswer(None)  # whoever has no answer yet asks under another serial

    def refuse_topic(self, topic: str) -> None:
        """Count and log a message to a topic that is no servo's; there is nobody to answer."""
        self._refusals.log(Refusal.NOT_UNDERSTOOD, "", False, why=f"topic {topic[:_TOPIC_SHOWN]!r} is no servo's")

    async def respond(self, request: ReceivedRequest) -> MqttAnswer:
        """Handle a request; the answer has no response where its token was revoked."""
        refused = ""
        try:
            response = await self._handle(request)
        except RequestRejected as rejected:
            self._refusals.log(rejected.refusal, request.servo, True, why=rejected.detail)
            refused = f"owner {request.servo}"
            busy = rejected.refusal in (Refusal.TOO_MANY, Refusal.UNAVAILABLE)
            response = RefusedResponse(rejected.refusal, rejected.detail, _RETRY_AFTER_S if busy else 0.0)
        verifier = self._gate.find_verifier(request.servo)
        if verifier is None:
            return MqttAnswer(None, refused)
        return MqttAnswer(encode_response(key_of(verifier), request.servo, request.serial, response), refused)

    async def hold_back(self, sender: str) -> None:
        """Hold the answer to a refused request back, as over HTTP."""
        await self._refusals.hold_back(sender)

    async def _handle(self, request: ReceivedRequest) -> MqttResponse:
        servo, question = request.servo, request.content
        if isinstance(question, PollRequest) and question.live is not None:
            self._gate.admit_authenticated(servo, limited=False)
            await self._live.admit(servo, question.claim)
            return PollResponse([], watched=await self._live.take(servo, question.live, question.wait))
        if isinstance(question, PollRequest):
            self._gate.admit_authenticated_poll(servo)
            if question.question is not None:
                return PollResponse([], await self._claims.answer(servo, question.question))
            await self._claims.check(servo, question.claim)
            messages = await self._polls.messages(servo, question.after, question.wait)
            await self._claims.check(servo, question.claim)  # another edge may have taken over meanwhile
            return PollResponse(seal_messages(self._gate.verifier(servo), servo, messages))
        self._gate.admit_authenticated(servo)
        await self._claims.check(servo, question.claim)
        incoming, message = self._ingest.read(servo, question.body, question.encoding)
        if await self._ingest.commit(incoming, message) is PutResult.NEW:
            self._wake()
        is_window = incoming.kind is MessageKind.WINDOW
        return PutResponse(self._ingest.older_pause(servo, question.waiting) if is_window else 0.0)


def _run_of(request: MqttRequest) -> str:
    """Run of the edge that makes a request; empty: it does not say."""
    if isinstance(request, PollRequest) and request.question is not None:
        return request.question.run
    held = HeldClaim.from_text(request.claim)
    return "" if held is None else held.run


class MqttServer:
    """Receives requests from a broker; acknowledges each to the broker only once it is handled.

    Parameters
    ----------
    broker : Broker
    handler : MqttRequestHandler
    group : str
        Twins of one group share the requests.

    Attributes
    ----------
    trouble : str
        Why the broker is not connected; empty: it is.
    refused : str
        Why the broker delivers no answers of this twin, since it connected; empty: it does.
    """

    def __init__(self, broker: Broker, handler: MqttRequestHandler, group: str) -> None:
        self._broker, self._handler, self._group = broker, handler, group
        self._tasks: set[asyncio.Task[None]] = set()
        self._held_back = 0
        self._connection: Connection | None = None
        self.trouble = "it has not answered yet"
        self.refused = ""

    @property
    def connected(self) -> bool:
        """The broker is connected."""
        return not self.trouble

    def sentences(self) -> list[str]:
        """A sentence that says why the broker is not connected, or passes no answers on; none: it does."""
        if self.trouble:
            return [f"the MQTT broker is not connected: {self.trouble}"]
        return [f"the MQTT broker passes no answers on to edges: {self.refused}"] if self.refused else []

    async def start(self) -> None:
        """Connect, and reconnect whenever the connection is lost."""
        loop = asyncio.get_running_loop()

        # paho calls back in a thread of its own.
        def on_message(topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
            loop.call_soon_threadsafe(self._receive, topic, payload, acknowledge)

        def on_not_delivered(_number: int, why: str) -> None:
            if why:  # otherwise only the edge is away
                loop.call_soon_threadsafe(self._on_refused, why)

        session = MqttSession(
            # Another name at each start: a broker that sees a name twice ends the older connection.
            client_id=f"servotwin-{uuid4().hex}",
            topics=(f"$share/{self._group}/{REQUEST_TOPICS}",),
            session_s=_SESSION_S,
            receive=_MAX_IN_FLIGHT,
            will=TWIN_GONE,
        )
        self._connection = Connection(
            self._broker, session, MqttCallbacks(on_message, self._on_connected, self._on_lost, on_not_delivered)
        )

    async def stop(self) -> None:
        """Accept nothing more, finish the running requests, disconnect."""
        # From here on `_receive` leaves requests unacknowledged, and the broker gives them to another twin.
        connection, self._connection = self._connection, None
        while self._tasks:
            await asyncio.wait(self._tasks)
        if connection is not None:
            await asyncio.to_thread(connection.close)

    def _receive(self, topic: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        """Start handling a request, on the event loop; one that comes during a stop goes to another twin."""
        if self._connection is None:
            return
        servo = servo_of(topic)
        if servo is None:
            # Of messages that are not acknowledged the broker allows a number, and after those sends none at all.
            acknowledge()
            self._handler.refuse_topic(topic)
            return
        task = asyncio.create_task(self._serve(self._connection, servo, payload, acknowledge))
        self._tasks.add(task)
        # The loop has weak references to tasks only; the set keeps this one from being collected.
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: Connection, servo: str, payload: bytes, acknowledge: Callable[[], None]) -> None:
        request = self._handler.decode(servo, payload)
        polls = isinstance(request, ReceivedRequest) and isinstance(request.content, PollRequest)
        if polls:
            acknowledge()  # a long poll waits, and must not count as in flight meanwhile
        try:
            answer = await self._handler.respond(request) if isinstance(request, ReceivedRequest) else request
        except Exception:
            log.exception("request not answered", extra={"servo": servo})
            answer = MqttAnswer(None)
        if not polls:
            acknowledge()
        if answer.data is None or (answer.refused and not await self._has_held_back(answer.refused)):
            return
        try:
            if connection.publish(response_topic(servo), answer.data, _RESPONSE_EXPIRY_S) is None:
                log.warning("response not sent: too much waits for the broker", extra={"servo": servo})
        except Unreachable as error:
            self._on_refused(str(error))

    async def _has_held_back(self, sender: str) -> bool:
        """Hold an answer back; False: too many are held back already.

        The request is acknowledged before: of those in flight the broker allows a number.
        """
        if self._held_back >= _MOST_HELD_BACK:
            return False
        self._held_back += 1
        try:
            await self._handler.hold_back(sender)
        finally:
            self._held_back -= 1
        return True

    def _on_connected(self, _session_lost: bool) -> None:
        self.trouble = self.refused = ""
        log.info("broker connected", extra={"broker": self._broker.url, "group": self._group})

    def _on_lost(self, why: str) -> None:
        if why != self.trouble:  # each reason once: it is tried again every few seconds
            log.warning("broker lost", extra={"broker": self._broker.url, "why": why})
        self.trouble = why

    def _on_refused(self, why: str) -> None:
        if why != self.refused:  # once: it concerns every answer
            log.warning("broker refuses answers", extra={"broker": self._broker.url, "why": why})
        self.refused = why
