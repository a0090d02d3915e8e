"""What is shown: a table on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import degrees, isfinite
from typing import Any, NamedTuple

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from servotwin.up.pacing import CORES, LIMIT, SLOWEST
from servotwin.up.reading import Judged, View
from servotwin.up.twin_watch import OK, Twin

NONE = "-"
HOUR = 3600.0


class Picture(NamedTuple):
    """Everything at one moment.

    Attributes
    ----------
    views : tuple of View
    twin : Twin or None
    seconds : float
        Since all runs.
    asked, reached : float
        Machine time per time: what is asked for, and what the slowest machine keeps.
    cores, share : float or None
        Cores' worth in use, and its share of two; None: not known.
    url, folder : str
    news : str
        What happened last that is worth a line.
    """

    views: tuple[View, ...]
    twin: Twin | None
    seconds: float
    asked: float
    reached: float
    cores: float | None
    share: float | None
    url: str
    folder: str
    news: str = ""


Cell = Callable[[View], str]


def rendered(picture: Picture) -> RenderableType:
    """The live table and what stands below it."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=True)
    table.add_column("", style="dim", no_wrap=True)
    for view in picture.views:
        table.add_column(view.plan.name, no_wrap=True, min_width=18)
    troubled = any(view.restarts for view in picture.views)
    for name, cell in [*ROWS, *([RESTARTS] if troubled else [])]:
        table.add_row(name, *(Text.from_markup(cell(view)) for view in picture.views))
    return Group(table, Text.from_markup("\n".join(["", *below(picture)]), overflow="fold"))


def below(picture: Picture) -> list[str]:
    """Speed, processor, twin, and where all is kept."""
    lines = [f"{_speed(picture)}   {_processor(picture)}   for {clock(picture.seconds)}", _twin(picture)]
    lines.append(f"[dim]{picture.url}   {escape(picture.folder)}/*.log   Ctrl-C ends it[/]")
    return lines if not picture.news else [*lines, f"[yellow]{escape(picture.news)}[/]"]


def line(picture: Picture) -> str:
    """All in one line of plain text."""
    parts = [_short(view) for view in picture.views]
    head = f"{clock(picture.seconds)}  {_speed(picture)}  {_processor(picture)}"
    return Text.from_markup("  |  ".join([head, *parts, _waits(picture.twin)])).plain


def clock(seconds: float) -> str:
    """h:mm:ss."""
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def _short(view: View) -> str:
    version, waiting = view.edge.get("version", NONE), _windows(view).get("waiting", 0)
    gap = NONE if view.machine is None else f"{view.machine.gap_deg:.3f}"
    link = f", link cut, {waiting} wait" if view.outage else ""
    return f"{view.plan.name} gap {gap} deg, est. {_estimate(view)}, version {version}{link}"


def _speed(picture: Picture) -> str:
    if picture.cores is None and picture.reached == 0.0:
        return f"starting at {picture.asked:g} x real time"
    slow = picture.reached < 0.95 * SLOWEST <= 0.95 * picture.asked
    note = f" [red](this machine does not hold {SLOWEST:g})[/]" if slow else ""
    return f"[bold]{picture.reached:.1f}[/] x real time{note}"


def _processor(picture: Picture) -> str:
    if picture.reached == 0.0:
        return "processor share not measured yet"
    if picture.share is None or picture.cores is None:
        return "processor share not known here: the speed stays"
    colour = "red" if picture.share > LIMIT else "green"
    return f"{picture.cores:.2f} of {CORES} cores = [{colour}]{100 * picture.share:.0f} %[/]"


def _twin(picture: Picture) -> str:
    twin = picture.twin
    if twin is None:
        return "twin: [yellow]no answer[/]"
    counts = ", ".join(f"{number} {name}" for name, number in twin.counts.items() if number or name != "workers lost")
    return f"twin: {counts}, {_waits(twin)}"


def _waits(twin: Twin | None) -> str:
    return "twin: no answer" if twin is None else f"{twin.waiting} in its queue"


def _windows(view: View) -> dict[str, Any]:
    found = view.edge.get("windows", {})
    return found if isinstance(found, dict) else {}


