"""Retention: bodies of old windows are deleted; estimates, versions and receipts are kept for ever."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from servotwin.errors import InvalidInput
from servotwin.store.engine import SQLITE, transaction
from servotwin.store.schema import WINDOWS, bodies, evidence, messages
from servotwin.store.set_aside import without
from servotwin.store.store import Store

_PAGES = 512
"""Pages that are freed in one transaction: 4 MB."""


class RetentionResult(NamedTuple):
    """Numbers of windows that retention emptied and retained.

    Attributes
    ----------
    emptied, bytes : int
        Windows whose bodies were deleted, and the bytes of those bodies.
    retained : int
        Old windows that stay: an update is based on them, or they are not yet processed.
    """

    emptied: int
    bytes: int
    retained: int


def delete_old_bodies(
    store: Store,
    through: int,
    batch: int = 256,
    pause: Callable[[], None] | None = None,
    most: float = math.inf,
) -> RetentionResult:
    """Delete the bodies of windows up to a message.

    Windows that led to an update and unprocessed ones stay. The work is done in short transactions, with `pause` called
    between them, so that incoming messages do not wait. Interrupted, it continues at the next call.

    Parameters
    ----------
    store : Store
    through : int
        Number (id) of the last message that is old.
    batch : int
        Windows in one transaction.
    most : float
        Windows after which the rest is left to the next call, to within a batch.

    Raises
    ------
    StoreUnavailable
        Batches committed before stay deleted.
    """
    if batch < 1:
        raise InvalidInput(f"retention batch = {batch!r} windows: must be at least 1")
    total, after = RetentionResult(0, 0, 0), 0
    while total.emptied < most and (rows := _next(store, after, through, batch)):
        # Read and delete are separate transactions, so that reading does not hold the write lock.
        total = _add(total, _empty(store, rows))
        after = rows[-1].id
        if pause is not None:
            pause()
    return total


def _next(store: Store, after: int, through: int, batch: int) -> Sequence[Any]:
    with transaction(store.engines.reader) as connection:
        query = without(_OLD_WINDOWS, messages.c.servo, store.aside)
        return connection.execute(query, {"_after": after, "_through": through, "_batch": batch}).all()


def _empty(store: Store, old: Sequence[Any]) -> RetentionResult:
    deleted = [row for row in old if not row.stays]
    if deleted:
        ids = [row.id for row in deleted]
        with store.writing() as connection:
            connection.execute(sa.delete(bodies).where(bodies.c.message.in_(ids)))
        _shrink(store)
    return RetentionResult(len(deleted), sum(row.size for row in deleted), len(old) - len(deleted))


def _shrink(store: Store) -> None:
    """Return free pages to the file system; PostgreSQL reuses them by itself."""
    if store.engines.writer.dialect.name == SQLITE:
        with store.writing() as connection:
            # Each step frees one page and returns no row; the driver takes all steps only of a script.
            connection.connection.cursor().executescript(f"PRAGMA incremental_vacuum({_PAGES})")


def _add(one: RetentionResult, other: RetentionResult) -> RetentionResult:
    return RetentionResult(*(a + b for a, b in zip(one, other, strict=True)))


_LED_TO_UPDATE = sa.exists().where(evidence.c.message == messages.c.id, evidence.c.kind == "update")
_OLD_WINDOWS = (
    sa.select(
        messages.c.id,
        sa.func.length(bodies.c.body).label("size"),
        sa.or_(messages.c.done.is_(None), _LED_TO_UPDATE).label("stays"),
    )
    .select_from(bodies.join(messages, messages.c.id == bodies.c.message))
    .where(bodies.c.message > sa.bindparam("_after"), bodies.c.message <= sa.bindparam("_through"), WINDOWS)
    .order_by(bodies.c.message)
    .limit(sa.bindparam("_batch"))
)
