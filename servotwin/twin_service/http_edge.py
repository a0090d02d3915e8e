"""HTTP API of the edges: windows and letters in, sealed messages out by long poll: sent as soon as there is one."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from servotwin import __version__
from servotwin.link.http import OLDER_PAUSE
from servotwin.link.seal import TO_EDGE, key_of, seal
from servotwin.messages import PROTOCOL, EdgeClaim, Refusal, encode
from servotwin.store.engine import StoreUnavailable
from servotwin.store.records import OutgoingMessage, PutResult
from servotwin.twin_service.auth import EdgeGate
from servotwin.twin_service.claims import EdgeClaims
from servotwin.twin_service.http_app import HttpRoute
from servotwin.twin_service.http_messages import HttpRequest, HttpResponse, json_response, msgpack_response
from servotwin.twin_service.http_server import BodyReader
from servotwin.twin_service.ingest import Ingest, acknowledgement
from servotwin.twin_service.limits import RequestRejected
from servotwin.twin_service.openapi import (
    BOOT,
    CLAIM,
    ENCODING,
    INTEGER,
    JSON,
    MESSAGE_ERRORS,
    MSGPACK,
    SECONDS,
    SEQUENCE,
    SERVO,
    WAITING,
    operation,
    parameter,
)
from servotwin.twin_service.store_executor import unavailable

Read = Callable[[str, int], Awaitable[Sequence[OutgoingMessage]]]
"""(servo, serial) -> messages with higher serials, rising."""
MAX_WAIT_S = 30.0
"""s that an edge may wait."""
REFUSED_POLL_S = 1.0
"""s that the refusal of a poll takes."""


class LongPolls:
    """Polls of edges that wait for messages.

    Parameters
    ----------
    read : callable
        Reads the store without blocking the event loop.
    limit, per_servo : int
        Polls that may wait at once, in all and of one servo.
    shared : bool
        Other processes post messages too: the caller has to read from the store the newest serials of the servos in
        `waiting` and give them to `notify_serials`.

    Attributes
    ----------
    open : int
        Polls that are being served.
    """

    def __init__(self, read: Read, limit: int, shared: bool = False, per_servo: int | None = None) -> None:
        self._read, self._limit, self._shared = read, limit, shared
        self._per_servo, self._open_of = limit if per_servo is None else per_servo, Counter[str]()
        self._waiting: dict[str, dict[asyncio.Future[None], int]] = {}
        self._notifications: Counter[str] = Counter()
        self._empty_after: dict[str, int] = {}
        self._evictions: Counter[str] = Counter()
        self._closed = False
        self.open = 0

    def notify(self, servo: str) -> None:
        """Wake the polls of a servo: it has a new message."""
        self._notifications[servo] += 1
        self._empty_after.pop(servo, None)
        for waiting in self._waiting.pop(servo, ()):
            if not waiting.done():
                waiting.set_result(None)

    def evict(self, servo: str) -> None:
        """End the polls of a servo now, without messages."""
        self._evictions[servo] += 1
        self.notify(servo)

    @property
    def waiting(self) -> list[str]:
        """Servos whose edges wait for a message."""
        return list(self._waiting)

    def notify_serials(self, newest: Mapping[str, int]) -> None:
        """Wake the polls that wait for serials up to the newest of their servo, whichever process posted it."""
        for servo, serial in newest.items():
            if any(after < serial for after in self._waiting.get(servo, {}).values()):
                self.notify(servo)

    def close(self) -> None:
        """End every poll now."""
        self._closed = True
        for servo in list(self._waiting):
            self.notify(servo)

    async def messages(self, servo: str, after: int, wait: float) -> Sequence[OutgoingMessage]:
        """Messages with serials above `after`, as soon as there are some; none after `wait` s.

        Raises
        ------
        RequestRejected
            TOO_MANY polls wait. UNAVAILABLE: the store cannot be read.
        """
        if self.open >= self._limit:
            raise RequestRejected(Refusal.TOO_MANY, f"{self._limit} polls wait already")
        if self._open_of[servo] >= self._per_servo:
            raise RequestRejected(Refusal.TOO_MANY, f"{self._per_servo} polls of servo {servo!r} wait already")
        self.open += 1
        self._open_of[servo] += 1
        try:
            return await self._poll(servo, after, wait)
        finally:
            self.open -= 1
            self._open_of[servo] -= 1
            if not self._open_of[servo]:
                del self._open_of[servo]

    async def _poll(self, servo: str, after: int, wait: float) -> Sequence[OutgoingMessage]:
        loop = asyncio.get_running_loop()
        until, evictions = loop.time() + wait, self._evictions[servo]
        while True:
            notifications = self._notifications[servo]
            messages = await self._read_newer(servo, after)
            left = until - loop.time()
            if evictions != self._evictions[servo]:
                return ()
            if messages or left <= 0.0 or self._closed:
                return messages
            # A notification that came while the store was read must not be slept through.
            if notifications == self._notifications[servo]:
                await self._sleep(servo, after, left)

    async def _read_newer(self, servo: str, after: int) -> Sequence[OutgoingMessage]:
        """Read the store, unless it is known to hold nothing newer."""
        notifications = self._notifications[servo]
        # Where other processes post too, only the store knows. An edge that has had more than it holds is news.
        if not self._shared and after == self._empty_after.get(servo):
            return ()
        try:
            messages = await self._read(servo, after)
        except StoreUnavailable as error:
            raise unavailable(error, "the store cannot be read now") from None
        # A message that was posted while the store was read may not be in what was read.
        if not messages and notifications == self._notifications[servo]:
            self._empty_after[servo] = after
        return messages

    async def _sleep(self, servo: str, after: int, seconds: float) -> None:
        """Sleep until a notification, at most `seconds`."""
        waiting: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(servo, {})[waiting] = after
        try:
            async with asyncio.timeout(seconds):
                await waiting
        except TimeoutError:
            pass
        finally:
            others = self._waiting.get(servo)
            if others is not None:
                others.pop(waiting, None)
                if not others:
                    del self._waiting[servo]


def seal_messages(verifier: bytes, servo: str, messages: Sequence[OutgoingMessage]) -> list[bytes]:
    """Seal messages for an edge."""
    if not messages:
        return []  # as of most polls; a key costs as much as a message
    key = key_of(verifier)
    return [seal(key, TO_EDGE, servo, message.serial, message.body) for message in messages]


SERVO_PATH = "/v1/servos/{servo}"
WINDOW_PATH = SERVO_PATH + "/windows/{boot}/{sequence}"


class EdgeApi:
    """Routes of the edges.

    Parameters
    ----------
    gate : EdgeGate
    bodies : BodyReader
    ingest : Ingest
    polls : LongPolls
    claims : EdgeClaims
    wake : callable
        Wakes the dispatcher after a new message.
    """

    def __init__(
        self,
        gate: EdgeGate,
        bodies: BodyReader,
        ingest: Ingest,
        polls: LongPolls,
        claims: EdgeClaims,
        wake: Callable[[], None],
    ) -> None:
        self._gate, self._bodies, self._ingest, self._polls, self._wake = gate, bodies, ingest, polls, wake
        self._claims = claims

    def routes(self) -> list[HttpRoute]:
        """Declarations."""
        put_window = operation(
            "Commit a window",
            {
                201: ("New, and safe: an array with its acknowledgement.", MSGPACK),
                200: ("Known already, likewise.", MSGPACK),
            },
            parameters=(SERVO, BOOT, SEQUENCE, ENCODING, CLAIM, WAITING),
            body="A window/1, MessagePack.",
            errors=MESSAGE_ERRORS,
        )
        post_letter = operation(
            "Commit a hello, receipt, fallback or answer",
            {202: ("It is safe: an array with CRC-32 and Content-Encoding of the body that came.", MSGPACK)},
            parameters=(SERVO, ENCODING, CLAIM),
            body="A hello/2, receipt/1, fallback/2 or answer/1, MessagePack; hello/1 and fallback/1 are read too.",
            errors=MESSAGE_ERRORS,
        )
        get_outgoing = operation(
            "Messages for an edge, sealed",
            {200: ("An array of sealed messages, serials rising; empty: none came in time.", MSGPACK)},
            parameters=(
                SERVO,
                parameter("after", INTEGER, "Only messages with higher serials."),
                parameter("wait", {**SECONDS, "maximum": MAX_WAIT_S}, "Longest wait for one, s."),
                CLAIM,
            ),
            errors=(400, 401, 403, 404, 409, 429, 503),
        )
        post_claim = operation(
            "Claim to be the servo's only edge, or ask which one is",
            {200: ("The servo's newest claim, a standing/1.", MSGPACK)},
            parameters=(SERVO,),
            body="A claim/1, MessagePack.",
            errors=(400, 401, 403, 404, 413, 429, 503),
        )
        version = operation("Versions of the protocol and of servotwin", {200: ("protocol, servotwin.", JSON)})
        return [
            HttpRoute("PUT", WINDOW_PATH, self._put_window, put_window),
            HttpRoute("POST", SERVO_PATH + "/letters", self._post_letter, post_letter),
            HttpRoute("GET", SERVO_PATH + "/outgoing", self._get_outgoing, get_outgoing),
            HttpRoute("POST", SERVO_PATH + "/claim", self._post_claim, post_claim),
            HttpRoute("GET", "/v1/version", _get_version, version),
        ]

    async def _put_window(self, request: HttpRequest) -> HttpResponse:
        """Commit a window, then acknowledge it: 201 if it is new, 200 if it is known."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token)
        await self._claims.check(servo, request.claim)
        body = await self._bodies.read(request.content_length, request.receive)
        with _marked(request, body):
            incoming, window = self._ingest.read_window(servo, body, request.content_encoding)
        if (window.boot, str(window.sequence)) != (request.path["boot"], request.path["sequence"]):
            # Without the mark: a proxy has changed the address, and the body that came is no reason to drop it.
            raise RequestRejected(Refusal.OTHER_NAME, f"the window is {incoming.key}, not what the address says")
        with _marked(request, body):
            new = await self._ingest.commit(incoming, window) is PutResult.NEW
        if new:
            self._wake()
        pause = self._ingest.older_pause(servo, request.waiting)
        headers = {OLDER_PAUSE: f"{pause:g}"} if pause else None
        return msgpack_response([acknowledgement(window)], 201 if new else 200, headers)

    async def _post_letter(self, request: HttpRequest) -> HttpResponse:
        """Commit a hello, receipt, fallback or answer: 202."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token)
        await self._claims.check(servo, request.claim)
        body = await self._bodies.read(request.content_length, request.receive)
        with _marked(request, body):
            incoming, letter = self._ingest.read_letter(servo, body, request.content_encoding)
            new = await self._ingest.commit(incoming, letter) is PutResult.NEW
        if new:
            self._wake()
        return msgpack_response([request.mark_of(body).encode()], 202)

    async def _get_outgoing(self, request: HttpRequest) -> HttpResponse:
        """Sealed messages with serials above `after`, as soon as there are some; none after `wait` s."""
        servo = request.path["servo"]
        await self._admit_poll(servo, request.token)
        after, wait = request.integer("after", 0), request.seconds("wait", 0.0)
        if wait > MAX_WAIT_S:
            detail = f"wait = {wait:g} s: at most {MAX_WAIT_S:g} s are allowed"
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, detail)
        await self._claims.check(servo, request.claim)
        messages = await self._polls.messages(servo, after, wait)
        await self._claims.check(servo, request.claim)  # another edge may have taken over meanwhile
        return msgpack_response(seal_messages(self._gate.verifier(servo), servo, messages))

    async def _admit_poll(self, servo: str, token: bytes | None) -> None:
        """Check token, name and rate; a refusal takes a second, or whoever polls in a loop would slow all others."""
        try:
            self._gate.admit_poll(servo, token)
        except RequestRejected:
            await asyncio.sleep(REFUSED_POLL_S)
            raise

    async def _post_claim(self, request: HttpRequest) -> HttpResponse:
        """Answer a question or a claim."""
        servo = request.path["servo"]
        self._gate.admit(servo, request.token)
        body = await self._bodies.read(request.content_length, request.receive)
        claim = self._ingest.decode(servo, body, request.content_encoding)
        if not isinstance(claim, EdgeClaim):
            raise RequestRejected(Refusal.NOT_UNDERSTOOD, "a claim is expected here")
        return HttpResponse(200, encode(await self._claims.answer(servo, claim)), MSGPACK)


@contextmanager
def _marked(request: HttpRequest, body: bytes) -> Iterator[None]:
    """Let a refusal tell which body it is of: the edge drops no message for what a proxy made of it."""
    try:
        yield
    except RequestRejected as rejected:
        rejected.mark = request.mark_of(body)
        raise


async def _get_version(_request: HttpRequest) -> HttpResponse:
    """Versions, without a token: an edge or an operator of any version may ask."""
    return json_response({"protocol": PROTOCOL, "servotwin": __version__})
