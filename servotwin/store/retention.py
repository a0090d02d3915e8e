"""What may be forgotten: bodies of old windows. Estimates, versions and receipts are kept for ever."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.store.address import SQLITE
from servotwin.store.engine import transaction
from servotwin.store.schema import WINDOWS, bodies, evidence, messages
from servotwin.store.store import Store

_PAGES = 512


class Forgotten(NamedTuple):
    """What retention did.

    Attributes
    ----------
    emptied, bytes : int
        Windows whose bodies are gone, and how much that was.
    kept : int
        Old windows that it left: an update stands on them, or they are not yet processed.
    """

    emptied: int
    bytes: int
    kept: int


def forget(store: Store, before: float, batch: int = 256, pause: Callable[[], None] | None = None) -> Forgotten:
    """Empty the windows received before a time.

    Those that led to an update stay, and those that are not yet processed. The work is done in short transactions, with
    `pause` called between them, so that what comes in meanwhile does not wait; ended early, it goes on next time.

    Parameters
    ----------
    store : Store
    before : float
        s since the epoch.
    batch : int
        Windows in one transaction.

    Raises
    ------
    StoreUnavailable
        What was done until then stays done.
    """
    if batch < 1:
        raise InvalidInput(f"retention batch = {batch!r} windows: must be at least 1")
    total, after = Forgotten(0, 0, 0), 0
    while rows := _next(store, after, batch):
        old = [row for row in rows if row.received < before]
        # Ids rise with time, but for clocks that were set back: a whole batch of newer ones is the end.
        if not old:
            break
        total = _add(total, _empty(store, old))
        after = rows[-1].id
        if pause is not None:
            pause()
    return total


def _next(store: Store, after: int, batch: int) -> Sequence[Any]:
    with transaction(store.engines.reader) as connection:
        return connection.execute(_HELD, {"_after": after, "_batch": batch}).all()


def _empty(store: Store, old: Sequence[Any]) -> Forgotten:
    leaving = [row for row in old if not row.stays]
    if leaving:
        gone = [row.id for row in leaving]
        with transaction(store.engines.writer) as connection:
            connection.execute(sa.delete(bodies).where(bodies.c.message.in_(gone)))
        _shrink(store)
    return Forgotten(len(leaving), sum(row.size for row in leaving), len(old) - len(leaving))


def _shrink(store: Store) -> None:
    """Give pages that are free back to the file system; PostgreSQL uses them again by itself."""
    if store.engines.writer.dialect.name == SQLITE:
        with transaction(store.engines.writer) as connection:
            # Each step of it frees one page, and it gives no rows: only as a script does the driver take all steps.
            connection.connection.cursor().executescript(f"PRAGMA incremental_vacuum({_PAGES})")


def _add(one: Forgotten, other: Forgotten) -> Forgotten:
    return Forgotten(*(a + b for a, b in zip(one, other, strict=True)))


_LED = sa.exists().where(evidence.c.message == messages.c.id, evidence.c.kind == "update")
_HELD = (
    sa.select(
        messages.c.id,
        messages.c.received,
        sa.func.length(bodies.c.body).label("size"),
        sa.or_(messages.c.done.is_(None), _LED).label("stays"),
    )
    .select_from(bodies.join(messages, messages.c.id == bodies.c.message))
    .where(bodies.c.message > sa.bindparam("_after"), WINDOWS)
    .order_by(bodies.c.message)
    .limit(sa.bindparam("_batch"))
)
