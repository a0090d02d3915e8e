"""Number of the newest message, noted beside the store: it tells whether the store has lost messages."""

from __future__ import annotations

from pathlib import Path

from servotwin.store.engine import POSTGRESQL, parse_address, sqlite_file
from servotwin.store.integrity import newest_message
from servotwin.store.store import Store

_MARK = "newest"


def lost_messages(store: Store, beside: Path) -> str:
    """Messages that a store had when a twin noted the newest one, and has no more; empty: none."""
    return loss(read_mark(mark_file(store, beside)), newest_message(store))


def lost_since(url: str, newest: int) -> str:
    """Messages that an SQLite store had once, where its newest one now is `newest`; empty: none."""
    file = sqlite_file(parse_address(url))
    return "" if file is None else loss(read_mark(_beside(file)), newest)


def loss(had: int, has: int) -> str:
    """Messages that a store has lost whose newest one was number `had` and is `has`; empty: none."""
    return f"its newest message is number {has}, and it once had number {had}" if has < had else ""


def mark_file(store: Store, beside: Path) -> Path | None:
    """File with the number of the newest message; None: the store is in memory."""
    shared = store.engines.writer.dialect.name == POSTGRESQL
    file = beside if shared else sqlite_file(store.engines.writer.url)
    return None if file is None else _beside(file)


def _beside(file: Path) -> Path:
    return file.with_name(f"{file.name}-{_MARK}")


def read_mark(file: Path | None) -> int:
    """Id in the file; 0: there is none, or it cannot be read."""
    try:
        return 0 if file is None else int(file.read_text())
    except (OSError, ValueError):
        return 0
