"""Evidence chain as text: one line per window in the order of the store, with its consequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from servotwin.cli.audit_events import Place, event_line, in_force_since, placing, utc
from servotwin.config.keys import items_of
from servotwin.config.own_units import OwnUnits
from servotwin.config.units import unit_of
from servotwin.control.cascade import Cascade
from servotwin.control.controller import Controller
from servotwin.estimation.estimate import NORMAL_95
from servotwin.messages import Reason
from servotwin.plant.display_units import DEGREES, MILLIMETRES, DisplayUnit

DEG = 180.0 / math.pi
HOUR = 3600.0
_OPEN = "a setting was found and waits to be sent"
_NO_ESTIMATE = "no estimate"
_UNCHANGED = "nothing moved"  # status that the store holds where screening found no new information
JsonObject = Mapping[str, Any]
"""A servo, the trace of a window or a piece of evidence, as the API returns it."""
Entry = tuple[Place, str, str]
"""Place in the order of the store, boot (empty: of none), and the line."""


_POSITIONS = {each.si: each.small for each in (MILLIMETRES, DEGREES)}
_NO_UNIT = DisplayUnit("", 1.0, "")


class Units(NamedTuple):
    """Units of a machine's small lengths or angles, and of its command; volts are shown in mV. Those that are not known
    yet have no name, and nothing is shown in them."""

    position: DisplayUnit = MILLIMETRES.small
    command: str = "V"

    @classmethod
    def of(cls, machine: JsonObject) -> Units:
        """Units in the facts of a machine, as the API returns them."""
        position = _POSITIONS.get(str(machine.get("travel_unit")), _NO_UNIT)
        return cls(position, str(machine.get("command_unit") or ""))

    @property
    def known(self) -> bool:
        """True where the machine is known."""
        return bool(self.command and self.position.si)

    @property
    def head(self) -> str:
        """Heading of the table."""
        columns = f"{'received, UTC':19}", f"{'window':>6}", f"{'gap ± 95 %, deg':>15}", f"{self.error:>9}", "version"
        return "  ".join([*columns, "what followed"])

    @property
    def error(self) -> str:
        """Heading of the errors."""
        return f"error, {self.position.name}" if self.position.name else "error"

    def of_gain(self, law: type, name: str, value: float) -> str:
        """A gain of a class of controllers, by its name, with its unit."""
        if not self.known:
            return f"{name} {value:.6g}"
        key = next((item.exact_name for item in items_of(law) if item.name == name), name)
        unit = unit_of(OwnUnits(self.command, self.position.si).key(key)).name
        return f"{name} {value:.6g} {unit}".rstrip()

    def of_command(self, value: float) -> str:
        """A small command with its unit."""
        # A zero has no sign here.
        if self.command == "V":
            return f"{round(value * 1e3, 1) + 0.0:.1f} mV"
        return f"{value + 0.0:.4g} {self.command}".rstrip()


def lines_of(
    servo: JsonObject,
    traces: Sequence[JsonObject],
    events: Iterable[JsonObject],
    units: Units,
    changes: bool = False,
) -> Iterator[str]:
    """Make all lines, oldest first.

    Parameters
    ----------
    servo : mapping
        `store.records.ServoSummary` as the API returns it.
    traces : sequence of mappings
        `store.records.WindowTrace` as the API returns them, newest first.
    events : iterable of mappings
        Evidence that belongs to no window.
    units : Units
    changes : bool
        Only windows that led to more than an estimate.
    """
    events = list(events)
    yield from _head(servo, traces, events, units)
    chosen = [trace for trace in traces if not changes or _matters(trace)]
    entries = [entry for trace in chosen for entry in _window(trace, units)]
    place = placing(traces, events)
    entries += [(place(event), "", event_line(event, units)) for event in events]
    if changes and not chosen:
        yield f"  none of the newest {len(traces)} windows led to more than an estimate; --limit 1000 looks further"
    yield ""
    yield units.head
    boot = ""
    for _, line_boot, line in sorted(entries, key=lambda entry: entry[0]):
        if line_boot not in ("", boot):
            boot = line_boot
            yield f"boot {boot}"
        yield line


def servo_lines(servos: Sequence[JsonObject]) -> Iterator[str]:
    """Head and rows of the table of servos."""
    rows: list[tuple[str, ...]] = [
        ("servo", "gap ± 95 %, deg", "status", "version", "receipt", "pending", "last message, UTC")
    ]
    rows += [_servo_row(servo) for servo in servos]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (f"{text:{align}{width}}" for text, align, width in zip(row, "<><><><", widths, strict=True))
        yield "  ".join(cells).rstrip()


def _servo_row(servo: JsonObject) -> tuple[str, ...]:
    version = "-" if servo["version"] is None else str(servo["version"])
    received = "never" if servo["last_message"] is None else utc(servo["last_message"])
    return (
        servo["servo"], _gap(servo) or "-", _status(servo) or _NO_ESTIMATE, version, servo["receipt"] or "-",
        str(servo["waiting"]), received,
    )  # fmt: skip


def _status(servo: JsonObject) -> str:
    """Status of the newest window; a healthy machine's estimate is unchanged most of the time."""
    return "unchanged" if servo["status"] == _UNCHANGED else str(servo["status"])


