"""What the edge says while it runs: one JSON line per event on the standard error."""

from __future__ import annotations

import sys
import time
from typing import Any

import msgspec


def say(event: str, **values: Any) -> None:
    """Write a line; a standard error that is gone is no reason to stop."""
    line = {"time": round(time.time(), 3), "event": event, **values}
    try:
        sys.stderr.write(msgspec.json.encode(line).decode() + "\n")
        sys.stderr.flush()
    except (OSError, ValueError):
        return