def _number(view: View, key: str, scale: float, digits: int) -> str:
    """Of the edge's status."""
    value = view.edge.get(key)
    return NONE if value is None else f"{value * scale:.{digits}f}"


def _gap(view: View) -> str:
    return NONE if view.machine is None else f"{view.machine.gap_deg:.3f}"


def _estimate(view: View) -> str:
    if view.judged is None:
        return NONE
    told = view.judged.told
    low, high = map(degrees, told.interval)
    note = "" if told.status == OK else f" [yellow]{escape(told.status)}[/]"
    return f"{degrees(told.gap):.3f} ± {0.5 * (high - low):.3f}{note}"


def _error(view: View) -> str:
    judged = view.judged
    if judged is None or judged.error is None:
        return NONE
    colour = "green" if judged.inside else "red"
    return f"[{colour}]{round(judged.error, 4) + 0.0:+.4f}[/] [dim]{_ago(judged)}[/]"


def _ago(judged: Judged) -> str:
    return "" if judged.age is None else f"{judged.age:.0f} s ago"


def _wear(view: View) -> str:
    told = None if view.judged is None else view.judged.told
    if told is None or not isfinite(told.rate):
        return NONE
    return f"{degrees(told.rate) * HOUR:.1f} ± {degrees(told.rate_half) * HOUR:.1f}"


def _version(view: View) -> str:
    if "version" not in view.edge:
        return NONE
    return f"{view.edge['version']}" + (" [yellow]fallback set[/]" if view.edge.get("fallback") else "")


def _gains(view: View) -> str:
    numbers = [_number(view, key, 1e-3, digits) for key, digits in _GAINS.items()]
    return NONE if NONE in numbers else " ".join(numbers)


def _acknowledged(view: View) -> str:
    return str(view.edge.get("up", {}).get("windows", 0)) if view.edge else NONE


def _dropped(view: View) -> str:
    return str(sum(_windows(view).get("dropped", {}).values())) if view.edge else NONE


def _waiting(view: View) -> str:
    number = _windows(view).get("waiting")
    return NONE if number is None else f"[yellow]{number}[/]" if number else "0"


def _link(view: View) -> str:
    if view.outage:
        return f"[red]outage[/], {view.outage:.0f} s left"
    trouble = view.edge.get("up", {}).get("trouble") or view.edge.get("down", {}).get("trouble")
    return "[yellow]coming back[/]" if trouble else "[green]up[/]" if view.edge else NONE


_GAINS = {"kp_v_per_m": 2, "ki_v_per_m_s": 1, "kd_v_s_per_m": 2}
ROWS: Sequence[tuple[str, Cell]] = (
    ("", lambda view: f"[dim]{view.plan.trait}[/]"),
    ("edge's role", lambda view: view.plan.role),
    ("twin's policy", lambda view: view.plan.model),
    ("machine time", lambda view: NONE if view.machine is None else clock(view.machine.time_s)),
    ("true gap, deg", _gap),
    ("estimate, deg", _estimate),
    ("off by, deg", _error),
    ("wear, deg/h", _wear),
    ("version", _version),
    ("dead zone, mm", lambda view: _number(view, "tolerance_m", 1e3, 4)),
    ("Kp Ki Kd, V/mm", _gains),
    ("feedforward, mV", lambda view: _number(view, "feedforward_v", 1e3, 1)),
    ("windows cut", lambda view: str(view.cut) if view.edge else NONE),
    ("acknowledged", _acknowledged),
    ("waiting", _waiting),
    ("dropped", _dropped),
    ("link", _link),
)
RESTARTS: tuple[str, Cell] = ("restarts", lambda view: f"[red]{view.restarts}[/]" if view.restarts else "0")


def summary(picture: Picture) -> Iterable[str]:
    """The last words, one line per servo."""
    for view in picture.views:
        machine = NONE if view.machine is None else clock(view.machine.time_s)
        windows = (
            f"{view.cut} cut, {_acknowledged(view)} acknowledged, {_waiting(view)} waiting, {_dropped(view)} dropped"
        )
        gap = f"gap {_gap(view)} deg, estimated {_estimate(view)} (off by {_error(view)})"
        told = f"{view.plan.name}: {machine} of machine time, {gap}, version {_version(view)}, windows: {windows}"
        yield Text.from_markup(told).plain
