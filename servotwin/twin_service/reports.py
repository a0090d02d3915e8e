"""Report of one machine, read from the store."""

from __future__ import annotations

from servotwin.dashboard.machine_report import machine_report
from servotwin.dashboard.series import machine_series
from servotwin.store.store import Store
from servotwin.twin_service.fleet_reader import FleetReader
from servotwin.twin_service.http_operator import trace_as_json

_WINDOWS, _UPDATES = 400, 50
"""Windows, and windows that led to updates, in a report."""


def report_of(store: Store, reader: FleetReader, servo: str) -> str | None:
    """Report of a machine as HTML; None: it has never sent a message."""
    store.require_sound(servo)
    now = reader.now()
    rows = reader.rows([servo])
    if not rows:
        return None
    series = store.reading(lambda connection: machine_series(connection, servo, _WINDOWS))
    traces = [trace_as_json(each) for each in store.audit(servo, limit=_UPDATES, updates=True)]
    return machine_report(rows[0], series, traces, now)
