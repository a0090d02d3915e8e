"""Rows of the fleet: what is known of each servo now, from its newest facts in the store."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from servotwin.dashboard.evidence_body import NORMAL_95, WearRate, body_of, finite, interval_95, wear_rate
from servotwin.dashboard.machine_facts import UNKNOWN, machine_facts
from servotwin.store.overview import ServoFacts
from servotwin.store.records import StoredEvidence

Interval = tuple[float | None, float | None]
ALARMS_S = 86400.0
"""s for which an alarm is shown after it was raised."""


@dataclass(frozen=True)
class FleetAlarm:
    """An alarm in a row: when it was raised, s since the epoch, and the sentence."""

    time: float
    sentence: str


@dataclass(frozen=True)
class LastWindow:
    """The newest window of a row; `received`: s since the epoch."""

    boot: str
    sequence: int
    received: float


@dataclass(frozen=True)
class FleetRow:
    """Present knowledge of a servo.

    Attributes
    ----------
    servo : str
    gap : float or None
        rad, of the newest estimate or glance.
    interval : (float or None, float or None) or None
        rad, 95 %; an end that is None is unbounded; None: unknown.
    status : str
        Of the same.
    rate : float or None
        rad per s of machine time, of the trend.
    rate_interval : (float, float) or None
        95 %.
    gap_limit : float or None
        rad, largest acceptable gap.
    until_limit : float or None
        s of machine time until the trend reaches that limit, 0: it has; None: it is not growing, or unknown.
    until_limit_interval : (float, float or None) or None
        With the rate at the ends of its interval; an end that is None: it may never get there.
    travel : float or None
        Travel of the load per radian of the gap, in `travel_unit`.
    travel_unit, command_unit : str
        As in `MachineFacts`.
    version_sent, version_in_force : int or None
        Of the newest update; as the edge reported in its present boot.
    receipt : str
        Reason in the newest receipt.
    windows, waiting : int
        Stored, and messages not yet processed.
    last_window : LastWindow or None
    last_message : float or None
        s since the epoch.
    connected : bool or None
        The edge holds a connection to this twin; None: cannot be known, as over MQTT.
    alarms : tuple of FleetAlarm
        Of the last day, newest first, each sentence once; before them that the fallback set runs, as long as it does.
    """

    servo: str
    gap: float | None
    interval: Interval | None
    status: str
    rate: float | None
    rate_interval: tuple[float, float] | None
    gap_limit: float | None
    until_limit: float | None
    until_limit_interval: tuple[float, float | None] | None
    travel: float | None
    travel_unit: str
    command_unit: str
    version_sent: int | None
    version_in_force: int | None
    receipt: str
    windows: int
    waiting: int
    last_window: LastWindow | None
    last_message: float | None
    connected: bool | None
    alarms: tuple[FleetAlarm, ...]


def fleet_row(facts: ServoFacts, contexts: Mapping[str, str], connected: bool | None) -> FleetRow:
    """Compose the row of a servo.

    Parameters
    ----------
    facts : ServoFacts
    contexts : mapping of str to str
        Texts of the contexts that `context_key` names.
    connected : bool or None
    """
    summary, newest, window = facts.summary, facts.newest, facts.window
    context, in_force = context_key(facts), version_in_force(newest, "" if window is None else window.boot)
    machine = machine_facts(contexts[context]) if context in contexts else UNKNOWN
    trend = wear_rate(newest.get("trend"))
    until, until_interval = time_until_limit(trend, machine.gap_limit)
    return FleetRow(
        servo=summary.servo,
        gap=finite(summary.gap),
        interval=_summary_interval(facts),
        status=summary.status,
        rate=None if trend is None else trend.rate,
        rate_interval=None if trend is None else rate_interval(trend),
        gap_limit=machine.gap_limit,
        until_limit=until,
        until_limit_interval=until_interval,
        travel=machine.travel,
        travel_unit=machine.travel_unit,
        command_unit=machine.command_unit,
        version_sent=summary.version,
        version_in_force=in_force,
        receipt=summary.receipt,
        windows=summary.windows,
        waiting=summary.waiting,
        last_window=None if window is None else LastWindow(window.boot, window.sequence, window.received),
        last_message=summary.last_message,
        connected=connected,
        alarms=(*_fallen(newest.get("fallback"), in_force), *_alarms(facts.alarms)),
    )


def context_key(facts: ServoFacts) -> str:
    """Key of the context that a row needs; empty: none."""
    records = (facts.newest.get(kind) for kind in ("window", "trend"))
    return next((record.context for record in records if record is not None and record.context), "")


def rate_interval(trend: WearRate) -> tuple[float, float]:
    """95 % interval of the wear rate, rad/s."""
    half = NORMAL_95 * trend.rate_std
    return trend.rate - half, trend.rate + half


def time_until_limit(
    trend: WearRate | None, limit: float | None
) -> tuple[float | None, tuple[float, float | None] | None]:
    """Time until the gap of the trend reaches a limit, s of machine time, and with both at the ends of their intervals.

    The two ends are taken together, so that the interval is a cautious one.
    """
    if trend is None or limit is None:
        return None, None
    slow, fast = rate_interval(trend)
    half = NORMAL_95 * trend.gap_std
    early = _passage(limit - trend.gap - half, fast)
    if early is None:
        return None, None
    return _passage(limit - trend.gap, trend.rate), (early, _passage(limit - trend.gap + half, slow))


def _passage(left: float, rate: float) -> float | None:
    """Time in which a rate covers what is left; None: never."""
    if left <= 0.0:
        return 0.0
    return left / rate if rate > 0.0 and math.isfinite(left / rate) else None


def version_in_force(newest: Mapping[str, StoredEvidence], window_boot: str = "") -> int | None:
    """Highest version that the edge reported in its present boot, with a window, a receipt, a fallback or a hello.

    Within a boot versions only rise, whatever the order in which the reports came. The present boot is that of the
    newest hello; without one, of the newest report.
    """
    reports = {kind: newest[kind] for kind in ("window", "hello", "receipt", "fallback") if kind in newest}
    if not reports:
        return None
    boots = {kind: _boot_of(record, kind, window_boot) for kind, record in reports.items()}
    present = boots["hello"] if "hello" in reports else boots[max(reports, key=lambda kind: reports[kind].id)]
    versions = (_version_of(record, kind) for kind, record in reports.items() if boots[kind] in (present, ""))
    return max((version for version in versions if version is not None), default=None)


def _boot_of(report: StoredEvidence, kind: str, window_boot: str) -> str:
    """Boot of a report; empty: unknown."""
    if kind in ("hello", "window"):
        return report.status if kind == "hello" else window_boot
    body = body_of(report)
    return str(body.get("boot", "")) if isinstance(body, dict) else ""


def _version_of(report: StoredEvidence, kind: str) -> int | None:
    """Version in force after a report."""
    body = body_of(report) if kind in ("receipt", "fallback") else None
    version = body.get("parameter_version") if isinstance(body, dict) else None
    return version if isinstance(version, int) else report.version


def _summary_interval(facts: ServoFacts) -> Interval | None:
    """Interval of the newest gap: of a lower bound, without an upper end."""
    interval = interval_95(finite(facts.summary.gap), finite(facts.summary.std))
    if interval is not None and facts.summary.status == "lower bound":
        return interval[0], None
    return interval


def _fallen(fallback: StoredEvidence | None, in_force: int | None) -> tuple[FleetAlarm, ...]:
    """Tell that the edge runs its fallback set; nothing where another version is in force."""
    if fallback is None or in_force is None or _version_of(fallback, "fallback") != in_force:
        return ()
    return (FleetAlarm(fallback.time, f"the edge runs its fallback set: {fallback.status}"),)


def _alarms(records: tuple[StoredEvidence, ...]) -> tuple[FleetAlarm, ...]:
    """Each sentence once, at its newest time."""
    first: dict[str, FleetAlarm] = {}
    for record in records:
        first.setdefault(record.status, FleetAlarm(record.created, record.status))
    return tuple(first.values())
