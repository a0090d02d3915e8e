"""Series of one machine: gap and wear over its windows, versions and what became of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import sqlalchemy as sa

from servotwin.dashboard.evidence_body import body_of, finite, interval_of
from servotwin.dashboard.machine_facts import UNKNOWN, MachineFacts, machine_facts
from servotwin.store import overview, queries
from servotwin.store.overview import WindowGap
from servotwin.store.records import StoredEvidence

Row = dict[str, Any]
_DECISIONS = 500
"""Updates, receipts and fallbacks, of each kind, that a series has at most."""
GAP_COLUMNS = (
    "received", "sample_time", "boot", "sequence", "kind", "status", "gap", "low", "high", "trend", "trend_std",
    "version", "tail", "residual", "reasons", "decision",
)  # fmt: skip
"""Columns of `gap_series`: s since the epoch, s of the edge's time, and rad; `tail` and `residual` in m or rad;
`decision`: why nothing was redesigned."""


def machine_series(connection: sa.Connection, servo: str, limit: int, before: int | None = None) -> Row:
    """Read the gaps of a servo's newest windows (or of those before an id), what was decided, and its model's facts."""
    found = overview.gaps(connection, servo, limit, before)
    decided = overview.decisions(connection, servo, _DECISIONS)
    key = _context(one for each in reversed(found) for one in each.evidence) or _context(
        # The newest windows may all wait to be processed.
        overview.evidence_of_kinds(connection, servo, ("estimate",), 1)
    )
    return {
        "servo": servo,
        "first": found[0].window.id if found else None,
        "windows": gap_series(found),
        "versions": versions(decided),
        "fallbacks": fallbacks(decided),
        "machine": _facts_in(connection, key),
    }


def machine_of(connection: sa.Connection, servo: str) -> MachineFacts:
    """Facts of a servo's model, as of its newest estimate."""
    return _facts_in(connection, _context(overview.evidence_of_kinds(connection, servo, ("estimate",), 1)))


def _facts_in(connection: sa.Connection, key: str) -> MachineFacts:
    context = queries.contexts(connection, [key]).get(key)
    return UNKNOWN if context is None else machine_facts(context)


def _context(records: Iterable[StoredEvidence]) -> str:
    """Key of the first context that evidence names; empty: none."""
    return next((record.context for record in records if record.context), "")


def gap_series(windows: Iterable[WindowGap]) -> dict[str, list[Any]]:
    """One entry per window, column by column, oldest first; None where something is unknown or unbounded."""
    rows = [_gap_row(each) for each in windows]
    return {name: [row[name] for row in rows] for name in GAP_COLUMNS}


def _gap_row(each: WindowGap) -> Row:
    window = each.window
    newest = {one.kind: one for one in each.evidence}
    estimate, trend, redesign = (
        newest.get("estimate", newest.get("glance")),
        newest.get("trend"),
        newest.get("redesign"),
    )
    failed = estimate is not None and estimate.status.startswith("failed")
    interval = None if estimate is None or failed else interval_of(estimate)
    low, high = interval or (None, None)
    residual, reasons = (None, []) if estimate is None else _fit(estimate)
    return {
        "received": window.received,
        "sample_time": window.start,
        "boot": window.boot,
        "sequence": window.sequence,
        "kind": "" if estimate is None else estimate.kind,
        "status": "" if estimate is None else estimate.status,
        "gap": None if estimate is None else finite(estimate.gap),
        "low": low,
        "high": high,
        "trend": None if trend is None else finite(trend.gap),
        "trend_std": None if trend is None else finite(trend.std),
        "version": None if estimate is None else estimate.version,
        "tail": None if estimate is None else finite(estimate.tail),
        "residual": residual,
        "reasons": reasons,
        "decision": "" if redesign is None else redesign.status,
    }


def _fit(estimate: StoredEvidence) -> tuple[float | None, list[str]]:
    """Root mean square of the residual, and the reasons against an estimate."""
    body = body_of(estimate)
    fit = body.get("estimate") if isinstance(body, dict) else None
    if not isinstance(fit, dict):
        return (finite(body.get("misfit")) if isinstance(body, dict) else None), []
    reasons = fit.get("reasons")
    return finite(fit.get("rms")), [str(each) for each in reasons] if isinstance(reasons, list) else []


def versions(decisions: Sequence[StoredEvidence]) -> list[Row]:
    """One row per update: when it was sent, and the edge's answer."""
    answers = {record.version: record for record in decisions if record.kind == "receipt"}
    return [_version(record, answers.get(record.version)) for record in decisions if record.kind == "update"]


def _version(update: StoredEvidence, receipt: StoredEvidence | None) -> Row:
    answer = None if receipt is None else body_of(receipt)
    applied = answer.get("applied") if isinstance(answer, dict) else None
    return {
        "version": update.version,
        "sent": update.created,
        "gap": finite(update.gap),
        "answered": None if receipt is None else receipt.time,
        "applied": applied if isinstance(applied, bool) else None,
        "reason": "" if receipt is None else receipt.status,
    }


def fallbacks(decisions: Sequence[StoredEvidence]) -> list[Row]:
    """One row per fallback of the edge: when it was reported, its cause, and the version that was left."""
    return [
        {"time": record.time, "cause": record.status, "version": record.version}
        for record in decisions
        if record.kind == "fallback"
    ]


def table_csv(columns: dict[str, list[Any]]) -> str:
    """Columns of equal length as CSV with a head; nothing where a value is unknown.

    A text that a spreadsheet would take for a formula begins with an apostrophe.
    """
    lines = [",".join(columns)]
    lines += [",".join(map(_cell, row)) for row in zip(*columns.values(), strict=True)]
    return "\r\n".join(lines) + "\r\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        value = "; ".join(map(str, value))
    if not isinstance(value, str):
        return repr(value)
    text = f"'{value}" if value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
    return '"' + text.replace('"', '""') + '"' if set(text) & set(',"\r\n') else text
