"""Opening of an edge's outbox, with what its last status tells about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servotwin.edge_process.config import EdgeConfig
from servotwin.edge_process.monitoring import log
from servotwin.edge_process.startup import count_start, is_later_start
from servotwin.link.outbox_index import AcknowledgedLimits, LastStatus
from servotwin.link.sqlite_outbox import INCOMPLETE, SqliteOutbox

_NOTHING_LEFT = (
    "it is empty or missing although this edge has run before, and the last status, which would tell how many windows "
    "waited, cannot be read: they are lost"
)


def open_outbox(config: EdgeConfig, last_status: Mapping[str, Any], run: str) -> SqliteOutbox:
    """Open the outbox and count the start; the last status tells how many windows waited in it, and how many it had."""
    files = config.files
    windows = last_status.get("windows")
    known = windows if isinstance(windows, dict) else {}
    numbers = (known.get(name) for name in LastStatus._fields)
    last = LastStatus(*(number if isinstance(number, int) else 0 for number in numbers))
    kept = AcknowledgedLimits(files.acknowledged_bytes, files.acknowledged_s)
    box = SqliteOutbox(config.path(files.outbox), config.agent.servo, files.windows, files.bytes, kept, last)
    if box.empty and not known and is_later_start(run):
        box.faults[INCOMPLETE] += 1
        log(INCOMPLETE, why=_NOTHING_LEFT)
    if box.flushed:
        count_start(config.path(files.boots), run)
    return box