def _head(servo: JsonObject, traces: Sequence[JsonObject], events: Sequence[JsonObject], units: Units) -> Iterator[str]:
    """Summary of the servo, its fallback set where that is in force, and its newest trend and disturbance."""
    gap = "no gap known" if servo["gap"] is None else f"gap {_gap(servo)} deg (95 %; {_status(servo) or 'unchanged'})"
    version = "no version sent" if servo["version"] is None else f"version {servo['version']}"
    answer = _newest_answer(servo, traces)
    receipt = f" ({answer})" if answer else ""
    last = "" if servo["last_message"] is None else f", last message {utc(servo['last_message'])} UTC"
    yield f"servo {servo['servo']}: {gap}, {version}{receipt}"
    yield f"  windows: {servo['windows']} stored, {servo['waiting']} messages pending{last}"
    if fallen := in_force_since(traces, events):
        yield f"  {fallen}"
    newest = _wear(_newest(traces, "trend")), _disturbance(_newest(traces, "disturbance"), units)
    if any(newest):
        yield f"  {', '.join(filter(None, newest))}"


def _newest_answer(servo: JsonObject, traces: Sequence[JsonObject]) -> str:
    """Answer of the edge to the newest version; that to an earlier one may be the newest that has come."""
    steps = (step for trace in traces for step in trace["steps"] if step["update"]["version"] == servo["version"])
    step = next(steps, None)
    if step is None:
        return str(servo["receipt"])
    receipts = [answer["status"] for answer in step["answers"] if answer["kind"] == "receipt"]
    return receipts[-1] if receipts else "not answered yet"


def _newest(traces: Sequence[JsonObject], kind: str) -> JsonObject:
    """Body of the newest evidence of a kind."""
    evidence = (one for trace in traces for one in reversed(trace["evidence"]) if one["kind"] == kind)
    return next((one["body"] for one in evidence if one["body"]), {})


def _wear(trend: JsonObject) -> str:
    if trend.get("updates", 2) < 2:  # one window alone tells nothing of wear
        return ""
    try:
        rate, spread = trend["mean"][1] * DEG * HOUR, math.sqrt(trend["covariance"][4]) * DEG * HOUR
        return f"wear {rate:.3g} ± {NORMAL_95 * spread:.3g} deg/h (95 %)"
    except (KeyError, TypeError, ValueError, IndexError):
        return ""


def _disturbance(body: JsonObject, units: Units) -> str:
    if not units.known:
        return ""
    fields = (("bias", units.of_command, "input bias {}"), ("noise", units.position.text, "noise {}"))
    values = ((text, shown, body.get(name)) for name, shown, text in fields)
    return ", ".join(text.format(shown(x)) for text, shown, x in values if isinstance(x, float) and math.isfinite(x))


def _matters(trace: JsonObject) -> bool:
    """True where more than an estimate followed from the window."""
    quiet = all(one["kind"] in _REMARKS for one in trace["evidence"])
    return bool(trace["steps"]) or not quiet or any(_failed(one) for one in trace["evidence"])


def _window(trace: JsonObject, units: Units) -> Iterator[Entry]:
    window, estimate = trace["window"], _estimate(trace)
    remarks = [*_remarks(trace, units)] or [""]
    head = units.head
    version = "" if estimate is None or estimate["version"] is None else estimate["version"]
    width = max(9, len(units.error))
    values = f"{_gap(estimate):>15}  {_error(estimate, units):>{width}}  {version:>7}"
    place = window["id"], 0
    line = f"{utc(window['received'])}  {window['sequence']:>6}  {values}  {remarks[0]}".rstrip()
    yield place, window["boot"], line
    for remark in remarks[1:]:
        yield place, window["boot"], f"{'':{len(head) - len('what followed')}}{remark}"


def _estimate(trace: JsonObject) -> JsonObject | None:
    """Estimate of a window, or the glance where there is no estimate."""
    estimates = [one for one in trace["evidence"] if one["kind"] in ("glance", "estimate") and not _failed(one)]
    return estimates[-1] if estimates else None


def _remarks(trace: JsonObject, units: Units) -> Iterator[str]:
    """Remarks on a window."""
    window = trace["window"]
    if window["done"] is None:
        yield "waits to be processed"
    # Evidence of the second kind has a remark of its own, which repeats that on the first.
    repeated_by = {"glance": "estimate", "estimate": "redesign"}
    with_remark = {one["kind"] for one in trace["evidence"] if one["status"]}
    for one in trace["evidence"]:
        if _failed(one):
            yield one["status"]
        elif one["kind"] == "redesign" and not one["status"] and not trace["steps"]:
            yield _OPEN
        elif one["kind"] == "glance" and (one["body"] or {}).get("moved") and not _is_estimated(trace):
            yield f"not estimated, for a newer window had come; screening: {one['status']}"
        elif repeated_by.get(one["kind"]) not in with_remark:
            yield from _remark(one)
    for step in trace["steps"]:
        yield _sent_update(step["update"], units)
        yield from (_receipt(answer) for answer in step["answers"] if answer["kind"] == "receipt")
        if step["effect"] is not None:
            yield _effect(step["effect"], units)


