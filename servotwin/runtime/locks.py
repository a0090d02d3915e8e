"""Locks between processes: files locked by the system, which end with whoever holds them, however that ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[int]:
    """Hold the exclusive lock on a file, which is made where it is missing and stays.

    Lock a file beside the one that is protected: that one may be replaced, and SQLite loses its own locks on a file
    when another descriptor of it is closed.

    Parameters
    ----------
    path : Path
        Made with mode 0600.
    wait : bool
        Wait for whoever holds it.

    Yields
    ------
    int
        Its descriptor; a child process that inherits it holds the lock too.

    Raises
    ------
    BlockingIOError
        Another process holds it.
    OSError
        The file cannot be made, or its disk takes no locks.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


def lock_beside(path: Path) -> Path:
    """Return the path of the file whose lock protects `path`, links resolved."""
    whole = path.resolve()
    return whole.with_name(f"{whole.name}-lock")
