"""Log lines and counts of evidence."""

from __future__ import annotations

import logging

from servotwin.store.records import TOO_LATE, EvidenceRecord, Lease, MessageKind, StoredMessage, WorkResult
from servotwin.twin_service.monitoring import Metrics, utc

QUIET = ("glance", "trend", "machine", "motor", "disturbance", "excitation")
"""Evidence of every window: logged at level debug."""
ALARMS = ("failed", "fallback", "withdrawn", "alarm")
"""Evidence that somebody should look at: logged as warnings."""


def log_kind(record: EvidenceRecord) -> str:
    """Kind of evidence in logs and metrics: "failed" for any message that could not be processed."""
    return "failed" if record.status.startswith("failed") else record.kind


def count_evidence(metrics: Metrics, result: WorkResult) -> None:
    """Count a committed result: its evidence, the edges' decisions, and the windows that are too old for an update."""
    for record in result.evidence:
        metrics.evidence.add(log_kind(record))
        if record.kind == "receipt":
            metrics.receipts.add(record.status)
        elif record.kind == "redesign" and record.status.startswith(TOO_LATE):
            metrics.late.add()


def write_evidence(log: logging.Logger, lease: Lease, result: WorkResult, seconds: float) -> None:
    """Log a committed result, whose work took so long."""
    about = {"servo": lease.servo, "serial": lease.serial, "seconds": round(seconds, 6)}
    sources = {message.id: message for message in lease.messages}
    for record in result.evidence:
        kind = log_kind(record)
        level = logging.WARNING if kind in ALARMS else logging.DEBUG if kind in QUIET else logging.INFO
        if log.isEnabledFor(level):
            log.log(level, kind, extra={**about, **_identifiers(record, sources.get(record.message))})


def _identifiers(record: EvidenceRecord, source: StoredMessage | None) -> dict[str, object]:
    """Message, with its receipt, window, version and context of evidence, as far as it has them."""
    known = {
        "message_id": record.message,
        "received": source and utc(source.received),  # under load long before this line
        "window": source.key if source is not None and source.kind is MessageKind.WINDOW else None,
        "version": record.version,
        "status": record.status,
        "context": record.context,
    }
    return {key: value for key, value in known.items() if value not in (None, "")}
