"""Gaps in the times at which messages were received: silence, or a clock that was set forward.

Which of the two a gap was cannot be told. So the age of a message does not count it: nothing becomes old because a
clock was wrong, and after a long silence messages only stay for longer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import sqlalchemy as sa

from servotwin.store.engine import transaction
from servotwin.store.schema import messages
from servotwin.store.store import Store

_LONGEST_GAP = 0.1
"""Share of an age; a longer gap is not counted beyond it."""


class _Receipt(NamedTuple):
    """A message's id, and when it was received, s since the epoch."""

    id: int
    received: float


def received_before(store: Store, now: float, age: float) -> float:
    """Time before which messages are older than `age`, without the gaps in between.

    Parameters
    ----------
    store : Store
    now : float
        s since the epoch, on a clock that may be wrong.
    age : float
        s. Of a gap in the times of receipt, a tenth of that counts.

    Returns
    -------
    float
        s since the epoch; -inf where the store has no messages.
    """
    with transaction(store.engines.reader) as connection:
        first, last = (_receipt(connection, query) for query in (_FIRST, _LAST))
        if first is None or last is None:
            return -float("inf")

        def between(one: _Receipt, other: _Receipt) -> _Receipt | None:
            lower = _receipt(connection, _UP_TO, (one.id + other.id) // 2) or one
            inner = lower if lower.id > one.id else _receipt(connection, _FROM, one.id + 1) or other
            return inner if inner.id < other.id else None

        longest = _LONGEST_GAP * age
        gaps = [(last.received, now), *_gaps(first, last, longest, between)]
    before = now - age
    for begin, end in gaps:
        if end > before and end - begin > longest:
            before -= end - begin - longest
    return before


def _gaps(
    first: _Receipt, last: _Receipt, longest: float, between: Callable[[_Receipt, _Receipt], _Receipt | None]
) -> Iterator[tuple[float, float]]:
    """Yield the longer gaps between two messages, the latest one first; few messages are read, by halving."""
    if last.received - first.received <= longest:
        return
    middle = between(first, last)
    if middle is None:
        yield first.received, last.received
        return
    if middle.received > last.received:
        # It came on a clock that was ahead, and was set back since: it is as old as the first one after that.
        middle = middle._replace(received=_set_back(middle, last, between).received)
    yield from _gaps(middle, last, longest, between)
    yield from _gaps(first, middle, longest, between)


def _set_back(ahead: _Receipt, last: _Receipt, between: Callable[[_Receipt, _Receipt], _Receipt | None]) -> _Receipt:
    """The first message, as far as halving tells, that was received no later than `last`, after one that was."""
    first, until = ahead, last
    while (middle := between(first, until)) is not None:
        first, until = (middle, until) if middle.received > last.received else (first, middle)
    return until


def _receipt(connection: sa.Connection, query: sa.Select[tuple[int, float]], id_: int = 0) -> _Receipt | None:
    row = connection.execute(query, {"_id": id_}).one_or_none()
    return None if row is None else _Receipt(row.id, row.received)


_RECEIVED = sa.select(messages.c.id, messages.c.received).limit(1)
_ALL = _RECEIVED.where(messages.c.id > 0)  # so that a plan names the key, by which the first row ends the search
_FIRST, _LAST = _ALL.order_by(messages.c.id), _ALL.order_by(messages.c.id.desc())
_FROM = _RECEIVED.where(messages.c.id >= sa.bindparam("_id")).order_by(messages.c.id)
_UP_TO = _RECEIVED.where(messages.c.id <= sa.bindparam("_id")).order_by(messages.c.id.desc())
