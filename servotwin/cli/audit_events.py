"""Events that belong to no window, for `servotwin audit`: their times, their places among the windows, their lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from servotwin.messages import Cause

if TYPE_CHECKING:
    from servotwin.cli.audit_report import JsonObject, Units

Place = tuple[int, int]
"""Place in the order of the store, which no clock changes: a message's id, and the evidence's after it."""
_LETTERS = ("hello", "fallback", "answer", "receipt")
"""Kinds of evidence that record a letter of the edge."""


def utc(seconds: float) -> str:
    """A time as text."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def in_force_since(traces: Sequence[JsonObject], events: Sequence[JsonObject]) -> str:
    """Sentence on the fallback set while it is in force, also of a later boot; empty: another version is."""
    fallen = max((one for one in events if one["kind"] == "fallback"), key=lambda one: int(one["id"]), default=None)
    if fallen is None:
        return ""
    answers = (answer for trace in traces for step in trace["steps"] for answer in step["answers"])
    applied = (one for one in answers if one["kind"] == "receipt" and (one["body"] or {}).get("applied"))
    version = (fallen["body"] or {}).get("parameter_version")
    others = (one for one in events if one["kind"] == "hello" and one["version"] != version)
    if any(one["id"] > fallen["id"] for one in (*applied, *others)):
        return ""
    return f"the edge runs its fallback set since {utc(_time(fallen))} UTC: {fallen['status']}"


def placing(traces: Sequence[JsonObject], events: Sequence[JsonObject]) -> Callable[[JsonObject], Place]:
    """Make a function that gives each event its place among the windows.

    A letter has the place in which it was received; what the twin notes by itself follows the last message that was
    processed before it.
    """
    first = {trace["window"]["id"]: trace["evidence"][0]["id"] for trace in traces if trace["evidence"]}
    first |= {letter: one["id"] for one in events if (letter := _letter(one))}

    def place(one: JsonObject) -> Place:
        before = (message for message, evidence in first.items() if evidence < one["id"])
        return _letter(one) or max(before, default=0), one["id"]

    return place


def event_line(one: JsonObject, units: Units) -> str:
    """Line of an event."""
    kind, body = one["kind"], one["body"] or {}
    if kind == "hello":
        text = f"edge connected: boot {one['status']}, version {one['version']} in force"
    elif kind == "fallback":
        now = f"; version {body['parameter_version']} in force" if "parameter_version" in body else ""
        text = f"FALLBACK from version {one['version']}: {one['status']}{_measured(body, units)}{now}"
    elif kind == "answer":
        text = f"the edge answers a request: {one['status']}"
    elif kind == "alarm":
        text = f"ALARM: {one['status']}"
    else:
        text = one["status"] or kind
    return f"{utc(_time(one))}  {text}"


def _letter(one: JsonObject) -> int:
    """Id of the letter or act that an event records; 0: it records none."""
    # A service of an earlier version does not say when one was received.
    return int(one["message"]) if one["kind"] in _LETTERS or one.get("received") is not None else 0


def _time(one: JsonObject) -> float:
    """Time at which the letter was received, or where that is not known the evidence was stored, s since the epoch."""
    received = one.get("received")
    return float(one["created"] if received is None else received)


def _measured(body: JsonObject, units: Units) -> str:
    """Measured and allowed value, in the cause's unit."""
    if body.get("cause") in (Cause.DRIVE, Cause.CONFLICT):
        return ""
    small = units.position
    known = {Cause.SILENCE: (1.0, "s"), Cause.EFFORT: (1.0, units.command)}
    scale, unit = known.get(body.get("cause", ""), (small.factor, small.name))
    if not unit:
        return ""
    try:
        return f", {body['measured'] * scale:.4g} {unit} where {body['allowed'] * scale:.4g} {unit} are allowed"
    except (KeyError, TypeError):
        return ""
