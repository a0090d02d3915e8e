"""Status display: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import degrees, isfinite
from typing import Any, NamedTuple

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from servotwin.config.units import unit_of
from servotwin.plant.display_units import DEGREES, MILLIMETRES
from servotwin.up.speed import CORES, LIMIT, SLOWEST
from servotwin.up.status import OK, ServoStatus, TwinStatus

_NONE, _NO_ESTIMATE = "-", "no estimate yet"
_HOUR = 3600.0


class Snapshot(NamedTuple):
    """Status of everything at one moment.

    Attributes
    ----------
    servos : tuple of ServoStatus
    twin : TwinStatus or None
    seconds : float
        s since all processes run.
    speed, reached : float
        Machine time per time: the set speed, and that of the slowest machine.
    cores, share : float or None
        Cores in use, and their share of two; None: unknown.
    url, folder : str
    event : str
        Latest event, such as the restart of a process; empty: none.
    """

    servos: tuple[ServoStatus, ...]
    twin: TwinStatus | None
    seconds: float
    speed: float
    reached: float
    cores: float | None
    share: float | None
    url: str
    folder: str
    event: str = ""


_Cell = Callable[[ServoStatus], str]


def table(snapshot: Snapshot) -> RenderableType:
    """Live table with the lines below it: a column for each servo or, where they are many, a short row."""
    grid = _rows_of_servos(snapshot) if len(snapshot.servos) > _MOST_COLUMNS else _columns_of_servos(snapshot)
    return Group(grid, Text.from_markup("\n".join(["", *_below(snapshot)]), overflow="fold"))


def _columns_of_servos(snapshot: Snapshot) -> Table:
    grid = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=True)
    grid.add_column("", style="dim", no_wrap=True)
    for servo in snapshot.servos:
        grid.add_column(servo.plan.name, no_wrap=True, min_width=18)
    troubled = any(servo.restarts for servo in snapshot.servos)
    rows = [*_ROWS, *_setting_rows(snapshot.servos), *_LINK_ROWS, *([_RESTARTS] if troubled else [])]
    for name, cell in rows:
        grid.add_row(name, *(Text.from_markup(cell(servo)) for servo in snapshot.servos))
    return grid


def _rows_of_servos(snapshot: Snapshot) -> Table:
    grid = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=True)
    for name in ("", *_SHORT):
        grid.add_column(name, no_wrap=True)
    for servo in snapshot.servos:
        grid.add_row(servo.plan.name, *(Text.from_markup(cell(servo)) for cell in _SHORT.values()))
    return grid


def _below(snapshot: Snapshot) -> list[str]:
    """Lines with speed, processor, twin, address and folder."""
    lines = [f"{_speed(snapshot)}   {_processor(snapshot)}   for {clock(snapshot.seconds)}", _twin(snapshot)]
    lines.append(f"[dim]{snapshot.url}   {escape(snapshot.folder)}/*.log   Ctrl-C ends it[/]")
    return lines if not snapshot.event else [*lines, f"[yellow]{escape(snapshot.event)}[/]"]


def line(snapshot: Snapshot) -> str:
    """One line of plain text."""
    parts = [_short(servo) for servo in snapshot.servos]
    head = f"{clock(snapshot.seconds)}  {_speed(snapshot)}  {_processor(snapshot)}"
    return Text.from_markup("  |  ".join([head, *parts, f"twin: {_waits(snapshot.twin)}"])).plain


def clock(seconds: float) -> str:
    """h:mm:ss."""
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def _short(servo: ServoStatus) -> str:
    waiting = _windows(servo).get("waiting", 0)
    gap = "no machine yet" if servo.machine is None else f"gap {_gap(servo)} deg"
    estimate = _NO_ESTIMATE if servo.estimate is None else f"est. {_estimate(servo)}"
    link = f", link cut, {waiting} wait" if servo.outage else ""
    return f"{servo.plan.name} {gap}, {estimate}, version {_version(servo)}{link}"


def _speed(snapshot: Snapshot) -> str:
    if snapshot.cores is None and snapshot.reached == 0.0:
        return f"starting at {snapshot.speed:g} x real time"
    least = min(SLOWEST, snapshot.speed)
    slow = snapshot.reached < 0.95 * least
    note = f" [red](this machine does not reach {least:g})[/]" if slow else ""
    return f"[bold]{snapshot.reached:.1f}[/] x real time{note}"


def _processor(snapshot: Snapshot) -> str:
    if snapshot.reached == 0.0:
        return "processor share not measured yet"
    if snapshot.share is None or snapshot.cores is None:
        return "processor share not known here: the speed stays"
    colour = "red" if snapshot.share > LIMIT else "green"
    return f"{snapshot.cores:.2f} of {CORES} cores = [{colour}]{100 * snapshot.share:.0f} %[/]"


def _twin(snapshot: Snapshot) -> str:
    twin = snapshot.twin
    if twin is None:
        return "twin: [yellow]no answer[/]"
    counts = ", ".join(f"{number} {name}" for name, number in twin.counts.items() if number or name != "workers lost")
    return f"twin: {counts}, {_waits(twin)}"


def _waits(twin: TwinStatus | None) -> str:
    if twin is None:
        return "no answer"
    return f"{twin.waiting} in its queue" + "".join(f", [red]{escape(servo)} set aside[/]" for servo in twin.aside)


def _windows(servo: ServoStatus) -> dict[str, Any]:
    windows = servo.edge.get("windows", {})
    return windows if isinstance(windows, dict) else {}


def _gap(servo: ServoStatus) -> str:
    return _NONE if servo.machine is None else f"{servo.machine.gap_deg:.3f}"


def _estimate(servo: ServoStatus) -> str:
    if servo.estimate is None:
        return _NONE
    estimate = servo.estimate.estimate
    low, high = map(degrees, estimate.interval)
    note = "" if estimate.status == OK else f" [yellow]{escape(estimate.status)}[/]"
    return f"{degrees(estimate.gap):.3f} ± {0.5 * (high - low):.3f}{note}"


def _error(servo: ServoStatus) -> str:
    compared = servo.estimate
    if compared is None or compared.error is None:
        return _NONE
    colour = "green" if compared.inside else "red"
    age = "" if compared.age is None else f"{compared.age:.0f} s ago"
    # Adding 0.0 turns -0.0 into 0.0, so that the sign does not flicker.
    return f"[{colour}]{round(compared.error, 4) + 0.0:+.4f}[/] [dim]{age}[/]"


def _wear(servo: ServoStatus) -> str:
    estimate = None if servo.estimate is None else servo.estimate.estimate
    if estimate is None or not isfinite(estimate.rate):
        return _NONE
    return f"{degrees(estimate.rate) * _HOUR:.1f} ± {degrees(estimate.rate_half) * _HOUR:.1f}"


def _version(servo: ServoStatus) -> str:
    if "version" not in servo.edge:
        return _NONE
    return f"{servo.edge['version']}" + (" [yellow]fallback set[/]" if servo.edge.get("fallback") else "")


def _setting_rows(servos: Sequence[ServoStatus]) -> list[tuple[str, _Cell]]:
    """Rows with the settings in force, a row for each unit: machines may count in different ones."""
    shown = [(servo, _setting(servo)) for servo in servos]
    names = dict.fromkeys(name for _, setting in shown for name in setting)

    def row(name: str) -> _Cell:
        return lambda servo: next(setting.get(name, _NONE) for each, setting in shown if each is servo)

    return [(name, row(name)) for order in _SETTINGS for name in names if name.startswith(order)]


def _setting(servo: ServoStatus) -> dict[str, str]:
    """Dead zone, gains and feedforward in the units of the machine, by the name of their row."""
    units, edge = servo.units, {name: each for name, each in servo.edge.items() if isinstance(each, float)}
    position = MILLIMETRES if units.position == "m" else DEGREES
    rows = dict[str, str]()
    if (tolerance := edge.get(units.key("tolerance_m"))) is not None:
        rows[f"dead zone, {position.name}"] = f"{tolerance * position.factor:.4f}"
    pid = [edge[name] for name in map(units.key, _PID) if name in edge]
    if len(pid) == len(_PID):
        scale, per = (1e-3, "mm") if units.position == "m" else (1.0, "rad")
        rows[f"Kp Ki Kd, {units.command}/{per}"] = " ".join(f"{scale * gain:.3g}" for gain in pid)
    for name, key in _CASCADE.items():
        if gain := edge.get(units.key(key)):  # 0: the drive closes the velocity loop, or there is no integral action
            rows[f"{name}, {unit_of(units.key(key)).name}"] = f"{gain:.3g}"
    if (feedforward := edge.get(units.key("feedforward_v"))) is not None:
        rows[f"feedforward, m{units.command}"] = f"{1e3 * feedforward:.1f}"
    return rows


def _acknowledged(servo: ServoStatus) -> str:
    return str(servo.edge.get("up", {}).get("windows", 0)) if servo.edge else _NONE


def _dropped(servo: ServoStatus) -> str:
    return str(sum(_windows(servo).get("dropped", {}).values())) if servo.edge else _NONE


def _waiting(servo: ServoStatus) -> str:
    number = _windows(servo).get("waiting")
    return _NONE if number is None else f"[yellow]{number}[/]" if number else "0"


def _link(servo: ServoStatus) -> str:
    if servo.outage:
        return f"[red]outage[/], {servo.outage:.0f} s left"
    trouble = servo.edge.get("up", {}).get("trouble") or servo.edge.get("down", {}).get("trouble")
    return "[yellow]reconnecting[/]" if trouble else "[green]up[/]" if servo.edge else _NONE


_PID = ("kp_v_per_m", "ki_v_per_m_s", "kd_v_s_per_m")
_CASCADE = {"Kv": "position_gain_per_s", "Kp": "velocity_gain_v_s_per_rad", "Ti": "integral_time_s"}
_SETTINGS = ("dead zone", "K", "Ti", "feedforward")
"""Beginnings of the names of rows, in their order."""
_ROWS: Sequence[tuple[str, _Cell]] = (
    ("", lambda servo: f"[dim]{servo.plan.trait}[/]"),
    ("edge's role", lambda servo: servo.plan.role),
    ("twin's policy", lambda servo: servo.plan.policy),
    ("machine time", lambda servo: _NONE if servo.machine is None else clock(servo.machine.time_s)),
    ("true gap, deg", _gap),
    ("estimate ± 95 %, deg", _estimate),
    ("error, deg", _error),
    ("wear ± 95 %, deg/h", _wear),
    ("version", _version),
)
_LINK_ROWS: Sequence[tuple[str, _Cell]] = (
    ("windows cut", lambda servo: str(servo.cut) if servo.edge else _NONE),
    ("acknowledged", _acknowledged),
    ("waiting", _waiting),
    ("dropped", _dropped),
    ("link", _link),
)
_SHORT: Mapping[str, _Cell] = {
    "gap ± 95 %, deg": _estimate,
    "error, deg": _error,
    "version": _version,
    "waiting": _waiting,
    "link": _link,
}
_MOST_COLUMNS = 4
_RESTARTS: tuple[str, _Cell] = ("restarts", lambda servo: f"[red]{servo.restarts}[/]" if servo.restarts else "0")


def summary(snapshot: Snapshot) -> Iterable[str]:
    """Final status, one line per servo."""
    for servo in snapshot.servos:
        machine = _NONE if servo.machine is None else clock(servo.machine.time_s)
        windows = f"{servo.cut} cut, {_acknowledged(servo)} acknowledged, {_waiting(servo)} waiting"
        windows += f", {_dropped(servo)} dropped"
        gap = f"gap {_gap(servo)} deg, {_NO_ESTIMATE}"
        if servo.estimate is not None:
            gap = f"gap {_gap(servo)} deg, estimated {_estimate(servo)} deg (95 %, error {_error(servo)})"
        line = f"{servo.plan.name}: {machine} of machine time, {gap}, version {_version(servo)}, windows: {windows}"
        yield Text.from_markup(line).plain
