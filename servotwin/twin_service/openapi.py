"""OpenAPI descriptions of the routes: parameters, operations, and the document of all of them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from servotwin.messages import MAX_BYTES, NAME_PATTERN
from servotwin.twin_service.limits import STATUS

Operation = dict[str, Any]
MSGPACK, JSON, TEXT = "application/msgpack", "application/json", "text/plain"
HTML, CSV, EVENTS = "text/html; charset=utf-8", "text/csv; charset=utf-8", "text/event-stream"
PARQUET = "application/vnd.apache.parquet"
MAX_INTEGER = 2**53
"""Largest integer in a request: the largest that JSON readers with float64 numbers represent exactly."""
_TITLE, _VERSION = "servotwin twin", "1"
_DESCRIPTION = (
    """MessagePack in, MessagePack out; errors are JSON: {"code": ..., "detail": ...}. Times in s, angles in rad."""
)
_NAME = NAME_PATTERN.replace(r"\A", "^").replace(r"\Z", "$")
_BYTES: Operation = {"type": "string", "format": "binary"}
INTEGER: Operation = {"type": "integer", "minimum": 0, "maximum": MAX_INTEGER}
SECONDS: Operation = {"type": "number", "minimum": 0}
_CONTENT: dict[str, Operation] = {
    MSGPACK: _BYTES,
    JSON: {},
    **{key: {"type": "string"} for key in (TEXT, HTML, CSV, EVENTS)},
    PARQUET: _BYTES,
}
_ERROR: Operation = {
    "type": "object",
    "required": ["code", "detail"],
    "properties": {
        "code": {"type": "string", "enum": [refusal.value for refusal in STATUS]},
        "detail": {"type": "string"},
        "mark": {"type": "string", "description": "CRC-32 and Content-Encoding of the body that was refused."},
    },
}
MESSAGE_ERRORS = (400, 401, 403, 404, 409, 413, 422, 429, 503)
QUERY_ERRORS = (400, 401, 403, 404, 503)


def parameter(
    name: str, schema: Operation, description: str, where: str = "query", required: bool = False
) -> Operation:
    """OpenAPI parameter object."""
    return {
        "name": name,
        "in": where,
        "required": required or where == "path",
        "schema": schema,
        "description": description,
    }


SERVO = parameter("servo", {"type": "string", "pattern": _NAME}, "Name of the servo.", "path")
BOOT = parameter("boot", {"type": "string", "pattern": _NAME}, "Boot of the edge.", "path")
SEQUENCE = parameter("sequence", INTEGER, "Number of the window within the boot.", "path")
CLAIM = parameter("servotwin-claim", {"type": "string"}, "Number and run of the sender's claim.", "header")
WAITING = parameter(
    "servotwin-waiting",
    INTEGER,
    "Number of windows that the edge has to send beside this one. The answer's header servotwin-older-pause is the "
    "pause before each that a newer one has overtaken, s.",
    "header",
)
ENCODING = parameter(
    "content-encoding",
    {"type": "string", "enum": ["identity", "deflate", "zstd"]},
    "Compression of the body.",
    "header",
)


def operation(
    summary: str,
    responses: Mapping[int, tuple[str, str | None]],
    parameters: Iterable[Operation] = (),
    body: str = "",
    errors: Iterable[int] = (),
    body_type: str = MSGPACK,
) -> Operation:
    """OpenAPI operation object.

    Parameters
    ----------
    summary : str
    responses : mapping of int to (str, str or None)
        Status to description and content type.
    parameters : iterable of dict
        As `parameter` makes them.
    body : str
        Description of the request's body; empty: it has none.
    errors : iterable of int
        Statuses of error bodies.
    body_type : str
        Content type of the request's body.
    """
    described: Operation = {}
    for status, (description, kind) in responses.items():
        content = {} if kind is None else {"content": {kind: {"schema": _CONTENT[kind]}}}
        described[str(status)] = {"description": description, **content}
    for status in errors:
        described.setdefault(str(status), {"description": "Rejected.", "content": {JSON: {"schema": _ERROR}}})
    declared: Operation = {"summary": summary, "parameters": list(parameters), "responses": described}
    if body:
        schema = {**_BYTES, "maxLength": MAX_BYTES} if body_type == MSGPACK else {}
        declared["requestBody"] = {"required": True, "description": body, "content": {body_type: {"schema": schema}}}
    return declared


def openapi_document(routes: Iterable[tuple[str, str, Operation]]) -> Operation:
    """OpenAPI 3.1 document of routes: method, path and operation of each."""
    paths: Operation = {}
    for method, path, described in routes:
        name = f"{method.lower()} {path}"
        declared = {**described, "operationId": re.sub(r"\W+", "_", name).strip("_")}
        paths.setdefault(path, {})[method.lower()] = declared
    info = {"title": _TITLE, "description": _DESCRIPTION, "version": _VERSION}
    return {"openapi": "3.1.0", "info": info, "paths": paths}