def _is_estimated(trace: JsonObject) -> bool:
    return any(one["kind"] == "estimate" for one in trace["evidence"])


_REMARKS = {
    "glance": "screening was enough: {}",
    "estimate": "",
    "disturbance": "",
    "trend": "trend: {}",
    "machine": "",
    "motor": "",
    "redesign": "{}",
    "excitation": "",
}
"""Kinds of evidence of windows from which nothing else follows, and the remark on each."""


def _remark(one: JsonObject) -> Iterator[str]:
    """Remark on a piece of evidence that is no update; none where it has no status."""
    kind, status, version = one["kind"], one["status"], one["version"]
    if kind in _REMARKS:
        if kind == "estimate" and status != "ok":
            yield f"{status}: {'; '.join(_reasons(one))}"
        elif status and _REMARKS[kind]:
            yield _REMARKS[kind].format("no new information" if status == _UNCHANGED else status)
    elif kind == "verification":
        yield f"version {version} " + (
            f"FAILED its verification: {status}" if status else "is verified for this evidence"
        )
    elif kind == "alarm":
        yield f"ALARM: {status}"
    elif kind == "withdrawn":
        yield f"version {version} WITHDRAWN: {status}"
    else:
        yield f"{kind}: {status}"


def _reasons(one: JsonObject) -> Sequence[str]:
    try:
        return tuple(map(str, one["body"]["estimate"]["reasons"])) or ("no reason noted",)
    except (KeyError, TypeError):
        return ("no reason noted",)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _sent_update(update: JsonObject, units: Units) -> str:
    """Contents of an update, and its verification."""
    body = update["body"] or {}
    setting = body.get("setting") or {}
    tolerance = setting.get("tolerance", body.get("tolerance"))  # flat in updates of the version before
    gains, verification = setting.get("gains", body.get("controller")), body.get("verification", body.get("proof"))
    zone = "no dead zone" if not tolerance else f"dead zone {units.position.text(tolerance, '.4g')}".rstrip()
    parts = [] if tolerance is None else [zone]
    if gains:
        parts.append(", ".join(units.of_gain(Controller, name, gains[name]) for name in ("Kp", "Ki", "Kd", "Tf")))
        parts += [f"feedforward {units.of_command(gains['feedforward'])}"] if gains.get("feedforward") else []
        moving, friction = gains.get("velocity_feedforward"), gains.get("friction_feedforward")
        per_speed = f" {units.command} s/{units.position.si}" if units.known else ""
        parts += [f"velocity feedforward {moving:.4g}{per_speed}"] if moving else []
        parts += [f"friction feedforward {units.of_command(friction)}"] if friction else []
        parts += [f"notch {gains['notch_hz']:.3g} Hz"] if gains.get("notch_hz") else []
    law = setting.get("law") or {}
    # A share of 0 says that nothing of a linear law integrates; other zeros are what is not there.
    named = {name: value for name, value in law.items() if _is_number(value) and (value or name == "integral_share")}
    numbers = [units.of_gain(Cascade, name, value) for name, value in named.items()]
    parts += [", ".join(numbers)] if numbers else []
    if verification:
        parts.append(f"verified on {verification['members']} simulated machines")
    return f"version {update['version']} sent: {', '.join(parts)}"


def _receipt(receipt: JsonObject) -> str:
    body = receipt["body"] or {}
    if body.get("applied"):
        return f"version {receipt['version']} applied at sample {body.get('sample')}"
    if receipt["status"] == Reason.FELL_BACK:
        in_force = body.get("parameter_version")
        return f"version {receipt['version']} not applied: {receipt['status']}, as version {in_force}"
    reason = ": ".join(filter(None, (receipt["status"], body.get("detail"))))
    return f"version {receipt['version']} REFUSED by the edge: {reason}"


def _effect(effect: JsonObject, units: Units) -> str:
    """Remark with the largest error at the end of a window, before and under the version."""
    window, before, after = effect["window"], effect["before"], effect["after"]
    errors = f"{_error(before, units)} -> {_error(after, units)} {units.position.name}"
    return f"version {after['version']} in window {window['sequence']}: error {errors}"


def _failed(one: JsonObject) -> bool:
    return str(one["status"]).startswith("failed: ")


def _gap(estimate: JsonObject | None) -> str:
    if estimate is None or estimate["gap"] is None:
        return ""
    spread = "" if estimate["std"] is None else f" ± {NORMAL_95 * estimate['std'] * DEG:.3f}"
    return f"{estimate['gap'] * DEG:.3f}{spread}"


def _error(estimate: JsonObject | None, units: Units) -> str:
    if estimate is None or estimate["tail"] is None or not units.position.name:
        return "?"
    return f"{estimate['tail'] * units.position.factor:.1f}"
