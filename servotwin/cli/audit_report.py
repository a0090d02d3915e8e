"""The evidence chain for people: a line per window in the order of time, and beside it what followed from it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from servotwin.estimation.estimate import NORMAL_95
from servotwin.messages import Cause

DEG = 180.0 / math.pi
HOUR = 3600.0
_STATUS_HEADS = f"{'gap ± 95 %, deg':>15}  {'status':14}  {'version':>7}  {'receipt':12}  {'pending':>7}"
SERVOS = f"{'servo':24}  {_STATUS_HEADS}  last message, UTC"
"""Head of the table of `servo_line`."""
HEAD = f"{'received, UTC':19}  {'window':>6}  {'gap ± 95 %, deg':>15}  {'error, um':>9}  {'version':>7}  what followed"
_OPEN = "a setting was found and waits to be sent"
_UNCHANGED = "nothing moved"  # status that the store holds where screening found no new information
JsonObject = Mapping[str, Any]
"""A servo, a link of the evidence chain or a piece of evidence, as the API returns it."""
Entry = tuple[float, str, str]
"""Time (s since the epoch), boot (empty: of none), and the line."""


def lines_of(
    servo: JsonObject, links: Sequence[JsonObject], events: Iterable[JsonObject], changes: bool = False
) -> Iterator[str]:
    """All lines, oldest first.

    Parameters
    ----------
    servo : mapping
        A `store.records` summary.
    links : sequence of mappings
        Of `store.links.Link`, newest first.
    events : iterable of mappings
        What belongs to no window.
    changes : bool
        Only windows from which something followed.
    """
    yield from _head(servo, links)
    chosen = [link for link in links if not changes or _matters(link)]
    entries = [entry for link in chosen for entry in _window(link)] + [_event(event) for event in events]
    yield ""
    yield HEAD
    boot = ""
    for _, of, line in sorted(entries, key=lambda entry: entry[0]):
        if of not in ("", boot):
            boot = of
            yield f"boot {boot}"
        yield line


def servo_line(servo: JsonObject) -> str:
    """One row of the table of servos."""
    version = "-" if servo["version"] is None else servo["version"]
    heard = "never" if servo["heard"] is None else _time(servo["heard"])
    receipt = servo["receipt"][:12] or "-"
    status = f"{_gap(servo) or '-':>15}  {_status(servo)[:14]:14}  {version:>7}  {receipt:12}  {servo['waiting']:>7}"
    return f"{servo['servo']:24}  {status}  {heard}"


def _status(servo: JsonObject) -> str:
    """Status of the newest window; a healthy machine's estimate is unchanged most of the time."""
    return "unchanged" if servo["status"] == _UNCHANGED else str(servo["status"])


def _head(servo: JsonObject, links: Sequence[JsonObject]) -> Iterator[str]:
    """The servo as it stands, and what its newest window with a trend says."""
    gap = "no gap known" if servo["gap"] is None else f"gap {_gap(servo)} deg (95 %; {_status(servo) or 'unchanged'})"
    version = "no version sent" if servo["version"] is None else f"version {servo['version']}"
    receipt = f" ({servo['receipt']})" if servo["receipt"] else ""
    heard = "" if servo["heard"] is None else f", last message {_time(servo['heard'])} UTC"
    yield f"servo {servo['servo']}: {gap}, {version}{receipt}"
    yield f"  windows: {servo['windows']} stored, {servo['waiting']} messages pending{heard}"
    newest = [line for line in (_wear(_of(links, "trend")), _disturbance(_of(links, "disturbance"))) if line]
    if newest:
        yield f"  {', '.join(newest)}"


def _of(links: Sequence[JsonObject], kind: str) -> JsonObject:
    """Body of the newest evidence of a kind."""
    found = (one["body"] for link in links for one in reversed(link["found"]) if one["kind"] == kind and one["body"])
    return next(found, {})


def _wear(trend: JsonObject) -> str:
    try:
        rate, spread = trend["mean"][1] * DEG * HOUR, math.sqrt(trend["covariance"][4]) * DEG * HOUR
        return f"wear {rate:.3g} ± {NORMAL_95 * spread:.3g} deg/h (95 %)"
    except (KeyError, TypeError, ValueError, IndexError):
        return ""


def _disturbance(found: JsonObject) -> str:
    known = (("bias", "input bias {:.1f} mV", 1e3), ("noise", "noise {:.1f} um", 1e6))
    given = ((text, scale, found.get(name)) for name, text, scale in known)
    return ", ".join(text.format(x * scale) for text, scale, x in given if isinstance(x, float) and math.isfinite(x))


def _matters(link: JsonObject) -> bool:
    """True where more followed from the window than an estimate."""
    quiet = all(one["kind"] in _REMARKS for one in link["found"])
    return bool(link["steps"]) or not quiet or any(_failed(one) for one in link["found"])


def _window(link: JsonObject) -> Iterator[Entry]:
    window, seen = link["window"], _seen(link)
    remarks = [*_remarks(link)] or [""]
    of_version = "" if seen is None or seen["version"] is None else seen["version"]
    values = f"{_gap(seen):>15}  {_error(seen):>9}  {of_version:>7}"
    line = f"{_time(window['received'])}  {window['sequence']:>6}  {values}  {remarks[0]}".rstrip()
    yield window["received"], window["boot"], line
    for remark in remarks[1:]:
        yield window["received"], window["boot"], f"{'':{len(HEAD) - len('what followed')}}{remark}"


