"""What the service logs: one JSON object per line, never a token, a header or a body."""

from __future__ import annotations

import logging
import sys
from datetime import UTC, datetime
from typing import Any, TextIO

import msgspec

_PLAIN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message", "taskName"}


class JsonLines(logging.Formatter):
    """A record as JSON: time, level, where, message, and whatever `extra` held."""

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        extra = {key: value for key, value in vars(record).items() if key not in _PLAIN}
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "where": record.name,
            "message": record.getMessage(),
            **extra,
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return msgspec.json.encode(line, enc_hook=str).decode()


def configure(level: str, stream: TextIO | None = None) -> logging.Handler:
    """Log to `stream` (standard error), from `level` on; returns the handler so that it can be removed again.

    Of uvicorn only warnings: its start and end are logged here, its access log would hold every request.
    """
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonLines())
    ours = logging.getLogger("servotwin")
    ours.setLevel(level.upper())
    ours.addHandler(handler)
    theirs = logging.getLogger("uvicorn")
    theirs.setLevel(logging.WARNING)
    theirs.addHandler(handler)
    ours.propagate = theirs.propagate = False
    return handler
