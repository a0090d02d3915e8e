"""What the API's description says of raw bodies, and of arguments that are read by hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotwin.messages import MAX_BYTES, NAME_PATTERN
from servotwin.twin_service.outgoing import LONGEST
from servotwin.twin_service.refused import STATUS

MSGPACK, JSON, TEXT = "application/msgpack", "application/json", "text/plain"
Operation = dict[str, Any]
Answers = Mapping[int, tuple[str, str | None]]
_NAME = NAME_PATTERN.replace(r"\A", "^").replace(r"\Z", "$")
_BYTES = {"type": "string", "format": "binary"}
_WHOLE = {"type": "integer", "minimum": 0, "maximum": 2**53}
_REFUSALS = {
    "type": "object",
    "required": ["code", "detail"],
    "properties": {
        "code": {"type": "string", "enum": [refusal.value for refusal in STATUS]},
        "detail": {"type": "string"},
    },
}


def _argument(name: str, schema: Operation, says: str, where: str = "query", required: bool = False) -> Operation:
    return {"name": name, "in": where, "required": required or where == "path", "schema": schema, "description": says}


SERVO = _argument("servo", {"type": "string", "pattern": _NAME}, "The servo's name.", "path")
BOOT = _argument("boot", {"type": "string", "pattern": _NAME}, "The edge's boot.", "path")
SEQUENCE = _argument("sequence", _WHOLE, "The window's number within the boot.", "path")
ENCODING = _argument(
    "content-encoding", {"type": "string", "enum": ["identity", "deflate", "zstd"]}, "Of the body.", "header"
)
NOW = _argument("now", {"type": "number", "minimum": 0}, "Sample time, s.", required=True)
LIMIT = _argument("limit", {**_WHOLE, "maximum": 1000}, "How many at most.")


def _operation(summary: str, answers: Answers, *arguments: Operation, body: str = "", errors: str) -> Operation:
    """An operation; `answers`: status to (what it means, of which type); `errors`: statuses."""
    responses: Operation = {str(status): _answer(*answer) for status, answer in answers.items()}
    for status in errors.split():
        responses.setdefault(status, {"description": "Refused.", "content": {JSON: {"schema": _REFUSALS}}})
    found: Operation = {"summary": summary, "parameters": list(arguments), "responses": responses}
    if body:
        content = {MSGPACK: {"schema": {**_BYTES, "maxLength": MAX_BYTES}}}
        found["requestBody"] = {"required": True, "description": body, "content": content}
    return found


def _answer(says: str, kind: str | None) -> Operation:
    return {"description": says, **({} if kind is None else {"content": {kind: {"schema": _SCHEMA[kind]}}})}


_SCHEMA: dict[str, Operation] = {MSGPACK: _BYTES, JSON: {}, TEXT: {"type": "string"}}
_SENT = "400 401 403 404 409 413 422 429 503"
_ASKED = "400 401 403 404 503"

PUT_WINDOW = _operation(
    "Commit a window",
    {201: ("New, and safe: an array with its acknowledgement.", MSGPACK), 200: ("Known already, likewise.", MSGPACK)},
    SERVO, BOOT, SEQUENCE, ENCODING,
    body="A window/1, MessagePack.", errors=_SENT,
)  # fmt: skip
POST_LETTER = _operation(
    "Commit a hello, receipt, fallback or answer",
    {202: ("It is safe.", None)},
    SERVO, ENCODING,
    body="A hello/1, receipt/1, fallback/1 or answer/1, MessagePack.", errors=_SENT,
)  # fmt: skip
GET_OUTGOING = _operation(
    "Messages for an edge, sealed",
    {200: ("An array of sealed messages, serials rising; empty: none came in time.", MSGPACK)},
    SERVO,
    _argument("after", _WHOLE, "Only of higher serials."),
    _argument("wait", {"type": "number", "minimum": 0, "maximum": LONGEST}, "How long to wait for one, s."),
    errors="400 401 403 404 429 503",
)  # fmt: skip
GET_SERVOS = _operation(
    "Servos at a glance",
    {200: ("By name.", JSON)},
    _argument("after", {"type": "string"}, "Only names after this one."), LIMIT,
    errors=_ASKED,
)  # fmt: skip
GET_SERVO = _operation("One servo at a glance", {200: ("As it stands.", JSON)}, SERVO, errors=_ASKED)
GET_AUDIT = _operation(
    "The evidence chain: window, estimate, version, receipt, effect",
    {200: ("Newest window first.", JSON)},
    SERVO, LIMIT,
    _argument("since", {"type": "number", "minimum": 0}, "Only windows received then or later, s since the epoch."),
    _argument("before", _WHOLE, "Only windows of a lower id: the next page."),
    errors=_ASKED,
)  # fmt: skip
GET_EVENTS = _operation(
    "What belongs to no window: starts of the edge, fallbacks, answers, faults of the twin itself",
    {200: ("Newest first.", JSON)},
    SERVO, LIMIT,
    _argument("since", {"type": "number", "minimum": 0}, "Only what was noted then or later, s since the epoch."),
    errors=_ASKED,
)  # fmt: skip
GET_WINDOW = _operation("A window as it came", {200: ("window/1.", MSGPACK)}, SERVO, BOOT, SEQUENCE, errors=_ASKED)
GET_HEALTH = _operation(
    "Whether all is well", {200: ("It is.", JSON), 503: ("It is not; the answer says what.", JSON)}, errors=""
)
GET_METRICS = _operation("Figures for Prometheus", {200: ("Text format 0.0.4.", TEXT)}, errors="")
_STEPPED: Answers = {200: ("The twin's messages, and when it wants to be woken.", MSGPACK)}
POST_RECEIVE = _operation(
    "Lock-step: a message arrives", _STEPPED, SERVO, NOW, ENCODING, body="Any message for a twin.", errors=_SENT
)
POST_WAKE = _operation("Lock-step: the time has come", _STEPPED, SERVO, NOW, errors=_ASKED)
GET_NEXT = _operation("Lock-step: when to wake", {200: ("Sample time, s, or null.", MSGPACK)}, SERVO, errors=_ASKED)