def _seen(link: JsonObject) -> JsonObject | None:
    """The estimate, or the glance where there is none."""
    found = [one for one in link["found"] if one["kind"] in ("glance", "estimate") and not _failed(one)]
    return found[-1] if found else None


def _remarks(link: JsonObject) -> Iterator[str]:
    """Remarks on a window."""
    window = link["window"]
    if window["done"] is None:
        yield "waits to be processed"
    later = {"glance": "estimate", "estimate": "redesign"}  # which says it all once more
    said = {one["kind"] for one in link["found"] if one["status"]}
    for one in link["found"]:
        if _failed(one):
            yield one["status"]
        elif one["kind"] == "redesign" and not one["status"] and not link["steps"]:
            yield _OPEN
        elif later.get(one["kind"]) not in said:
            yield from _said(one)
    for step in link["steps"]:
        yield _sent(step["update"])
        yield from (_received(answer) for answer in step["answers"] if answer["kind"] == "receipt")
        if step["effect"] is not None:
            yield _effect(step["effect"])


_REMARKS = {
    "glance": "screening was enough: {}",
    "estimate": "",
    "disturbance": "",
    "trend": "trend: {}",
    "redesign": "{}",
    "excitation": "",
}
"""Kinds of evidence of windows from which nothing else follows, and the remark on each."""


def _said(one: JsonObject) -> Iterator[str]:
    """Of a piece of evidence that is no update; nothing where it says nothing."""
    kind, status, version = one["kind"], one["status"], one["version"]
    if kind in _REMARKS:
        if kind == "estimate" and status != "ok":
            yield f"{status}: {'; '.join(_reasons(one))}"
        elif status and _REMARKS[kind]:
            yield _REMARKS[kind].format("no new information" if status == _UNCHANGED else status)
    elif kind == "proof":
        yield f"version {version} " + (
            f"FAILED its verification: {status}" if status else "is verified for this evidence"
        )
    elif kind == "withdrawn":
        yield f"version {version} WITHDRAWN: {status}"
    else:
        yield f"{kind}: {status}"


def _reasons(one: JsonObject) -> Sequence[str]:
    try:
        return tuple(map(str, one["body"]["estimate"]["reasons"])) or ("no reason noted",)
    except (KeyError, TypeError):
        return ("no reason noted",)


def _sent(update: JsonObject) -> str:
    """Contents of an update, and its verification."""
    body = update["body"] or {}
    setting = body.get("setting") or {}
    tolerance = setting.get("tolerance", body.get("tolerance"))  # flat in updates of the version before
    gains, proof = setting.get("gains", body.get("controller")), body.get("verification", body.get("proof"))
    parts = [] if tolerance is None else [f"dead zone {tolerance * 1e6:.4g} um" if tolerance else "no dead zone"]
    if gains:
        parts.append(", ".join(f"{name} {gains[name]:.6g}" for name in ("Kp", "Ki", "Kd", "Tf")))
        parts += [f"feedforward {gains['feedforward'] * 1e3:.1f} mV"] if gains.get("feedforward") else []
    if proof:
        parts.append(f"verified on {proof['members']} simulated machines")
    return f"version {update['version']} sent: {', '.join(parts)}"


def _received(receipt: JsonObject) -> str:
    body = receipt["body"] or {}
    if body.get("applied"):
        return f"version {receipt['version']} applied at sample {body.get('sample')}"
    return f"version {receipt['version']} REFUSED by the edge: {receipt['status']}"


def _effect(effect: JsonObject) -> str:
    """The largest error at the window's end, before and under the version."""
    window, before, after = effect["window"], effect["before"], effect["after"]
    return f"version {after['version']} in window {window['sequence']}: error {_error(before)} -> {_error(after)} um"


def _event(one: JsonObject) -> Entry:
    kind, body = one["kind"], one["body"] or {}
    if kind == "hello":
        text = f"edge in touch: boot {one['status']}, version {one['version']} in force"
    elif kind == "fallback":
        text = f"FALLBACK from version {one['version']}: {one['status']}{_measured(body)}"
    elif kind == "answer":
        text = f"the edge answers a request: {one['status']}"
    else:
        text = one["status"] or kind
    return one["made"], "", f"{_time(one['made'])}  {text}"


def _measured(body: JsonObject) -> str:
    """Measured and allowed value, in the cause's unit."""
    if body.get("cause") == Cause.DRIVE:
        return ""
    scale, unit = {Cause.SILENCE: (1.0, "s"), Cause.EFFORT: (1.0, "V")}.get(body.get("cause", ""), (1e6, "um"))
    try:
        return f", {body['measured'] * scale:.4g} {unit} where {body['allowed'] * scale:.4g} {unit} are allowed"
    except (KeyError, TypeError):
        return ""


def _failed(one: JsonObject) -> bool:
    return str(one["status"]).startswith("failed: ")


def _gap(found: JsonObject | None) -> str:
    if found is None or found["gap"] is None:
        return ""
    spread = "" if found["std"] is None else f" ± {NORMAL_95 * found['std'] * DEG:.3f}"
    return f"{found['gap'] * DEG:.3f}{spread}"


def _error(found: JsonObject | None) -> str:
    return "?" if found is None or found["tail"] is None else f"{found['tail'] * 1e6:.1f}"


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
