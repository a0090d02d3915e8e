"""Locks between processes: they end with whoever holds them, however that ends."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.store.engine import parse_address, sqlite_file
from servotwin.twin_service.secret_file import PRIVATE


@contextmanager
def alone(store: str) -> Iterator[None]:
    """Hold a store for this process; one of PostgreSQL is shared, and not held.

    Two services on one SQLite store would lend each other's servos away, and never tell each other's edges.

    Raises
    ------
    InvalidInput
        Another process holds it, or the file beside it cannot be made.
    """
    file = sqlite_file(parse_address(store))
    if file is None:
        yield
        return
    with _beside(file) as descriptor:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InvalidInput(
                f"store {file}: another twin works on it; end that one first, or let several share a PostgreSQL"
            ) from None
        yield


@contextmanager
def in_turn(file: Path) -> Iterator[None]:
    """Change a file after whoever else is changing it; raises InvalidInput where nothing can be made beside it."""
    with _beside(file) as descriptor:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


@contextmanager
def _beside(file: Path) -> Iterator[int]:
    """The file that is locked: not `file`, which is replaced, or loses SQLite's own locks when it is closed."""
    whole = file.resolve()
    lock = whole.with_name(f"{whole.name}-lock")
    try:
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR, PRIVATE)
    except OSError as error:
        raise InvalidInput(f"{lock}: cannot be made ({error.strerror})") from None
    try:
        yield descriptor
    finally:
        os.close(descriptor)
