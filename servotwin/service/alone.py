"""One process for one SQLite store: two would lend each other's servos away, and never tell each other's edges."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.service.secretfile import PRIVATE
from servotwin.store.address import address_of, file_of


@contextmanager
def alone(store: str) -> Iterator[None]:
    """Hold a store for this process, however it ends; one of PostgreSQL is shared, and not held.

    A file beside the store is locked: SQLite loses its own locks where the store's is opened and closed once more.

    Raises
    ------
    InvalidInput
        Another process holds it, or the file beside it cannot be made.
    """
    file = file_of(address_of(store))
    if file is None:
        yield
        return
    whole = file.resolve()
    descriptor = _opened(whole.with_name(f"{whole.name}-lock"))
    try:
        _hold(descriptor, file)
        yield
    finally:
        os.close(descriptor)


def _opened(lock: Path) -> int:
    try:
        return os.open(lock, os.O_CREAT | os.O_RDWR, PRIVATE)
    except OSError as error:
        raise InvalidInput(f"{lock}: cannot be made ({error.strerror})") from None


def _hold(descriptor: int, file: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise InvalidInput(
            f"store {file}: another twin works on it; end that one first, or let several share a PostgreSQL"
        ) from None
