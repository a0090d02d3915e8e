"""The evidence chain for people: a line per window in the order of time, and beside it what followed from it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from servotwin.messages import Cause

DEG = 180.0 / math.pi
HOUR = 3600.0
SERVOS = f"{'servo':24}  {'gap, deg':>15}  {'status':14}  {'version':>7}  {'receipt':12}  {'waits':>5}  last heard, UTC"
"""Above `servos_line`."""
HEAD = f"{'received, UTC':19}  {'window':>6}  {'gap, deg':>15}  {'error, um':>9}  {'version':>7}  what followed"
_OPEN = "a setting was found, and waits to be sent"
Told = Mapping[str, Any]
"""As the API tells it: a servo, a link of the chain, a piece of evidence."""
Entry = tuple[float, str, str]
"""When (s since the epoch), the boot that it belongs to (empty: to none), and the line."""


def lines_of(servo: Told, links: Sequence[Told], events: Iterable[Told], changes: bool = False) -> Iterator[str]:
    """All lines, oldest first.

    Parameters
    ----------
    servo : mapping
        A `store.rows.Summary`.
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


def servo_line(servo: Told) -> str:
    """One servo at a glance."""
    version = "-" if servo["version"] is None else servo["version"]
    heard = "never" if servo["heard"] is None else _time(servo["heard"])
    receipt = servo["receipt"][:12] or "-"
    status = f"{_gap(servo) or '-':>15}  {servo['status'][:14]:14}  {version:>7}  {receipt:12}  {servo['waiting']:>5}"
    return f"{servo['servo']:24}  {status}  {heard}"


def _head(servo: Told, links: Sequence[Told]) -> Iterator[str]:
    """The servo as it stands, and what its newest window with a trend says."""
    gap = "no gap known" if servo["gap"] is None else f"gap {_gap(servo)} deg ({servo['status'] or 'by a glance'})"
    version = "no version sent" if servo["version"] is None else f"version {servo['version']}"
    receipt = f" ({servo['receipt']})" if servo["receipt"] else ""
    heard = "" if servo["heard"] is None else f", last heard of {_time(servo['heard'])} UTC"
    yield f"servo {servo['servo']}: {gap}, {version}{receipt}"
    yield f"  windows: {servo['windows']} stored, {servo['waiting']} messages wait{heard}"
    newest = [line for line in (_wear(_of(links, "trend")), _disturbance(_of(links, "disturbance"))) if line]
    if newest:
        yield f"  {', '.join(newest)}"


def _of(links: Sequence[Told], kind: str) -> Told:
    """What the newest evidence of a kind holds."""
    found = (one["body"] for link in links for one in reversed(link["found"]) if one["kind"] == kind and one["body"])
    return next(found, {})


def _wear(trend: Told) -> str:
    try:
        rate, spread = trend["mean"][1] * DEG * HOUR, math.sqrt(trend["covariance"][4]) * DEG * HOUR
        return f"wear {rate:.3g} ± {spread:.2g} deg/h"
    except (KeyError, TypeError, ValueError, IndexError):
        return ""


def _disturbance(found: Told) -> str:
    known = (("bias", "input bias {:.1f} mV", 1e3), ("noise", "noise {:.1f} um", 1e6))
    given = ((text, scale, found.get(name)) for name, text, scale in known)
    return ", ".join(text.format(x * scale) for text, scale, x in given if isinstance(x, float) and math.isfinite(x))


def _matters(link: Told) -> bool:
    """Whether more came of it than an estimate."""
    quiet = all(one["kind"] in _REMARKS for one in link["found"])
    return bool(link["steps"]) or not quiet or any(_failed(one) for one in link["found"])


def _window(link: Told) -> Iterator[Entry]:
    window, seen = link["window"], _seen(link)
    remarks = [*_remarks(link)] or [""]
    of_version = "" if seen is None or seen["version"] is None else seen["version"]
    values = f"{_gap(seen):>15}  {_error(seen):>9}  {of_version:>7}"
    line = f"{_time(window['received'])}  {window['sequence']:>6}  {values}  {remarks[0]}".rstrip()
    yield window["received"], window["boot"], line
    for remark in remarks[1:]:
        yield window["received"], window["boot"], f"{'':{len(HEAD) - len('what followed')}}{remark}"


