"""What the edge says while it runs: one JSON line per event on the standard error; no line is waited for."""

from __future__ import annotations

import select
import sys
import time
from typing import Any, TextIO

import msgspec


class Troubles:
    """Says what goes wrong, once until it is another thing, and when it is over."""

    def __init__(self) -> None:
        self._told: dict[str, str] = {}

    def look(self, where: str, why: str) -> None:
        """`why`: what is wrong with a part now; empty: nothing."""
        if why != self._told.get(where, ""):
            self._told[where] = why
            if why:
                say("trouble", where=where, why=why)
            else:
                say("trouble over", where=where)


def say(event: str, **values: Any) -> None:
    """Write a line; a standard error that is gone, or that nobody reads, is no reason to stop: the line is lost."""
    line = {"time": round(time.time(), 3), "event": event, **values}
    stream: TextIO | None = sys.stderr
    try:
        if stream is not None and _takes(stream):
            stream.write(msgspec.json.encode(line).decode() + "\n")
            stream.flush()
    except (OSError, ValueError):
        return


def _takes(stream: TextIO) -> bool:
    """Whether writing would not wait: a pipe whose reader stands still is full one day."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return True  # nothing of the system's is behind it
    return bool(select.select([], [descriptor], [], 0.0)[1])
