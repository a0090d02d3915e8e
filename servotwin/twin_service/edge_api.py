"""What edges use: windows and letters come in, messages for them go out. Raw bodies, nothing parsed twice."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
from fastapi import Request, Response

from servotwin.messages import Refusal
from servotwin.messages.compression import ENCODINGS
from servotwin.store.records import PutResult
from servotwin.twin_service.auth import Authority, bearer
from servotwin.twin_service.ingest import Ingest, acknowledgement
from servotwin.twin_service.limits import Bodies, Buckets
from servotwin.twin_service.outgoing import LONGEST, Outgoing, sealed
from servotwin.twin_service.refused import Refused

MSGPACK = "application/msgpack"
MOST = 2**53
_pack = msgspec.msgpack.Encoder().encode


class Gate:
    """Who comes in: token, name and rate, before any body is read."""

    def __init__(self, authority: Authority, knows: Callable[[str], bool], buckets: Buckets) -> None:
        self._authority, self._knows, self._buckets = authority, knows, buckets

    def admit(self, request: Request, costs: bool = True) -> str:
        """The servo that a request speaks for; it counts against the servo's rate if it `costs`.

        Raises
        ------
        Refused
        """
        servo: str = request.path_params["servo"]
        self._authority.admit_servo(servo, token_of(request))
        if not self._knows(servo):
            raise Refused(Refusal.UNKNOWN_SERVO, f"servo {servo[:64]!r} is not looked after here")
        if costs:
            self._buckets.take(servo)
        return servo

    def verifier(self, servo: str) -> bytes:
        """With which messages to the servo are sealed; raises Refused where its token was taken away meanwhile."""
        found = self._authority.verifier(servo)
        if found is None:
            raise Refused(Refusal.BAD_TOKEN, "the token of this servo was taken away")
        return found


class EdgeApi:
    """The three things that an edge does.

    Parameters
    ----------
    gate : Gate
    bodies : Bodies
    ingest : Ingest
    outgoing : Outgoing
    came : callable
        Told when there is something new to work on.
    """

    def __init__(
        self, gate: Gate, bodies: Bodies, ingest: Ingest, outgoing: Outgoing, came: Callable[[], None]
    ) -> None:
        self._gate, self._bodies, self._ingest, self._outgoing, self._came = gate, bodies, ingest, outgoing, came

    async def put_window(self, request: Request) -> Response:
        """Commit a window, then acknowledge it: 201 if it is new, 200 if it was known."""
        servo = self._gate.admit(request)
        body = await self._bodies.read(request.headers.get("content-length"), request.receive)
        incoming, window = self._ingest.read_window(servo, body, encoding_of(request))
        if (window.boot, str(window.sequence)) != (request.path_params["boot"], request.path_params["sequence"]):
            raise Refused(Refusal.OTHER_NAME, f"the window is {incoming.key}, not what the address says")
        put = await self._ingest.commit(incoming)
        if put is PutResult.NEW:
            self._came()
        return packed([acknowledgement(window)], 201 if put is PutResult.NEW else 200)

    async def post_letter(self, request: Request) -> Response:
        """Commit a hello, receipt, fallback or answer: 202."""
        servo = self._gate.admit(request)
        body = await self._bodies.read(request.headers.get("content-length"), request.receive)
        incoming, _ = self._ingest.read_letter(servo, body, encoding_of(request))
        if await self._ingest.commit(incoming) is PutResult.NEW:
            self._came()
        return Response(status_code=202)

    async def get_outgoing(self, request: Request) -> Response:
        """Sealed messages of higher serials than `after`, as soon as there are some, none after `wait` s."""
        servo = self._gate.admit(request, costs=False)
        after, wait = whole(request, "after", 0), seconds(request, "wait", 0.0)
        if wait > LONGEST:
            raise Refused(Refusal.NOT_UNDERSTOOD, f"wait = {wait:g} s: at most {LONGEST:g} s are allowed")
        posted = await self._outgoing.after(servo, after, wait)
        return packed(sealed(self._gate.verifier(servo), servo, posted))


def token_of(request: Request) -> bytes | None:
    """The bearer token of a request; None: it has none."""
    header = request.headers.get("authorization")
    return None if header is None else bearer(header.encode("latin-1"))


def encoding_of(request: Request) -> str:
    """How a body is compressed; raises Refused for what is not known."""
    encoding = request.headers.get("content-encoding", "")
    if encoding in ENCODINGS:
        return encoding
    if encoding == "identity":
        return ""
    raise Refused(Refusal.NOT_UNDERSTOOD, "content-encoding: known are identity, deflate and zstd")


def whole(request: Request, key: str, default: int | None = None) -> int:
    """A query's argument as a number from 0 to 2**53; raises Refused."""
    text = request.query_params.get(key)
    if text is None and default is not None:
        return default
    if text is None or not (text.isascii() and text.isdecimal() and len(text) <= 16 and int(text) <= MOST):
        raise Refused(Refusal.NOT_UNDERSTOOD, f"{key}: give a whole number from 0 to {MOST}")
    return int(text)


def seconds(request: Request, key: str, default: float | None = None) -> float:
    """A query's argument as a time in s; raises Refused."""
    text = request.query_params.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise Refused(Refusal.NOT_UNDERSTOOD, f"{key}: give a time in s, finite and at least 0")
    return value


def packed(value: object, status: int = 200) -> Response:
    """An answer in MessagePack."""
    return Response(_pack(value), status, media_type=MSGPACK)