def _seen(link: Told) -> Told | None:
    """The estimate, or the glance where there is none."""
    found = [one for one in link["found"] if one["kind"] in ("glance", "estimate") and not _failed(one)]
    return found[-1] if found else None


def _remarks(link: Told) -> Iterator[str]:
    """What is to be said of a window."""
    window = link["window"]
    if window["done"] is None:
        yield "waits to be worked on"
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
    "glance": "a glance was enough: {}",
    "estimate": "",
    "disturbance": "",
    "trend": "trend: {}",
    "redesign": "{}",
    "excitation": "",
}
"""What comes with windows from which nothing else follows, and what is said of it."""


def _said(one: Told) -> Iterator[str]:
    """Of a piece of evidence that is no update; nothing where it says nothing."""
    kind, status, version = one["kind"], one["status"], one["version"]
    if kind in _REMARKS:
        if kind == "estimate" and status != "ok":
            yield f"{status}: {'; '.join(_reasons(one))}"
        elif status and _REMARKS[kind]:
            yield _REMARKS[kind].format(status)
    elif kind == "proof":
        yield f"version {version} " + (f"FAILED its proof: {status}" if status else "is proved for this evidence")
    elif kind == "withdrawn":
        yield f"version {version} WITHDRAWN: {status}"
    else:
        yield f"{kind}: {status}"


def _reasons(one: Told) -> Sequence[str]:
    try:
        return tuple(map(str, one["body"]["estimate"]["reasons"])) or ("no reason noted",)
    except (KeyError, TypeError):
        return ("no reason noted",)


def _sent(update: Told) -> str:
    """What an update sets, and what it was proved on."""
    body = update["body"] or {}
    setting = body.get("setting") or {}
    tolerance = setting.get("tolerance", body.get("tolerance"))  # flat in updates of the version before
    gains, proof = setting.get("gains", body.get("controller")), body.get("verification", body.get("proof"))
    parts = [] if tolerance is None else [f"dead zone {tolerance * 1e6:.4g} um" if tolerance else "no dead zone"]
    if gains:
        parts.append(", ".join(f"{name} {gains[name]:.6g}" for name in ("Kp", "Ki", "Kd", "Tf")))
        parts += [f"feedforward {gains['feedforward'] * 1e3:.1f} mV"] if gains.get("feedforward") else []
    if proof:
        parts.append(f"proved on {proof['members']} machines")
    return f"version {update['version']} sent: {', '.join(parts)}"


def _received(receipt: Told) -> str:
    body = receipt["body"] or {}
    if body.get("applied"):
        return f"version {receipt['version']} applied at sample {body.get('sample')}"
    return f"version {receipt['version']} REFUSED by the edge: {receipt['status']}"


def _effect(effect: Told) -> str:
    """The largest error at the window's end, before and under the version."""
    window, before, after = effect["window"], effect["before"], effect["after"]
    return f"version {after['version']} in window {window['sequence']}: error {_error(before)} -> {_error(after)} um"


def _event(one: Told) -> Entry:
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


def _measured(body: Told) -> str:
    """What was seen and what was allowed, in the cause's unit."""
    if body.get("cause") == Cause.DRIVE:
        return ""
    if body.get("cause") == Cause.DRIVE:
        return ""
    scale, unit = {Cause.SILENCE: (1.0, "s"), Cause.EFFORT: (1.0, "V")}.get(body.get("cause", ""), (1e6, "um"))
    try:
        return f", {body['measured'] * scale:.4g} {unit} where {body['allowed'] * scale:.4g} {unit} are allowed"
    except (KeyError, TypeError):
        return ""


def _failed(one: Told) -> bool:
    return str(one["status"]).startswith("failed: ")


def _gap(found: Told | None) -> str:
    if found is None or found["gap"] is None:
        return ""
    spread = "" if found["std"] is None else f" ± {found['std'] * DEG:.3f}"
    return f"{found['gap'] * DEG:.3f}{spread}"


def _error(found: Told | None) -> str:
    return "?" if found is None or found["tail"] is None else f"{found['tail'] * 1e6:.1f}"


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
