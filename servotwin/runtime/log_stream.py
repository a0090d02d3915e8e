"""Log lines on a stream whose reader may have stopped, and whose disk may be full: writing never waits."""

from __future__ import annotations

import select
from typing import TextIO

_PIPE_BYTES = 4096
"""Room that a pipe has at least where the system calls it writable."""


class LogStream:
    """Stream of lines, each of which is lost where writing it would block or fails.

    Parameters
    ----------
    stream : TextIO or None
        None: the standard error is closed, and every line is lost.

    Attributes
    ----------
    lost : int
        Number of lines that were lost since the last one that was written.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.stream, self.lost = stream, 0

    def write(self, line: str) -> None:
        """Write a line, or count it."""
        if self.stream is not None and _written(self.stream, line + "\n"):
            self.lost = 0
        else:
            self.lost += 1


def _written(stream: TextIO, text: str) -> bool:
    # In one piece where that cannot block: several processes write lines to one pipe.
    size = len(text) if len(text.encode("utf-8", "replace")) <= _PIPE_BYTES else _PIPE_BYTES // 4
    try:
        for begin in range(0, len(text), size):
            if not _is_writable(stream):
                return False
            stream.write(text[begin : begin + size])
            stream.flush()
    except (OSError, ValueError):
        return False
    return True


def _is_writable(stream: TextIO) -> bool:
    """True where writing would not block; a pipe whose reader has stopped is full one day."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return True  # not a file of the system (a test's StringIO): writing does not block
    return bool(select.select([], [descriptor], [], 0.0)[1])
