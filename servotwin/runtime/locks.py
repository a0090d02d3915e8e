"""Locks between processes: file locks, which the system releases when their process ends, even by SIGKILL."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[int]:
    """Hold the exclusive lock on a file inside a `with` block; the file is made where it is missing, and stays.

    Lock a file beside the protected one: the protected one may be replaced, and SQLite loses its own locks on a file
    when another descriptor of it is closed.

    Parameters
    ----------
    path : Path
        Made with mode 0600.
    wait : bool
        Wait until another process that holds the lock releases it.

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
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield descriptor
    finally:
        os.close(descriptor)


def lock_beside(path: Path) -> Path:
    """Return the path of the lock file of `path`, links resolved."""
    whole = path.resolve()
    return whole.with_name(f"{whole.name}-lock")
