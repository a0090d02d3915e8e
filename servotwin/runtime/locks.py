"""Locks between processes: file locks, which the system releases when their process ends, even by SIGKILL."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_SILENT_S, _AGAIN_S = 1.0, 0.02
"""s for which a lock is waited for without a word; s between tries meanwhile."""


@contextmanager
def locked(path: Path, *, wait: bool = False, waiting: Callable[[int], None] | None = None) -> Iterator[int]:
    """Hold the exclusive lock on a file inside a `with` block; the file is made where it is missing, and stays.

    Lock a file beside the protected one: the protected one may be replaced, and SQLite loses its own locks on a file
    when another descriptor of it is closed.

    Parameters
    ----------
    path : Path
        Made with mode 0600.
    wait : bool
        Wait until another process that holds the lock releases it.
    waiting : callable, optional
        Called once after a second of waiting, with the descriptor of the lock file.

    Yields
    ------
    int
        Descriptor of the lock file; a child process that inherits it holds the lock too.

    Raises
    ------
    BlockingIOError
        Another process holds the lock.
    OSError
        The file cannot be made, or its file system has no locks.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        if waiting is not None and not _locked_soon(descriptor):
            waiting(descriptor)
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


def _locked_soon(descriptor: int) -> bool:
    """Try to take a lock for a moment; returns whether it is held."""
    until = time.monotonic() + _SILENT_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(_AGAIN_S)
        else:
            return True


def lock_beside(path: Path) -> Path:
    """Return the path of the lock file of `path`, links resolved."""
    whole = path.resolve()
    return whole.with_name(f"{whole.name}-lock")
