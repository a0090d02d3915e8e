"""Locks between processes: they end with whoever holds them, however that ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.runtime.locks import lock_beside, locked
from servotwin.store.engine import parse_address, sqlite_file


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
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(lock_beside(file)))
        except BlockingIOError:
            raise InvalidInput(
                f"store {file}: another twin works on it; end that one first, or let several share a PostgreSQL"
            ) from None
        except OSError as error:
            raise InvalidInput(f"{lock_beside(file)}: cannot be made ({error.strerror})") from None
        yield


@contextmanager
def in_turn(file: Path) -> Iterator[None]:
    """Change a file after whoever else is changing it; raises InvalidInput where nothing can be made beside it."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(lock_beside(file), wait=True))
        except OSError as error:
            raise InvalidInput(f"{lock_beside(file)}: cannot be made ({error.strerror})") from None
        yield
